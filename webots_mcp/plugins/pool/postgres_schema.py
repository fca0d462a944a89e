"""The tables and views of a pool in PostgreSQL.

The tables are made from the models of a recording's tables, with these differences: the UUID of the
recording is part of every key, integers have 64 bits, and JSON columns are of type json, which
keeps the text as it came. A pool outlives what retention deletes from a recording, and may hold
runs of which another recording shipped the rest. Therefore rows may refer to missing rows, names
may repeat, and there are no foreign keys. The only unique columns are the keys and the UUIDs of
runs: a run is in a pool once. Some views of a recording exist too, by the same names and with the
UUID of the recording.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql
from sqlmodel import SQLModel

from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.database.schema import shipped_objects
from webots_mcp.errors import PoolError
from webots_mcp.plugins.pool.pool_interface import (
    ShippedTable,
    tables,
)
from webots_mcp.plugins.pool.postgres_connection import Connection, clear_errors, connect
from webots_mcp.store.models import STATISTICS

OWNER: Final = "recording_uuid"
VERSION: Final = "pool_version"
_LOCK: Final = 7_463_962_947  # Lock of a process that creates the tables: an arbitrary number.
# Tables of a pool in addition to those of a recording.
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
_EPOCH_MS: Final = "210866760000000::double precision"  # From the first Julian day to 1970.
# A time as text, rounded to milliseconds by the same additions as in SQLite's strftime.
_UTC: Final = (
    rf"to_char(to_timestamp((floor((\1) * 1000 + {_EPOCH_MS} + 0.5) - {_EPOCH_MS}) / 1000) "
    "AT TIME ZONE 'UTC', 'YYYY-MM-DD HH24:MI:SS.MS')"
)


def prepare(url: str, address: str) -> None:
    """Create the tables of a pool if it has none. Of several processes at once, one does it.

    Raises:
        PoolUnavailableError: The server does not answer.
        PoolError: The tables have another version or another origin, or the role lacks a right.
    """
    with connect(url, address) as connection, clear_errors(address):
        if _is_pool(connection):
            return require_current(connection, address)
        with connection.transaction():
            connection.execute("SELECT pg_advisory_xact_lock(%s)", (_LOCK,))
            if not _is_pool(connection):  # Otherwise another process was faster.
                for statement in (*_table_statements(), _OWN, *_view_statements()):
                    connection.execute(statement.encode())


def require_current(connection: Connection, address: str) -> None:
    """Require a pool of exactly this version.

    Raises:
        PoolError: There is no pool, or one of another version.
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
    """Return the statements that create the tables, with indexes and comments of columns."""
    metadata, made = sa.MetaData(), list[str]()
    for each in tables():
        _pooled(metadata, SQLModel.metadata.tables[each.name], each)

    def note(statement: Any, *_: Any, **__: Any) -> None:
        made.append(str(statement.compile(dialect=engine.dialect)))

    engine = sa.create_mock_engine("postgresql+psycopg://", note)
    metadata.create_all(engine, checkfirst=False)
    return made


def _pooled(metadata: sa.MetaData, made: sa.Table, shipped: ShippedTable) -> sa.Table:
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


def _column(column: sa.Column[Any], shipped: ShippedTable) -> sa.Column[Any]:
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


def views() -> dict[str, str]:
    """Return the statements that create the views, by name."""
    text = Path(__file__).with_name("postgres_views.sql").read_text("utf-8")
    written_out = re.sub(
        r"UTC\((.*?)\)",
        _UTC,
        text.replace("NOW_S", "extract(epoch FROM clock_timestamp())::double precision"),
    )
    return {
        made[1]: made[0]
        for made in re.finditer(r"CREATE VIEW (\w+) AS\n.*?(?=;\n)", written_out, flags=re.DOTALL)
    }


def _view_statements() -> Iterator[str]:
    """Yield those statements, and the comments on views from a recording's schema."""
    for name, made in views().items():
        comment = re.search(r"/\* (.*?) \*/", shipped_objects()[name], re.DOTALL)
        assert comment is not None, f"{name} has no comment"
        yield made
        yield f"COMMENT ON VIEW {name} IS '{comment[1].replace(chr(39), chr(39) * 2)}'"
