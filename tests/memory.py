"""Databases in memory for tests: empty ones, and copies of one that takes long to fill."""

from __future__ import annotations

import sqlite3
from collections.abc import Generator
from contextlib import closing, contextmanager
from functools import cache

from webots_mcp.contract import new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.location import MemoryDatabase
from webots_mcp.database.schema import create_schema


@contextmanager
def memory_connection(filled: sqlite3.Connection | None = None) -> Generator[sqlite3.Connection]:
    """A connection to a database without a row, or to a copy of a filled one.

    Either is a recording of its own: no other has its UUID.
    """
    with closing(MemoryDatabase()) as database, closing(connect(database, "writer")) as connection:
        (filled or _empty()).backup(connection)
        connection.execute("UPDATE recording SET uuid = ?", (new_uuid(),))
        yield connection


@cache
def _empty() -> sqlite3.Connection:
    """What all others are copied from: to make the tables takes ten times as long."""
    connection = sqlite3.connect(":memory:", isolation_level=None)
    create_schema(connection)
    return connection
