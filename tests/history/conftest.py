"""The known recording, in memory, rolled up or not."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator

import pytest

from tests.history.recording import record_rover
from webots_mcp.connection import connect
from webots_mcp.contract import MemoryDatabase
from webots_mcp.schema import create_schema
from webots_mcp.store.history.rollup import roll


@pytest.fixture
def empty() -> Iterator[sqlite3.Connection]:
    """A database of the current schema without a row."""
    database = MemoryDatabase()
    connection = connect(database, "writer")
    create_schema(connection)
    yield connection
    connection.close()
    database.close()


@pytest.fixture(scope="session")
def _recorded() -> Iterator[dict[str, sqlite3.Connection]]:
    databases = [MemoryDatabase(), MemoryDatabase()]
    made: dict[str, sqlite3.Connection] = {}
    for name, database in zip(("raw", "rolled"), databases, strict=True):
        made[name] = connect(database, "writer")
        create_schema(made[name])
        record_rover(made[name])
    assert roll(made["rolled"], 100_000).done
    yield made
    for connection in made.values():
        connection.close()
    for database in databases:
        database.close()


@pytest.fixture(params=["raw", "rolled"])
def rover(
    request: pytest.FixtureRequest, _recorded: dict[str, sqlite3.Connection]
) -> sqlite3.Connection:
    """The known recording; every answer has to be the same before and after rolling up."""
    return _recorded[request.param]
