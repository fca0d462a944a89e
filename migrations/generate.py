"""The schema as the migrations make it: `python -m migrations.generate` prints it.

Its text is `webots_mcp/database/schema.sql`, which `make schema` regenerates. The package makes a
recording by that file alone.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Final

import sqlalchemy
from alembic import command
from alembic.config import Config
from sqlalchemy.pool import StaticPool

_STAMPS: Final = ("application_id", "user_version")
# Each table, then its indexes by name; the views as they were made.
_MADE: Final = (
    "SELECT made.sql FROM sqlite_master made JOIN sqlite_master subject "
    "ON subject.name = made.tbl_name WHERE made.sql IS NOT NULL "
    "AND made.name NOT LIKE 'sqlite_%' ORDER BY subject.rowid, made.type = 'index', made.name"
)


def migration_config() -> Config:
    """Alembic's configuration; the connection is the caller's to add."""
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    return config


def generated_statements() -> list[str]:
    """The statements that make a recording, without its one row of `recording`."""
    with closing(sqlite3.connect(":memory:")) as connection:
        engine = sqlalchemy.create_engine(
            "sqlite://", creator=lambda: connection, poolclass=StaticPool
        )
        with engine.connect() as bound:
            config = migration_config()
            config.attributes["connection"] = bound
            command.upgrade(config, "head")
        pragmas = [f"PRAGMA {name} = {_only(connection, f'PRAGMA {name}')}" for name in _STAMPS]
        made = [str(sql).rstrip() for (sql,) in connection.execute(_MADE)]
        revision = _only(connection, "SELECT version_num FROM alembic_version")
        stamp = f"INSERT INTO alembic_version (version_num) VALUES ('{revision}')"
        return [*pragmas, *made, stamp]


def _only(connection: sqlite3.Connection, sql: str) -> str | int:
    return connection.execute(sql).fetchone()[0]


if __name__ == "__main__":
    print("".join(f"{each};\n" for each in generated_statements()), end="")
