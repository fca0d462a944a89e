"""A pool in PostgreSQL: its schema, shipping to it, and reading it.

Rows go in by COPY, in one transaction with how far they go. Where PostgreSQL refuses a batch (a
value that it cannot hold, a row that is there already), it goes the way of rows that change:
through a temporary table, and from there row by row.

The tables are made from the models of those of a recording. What differs: the recording's UUID
comes before every key, integers have 64 bits, and JSON is json, which holds the text as it came. A
pool outlives what retention deletes at the edge, and has runs of which another recording shipped
the rest: so rows may refer to what is not there, names may come again, and there are no foreign
keys and no unique columns but the keys and the UUIDs of runs, of which each is in a pool once. Some
views of a recording are there, by the same names, with its UUID.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NoReturn, TypeAlias, cast

import psycopg
import sqlalchemy as sa
from psycopg.adapt import AdaptersMap
from psycopg.types.numeric import FloatLoader
from psycopg.types.string import TextLoader
from sqlalchemy.dialects import postgresql
from sqlmodel import SQLModel

from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.database.connection import shipped_objects
from webots_mcp.errors import InvalidInputError, PoolBusyError, PoolError, PoolUnavailableError
from webots_mcp.plugins.pool.duckdb_statement import answered
from webots_mcp.plugins.pool.pool_interface import (
    LISTED,
    Batch,
    PoolRow,
    ShippedTable,
    SQLValue,
    batches,
    redacted,
    tables,
)
from webots_mcp.store.models import STATISTICS
from webots_mcp.store.sql import Result, require_max_rows

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
_VIEW: Final = re.compile(r"CREATE VIEW (\w+) AS\n.*?(?=;\n)", re.DOTALL)
_NOW_S: Final = "extract(epoch FROM clock_timestamp())::double precision"
_EPOCH_MS: Final = "210866760000000::double precision"  # from the first Julian day to 1970
# As text, rounded to milliseconds by the same additions that SQLite's strftime makes.
_UTC: Final = (
    rf"to_char(to_timestamp((floor((\1) * 1000 + {_EPOCH_MS} + 0.5) - {_EPOCH_MS}) / 1000) "
    "AT TIME ZONE 'UTC', 'YYYY-MM-DD HH24:MI:SS.MS')"
)
SELECT_S: Final = 60
_SHIPPER: Final = 1_463_962_947  # the seed of the lock of who ships a recording
_REPLACEMENT: Final = "\N{REPLACEMENT CHARACTER}"
# Of values, where a batch has one that PostgreSQL cannot hold; and of rows that are there already.
_REFUSED: Final = (
    psycopg.DataError, psycopg.IntegrityError, psycopg.errors.ProgramLimitExceeded,
    psycopg.errors.StatementTooComplex,
)  # fmt: skip
_FETCHED: Final = 2000  # rows that are asked of the server at a time
_AS_THEY_ARE: Final = ("bool", "int2", "int4", "int8", "oid", "float4", "float8", "bytea")
_PARAMETER: Final = "08P01"  # one SQLSTATE of what the client did wrong: it gave no values
_ASKED_WRONG: Final = ("22", "25006", "42", "57014", "0A", _PARAMETER)  # that a question has


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


# -- views ------------------------------------------------------------------------------------


def views() -> dict[str, str]:
    """The statements that make the views, by name."""
    text = Path(__file__).with_name("postgres_views.sql").read_text("utf-8")
    written_out = re.sub(r"UTC\((.*?)\)", _UTC, text.replace("NOW_S", _NOW_S))
    return {made[1]: made[0] for made in _VIEW.finditer(written_out)}


def _view_statements() -> Iterator[str]:
    """Those, and what a recording's schema says of each view."""
    for name, made in views().items():
        comment = re.search(r"/\* (.*?) \*/", shipped_objects()[name], re.DOTALL)
        assert comment is not None, f"{name} has no comment"
        yield made
        yield f"COMMENT ON VIEW {name} IS '{comment[1].replace(chr(39), chr(39) * 2)}'"


# -- the pool --------------------------------------------------------------------------------------


class PostgresPool:
    """A PostgreSQL database as a pool, read in one moment of it; see `Pool`."""

    def __init__(self, url: str, *, ships: bool = False) -> None:
        self._url, self.address, self._ships = url, redacted(url), ships
        self._names = (f"rows_{number}" for number in itertools.count())
        self._connection: Connection

    def __enter__(self) -> PostgresPool:
        if self._ships:
            prepare(self._url, self.address)
        self._connection = connect(self._url, self.address)
        try:
            with clear_errors(self.address):
                require_current(self._connection, self.address)
                if not self._ships:
                    self._connection.execute("SET idle_in_transaction_session_timeout = '15min'")
                    self._connection.read_only = True
                    self._connection.isolation_level = psycopg.IsolationLevel.REPEATABLE_READ
                    self._connection.autocommit = False
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        self._connection.close()

    @contextmanager
    def shipment(self, recording_uuid: str) -> Generator[PostgresShipment]:
        """Be the one who ships this recording, as long as the connection lasts."""
        connection, values = self._connection, (recording_uuid, _SHIPPER)
        with clear_errors(self.address):
            lock = "SELECT pg_try_advisory_lock(hashtextextended(%s, %s))"
            got = connection.execute(lock, values).fetchone()
        if got is None or not got[0]:
            raise PoolBusyError(
                f"another process ships the recording {recording_uuid} to {self.address}"
            )
        try:
            yield PostgresShipment(connection, self.address, recording_uuid)
        finally:
            unlock = "SELECT pg_advisory_unlock(hashtextextended(%s, %s))"
            with contextlib.suppress(psycopg.Error):  # it is lost, and the lock with it
                connection.execute(unlock, values)

    def rows_of(self, name: str) -> Iterator[tuple[str, Sequence[Any]]]:
        """The columns `LISTED` of all rows of such a table, behind their recording's UUID."""
        columns = ", ".join(map(_quoted, LISTED[name]))
        for owner, *row in self._asked(f"SELECT {OWNER}::text, {columns} FROM {name}"):
            yield owner, row

    def progress(self, recording_uuid: str) -> dict[str, int]:
        """How far the recording was shipped."""
        query = f"SELECT name, value FROM progress WHERE {OWNER} = %s"
        return {str(name): int(value) for name, value in self._asked(query, (recording_uuid,))}

    def rows(
        self, recording_uuid: str, table: ShippedTable, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        """Rows whose columns have one of these values, in any order."""
        conditions = "".join(f' AND "{column}" = ANY(%s)' for column in where)
        columns = ", ".join(
            f"{_quoted(each)}::text" if each in table.json_columns else _quoted(each)
            for each in table.columns
        )
        query = f"SELECT {columns} FROM {table.name} WHERE {OWNER} = %s{conditions}"
        asked = (recording_uuid, *(list(ids) for ids in where.values()))
        yield from batches(table, cast("Iterator[PoolRow]", self._asked(query, asked)))

    def picture(self, recording_uuid: str, path: str) -> bytes | None:
        """The file of a picture."""
        query = f"SELECT content FROM picture WHERE {OWNER} = %s AND path = %s"
        found = list(self._asked(query, (recording_uuid, path)))
        return bytes(found[0][0]) if found else None

    def select(self, sql: str, max_rows: int) -> Result:
        """The first rows of one SELECT.

        Raises:
            InvalidInputError: It is no SELECT, is wrong, or takes longer than a minute.
        """
        require_max_rows(max_rows)
        # Large objects may be made in a transaction that only reads: none of it stays.
        undone = self._connection.transaction(force_rollback=True)
        with clear_errors(self.address), _clear_question(), undone:
            limit = f"SET LOCAL statement_timeout = {max(1, round(SELECT_S * 1000))}"
            self._connection.execute(limit.encode())
            # A cursor on the server takes nothing but one SELECT.
            with self._connection.cursor(next(self._names)) as cursor:
                _as_texts(cursor.adapters)
                cursor.execute(sql.replace("%", "%%").encode(), ())
                names = [each.name for each in cursor.description or ()]
                return answered(names, cursor.fetchmany(max_rows + 1), max_rows)

    def _asked(self, query: str, values: Any = None) -> Iterator[tuple[Any, ...]]:
        """The rows of a query, a few of them in memory."""
        with clear_errors(self.address), self._connection.cursor(next(self._names)) as cursor:
            cursor.itersize = _FETCHED
            cursor.execute(query.encode(), values)
            yield from cursor


def _as_texts(adapters: AdaptersMap) -> None:
    """Have all values as PostgreSQL writes them, but numbers, flags and bytes."""
    for each in psycopg.adapters.types:
        if each.name not in _AS_THEY_ARE:
            adapters.register_loader(each.oid, TextLoader)
        if each.array_oid:
            adapters.register_loader(each.array_oid, TextLoader)
    adapters.register_loader("numeric", FloatLoader)


@contextmanager
def _clear_question() -> Generator[None]:
    """Inside the block, errors that the question has are said as such."""
    try:
        yield
    except psycopg.Error as error:
        if not (error.sqlstate or "").startswith(_ASKED_WRONG):
            raise
        said = one_line(error.diag.message_primary or str(error))
        if error.sqlstate == _PARAMETER:
            said = "a parameter such as $1 has no value here"
        hint = f"; {one_line(error.diag.message_hint)}" if error.diag.message_hint else ""
        raise InvalidInputError(
            f"PostgreSQL does not answer this: {said}{hint}. Ask one SELECT, which ends within "
            f"{SELECT_S} s, of the tables and views of docs/pool.md"
        ) from None


# -- shipping ---------------------------------------------------------------------------------


class PostgresShipment:
    """One recording's part of the pool; see `Shipment`."""

    def __init__(self, connection: Connection, address: str, recording_uuid: str) -> None:
        self._connection, self._address, self._uuid = connection, address, recording_uuid

    def progress(self) -> dict[str, int]:
        """What the last `write` left."""
        with clear_errors(self._address):
            query = f"SELECT name, value FROM progress WHERE {OWNER} = %s"
            return dict(self._connection.execute(query.encode(), (self._uuid,)).fetchall())

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        """Those that another recording has shipped."""
        with clear_errors(self._address):
            query = f"SELECT uuid, {OWNER}::text FROM run WHERE uuid = ANY(%s) AND {OWNER} <> %s"
            values = (list(run_uuids), self._uuid)
            return dict(self._connection.execute(query.encode(), values).fetchall())

    def write_picture(self, path: str, content: bytes) -> None:
        """Keep a picture, at once."""
        with clear_errors(self._address):
            self._connection.execute(
                f"INSERT INTO picture ({OWNER}, path, content) VALUES (%s, %s, %s) "
                f"ON CONFLICT ({OWNER}, path) DO UPDATE SET content = EXCLUDED.content".encode(),
                (self._uuid, path.replace("\0", _REPLACEMENT), content),
            )

    def write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> Counter[str]:
        """Write rows and how far they go, or nothing; returns what was replaced, by column."""
        replaced = Counter[str]()
        with clear_errors(self._address), self._connection.transaction():
            for batch in batches:
                self._write_batch(batch, replaced)
            self._connection.execute(
                f"INSERT INTO progress ({OWNER}, name, value) "
                "SELECT %s, unnest(%s::text[]), unnest(%s::bigint[]) "
                f"ON CONFLICT ({OWNER}, name) DO UPDATE SET value = EXCLUDED.value".encode(),
                (self._uuid, list(progress), list(progress.values())),
            )
        return replaced

    def _write_batch(self, batch: Batch, replaced: Counter[str]) -> None:
        """Straight into the table; where it refuses a row, or rows change, by a temporary one."""
        table, staged = batch.table, f"staged_{batch.table.name}"
        if table.is_appended and self._tried(lambda: self._copy(table.name, table, batch.rows)):
            return
        make = f"CREATE TEMPORARY TABLE IF NOT EXISTS {staged} (LIKE {table.name})"
        self._connection.execute(make.encode())
        self._connection.execute(f"TRUNCATE {staged}".encode())
        if not self._tried(lambda: self._copy(staged, table, batch.rows)):
            self._copy(staged, table, [_holdable(table, row, replaced) for row in batch.rows])
        try:
            self._connection.execute(_merging(table, staged).encode())
        except psycopg.errors.UniqueViolation as error:
            raise PoolError(
                f"a run of this recording was shipped to {self._address} by another: {error}"
            ) from None

    def _tried(self, step: Callable[[], None]) -> bool:
        """Whether a step was done; otherwise, where a row was refused, nothing of it."""
        try:
            with self._connection.transaction():
                step()
        except _REFUSED:
            return False
        return True

    def _copy(self, into: str, table: ShippedTable, rows: Iterable[PoolRow]) -> None:
        names = ", ".join([OWNER, *map(_quoted, table.columns)])
        with (
            self._connection.cursor() as cursor,
            cursor.copy(f"COPY {into} ({names}) FROM STDIN".encode()) as copy,
        ):
            for row in rows:
                copy.write_row((self._uuid, *row))


def _merging(table: ShippedTable, staged: str) -> str:
    """The statement that brings rows of a temporary table into their table."""
    insert = f"INSERT INTO {table.name} AS held SELECT * FROM {staged}"
    changing = [each for each in table.columns if each not in table.key]
    if table.is_appended or not changing:
        return f"{insert} ON CONFLICT DO NOTHING"
    news = {
        _quoted(each): f"coalesce(EXCLUDED.{_quoted(each)}, held.{_quoted(each)})"
        if each in table.lasting
        else f"EXCLUDED.{_quoted(each)}"
        for each in changing
    }
    changes = ", ".join(f"{column} = {new}" for column, new in news.items())
    # As text, since json can be compared in no other way.
    olds = ", ".join(f"held.{column}::text" for column in news)
    return (
        f"{insert} ON CONFLICT ({OWNER}, {', '.join(map(_quoted, table.key))}) DO UPDATE "
        f"SET {changes} WHERE ({olds}) IS DISTINCT FROM "
        f"({', '.join(f'{new}::text' for new in news.values())})"
    )


def _holdable(table: ShippedTable, row: PoolRow, replaced: Counter[str]) -> PoolRow:
    """A row with what comes nearest to texts that PostgreSQL cannot hold, which are counted."""
    values = list[SQLValue]()
    for name, value in zip(table.columns, row, strict=True):
        held = value.replace("\0", _REPLACEMENT) if isinstance(value, str) else value
        if name in table.json_columns and isinstance(held, str) and not _is_json(held):
            held = json.dumps(held)
        replaced[f"{table.name}.{name}"] += held != value
        values.append(held)
    return tuple(values)


def _is_json(text: str) -> bool:
    try:
        json.loads(text, parse_constant=_no_json)
    except (ValueError, RecursionError):
        return False
    return True


def _no_json(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON")


def _quoted(name: str) -> str:
    """A name of ours in SQL; some are words of it."""
    return f'"{name}"'
