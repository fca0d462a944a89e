"""Databases in memory for tests."""

from __future__ import annotations

import sqlite3
from collections.abc import Generator
from contextlib import closing, contextmanager

from webots_mcp.connection import connect
from webots_mcp.contract import MemoryDatabase
from webots_mcp.schema import create_schema


@contextmanager
def memory_connection() -> Generator[sqlite3.Connection]:
    """A connection to a database of the current schema without a row."""
    with closing(MemoryDatabase()) as database, closing(connect(database, "writer")) as connection:
        create_schema(connection)
        yield connection
