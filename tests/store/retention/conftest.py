"""A recording in memory that is pruned."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.memory import memory_connection
from tests.recordings.runs import Recorded
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema

TABLES = ("state", "chunk", "row_group", "log", "event", "image", "command", "run", "session")


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    with memory_connection() as connection:
        yield Recorded(connection, tmp_path)


@pytest.fixture
def filed(tmp_path: Path) -> Iterator[Recorded]:
    """Two runs of 20 rows in a file."""
    with closing(connect(tmp_path / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        recorded = Recorded(connection, tmp_path)
        for _ in range(2):
            recorded.add_run(20)
        yield recorded
