"""The tables and views of a pool in PostgreSQL, and connections to it.

The tables are made from the models of those of a recording. What differs: the recording's UUID
comes before every key, integers have 64 bits, and JSON is json, which holds the text as it came. A
pool outlives what retention deletes at the edge, and has runs of which another recording shipped
the rest: so rows may refer to what is not there, names may come again, and there are no foreign
keys and no unique columns but the keys and the UUIDs of runs, of which each is in a pool once. Some
views of a recording are there, by the same names, with its UUID.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import Any, Final, TypeAlias

import psycopg
import sqlalchemy as sa
from sqlalchemy.dialects import postgresql
from sqlmodel import SQLModel

from webots_mcp.connection import shipped_objects
from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.errors import PoolError, PoolUnavailableError
from webots_mcp.plugins.pool.pool_interface import Table, tables
from webots_mcp.store.models import STATISTICS

Connection: TypeAlias = "psycopg.Connection[tuple[Any, ...]]"

# A server that went away is noticed within a minute, on both sides.
_CLIENT: Final[dict[str, Any]] = {
    "connect_timeout": 10, "keepalives_idle": 30, "keepalives_interval": 10, "keepalives_count": 3,
    "tcp_user_timeout": 60_000, "client_encoding": "UTF8",
    "fallback_application_name": "webots-mcp",
}  # fmt: skip
_SERVER: Final = """
    SET tcp_keepalives_idle = 30; SET tcp_keepalives_interval = 10; SET tcp_keepalives_count = 3;
    SET idle_in_transaction_session_timeout = '60s'; SET lock_timeout = '30s';
    SET synchronous_commit = on"""
# What is said of a connection that is not made for reasons that last.
_LASTING: Final = re.compile(
    "password|authentication|does not exist|permission denied|pg_hba|certificate|"
    "definition of service|invalid|not allowed|no encryption",
    re.IGNORECASE,
)
# Classes of SQLSTATE, and some of their members, after which the same may succeed.
_PASSING: Final = ("08", "40", "53", "57", "58", "55P03", "25P03", "XX")
_PRIVILEGE: Final = "42501"
_THERE_ALREADY: Final = ("42P07", "42723")  # a table, a function


def connect(url: str, address: str) -> Connection:
    """Connect to the database of a URL; libpq looks for passwords where it always does.

    Raises:
        PoolUnavailableError: Nobody answers.
        PoolError: Who answers does not let us in.
    """
    connection = _connected(url, address)
    if isinstance(connection, PoolError):
        raise connection
    with clear_errors(address):
        connection.execute(_SERVER.encode())
    return connection


def _connected(url: str, address: str) -> Connection | PoolError:
    """A connection, or why there is none.

    That is not raised here, as psycopg's error would go with it, which holds the password.
    """
    try:
        return psycopg.connect(url, autocommit=True, **_CLIENT)
    except psycopg.Error as error:
        said = one_line(str(error))
        if error.pgconn is not None and error.pgconn.needs_password:
            return PoolError(
                f"{address} asks for a password: give it in PGPASSWORD, ~/.pgpass or a service file"
            )
        if isinstance(error, psycopg.ProgrammingError) or _LASTING.search(said):
            return PoolError(f"{address} refuses the connection: {said}")
        return PoolUnavailableError(f"{address} does not answer: {said}")


@contextmanager
def clear_errors(address: str) -> Generator[None]:
    """Inside the block, errors of PostgreSQL are ours; their texts hold no values of rows."""
    try:
        yield
    except psycopg.Error as error:
        raise _explained(error, address) from None


def _explained(error: psycopg.Error, address: str) -> PoolError:
    state = error.sqlstate or ""
    said = one_line(error.diag.message_primary or str(error))
    is_lost = not state and isinstance(error, psycopg.OperationalError)  # the connection
    if state == _PRIVILEGE:
        return PoolError(f"{address} forbids it: {said}; see docs/pool.md for what to grant")
    if state in _THERE_ALREADY:
        return PoolError(
            f"{address} holds tables of something else that are called as those of a pool ({said}):"
            " give a database of its own, or a schema of its own by "
            "'?options=-csearch_path%3DNAME' in the URL"
        )
    if state.startswith(_PASSING) or is_lost:
        return PoolUnavailableError(f"{address} could not do it now: {said}")
    return PoolError(f"{address} refused it: {said}")


def one_line(text: str) -> str:
    """A text without line breaks, and without the advice for beginners that libpq indents."""
    lines = (line for line in text.splitlines() if not line.startswith("\t"))
    return " ".join(" ".join(lines).split())


# -- tables -----------------------------------------------------------------------------------

OWNER: Final = "recording_uuid"
VERSION: Final = "pool_version"
_LOCK: Final = 7_463_962_947  # of whoever makes tables: any number that nobody else takes

# What a pool has beside the tables of a recording.
_OWN: Final = f"""
CREATE TABLE {VERSION} AS SELECT '{SCHEMA_VERSION}' AS version_num;
CREATE TABLE progress (
  {OWNER} uuid NOT NULL,
  name text NOT NULL,
  value bigint NOT NULL,
  PRIMARY KEY ({OWNER}, name)
);
COMMENT ON TABLE progress IS 'how far each recording was shipped';
CREATE TABLE picture (
  {OWNER} uuid NOT NULL,
  path text NOT NULL,
  content bytea NOT NULL,
  PRIMARY KEY ({OWNER}, path)
);
ALTER TABLE picture ALTER content SET STORAGE EXTERNAL;
COMMENT ON TABLE picture IS 'the files of image, where they were shipped';
"""


def prepare(url: str, address: str) -> None:
    """Make the tables of a pool where there are none; of several at once, one does it.

    Raises:
        PoolUnavailableError: Nobody answers there.
        PoolError: The tables are older, newer or none of ours, or the role lacks a right.
    """
    with connect(url, address) as connection, clear_errors(address):
        if _is_pool(connection):
            return require_current(connection, address)
        with connection.transaction():
            connection.execute("SELECT pg_advisory_xact_lock(%s)", (_LOCK,))
            if not _is_pool(connection):  # else another was faster
                for statement in (*_table_statements(), _OWN, *_view_statements()):
                    connection.execute(statement.encode())


def require_current(connection: Connection, address: str) -> None:
    """Raise unless a pool of exactly this version is there.

    Raises:
        PoolError: There is none, or an older or a newer one.
    """
    if not _is_pool(connection):
        raise PoolError(f"{address} holds no pool: nothing was shipped there yet")
    version = int(_first(connection, f"SELECT version_num FROM {VERSION}"))
    if version != SCHEMA_VERSION:
        raise PoolError(
            f"{address} has schema {version}, this webots-mcp {SCHEMA_VERSION}: use one version "
            "of it, or ship the recordings anew, into a database or a schema of its own "
            "('?options=-csearch_path%3DNAME' in the URL)"
        )


def _is_pool(connection: Connection) -> bool:
    there = f"SELECT to_regclass(format('%I.{VERSION}', current_schema())) IS NOT NULL"
    if _first(connection, "SELECT current_schema()") is None:
        raise PoolError("no schema on the search path exists, or may be used: name another one")
    return bool(_first(connection, there))


def _first(connection: Connection, sql: str) -> Any:
    row = connection.execute(sql.encode()).fetchone()
    return row[0] if row else None


def _table_statements() -> list[str]:
    """The statements that make the tables, with their indexes and the comments of their columns."""
    metadata, made = sa.MetaData(), list[str]()
    for each in tables():
        _pooled(metadata, SQLModel.metadata.tables[each.name], each)

    def note(statement: Any, *_: Any, **__: Any) -> None:
        made.append(str(statement.compile(dialect=engine.dialect)))

    engine = sa.create_mock_engine("postgresql+psycopg://", note)
    metadata.create_all(engine, checkfirst=False)
    return made


def _pooled(metadata: sa.MetaData, made: sa.Table, shipped: Table) -> sa.Table:
    columns = [_column(made.columns[name], shipped) for name in shipped.columns]
    owner = sa.Column(OWNER, postgresql.UUID(), nullable=False)
    constraint = sa.PrimaryKeyConstraint(OWNER, *shipped.key)
    pooled = sa.Table(made.name, metadata, owner, *columns, constraint)
    for index in sorted(made.indexes, key=str):
        indexed = [
            pooled.c[column.name]
            for column in index.columns
            if column.name == "uuid" or not isinstance(column.type, sa.Text)
            if column.name not in STATISTICS
        ]
        where = index.dialect_kwargs.get("postgresql_where")
        sa.Index(index.name, pooled.c[OWNER], *indexed, postgresql_where=where)
    if made.name == "run":
        sa.Index("run_is_there_once", pooled.c.uuid, unique=True)
    return pooled


def _column(column: sa.Column[Any], shipped: Table) -> sa.Column[Any]:
    kind: Any = column.type
    if column.name in shipped.json_columns:
        kind = postgresql.JSON()
    elif isinstance(kind, sa.Integer):
        kind = sa.BigInteger()
    default: Any = column.server_default
    return sa.Column(
        column.name, kind, nullable=column.nullable, comment=column.comment, autoincrement=False,
        server_default=default.arg if default is not None else None,
    )  # fmt: skip


# -- views ------------------------------------------------------------------------------------

_KEY: Final = OWNER
_NOW_S: Final = "extract(epoch FROM clock_timestamp())::double precision"


def _rounded(number: str, digits: int = 3) -> str:
    return f"round(({number})::numeric, {digits})::double precision"


_EPOCH_MS: Final = "210866760000000::double precision"  # from the first Julian day to 1970


def _utc(time: str) -> str:
    """As text, rounded to milliseconds by the same additions that SQLite's strftime makes."""
    seconds = f"(floor(({time}) * 1000 + {_EPOCH_MS} + 0.5) - {_EPOCH_MS}) / 1000"
    return f"to_char(to_timestamp({seconds}) AT TIME ZONE 'UTC', 'YYYY-MM-DD HH24:MI:SS.MS')"


def _robot_of(alias: str) -> str:
    return f"""(SELECT r.name FROM run u JOIN robot r USING ({_KEY})
    WHERE u.{_KEY} = {alias}.{_KEY} AND u.id = {alias}.run_id AND r.id = u.robot_id) AS robot"""


VIEWS: Final = {
    "robot_run": f"""SELECT u.{_KEY}, r.name AS robot, u.id AS run_id, u.label,
  {_utc("u.started_wall_time_s")} AS started_utc,
  {_rounded("u.last_sim_time_s - u.started_sim_time_s")} AS duration_s,
  {_rounded("u.last_wall_time_s - u.started_wall_time_s")} AS wall_duration_s,
  {
        _rounded(
            "(u.last_sim_time_s - u.started_sim_time_s) / "
            "nullif(u.last_wall_time_s - u.started_wall_time_s, 0)"
        )
    } AS real_time_factor,
  u.row_count, u.purged_rows,
  {_rounded("u.row_count / nullif(u.last_sim_time_s - u.started_sim_time_s, 0)", 2)} AS rows_per_s,
  u.start_reason, u.end_reason, u.keep, u.note, u.world, s.controller, s.controller_sha256,
  s.git_commit, u.session_id
FROM run u JOIN robot r ON r.{_KEY} = u.{_KEY} AND r.id = u.robot_id
JOIN session s ON s.{_KEY} = u.{_KEY} AND s.id = u.session_id""",
    "robot_command": f"""SELECT c.{_KEY}, r.name AS robot, c.id AS command_id, c.action, c.params,
  c.status, {_utc("c.created_wall_time_s")} AS created_utc,
  {
        _rounded(
            "coalesce(c.claimed_wall_time_s, c.finished_wall_time_s, "
            + _NOW_S
            + ") - c.created_wall_time_s"
        )
    } AS waiting_s,
  {_rounded(f"coalesce(c.finished_wall_time_s, {_NOW_S}) - c.claimed_wall_time_s")} AS running_s,
  c.claimed_sim_time_s, c.finished_sim_time_s,
  CASE WHEN c.finished_sim_time_s >= c.claimed_sim_time_s /* a reset takes it back */
    THEN {_rounded("c.finished_sim_time_s - c.claimed_sim_time_s")} END AS running_sim_s,
  c.result, c.error, c.requested_by, c.session_id
FROM command c JOIN robot r ON r.{_KEY} = c.{_KEY} AND r.id = c.robot_id""",
    "robot_event": f"""SELECT e.{_KEY}, {_robot_of("e")},
  e.run_id, e.id AS event_id, e.sim_time_s, {_utc("e.wall_time_s")} AS utc, e.kind, e.name,
  e.data ->> 'from' AS from_value, e.data ->> 'to' AS to_value, e.data
FROM event e""",
    "robot_log": f"""SELECT l.{_KEY}, {_robot_of("l")},
  l.run_id, l.id AS log_id, l.sim_time_s, {_utc("l.wall_time_s")} AS utc, l.level, l.source,
  l.logger, l.message
FROM log l""",
    "robot_statistics": f"""SELECT g.{_KEY}, r.name AS robot, g.run_id, s.name AS signal,
  g.start_sim_time_s AS start_s, g.end_sim_time_s AS end_s, c.row_count, c.value_count, c.min,
  c.max, c.sum / nullif(c.value_count, 0) AS mean, c.first, c.last, c.largest_step, c.change_count
FROM chunk c JOIN row_group g ON g.{_KEY} = c.{_KEY} AND g.id = c.group_id
JOIN signal s ON s.{_KEY} = c.{_KEY} AND s.id = c.signal_id
JOIN robot r ON r.{_KEY} = s.{_KEY} AND r.id = s.robot_id""",
}


def _view_statements() -> Iterator[str]:
    """The statements that make the views, and say of each what a recording's schema says."""
    for name, query in VIEWS.items():
        comment = re.search(r"/\* (.*?) \*/", shipped_objects()[name], re.DOTALL)
        assert comment is not None, f"{name} has no comment"
        yield f"CREATE VIEW {name} AS\n{query}"
        yield f"COMMENT ON VIEW {name} IS '{comment[1].replace(chr(39), chr(39) * 2)}'"
