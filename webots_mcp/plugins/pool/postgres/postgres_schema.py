"""The tables of a pool in PostgreSQL, made from the models of those of a recording.

What differs: the recording's UUID comes before every key, integers have 64 bits, JSON is jsonb, and
appended tables are partitioned by wall time, a month each. A pool outlives what retention deletes
at the edge, and has runs of which another recording shipped the rest: so rows may refer to what is
not there, names may come again, and there are no foreign keys and no unique columns but the keys.
`run_owner` holds that a run is in a pool once.
"""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Any, Final

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql
from sqlmodel import SQLModel

from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.errors import PoolError
from webots_mcp.plugins.pool.postgres.connecting import Connection, clear_errors, connect
from webots_mcp.plugins.pool.postgres.postgres_views import VIEWS, make_views
from webots_mcp.plugins.pool.shipped_tables import Table, tables
from webots_mcp.store.models import STATISTICS

OWNER: Final = "recording_uuid"
VERSION: Final = "pool_version"
FIRST_YEAR: Final = 2000
LAST_YEAR: Final = 2099
FIRST_S: Final = datetime(FIRST_YEAR, 1, 1, tzinfo=timezone.utc).timestamp()
END_S: Final = datetime(LAST_YEAR + 1, 1, 1, tzinfo=timezone.utc).timestamp()
_LOCK: Final = 7_463_962_947  # of whoever makes tables: any number that nobody else takes
_ENCODING: Final = "UTF8"

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
_TO_GRANT: Final = (
    "GRANT USAGE ON SCHEMA {schema} TO {role}; "
    "GRANT SELECT, INSERT, UPDATE ON ALL TABLES IN SCHEMA {schema} TO {role}; "
    "GRANT EXECUTE ON ALL FUNCTIONS IN SCHEMA {schema} TO {role}"
)


def prepare(url: str, address: str) -> None:
    """Make the tables of a pool where there are none; of several at once, one does it.

    Raises:
        PoolUnavailableError: Nobody answers there.
        PoolError: The tables are older, newer or none of ours, or the role lacks a right.
    """
    with connect(url, address) as connection, clear_errors(address):
        _require_usable(connection, address)
        if _is_pool(connection):
            _require_writable(connection, address)
            return require_current(connection, address)
        _require_create(connection, address)
    with clear_errors(address), connect(url, address, autocommit=False) as connection:
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (_LOCK,))
        if _is_pool(connection):  # another was faster
            return
        _require_nothing_foreign(connection, address)
        for statement in (*_table_statements(), _OWN):
            connection.execute(statement.encode())
        make_views(connection)


def require_current(connection: Connection, address: str) -> None:
    """Raise unless a pool of exactly this version is there.

    Raises:
        PoolError: There is none, or an older or a newer one.
    """
    version = _version(connection)
    if version is None:
        raise PoolError(f"{address} holds no pool: nothing was shipped there yet")
    if version < SCHEMA_VERSION:
        raise PoolError(
            f"{address} has schema {version}, of an older webots-mcp: ship the recordings anew, "
            "into a database or a schema of its own ('?options=-csearch_path%3DNAME' in the URL)"
        )


def _version(connection: Connection) -> int | None:
    """The schema version of the pool; None where there is none.

    Raises:
        PoolError: It is newer than this webots-mcp.
    """
    if not _is_pool(connection):
        return None
    version = int(_first(connection, f"SELECT version_num FROM {VERSION}"))
    if version > SCHEMA_VERSION:
        raise PoolError(
            f"the pool has schema {version}, this webots-mcp knows {SCHEMA_VERSION}: "
            "upgrade it with 'pip install --upgrade', from where it was installed"
        )
    return version


def _is_pool(connection: Connection) -> bool:
    there = "SELECT to_regclass(format('%%I.%%I', current_schema(), %s::text)) IS NOT NULL"
    return bool(_first(connection, there, VERSION))


def _require_usable(connection: Connection, address: str) -> None:
    if _first(connection, "SELECT current_schema()") is None:
        raise PoolError(
            f"no schema on the search path of {address} exists, or may be used: "
            "GRANT USAGE ON SCHEMA public, or set another search_path"
        )
    if (encoding := _first(connection, "SHOW server_encoding")) != _ENCODING:
        raise PoolError(
            f"the database of {address} has the encoding {encoding}, which lacks letters: "
            f"make one with CREATE DATABASE ... ENCODING '{_ENCODING}' TEMPLATE template0"
        )
    if _first(connection, "SHOW transaction_read_only") == "on":
        raise PoolError(
            f"{address} is read-only: a standby, or a database or role that is set so; "
            "give the URL of the primary, and a role that may write"
        )


def _require_writable(connection: Connection, address: str) -> None:
    """Raise unless what is there of the pool's tables may be written."""
    lacking = connection.execute(
        "SELECT relname FROM pg_class WHERE relnamespace = current_schema()::regnamespace "
        "AND relname = ANY(%s) AND NOT (has_table_privilege(oid, 'SELECT') AND (relname = %s "
        "OR has_table_privilege(oid, 'INSERT') AND has_table_privilege(oid, 'UPDATE'))) LIMIT 1",
        (_names(), VERSION),
    ).fetchone()
    if lacking:
        raise PoolError(_missing_right(connection, address, f"write {lacking[0]}", _TO_GRANT))


def _names() -> list[str]:
    """Of all tables of a pool."""
    return [each.name for each in tables()] + [
        "shipment",
        "progress",
        "run_owner",
        "picture",
        VERSION,
    ]


def _require_create(connection: Connection, address: str) -> None:
    if not _first(connection, "SELECT has_schema_privilege(current_schema(), 'CREATE')"):
        grant = "GRANT USAGE, CREATE ON SCHEMA {schema} TO {role}"
        raise PoolError(_missing_right(connection, address, "make tables", grant))


def _missing_right(connection: Connection, address: str, what: str, grant: str) -> str:
    role, schema = (
        _first(connection, f"SELECT quote_ident({each})")
        for each in ("current_user", "current_schema()")
    )
    asked = grant.format(schema=schema, role=role)
    return f"the role {role} may not {what} in {address}: let the owner of it run {asked!r}"


def _require_nothing_foreign(connection: Connection, address: str) -> None:
    there = connection.execute(
        "SELECT relname FROM pg_class WHERE relnamespace = current_schema()::regnamespace "
        "AND relname = ANY(%s) ORDER BY relname",
        ([*_names(), *VIEWS],),
    ).fetchall()
    if there:
        found = ", ".join(name for (name,) in there)
        raise PoolError(
            f"{address} holds tables of something else that are called as those of a pool "
            f"({found}): give a database of its own, or a schema of its own by "
            "'?options=-csearch_path%3DNAME' in the URL"
        )


def _first(connection: Connection, sql: str, *arguments: Any) -> Any:
    row = connection.execute(sql.encode(), arguments or None).fetchone()
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
