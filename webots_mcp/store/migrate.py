"""The schema as the migrations make it, and recordings of the schema before.

Run as a module it prints the text of `webots_mcp/schema.sql`: regenerate that with `make schema`.
"""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Generator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final

import sqlalchemy
from alembic import command
from alembic.config import Config
from sqlalchemy.pool import StaticPool

from webots_mcp.connection import FAILURES, OLDER_SCHEMA, text_of, transaction
from webots_mcp.contract import APPLICATION_ID, DATABASE_NAME, bundled
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.merging import small_recording
from webots_mcp.waiting_file import waiting_paths

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
    config.set_main_option("script_location", str(bundled("migrations")).replace("%", "%%"))
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
    print("".join(f"{each};\n" for each in generated_statements()), end="")  # noqa: T201


# Recordings of the schema before this one, copied into one of today, from which `merge` takes in.
#
# What was recorded comes over; rollups and changes do not. Chunks are made anew from the states
# that are left, so that of deleted ones nothing is searched: the run says how many they were, and
# answers name their time. The older file is only read.


# In an order in which what is referred to comes first.
_TABLES: Final = (
    "robot", "session", "run", "state", "kept_stretch", "kept_state", "log", "event", "image",
    "command", "breakpoint", "parameter", "parameter_value", "trial_set", "trial",
)  # fmt: skip
_FORMER_NAMES: Final[dict[str, str]] = {
    "session.pause_state": "hold",
    "session.mode_before_pause": "hold_mode",
    "session.last_adopted_entry": "adopted_rows",
    "session.end_reason": "replace(end_reason, 'replaced', 'superseded')",
    "run.end_reason": "replace(end_reason, 'replaced', 'superseded')",
    "run.row_count": "rows",
    "run.is_chunked": "0",
    "state.replaced": "odd",
    "kept_state.replaced": "odd",
    "image.size_bytes": "bytes",
    "breakpoint.hit_count": "hits",
}
_COLUMNS: Final = "SELECT name FROM pragma_table_info(?)"
_IS_TABLE: Final = (
    "SELECT count(*) FROM older.sqlite_master WHERE name = ? AND sql LIKE 'CREATE TABLE%'"
)
_BREAKPOINT: Final = (
    "condition, action, after_hits, enabled, hit_count, created_wall_time_s, created_by, error"
)
# Those of a controller's code it makes again. A recording that came before has brought them.
_COPY_BREAKPOINTS: Final = (
    f"INSERT INTO main.breakpoint (robot_id, {_BREAKPOINT}) SELECT h.id, {_BREAKPOINT} "
    "FROM source.breakpoint b JOIN source.robot r ON r.id = b.robot_id "
    "JOIN main.robot h ON h.name = r.name WHERE b.session_id IS NULL AND NOT EXISTS (SELECT 1 "
    "FROM main.breakpoint n WHERE n.robot_id = h.id AND n.condition = b.condition "
    "AND n.created_wall_time_s = b.created_wall_time_s) ORDER BY b.id"
)


def is_older(file: Path) -> bool:
    """Whether a file is a recording of the schema before this one."""
    try:
        with closing(sqlite3.connect(_address(file), uri=True)) as connection:
            return tuple(
                connection.execute(f"PRAGMA {name}").fetchone()[0]
                for name in ("application_id", "user_version")
            ) == (APPLICATION_ID, OLDER_SCHEMA)
    except FAILURES:
        return False  # who opens it as a recording says what it is


@contextmanager
def converted(file: Path) -> Generator[Path]:
    """A recording of today's schema with what an older one holds, for the duration of the block.

    Raises:
        InvalidInputError: Rows wait next to the file, or it is damaged.
    """
    if waiting := waiting_paths(file):
        raise InvalidInputError(
            f"rows wait next to {file} in {waiting[0].name}: let the webots-mcp that made it take "
            "them in (a controller's start does), and import it then"
        )
    with tempfile.TemporaryDirectory(prefix="webots-mcp-") as name:
        with small_recording(Path(name)) as connection:
            connection.execute("ATTACH DATABASE ? AS older", (_address(file),))
            try:
                with transaction(connection):
                    _copy(connection, file)
            except FAILURES as error:
                raise InvalidInputError(
                    f"{file} is damaged, or not as webots-mcp made it: {text_of(error)}"
                ) from error
        yield Path(name) / DATABASE_NAME


def copy_breakpoints(connection: sqlite3.Connection, source: Path) -> None:
    """Take in breakpoints that persons had set, of robots that are here under the same name."""
    connection.execute("ATTACH DATABASE ? AS source", (str(source),))
    try:
        connection.execute(_COPY_BREAKPOINTS)
    finally:
        connection.execute("DETACH DATABASE source")


def _copy(connection: sqlite3.Connection, file: Path) -> None:
    for table in _TABLES:
        # A view would run its author's SQL.
        if not connection.execute(_IS_TABLE, (table,)).fetchone()[0]:
            raise InvalidInputError(f"{file} has no table {table}, which each recording has")
        names = [str(name) for (name,) in connection.execute(_COLUMNS, (table,)).fetchall()]
        former = ", ".join(_FORMER_NAMES.get(f"{table}.{name}", name) for name in names)
        connection.execute(
            f"INSERT INTO main.{table} ({', '.join(names)}) SELECT {former} FROM older.{table}"
        )


def _address(file: Path) -> str:
    return f"{file.absolute().as_uri()}?mode=ro"
