"""The tables and views of a pool in PostgreSQL, and connections to it.

The tables are made from the models of those of a recording. What differs: the recording's UUID
comes before every key, integers have 64 bits, JSON is jsonb, and appended tables are partitioned by
wall time, a month each. A pool outlives what retention deletes at the edge, and has runs of which
another recording shipped the rest: so rows may refer to what is not there, names may come again,
and there are no foreign keys and no unique columns but the keys. `run_owner` holds that a run is in
a pool once. The views are those of a recording, by the same names, with its UUID.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from typing import Any, Final, TypeAlias

import psycopg
import sqlalchemy as sa
from sqlalchemy.dialects import postgresql
from sqlmodel import SQLModel

from webots_mcp.connection import shipped_objects
from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.errors import PoolError, PoolUnavailableError
from webots_mcp.naming import METRES
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
_READ_ONLY: Final = "25006"
_FULL: Final = "53100"
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
    if state == _READ_ONLY:
        return PoolError(
            f"{address} is read-only ({said}): a standby, or a database or role that is set so; "
            "give the URL of the primary, and a role that may write"
        )
    if state in _THERE_ALREADY:
        return PoolError(
            f"{address} holds tables of something else that are called as those of a pool ({said}):"
            " give a database of its own, or a schema of its own by "
            "'?options=-csearch_path%3DNAME' in the URL"
        )
    if state == _FULL:
        return PoolUnavailableError(f"the disk of {address} is full: {said}")
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
FIRST_YEAR: Final = 2000
LAST_YEAR: Final = 2099
FIRST_S: Final = datetime(FIRST_YEAR, 1, 1, tzinfo=timezone.utc).timestamp()
END_S: Final = datetime(LAST_YEAR + 1, 1, 1, tzinfo=timezone.utc).timestamp()
_LOCK: Final = 7_463_962_947  # of whoever makes tables: any number that nobody else takes

# What a pool has beside the tables of a recording. `make_partition` belongs to the owner of the
# tables, so that whoever ships need not own them.
_OWN: Final = f"""
CREATE TABLE {VERSION} AS SELECT '{SCHEMA_VERSION}' AS version_num;
CREATE TABLE shipment (
  {OWNER} uuid PRIMARY KEY,
  replaced_values bigint NOT NULL DEFAULT 0,
  shipped_wall_time_s double precision
);
CREATE TABLE progress (
  {OWNER} uuid NOT NULL,
  name text NOT NULL,
  value bigint NOT NULL,
  PRIMARY KEY ({OWNER}, name)
);
COMMENT ON TABLE progress IS 'how far each recording was shipped';
COMMENT ON COLUMN shipment.replaced_values IS 'values that PostgreSQL cannot hold as they were';
CREATE TABLE run_owner (
  uuid text PRIMARY KEY,
  {OWNER} uuid NOT NULL
);
COMMENT ON TABLE run_owner IS 'which recording shipped a run first: it is in the pool once';
CREATE TABLE picture (
  {OWNER} uuid NOT NULL,
  path text NOT NULL,
  content bytea NOT NULL,
  PRIMARY KEY ({OWNER}, path)
);
ALTER TABLE picture ALTER content SET STORAGE EXTERNAL;
COMMENT ON TABLE picture IS 'the files of image, where they were shipped';

CREATE FUNCTION as_jsonb(json text) RETURNS jsonb LANGUAGE plpgsql IMMUTABLE STRICT AS $$
BEGIN
  RETURN json::jsonb;
EXCEPTION WHEN OTHERS THEN
  RETURN to_jsonb(json);  -- malformed, or with a \\u0000, which jsonb cannot hold
END $$;

CREATE FUNCTION make_partition(parent text, year integer, month integer) RETURNS void
LANGUAGE plpgsql SECURITY DEFINER AS $$
DECLARE
  part text := format('%s_%s_%s', parent, year, lpad(month::text, 2, '0'));
  start timestamptz := make_timestamptz(year, month, 1, 0, 0, 0, 'UTC');
BEGIN
  IF NOT EXISTS (SELECT 1 FROM pg_partitioned_table p JOIN pg_class c ON c.oid = p.partrelid
      WHERE c.relname = parent AND c.relnamespace = current_schema()::regnamespace)
      OR year NOT BETWEEN {FIRST_YEAR} AND {LAST_YEAR} THEN
    RAISE EXCEPTION 'no table % of a pool, or no month % of %', parent, month, year;
  END IF;
  PERFORM pg_advisory_xact_lock({_LOCK});
  IF to_regclass(quote_ident(part)) IS NULL THEN
    -- Made apart and attached, it keeps nobody from reading and writing the others.
    EXECUTE format('CREATE TABLE %I (LIKE %I INCLUDING ALL)', part, parent);
    EXECUTE format('ALTER TABLE %I ATTACH PARTITION %I FOR VALUES FROM (%s) TO (%s)', parent, part,
      extract(epoch FROM start), extract(epoch FROM (start AT TIME ZONE 'UTC' + interval '1 month')
        AT TIME ZONE 'UTC'));
  END IF;
END $$;
DO $$
BEGIN  -- as the owner it must not meet what the caller made under these names
  EXECUTE format('ALTER FUNCTION make_partition SET search_path = %I, pg_temp', current_schema());
END $$;
REVOKE ALL ON FUNCTION make_partition FROM PUBLIC;
"""
_OUTER_PARTITIONS: Final = (
    f"CREATE TABLE {{0}}_before_{FIRST_YEAR} PARTITION OF {{0}} "
    f"FOR VALUES FROM (MINVALUE) TO ({FIRST_S})",
    f"CREATE TABLE {{0}}_after_{LAST_YEAR} PARTITION OF {{0}} "
    f"FOR VALUES FROM ({END_S}) TO (MAXVALUE)",
)


def prepare(url: str, address: str) -> None:
    """Make the tables of a pool where there are none; of several at once, one does it.

    Raises:
        PoolUnavailableError: Nobody answers there.
        PoolError: The tables are older, newer or none of ours, or the role lacks a right.
    """
    with connect(url, address) as connection, clear_errors(address):
        if _is_pool(connection):
            return require_current(connection, address)
        if (encoding := _first(connection, "SHOW server_encoding")) != "UTF8":
            raise PoolError(
                f"the database of {address} has the encoding {encoding}, which lacks letters: "
                "make one with CREATE DATABASE ... ENCODING 'UTF8' TEMPLATE template0"
            )
        with connection.transaction():
            connection.execute("SELECT pg_advisory_xact_lock(%s)", (_LOCK,))
            if not _is_pool(connection):  # else another was faster
                for statement in (*_table_statements(), _OWN, _FUNCTIONS, *_view_statements()):
                    connection.execute(statement.encode())


def require_current(connection: Connection, address: str) -> None:
    """Raise unless a pool of exactly this version is there.

    Raises:
        PoolError: There is none, or an older or a newer one.
    """
    if not _is_pool(connection):
        raise PoolError(f"{address} holds no pool: nothing was shipped there yet")
    version = int(_first(connection, f"SELECT version_num FROM {VERSION}"))
    if version > SCHEMA_VERSION:
        raise PoolError(
            f"the pool has schema {version}, this webots-mcp knows {SCHEMA_VERSION}: "
            "upgrade it with 'pip install --upgrade', from where it was installed"
        )
    if version < SCHEMA_VERSION:
        raise PoolError(
            f"{address} has schema {version}, of an older webots-mcp: ship the recordings anew, "
            "into a database or a schema of its own ('?options=-csearch_path%3DNAME' in the URL)"
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
    for each in tables():
        made += [outer.format(each.name) for outer in _OUTER_PARTITIONS if each.time_column]
    return made


def _pooled(metadata: sa.MetaData, made: sa.Table, shipped: Table) -> sa.Table:
    key = [OWNER, *shipped.key]
    options: dict[str, Any] = {}
    if shipped.time_column:
        key.append(shipped.time_column)
        options["postgresql_partition_by"] = f"RANGE ({shipped.time_column})"
    columns = [_column(made.columns[name], shipped) for name in shipped.columns]
    owner = sa.Column(OWNER, postgresql.UUID(), nullable=False)
    constraint = sa.PrimaryKeyConstraint(*key)
    pooled = sa.Table(made.name, metadata, owner, *columns, constraint, **options)
    for index in sorted(made.indexes, key=str):
        indexed = [
            pooled.c[column.name]
            for column in index.columns
            if column.name == "uuid" or not isinstance(column.type, sa.Text)
            if column.name not in STATISTICS
        ]
        where = index.dialect_kwargs.get("postgresql_where")
        sa.Index(index.name, pooled.c[OWNER], *indexed, postgresql_where=where)
    return pooled


def _column(column: sa.Column[Any], shipped: Table) -> sa.Column[Any]:
    kind: Any = column.type
    if column.name in shipped.json_columns:
        kind = postgresql.JSONB()
    elif isinstance(kind, sa.Integer):
        kind = sa.BigInteger()
    default: Any = column.server_default
    return sa.Column(
        column.name, kind, nullable=column.nullable, comment=column.comment, autoincrement=False,
        server_default=default.arg if default is not None else None,
    )  # fmt: skip


# -- views ------------------------------------------------------------------------------------

# From the first Julian day to 1970: SQLite adds it before it rounds, and so loses some digits.
_JULIAN_MS: Final = "210866760000000.0::double precision"

# Functions are found by name when a view is asked: so they keep the search path they were made in.
_FUNCTIONS: Final = rf"""
CREATE FUNCTION utc_text(wall_time_s double precision) RETURNS text
LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT CASE WHEN wall_time_s BETWEEN -62135596800 AND 253402300799
    THEN to_char(timestamp '1970-01-01' + interval '1 ms' * (
      floor(wall_time_s * 1000 + {_JULIAN_MS} + 0.5) - {_JULIAN_MS}), 'YYYY-MM-DD HH24:MI:SS.MS')
    END $$;

CREATE FUNCTION rounded(number double precision, digits integer)
RETURNS double precision LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT round(number::numeric, digits)::double precision $$;

-- A JSON value as SQLite's json_extract gives it: true and false are 1 and 0.
CREATE FUNCTION text_of(value jsonb) RETURNS text
LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT CASE jsonb_typeof(value) WHEN 'boolean' THEN CASE WHEN value::boolean THEN '1' ELSE '0' END
    ELSE value #>> '{{}}' END $$;

-- JSON has numbers that are beyond all floats.
CREATE FUNCTION number_of(value jsonb) RETURNS double precision
LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT CASE WHEN jsonb_typeof(value) <> 'number' THEN NULL
    WHEN abs(value::numeric) > 1.7e308 THEN sign(value::numeric) * 'Infinity'::double precision
    WHEN abs(value::numeric) < 1e-307 THEN 0
    ELSE value::double precision END $$;

CREATE FUNCTION value_at(state jsonb, path text) RETURNS jsonb
LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT jsonb_path_query_first(state, ('strict ' || path)::jsonpath, '{{}}', true) $$;
"""

_KEY: Final = OWNER
_VALUE: Final = "value_at(s.data, p.path)"
_NUMBER: Final = f"number_of({_VALUE})"
_IS_NUMBER: Final = f"jsonb_typeof({_VALUE}) = 'number'"
_NOW_S: Final = "extract(epoch FROM clock_timestamp())::double precision"


def _robot_of(alias: str) -> str:
    return f"""(SELECT r.name FROM run u JOIN robot r USING ({_KEY})
    WHERE u.{_KEY} = {alias}.{_KEY} AND u.id = {alias}.run_id AND r.id = u.robot_id) AS robot"""


def _motion(robot_id: str) -> str:
    """What the signals with a role have in a row `s`."""
    metres = " ".join(f"WHEN '{unit}' THEN {metres}" for unit, metres in METRES.items())
    integer = f"jsonb_typeof({_VALUE}) = 'number' AND scale(({_VALUE})::numeric) = 0"
    shown = {
        "x_m": _first_postgres_views(
            robot_id, "x", f"{_NUMBER} * CASE p.unit {metres} ELSE 1 END", beside="y"
        ),
        "y_m": _first_postgres_views(
            robot_id, "y", f"{_NUMBER} * CASE p.unit {metres} ELSE 1 END", beside="x"
        ),
        "yaw_rad": _first_postgres_views(
            robot_id, "yaw", f"{_NUMBER} * CASE p.unit WHEN 'deg' THEN pi() / 180 ELSE 1 END"
        ),
        "mode": _first_postgres_views(
            robot_id,
            "mode",
            f"text_of({_VALUE})",
            f"jsonb_typeof({_VALUE}) = 'string' OR {integer}",
        ),
        "speed": _first_postgres_views(robot_id, "speed"),
        "commanded_speed": _first_postgres_views(robot_id, "commanded_speed"),
    }
    return ",".join(f"\n  {query} AS {name}" for name, query in shown.items())


def _first_postgres_views(
    robot_id: str, role: str, shown: str = _NUMBER, wanted: str = _IS_NUMBER, beside: str = ""
) -> str:
    """The first of these roles that has such a value in the row, beside one of another role."""
    other = (
        f"JOIN signal o ON o.{_KEY} = p.{_KEY} AND o.robot_id = p.robot_id "
        f"AND o.role = '{beside}' || substr(p.role, 2) AND {_IS_NUMBER.replace('p.', 'o.')}"
    )
    # With an OFFSET they are chosen first: a path without a role may be none for PostgreSQL.
    return f"""(SELECT {shown} FROM (SELECT * FROM signal WHERE {_KEY} = s.{_KEY}
      AND robot_id = {robot_id} AND role COLLATE "C" BETWEEN '{role}' AND '{role}9' OFFSET 0) p
    {other if beside else ""}
    WHERE {wanted} ORDER BY p.role COLLATE "C" LIMIT 1)"""


# In the order in which they are made: what a view asks comes before it.
VIEWS: Final = {
    "all_state": f"""SELECT {_KEY}, id AS state_id, run_id, sim_time_s, wall_time_s, data, replaced
FROM state
UNION ALL
SELECT {_KEY}, NULL, run_id, sim_time_s, wall_time_s, data, replaced FROM kept_state k
WHERE call IS NOT NULL OR NOT EXISTS (SELECT 1 FROM state s /* retention moved it there */
  WHERE s.{_KEY} = k.{_KEY} AND s.run_id = k.run_id AND s.sim_time_s = k.sim_time_s
    AND s.wall_time_s = k.wall_time_s)""",
    "robot_now": f"""SELECT r.{_KEY}, r.name AS robot, u.id AS run_id, u.end_reason, s.sim_time_s,
  rounded({_NOW_S} - s.wall_time_s, 1) AS age_s,{_motion("r.id")},
  s.data, s.replaced
FROM robot r
LEFT JOIN LATERAL (SELECT id, end_reason FROM run
  WHERE {_KEY} = r.{_KEY} AND robot_id = r.id ORDER BY id DESC LIMIT 1) u ON true
LEFT JOIN LATERAL (SELECT * FROM state
  WHERE {_KEY} = r.{_KEY} AND run_id = u.id ORDER BY sim_time_s DESC, id DESC LIMIT 1) s ON true""",
    "robot_trajectory": f"""SELECT s.{_KEY}, {_robot_of("s")},
  s.run_id, s.id AS state_id, s.sim_time_s, utc_text(s.wall_time_s) AS utc,{_motion("v.robot_id")},
  s.replaced
FROM state s LEFT JOIN run v ON v.{_KEY} = s.{_KEY} AND v.id = s.run_id""",
    "robot_run": f"""SELECT u.{_KEY}, r.name AS robot, u.id AS run_id, u.label,
  utc_text(u.started_wall_time_s) AS started_utc,
  rounded(u.last_sim_time_s - u.started_sim_time_s, 3) AS duration_s,
  rounded(u.last_wall_time_s - u.started_wall_time_s, 3) AS wall_duration_s,
  rounded((u.last_sim_time_s - u.started_sim_time_s)
    / nullif(u.last_wall_time_s - u.started_wall_time_s, 0), 3) AS real_time_factor,
  u.row_count, u.purged_rows,
  rounded(u.row_count / nullif(u.last_sim_time_s - u.started_sim_time_s, 0), 2) AS rows_per_s,
  u.start_reason, u.end_reason, u.keep, u.note, u.world, s.controller, s.controller_sha256,
  s.git_commit, u.session_id
FROM run u JOIN robot r ON r.{_KEY} = u.{_KEY} AND r.id = u.robot_id
JOIN session s ON s.{_KEY} = u.{_KEY} AND s.id = u.session_id""",
    "robot_command": f"""SELECT c.{_KEY}, r.name AS robot, c.id AS command_id, c.action, c.params,
  c.status, utc_text(c.created_wall_time_s) AS created_utc,
  rounded(coalesce(c.claimed_wall_time_s, c.finished_wall_time_s, {_NOW_S})
    - c.created_wall_time_s, 3) AS waiting_s,
  rounded(coalesce(c.finished_wall_time_s, {_NOW_S}) - c.claimed_wall_time_s, 3) AS running_s,
  c.claimed_sim_time_s, c.finished_sim_time_s,
  CASE WHEN c.finished_sim_time_s >= c.claimed_sim_time_s /* a reset takes it back */
    THEN rounded(c.finished_sim_time_s - c.claimed_sim_time_s, 3) END AS running_sim_s,
  c.result, c.error, c.requested_by, c.session_id
FROM command c JOIN robot r ON r.{_KEY} = c.{_KEY} AND r.id = c.robot_id""",
    "robot_event": f"""SELECT e.{_KEY}, {_robot_of("e")},
  e.run_id, e.id AS event_id, e.sim_time_s, utc_text(e.wall_time_s) AS utc, e.kind, e.name,
  text_of(e.data -> 'from') AS from_value, text_of(e.data -> 'to') AS to_value, e.data
FROM event e""",
    "robot_log": f"""SELECT l.{_KEY}, {_robot_of("l")},
  l.run_id, l.id AS log_id, l.sim_time_s, utc_text(l.wall_time_s) AS utc, l.level, l.source,
  l.logger, l.message
FROM log l""",
    "robot_period": f"""SELECT p.{_KEY}, {_robot_of("p")},
  p.run_id, p.name AS signal, p.value, p.start_s,
  coalesce(p.next_s, u.last_sim_time_s) AS end_s,
  rounded(coalesce(p.next_s, u.last_sim_time_s) - p.start_s, 3) AS duration_s
FROM (
  SELECT {_KEY}, run_id, name, value, start_s,
    lead(start_s) OVER (PARTITION BY {_KEY}, run_id, name ORDER BY start_s, id, side) AS next_s
  FROM (
    SELECT e.{_KEY}, e.run_id, e.name, e.id, k.side,
      CASE k.side WHEN 0 THEN coalesce((SELECT min(f.sim_time_s) FROM state f
          WHERE f.{_KEY} = v.{_KEY} AND f.run_id = v.id AND f.sim_time_s <= e.sim_time_s
            AND v.purged_rows = 0), v.started_sim_time_s /* purged, or not shipped */)
        ELSE e.sim_time_s END AS start_s,
      text_of(e.data -> CASE k.side WHEN 0 THEN 'from' ELSE 'to' END) AS value
    FROM event e JOIN run v ON v.{_KEY} = e.{_KEY} AND v.id = e.run_id
    CROSS JOIN (VALUES (0), (1)) k (side)
    WHERE e.kind = 'change' AND (k.side = 1 OR NOT EXISTS (
      SELECT 1 FROM event b WHERE b.{_KEY} = e.{_KEY} AND b.run_id = e.run_id
        AND b.kind = 'change' AND b.name = e.name AND b.id < e.id))
  ) c
) p JOIN run u ON u.{_KEY} = p.{_KEY} AND u.id = p.run_id""",
    "robot_parameter": f"""SELECT v.{_KEY}, r.name AS robot, v.run_id, v.name,
  v.value #>> '{{}}' AS value, p.unit, v.sim_time_s AS since_s, utc_text(v.wall_time_s) AS utc,
  v.is_default, v.set_by, v.command_id
FROM parameter_value v JOIN run u ON u.{_KEY} = v.{_KEY} AND u.id = v.run_id
JOIN robot r ON r.{_KEY} = u.{_KEY} AND r.id = u.robot_id
LEFT JOIN LATERAL (SELECT unit FROM parameter WHERE {_KEY} = u.{_KEY} AND robot_id = u.robot_id
  AND name = v.name ORDER BY id DESC LIMIT 1) p ON true""",
    "robot_statistics": f"""SELECT g.{_KEY}, r.name AS robot, g.run_id, s.name AS signal,
  g.start_sim_time_s AS start_s, g.end_sim_time_s AS end_s, c.row_count, c.value_count, c.min,
  c.max, c.sum / nullif(c.value_count, 0) AS mean, c.first, c.last, c.largest_step, c.change_count
FROM chunk c JOIN row_group g ON g.{_KEY} = c.{_KEY} AND g.id = c.group_id
JOIN signal s ON s.{_KEY} = c.{_KEY} AND s.id = c.signal_id
JOIN robot r ON r.{_KEY} = s.{_KEY} AND r.id = s.robot_id""",
    "robot_kept": f"""SELECT k.{_KEY}, r.name AS robot, k.run_id, k.id AS stretch_id,
  k.start_sim_time_s AS start_s,
  least(k.end_sim_time_s, greatest(u.last_sim_time_s, k.start_sim_time_s)) AS end_s,
  (SELECT count(*) FROM all_state s WHERE s.{_KEY} = k.{_KEY} AND s.run_id = k.run_id
    AND s.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s) AS states,
  utc_text(k.wall_time_s) AS utc, k.reason
FROM kept_stretch k JOIN run u ON u.{_KEY} = k.{_KEY} AND u.id = k.run_id
JOIN robot r ON r.{_KEY} = u.{_KEY} AND r.id = u.robot_id""",
}  # fmt: skip


def _view_statements() -> Iterator[str]:
    """The statements that make the views, and say of each what the schema of a recording says."""
    for name, query in VIEWS.items():
        comment = re.search(r"/\* (.*?) \*/", shipped_objects()[name], re.DOTALL)
        assert comment is not None, f"{name} has no comment"
        said = comment[1].replace("ask with run_id", f"ask with {_KEY} = ..., run_id")
        yield f"CREATE VIEW {name} AS\n{query}"
        yield f"COMMENT ON VIEW {name} IS '{said.replace(chr(39), chr(39) * 2)}'"
