"""Shipping to PostgreSQL: rows by COPY, in one transaction with how far they go.

Rows that are new, as a rule, go straight to their table. Where PostgreSQL refuses a batch (a value
that it cannot hold, a row that is there already), it goes the way of all others: through a
temporary table, where JSON is text still, and from there row by row.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from decimal import Decimal
from typing import Any, Final, TypeVar, cast

import psycopg
from psycopg.abc import Buffer
from psycopg.adapt import Dumper, Loader

from webots_mcp.errors import InvalidInputError, PoolBusyError, PoolError
from webots_mcp.plugins.pool.duckdb_statement import Kind, answered, bounded
from webots_mcp.plugins.pool.pool_interface import (
    Batch,
    PooledSize,
    Row,
    SQLValue,
    Table,
    batches,
    nearest,
    number_in,
    redacted,
    table,
    tables,
)
from webots_mcp.plugins.pool.postgres_schema import (
    END_S,
    FIRST_S,
    OWNER,
    Connection,
    clear_errors,
    connect,
    one_line,
    prepare,
    require_current,
)
from webots_mcp.store.questions.sql import Result, require_max_rows

_T = TypeVar("_T")
_SHIPPER: Final = 1_463_962_947  # the seed of the lock of who ships a recording
_MANY: Final = 500  # rows of a table that changes: as a rule, so many at once are new
_TYPES: Final = {int: "bigint", float: "double precision", str: "text", bytes: "bytea"}
_REPLACEMENT: Final = "\N{REPLACEMENT CHARACTER}"
# Of values, where a batch has one that PostgreSQL cannot hold; and of rows that are there already.
_REFUSED: Final = (
    psycopg.DataError, psycopg.IntegrityError, psycopg.errors.ProgramLimitExceeded,
    psycopg.errors.StatementTooComplex, UnicodeEncodeError,
)  # fmt: skip


class PostgresTarget:
    """A PostgreSQL database as a pool to ship to; see `target.Target`."""

    def __init__(self, url: str) -> None:
        self._url, self.address = url, redacted(url)
        self._connection: Connection | None = None

    def __enter__(self) -> PostgresTarget:
        self._connection = connect(self._url, self.address)
        return self

    def __exit__(self, *exception: object) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def prepare(self) -> None:
        """See `schema.prepare`."""
        prepare(self._url, self.address)

    @contextmanager
    def shipment(self, recording_uuid: str) -> Generator[PostgresShipment]:
        """Be the one who ships this recording, as long as the connection lasts."""
        connection = self._connected()
        lock = "SELECT pg_try_advisory_lock(hashtextextended(%s, %s))"
        with clear_errors(self.address):
            require_current(connection, self.address)
            got = connection.execute(lock, (recording_uuid, _SHIPPER)).fetchone()
        if got is None or not got[0]:
            raise PoolBusyError(
                f"another process ships the recording {recording_uuid} to {self.address}"
            )
        try:
            yield PostgresShipment(connection, self.address, recording_uuid)
        finally:
            unlock = "SELECT pg_advisory_unlock(hashtextextended(%s, %s))"
            with contextlib.suppress(psycopg.Error):  # it is lost, and the lock with it
                connection.execute(unlock, (recording_uuid, _SHIPPER))

    def _connected(self) -> Connection:
        """The connection; a new one in the place of one that was lost."""
        if self._connection is None or self._connection.closed:
            self._connection = connect(self._url, self.address)
        return self._connection


class PostgresShipment:
    """One recording's part of the pool; see `target.Shipment`."""

    def __init__(self, connection: Connection, address: str, recording_uuid: str) -> None:
        self._connection, self._address, self._uuid = connection, address, recording_uuid
        self._parts: set[tuple[str, int, int]] = set()  # partitions that are there
        self._staged: set[str] = set()  # tables that have a temporary one
        self._replaced = Counter[str]()  # of one `write`, by column

    def progress(self) -> dict[str, int]:
        """What the last `write` left."""
        with clear_errors(self._address):
            query = f"SELECT name, value FROM progress WHERE {OWNER} = %s"
            return dict(self._connection.execute(query.encode(), (self._uuid,)).fetchall())

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        """Those that another recording has shipped."""
        with clear_errors(self._address):
            return self._owners(run_uuids)

    def write_picture(self, path: str, content: bytes) -> None:
        """Keep a picture, at once."""
        with clear_errors(self._address):
            self._connection.execute(
                f"INSERT INTO picture ({OWNER}, path, content) VALUES (%s, %s, %s) "
                f"ON CONFLICT ({OWNER}, path) DO UPDATE SET content = EXCLUDED.content".encode(),
                (self._uuid, _text(path), content),
            )

    def write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> Counter[str]:
        """Write rows and how far they go, or nothing; returns what was replaced, by column."""
        with clear_errors(self._address):
            try:
                self._write_all(batches, progress)
            except psycopg.errors.CheckViolation:  # somebody dropped the months that are over
                self._parts.clear()
                self._write_all(batches, progress)
        return self._replaced

    def _write_all(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> None:
        self._make_partitions(batches)
        self._staged, before = set(self._staged), self._staged
        try:
            with self._connection.transaction():
                self._write(batches, progress)
        except BaseException:
            self._staged = before  # those that were made in it are gone
            raise

    def _write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> None:
        self._replaced = Counter[str]()
        self._lock()
        for batch in batches:
            if batch.rows:
                self._write_batch(batch)
        self._connection.execute(
            f"INSERT INTO progress ({OWNER}, name, value) "
            "SELECT %s, unnest(%s::text[]), unnest(%s::bigint[]) "
            f"ON CONFLICT ({OWNER}, name) DO UPDATE SET value = EXCLUDED.value".encode(),
            (self._uuid, list(progress), list(progress.values())),
        )
        self._connection.execute(
            "UPDATE shipment SET replaced_values = replaced_values + %s, shipped_wall_time_s = %s "
            f"WHERE {OWNER} = %s".encode(),
            (self._replaced.total(), time.time(), self._uuid),
        )

    def _lock(self) -> None:
        """Keep all others who ship this recording waiting until the end of the transaction."""
        values = (self._uuid,)
        insert = f"INSERT INTO shipment ({OWNER}) VALUES (%s) ON CONFLICT DO NOTHING"
        self._connection.execute(insert.encode(), values)
        lock = f"SELECT 1 FROM shipment WHERE {OWNER} = %s FOR UPDATE"
        self._connection.execute(lock.encode(), values)

    def _write_batch(self, batch: Batch) -> None:
        if batch.table.name == "run":
            self._own_runs(batch)
        is_new = batch.table.is_appended or len(batch.rows) >= _MANY
        if not is_new or not self._tried(lambda: self._append(batch)):
            self._merge(batch)

    def _own_runs(self, batch: Batch) -> None:
        """Say that these runs are this recording's; those of two at once wait for each other."""
        at = batch.table.columns.index("uuid")
        uuids = sorted({str(row[at]) for row in batch.rows if row[at] is not None})
        self._connection.execute(
            f"INSERT INTO run_owner (uuid, {OWNER}) SELECT unnest(%s::text[]), %s "
            "ON CONFLICT DO NOTHING".encode(),
            (uuids, self._uuid),
        )
        if others := self._owners(uuids):
            uuid, owner = next(iter(others.items()))
            raise PoolError(f"the run {uuid} was shipped to {self._address} by recording {owner}")

    def _owners(self, run_uuids: Collection[str]) -> dict[str, str]:
        found = self._connection.execute(
            f"SELECT uuid, {OWNER}::text FROM run_owner WHERE uuid = ANY(%s) AND {OWNER} <> %s "
            "ORDER BY uuid".encode(),
            (list(run_uuids), self._uuid),
        )
        return dict(found.fetchall())

    def _append(self, batch: Batch) -> None:
        names = ", ".join([OWNER, *map(_quoted, batch.table.columns)])
        uuid = self._uuid
        self._copy(batch.table, batch.table.name, names, ((uuid, *row) for row in batch.rows))

    def _merge(self, batch: Batch) -> None:
        """Through a temporary table, where rows may be anything that the types hold."""
        name = self._stage(batch.table)
        columns = ", ".join(map(_quoted, batch.table.columns))
        self._connection.execute(f"TRUNCATE {name}".encode())
        if not self._tried(lambda: self._copy(batch.table, name, columns, batch.rows)):
            held = [self._holdable(batch.table, row) for row in batch.rows]
            self._copy(batch.table, name, columns, held)
        self._connection.execute(_merging(batch.table, name).encode(), (self._uuid,))

    def _stage(self, table: Table) -> str:
        """The temporary table of a table."""
        name = f"staged_{table.name}"
        if name not in self._staged:
            columns = ", ".join(
                f"{_quoted(column)} {_TYPES[kind]}{'' if column in table.nullable else ' NOT NULL'}"
                for column, kind in zip(table.columns, table.types, strict=True)
            )
            made = f"CREATE TEMPORARY TABLE IF NOT EXISTS {name} ({columns}) ON COMMIT DELETE ROWS"
            self._connection.execute(made.encode())
            self._staged.add(name)
        return name

    def _tried(self, step: Callable[[], None]) -> bool:
        """Whether a step was done; otherwise, where a row was refused, nothing of it."""
        try:
            with self._connection.transaction():
                step()
        except _REFUSED:
            return False
        return True

    def _copy(self, table: Table, name: str, columns: str, rows: Iterable[Row]) -> None:
        with self._connection.cursor() as cursor:
            if bytes not in table.types:
                cursor.adapters.register_dumper(bytes, _NoBytes)
            with cursor.copy(f"COPY {name} ({columns}) FROM STDIN".encode()) as copy:
                for row in rows:
                    copy.write_row(row)

    def _holdable(self, table: Table, row: Row) -> Row:
        """A row with what PostgreSQL can hold in the place of what it cannot, which is counted."""
        held = tuple(
            _nearest(value, kind, column in table.nullable)
            for value, kind, column in zip(row, table.types, table.columns, strict=True)
        )
        self._replaced.update(
            f"{table.name}.{column}"
            for column, new, old in zip(table.columns, held, row, strict=True)
            if new is not old and new != old
        )
        return held

    def _make_partitions(self, batches: Sequence[Batch]) -> None:
        """Make the months that rows fall into, apart from their transaction: it ends at once."""
        for batch in batches:
            for part in _parts(batch) - self._parts:
                self._connection.execute("SELECT make_partition(%s, %s, %s)", part)
                self._parts.add(part)


class _NoBytes(Dumper):
    """Refuses bytes in a column of texts or numbers, where SQLite may hold them."""

    def dump(self, obj: Any) -> Buffer | None:
        raise psycopg.DataError("bytes in a column that holds none")


def _merging(table: Table, staged: str) -> str:
    """The statement that brings rows of a temporary table into their table."""
    columns = [_quoted(each) for each in table.columns]
    values = ", ".join(
        f"as_jsonb({_quoted(each)})" if each in table.json_columns else _quoted(each)
        for each in table.columns
    )
    insert = (
        f"INSERT INTO {table.name} AS held ({OWNER}, {', '.join(columns)}) "
        f"SELECT %s, {values} FROM {staged}"
    )
    others = [each for each in table.columns if each not in table.key]
    if table.is_appended or not others:
        return f"{insert} ON CONFLICT DO NOTHING"
    news = {each: _news(table, each) for each in others}
    changes = ", ".join(f"{_quoted(each)} = {new}" for each, new in news.items())
    olds = ", ".join(f"held.{_quoted(each)}" for each in others)
    return (
        f"{insert} ON CONFLICT ({OWNER}, {', '.join(map(_quoted, table.key))}) DO UPDATE "
        f"SET {changes} WHERE ({olds}) IS DISTINCT FROM ({', '.join(news.values())})"
    )


def _news(table: Table, column: str) -> str:
    new = f"EXCLUDED.{_quoted(column)}"
    return f"coalesce({new}, held.{_quoted(column)})" if column in table.lasting else new


def _parts(batch: Batch) -> set[tuple[str, int, int]]:
    """The table and the months of a batch that is cut by time."""
    column = batch.table.time_column
    if column is None or not batch.rows:
        return set()
    at = batch.table.columns.index(column)
    times = {_day(row[at]) for row in batch.rows} - {None}
    days = (datetime.fromtimestamp(cast("int", day) * 86_400, timezone.utc) for day in times)
    return {(batch.table.name, day.year, day.month) for day in days}


def _day(value: SQLValue) -> int | None:
    """The day of a wall time; None of those that are in no month of a pool."""
    number = number_in(value) or 0.0
    return int(number // 86_400) if FIRST_S <= number < END_S else None


def _nearest(value: SQLValue, kind: type, nullable: bool) -> SQLValue:
    held = nearest(value, kind, nullable=nullable)
    return _text(held) if isinstance(held, str) else held


def _text(text: str) -> str:
    """A text without NUL, which PostgreSQL's have not."""
    return text.replace("\0", _REPLACEMENT)


def _quoted(name: str) -> str:
    """A name of ours in SQL; some are words of it."""
    return f'"{name}"'


# Reading a pool in PostgreSQL: what is there, rows to bring back, and one SELECT.


SELECT_S: Final = 60
_FETCHED: Final = 2000  # rows that are asked of the server at a time
_COUNTED_BYTES: Final = 200_000_000  # larger tables are not counted, which would take long
_SESSION: Final = "SET idle_in_transaction_session_timeout = '15min'"
_SIZE: Final = """
SELECT sum(pg_total_relation_size(oid))::bigint,
  sum(reltuples) FILTER (WHERE relkind = 'r')::bigint,
  coalesce(bool_and(reltuples >= 0) FILTER (WHERE relkind = 'r'), false)
FROM pg_class WHERE oid = %(name)s::regclass
  OR oid IN (SELECT relid FROM pg_partition_tree(%(name)s))"""
# By their OIDs: bool, int8, int2, int4, oid, float4, float8, numeric; bytea.
_KINDS: Final[dict[int, Kind]] = {
    **dict.fromkeys((16, 20, 21, 23, 26, 700, 701, 1700), "number"), 17: "bytes",
}  # fmt: skip
_PARAMETER: Final = "08P01"  # one SQLSTATE of what the client did wrong: it gave no values
_ASKED_WRONG: Final = ("22", "25006", "42", "57014", "0A", _PARAMETER)  # that a question has
# With comments behind it, in which nothing may be taken for the end of a text.
_END: Final = re.compile(r";(?:\s|;|--[^\n'\"$]*(?:\n|\Z)|/\*[^'\"$*]*\*/)*\Z")


class _NumericLoader(Loader):
    """As a number; one that is larger than any float as its text, with 17 digits."""

    def load(self, data: Buffer) -> float | str:
        number = Decimal(bytes(data).decode())
        if number.is_finite() and abs(number) > sys.float_info.max:
            return f"{number:.16e}"
        return float(number)


_Cursor = TypeVar("_Cursor", bound="psycopg.Cursor[Any] | psycopg.ServerCursor[Any]")


class PostgresPool:
    """A PostgreSQL database as a pool to read from, in one moment of it; see `target.Pool`."""

    keeps_order = False  # jsonb has an order of its own

    def __init__(self, url: str) -> None:
        self._url, self.address = url, redacted(url)
        self._names = (f"rows_{number}" for number in itertools.count())
        self._opened: Connection | None = None

    def __enter__(self) -> PostgresPool:
        self._opened = connect(self._url, self.address)
        try:
            with clear_errors(self.address):
                self._opened.execute(_SESSION)
                require_current(self._opened, self.address)
                self._opened.read_only = True
                self._opened.isolation_level = psycopg.IsolationLevel.REPEATABLE_READ
                self._opened.autocommit = False
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    @property
    def _connection(self) -> Connection:
        if self._opened is None:
            raise PoolError(f"{self.address} is not open")
        return self._opened

    def records(self, name: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """All rows of a table that changes, each behind its recording's UUID."""
        columns = table(name).columns
        asked = ", ".join(map('"{}"'.format, columns))
        for owner, *row in self._asked(f"SELECT {OWNER}::text, {asked} FROM {name}"):
            yield owner, dict(zip(columns, row, strict=True))

    def sizes(self) -> Iterator[PooledSize]:
        """Bytes with those of indexes; rows of large tables as PostgreSQL last estimated them."""
        for each in (*(each.name for each in tables()), "picture"):
            ((size_bytes, estimate, is_estimated),) = self._asked(_SIZE, {"name": each})
            rows = estimate
            if size_bytes < _COUNTED_BYTES or not is_estimated:
                ((rows,),) = self._asked(f"SELECT count(*) FROM {each}")
            yield PooledSize(each, rows, size_bytes)

    def progress(self, recording_uuid: str) -> dict[str, int]:
        """How far the recording was shipped."""
        query = f"SELECT name, value FROM progress WHERE {OWNER} = %s"
        return dict(cast("list[tuple[str, int]]", list(self._asked(query, (recording_uuid,)))))

    def rows(
        self, recording_uuid: str, table: Table, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        """Rows with their JSON as text, in PostgreSQL's notation."""
        conditions = "".join(f' AND "{column}" = ANY(%s)' for column in where)
        query = (
            f"SELECT {', '.join(_as_recorded(table, each) for each in table.columns)} "
            f"FROM {table.name} WHERE {OWNER} = %s{conditions}"
        )
        asked = (recording_uuid, *(list(ids) for ids in where.values()))
        yield from batches(table, cast("Iterator[Row]", self._asked(query, asked)))

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
        asked = _END.sub("", sql.strip()).replace("%", "%%")
        until_s = time.monotonic() + SELECT_S
        # Large objects may be made in a transaction that only reads: none of it stays.
        undone = self._connection.transaction(force_rollback=True)
        with clear_errors(self.address), _clear_question(), undone:
            # A cursor takes nothing but one SELECT, and knows its columns before it runs.
            with self._limited(self._connection.cursor(next(self._names)), until_s) as cursor:
                columns = cursor.execute(asked.encode(), ()).description or ()
            with self._limited(self._connection.cursor(), until_s) as cursor:
                cursor.adapters.register_loader("numeric", _NumericLoader)
                query = _bounded(asked, [each.type_code for each in columns], max_rows + 1)
                rows = cursor.execute(query.encode(), ()).fetchall()
        return answered([each.name for each in columns], rows, max_rows)

    def _limited(self, cursor: _Cursor, until_s: float) -> _Cursor:
        """The cursor; the statements that follow end at that time of the monotonic clock."""
        left_ms = max(1, round((until_s - time.monotonic()) * 1000))
        self._connection.execute(f"SET LOCAL statement_timeout = {left_ms}".encode())
        return cursor

    def _asked(self, query: str, values: Any = None) -> Iterator[tuple[Any, ...]]:
        """The rows of a query, a few of them in memory."""
        with clear_errors(self.address), self._connection.cursor(next(self._names)) as cursor:
            cursor.itersize = _FETCHED
            cursor.execute(query.encode(), values)
            yield from cursor


def _bounded(sql: str, types: Sequence[int], limit: int) -> str:
    """The question with long values cut, and at the end of each row how many of it are."""
    names = [f"c{at}" for at in range(len(types))]
    kinds: list[Kind] = [_KINDS.get(each, "text") for each in types]
    shown = bounded(list(zip(names, kinds, strict=True)))
    asked = f"asked({', '.join(names)})" if names else "asked"
    # OFFSET 0: else what a column is computed from would be computed for each mention of it.
    once = f"SELECT * FROM (\n{sql}\n) AS {asked} OFFSET 0"
    return f"SELECT {', '.join(shown)} FROM ({once}) AS once LIMIT {limit}"


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


def _as_recorded(table: Table, column: str) -> str:
    """A column as SQLite holds it: JSON is text, and what was no JSON is that text again."""
    name = f'"{column}"'
    if column not in table.json_columns:
        return name
    is_text = f"jsonb_typeof({name}) = 'string'"
    if column in table.json_values:  # where a text is JSON as well
        is_text += f" AND position('\\u0000' in {name} #>> '{{}}') > 0"
    return f"CASE WHEN {is_text} THEN {name} #>> '{{}}' ELSE {name}::text END"
