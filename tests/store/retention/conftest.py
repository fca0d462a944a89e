"""A recording in memory that is pruned."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.memory import memory_connection
from tests.recordings.runs import Recorded

TABLES = ("state", "chunk", "row_group", "log", "event", "image", "command", "run", "session")


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    with memory_connection() as connection:
        yield Recorded(connection, tmp_path)
