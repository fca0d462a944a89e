"""One recording by the real bridge, and copies of it to change."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.data.recorded import record
from webots_mcp.connection import connect


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The database of two runs of the rover; do not change it."""
    return record(tmp_path_factory.mktemp("recorded"))


@pytest.fixture
def reader(recorded: Path) -> Iterator[sqlite3.Connection]:
    with closing(connect(recorded, "reader")) as connection:
        yield connection
