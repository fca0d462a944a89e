"""Bringing a database to the schema of this version, by Alembic."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Generator
from typing import Final

import sqlalchemy
from alembic import command
from alembic.config import Config
from sqlalchemy import event
from sqlalchemy.pool import StaticPool

from webots_mcp.connection import connect
from webots_mcp.contract import SCHEMA_VERSION, Database, MemoryDatabase, bundled
from webots_mcp.schema import require_shipped, schema_version

_STAMPS: Final = ("application_id", "user_version")


def upgrade(database: Database, revision: str = "head") -> tuple[int, int]:
    """Bring the database forward; of several starters at once, one does it.

    Args:
        database: A file (made where missing) or a database in memory.
        revision: An Alembic revision, or "head".

    Returns:
        The schema version before and after.

    Raises:
        ForeignDatabaseError: The file belongs to another application, or holds what that version
            has not made.
        DatabaseError: The file cannot be opened.
    """
    with _alembic(database) as (config, connection):
        before = schema_version(connection)
        if 0 < before < SCHEMA_VERSION:
            require_shipped(connection, _statements(f"{before:04}"))
        command.upgrade(config, revision)
        return before, schema_version(connection)


def downgrade(database: Database, revision: str = "base") -> tuple[int, int]:
    """Bring the database back to an older revision; what the older schema lacks is deleted.

    Returns:
        The schema version before and after.
    """
    with _alembic(database) as (config, connection):
        before = schema_version(connection)
        command.downgrade(config, revision)
        return before, schema_version(connection)


@contextlib.contextmanager
def _alembic(database: Database) -> Generator[tuple[Config, sqlite3.Connection], None, None]:
    """An Alembic configuration bound to one connection whose transactions lock at once."""
    connection = connect(database, "writer", create=True)
    engine = sqlalchemy.create_engine("sqlite://", creator=lambda: connection, poolclass=StaticPool)
    # Two starters: the second waits here, then finds the newer revision and has nothing to do.
    event.listen(engine, "begin", _begin_immediate)
    try:
        with engine.connect() as bound:
            config = Config()
            config.set_main_option("script_location", str(bundled("migrations")).replace("%", "%%"))
            config.attributes["connection"] = bound
            yield config, connection
    finally:
        engine.dispose()
        connection.close()


def _begin_immediate(connection: sqlalchemy.Connection) -> None:
    connection.exec_driver_sql("BEGIN IMMEDIATE")


def _statements(revision: str = "head") -> list[str]:
    """What the migrations make of an empty database; at the end, that of `schema.sql`.

    Regenerate that with `python -m webots_mcp.store.migrate > webots_mcp/schema.sql`.
    """
    with _alembic(MemoryDatabase()) as (config, connection):
        command.upgrade(config, revision)
        pragmas = [f"PRAGMA {name} = {_pragma(connection, name)}" for name in _STAMPS]
        rows = connection.execute(
            "SELECT sql FROM sqlite_master WHERE sql IS NOT NULL AND name NOT LIKE 'sqlite_%' "
            "ORDER BY rowid"
        )
        revision = connection.execute("SELECT version_num FROM alembic_version").fetchone()[0]
        stamp = f"INSERT INTO alembic_version (version_num) VALUES ('{revision}')"
        return [*pragmas, *(str(sql).rstrip() for (sql,) in rows), stamp]


def _pragma(connection: sqlite3.Connection, name: str) -> int:
    return int(connection.execute(f"PRAGMA {name}").fetchone()[0])


if __name__ == "__main__":
    print("".join(f"{each};\n" for each in _statements()), end="")  # noqa: T201
