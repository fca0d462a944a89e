"""A recording of the schema before this one."""

import sqlite3
from contextlib import closing
from pathlib import Path

from webots_mcp.connection import OLDER_SCHEMA, connect, create_schema


def make_older(file: Path) -> None:
    """Make a recording that says of itself that it is one."""
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        connection.execute(f"PRAGMA user_version = {OLDER_SCHEMA}")


def record_older(file: Path) -> None:
    """A small one as webots-mcp made it then; of its first run the first 30 states are deleted."""
    text = Path(__file__).parent / "recordings" / "schema_9.sql"
    with closing(sqlite3.connect(file)) as connection:
        connection.executescript(text.read_text("utf-8"))
