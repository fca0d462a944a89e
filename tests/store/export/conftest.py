"""Recordings in memory that are exported."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import Recorder, start_run
from tests.recordings.runs import Recorded


@pytest.fixture
def recorder() -> Iterator[Recorder]:
    with memory_connection() as connection:
        yield start_run(connection)


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    with memory_connection() as connection:
        yield Recorded(connection, tmp_path)
