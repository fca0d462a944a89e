"""Recordings of the previous schema, for the import: a copy of one in the schema of this version.

The recording itself is never changed, so the webots-mcp that made it can still use it.
"""

from __future__ import annotations

import glob
import shutil
import sqlite3
import tempfile
from collections.abc import Generator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final

from webots_mcp.contract import DATABASE_NAME, PREVIOUS_SCHEMA_VERSION
from webots_mcp.database.connection import FrozenConnection, connect
from webots_mcp.database.schema import create_schema, require_shipped, schema_version, statements_of

PREVIOUS_SCHEMA_FILE: Final = Path(__file__).with_name(f"schema_{PREVIOUS_SCHEMA_VERSION}.sql")


@contextmanager
def in_current_schema(database: Path) -> Generator[Path]:
    """Give a database to read a recording from: itself, or a copy for the duration of the block.

    Only a recording of the previous schema is copied. Pictures stay where they are.

    Raises:
        DatabaseError: The recording does not exist, or its tables are not ours.
    """
    try:
        with closing(connect(database, "reader")) as connection:
            version = schema_version(connection)
            is_frozen = isinstance(connection, FrozenConnection)
    except sqlite3.Error:  # reading it reports what is wrong with it
        version, is_frozen = 0, False
    if version != PREVIOUS_SCHEMA_VERSION:
        yield database
        return
    with tempfile.TemporaryDirectory(prefix="webots-mcp-") as folder:
        copy = Path(folder) / DATABASE_NAME
        _copy_rows(database, copy, is_frozen=is_frozen)
        for file in database.parent.glob(f"{glob.escape(database.name)}-*"):
            suffix = file.name[len(database.name) :]
            # They belong to SQLite. All other files whose names begin with that of the database
            # hold rows.
            if suffix not in ("-wal", "-shm", "-journal"):
                shutil.copyfile(file, f"{copy}{suffix}")
        yield copy


def _copy_rows(database: Path, copy: Path, *, is_frozen: bool) -> None:
    """Make a database of the current schema with the rows of another one."""
    frozen = "&immutable=1" if is_frozen else ""
    with closing(connect(copy, "writer", create=True)) as connection:
        create_schema(connection)
        connection.execute("PRAGMA journal_mode=DELETE")
        connection.execute("PRAGMA synchronous=OFF")  # a copy that a power cut damages is discarded
        connection.execute("PRAGMA foreign_keys=OFF")
        connection.execute(
            "ATTACH DATABASE ? AS old", (f"{database.absolute().as_uri()}?mode=ro{frozen}",)
        )
        previous = statements_of(PREVIOUS_SCHEMA_FILE)
        require_shipped(connection, schema="old", statements=previous)
        connection.execute("BEGIN")
        connection.execute("DELETE FROM main.recording")
        for table in _tables(connection):
            columns = ", ".join(_shared_columns(connection, table))
            connection.execute(
                f"INSERT INTO main.{table} ({columns}) SELECT {columns} FROM old.{table}"
            )
        connection.execute("COMMIT")


def _tables(connection: sqlite3.Connection) -> list[str]:
    """Return the tables of the current schema that the other database has too."""
    query = "SELECT name FROM main.sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
    names = [name for (name,) in connection.execute(query) if name not in ("alembic_version",)]
    statement = "SELECT name FROM old.sqlite_master WHERE type = 'table' AND name = ?"
    return [name for name in names if connection.execute(statement, (name,)).fetchone()]


def _shared_columns(connection: sqlite3.Connection, table: str) -> list[str]:
    statement = "SELECT name FROM pragma_table_info(?, ?)"
    main, old = (
        [name for (name,) in connection.execute(statement, (table, schema))]
        for schema in ("main", "old")
    )
    return [name for name in main if name in old]
