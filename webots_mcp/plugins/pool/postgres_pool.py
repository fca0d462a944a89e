"""A pool in PostgreSQL: shipping to it, and reading it.

Rows are written by COPY, in one transaction with the progress. If PostgreSQL refuses a batch (a
value that it cannot hold, or a row that exists), the batch is written like rows that change: into a
temporary table, and from there row by row.
"""

from __future__ import annotations

import contextlib
import itertools
import json
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final, NoReturn, cast

import psycopg
from psycopg.adapt import AdaptersMap
from psycopg.types.numeric import FloatLoader
from psycopg.types.string import TextLoader

from webots_mcp.errors import InvalidInputError, PoolBusyError, PoolError
from webots_mcp.plugins.pool.duckdb_statement import answered
from webots_mcp.plugins.pool.pool_interface import (
    LISTED,
    Batch,
    PoolRow,
    ShippedTable,
    SQLValue,
    batches,
    redacted,
)
from webots_mcp.plugins.pool.postgres_connection import Connection, clear_errors, connect, one_line
from webots_mcp.plugins.pool.postgres_schema import OWNER, prepare, require_current
from webots_mcp.store.sql import SqlResult, require_max_rows

SELECT_S: Final = 60
"""Time limit of a SELECT."""
_SHIPPER: Final = 1_463_962_947
"""Seed of the lock that a shipper of a recording holds."""
_REPLACEMENT: Final = "\N{REPLACEMENT CHARACTER}"
# Errors of a batch with a value that PostgreSQL cannot hold, or with a row that exists.
_REFUSED: Final = (
    psycopg.DataError, psycopg.IntegrityError, psycopg.errors.ProgramLimitExceeded,
    psycopg.errors.StatementTooComplex,
)  # fmt: skip
_FETCHED: Final = 2000  # Rows that are read from the server at a time.
_PARAMETER: Final = "08P01"  # SQLSTATE of a parameter without a value.
_ASKED_WRONG: Final = ("22", "25006", "42", "57014", "0A", _PARAMETER)
"""SQLSTATEs, or their beginnings, of errors in the question itself."""


class PostgresPool:
    """A PostgreSQL database as a pool, read as of one moment; see `Pool`."""

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
        """Be the only shipper of a recording, as long as the connection lasts.

        Raises:
            PoolBusyError: Another process ships it.
        """
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
            with contextlib.suppress(
                psycopg.Error
            ):  # The connection was lost, and the lock with it.
                connection.execute(unlock, values)

    def rows_of(self, name: str) -> Iterator[tuple[str, Sequence[Any]]]:
        """Yield the UUID of the recording and the columns `LISTED` of each row of a table."""
        columns = ", ".join(map(_quoted, LISTED[name]))
        for owner, *row in self._asked(f"SELECT {OWNER}::text, {columns} FROM {name}"):
            yield owner, row

    def progress(self, recording_uuid: str) -> dict[str, int]:
        """Return how far the recording was shipped."""
        query = f"SELECT name, value FROM progress WHERE {OWNER} = %s"
        return {str(name): int(value) for name, value in self._asked(query, (recording_uuid,))}

    def rows(
        self, recording_uuid: str, table: ShippedTable, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        """Yield rows whose columns have one of some values, in any order."""
        conditions = "".join(f' AND "{column}" = ANY(%s)' for column in where)
        columns = ", ".join(
            f"{_quoted(each)}::text" if each in table.json_columns else _quoted(each)
            for each in table.columns
        )
        query = f"SELECT {columns} FROM {table.name} WHERE {OWNER} = %s{conditions}"
        asked = (recording_uuid, *(list(ids) for ids in where.values()))
        yield from batches(table, cast("Iterator[PoolRow]", self._asked(query, asked)))

    def picture(self, recording_uuid: str, path: str) -> bytes | None:
        """Return the file of a picture; None if it was not shipped."""
        query = f"SELECT content FROM picture WHERE {OWNER} = %s AND path = %s"
        found = list(self._asked(query, (recording_uuid, path)))
        return bytes(found[0][0]) if found else None

    def select(self, sql: str, max_rows: int) -> SqlResult:
        """Return the first rows of one SELECT.

        Raises:
            InvalidInputError: It is no SELECT, is wrong, or takes longer than a minute.
        """
        require_max_rows(max_rows)
        # A read-only transaction can create large objects: undo everything.
        undone = self._connection.transaction(force_rollback=True)
        with clear_errors(self.address), _clear_question(), undone:
            limit = f"SET LOCAL statement_timeout = {max(1, round(SELECT_S * 1000))}"
            self._connection.execute(limit.encode())
            # A cursor on the server accepts only one SELECT.
            with self._connection.cursor(next(self._names)) as cursor:
                _as_texts(cursor.adapters)
                cursor.execute(sql.replace("%", "%%").encode(), ())
                names = [each.name for each in cursor.description or ()]
                return answered(names, cursor.fetchmany(max_rows + 1), max_rows)

    def _asked(self, query: str, values: Any = None) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query, with few of them in memory."""
        with clear_errors(self.address), self._connection.cursor(next(self._names)) as cursor:
            cursor.itersize = _FETCHED
            cursor.execute(query.encode(), values)
            yield from cursor


def _as_texts(adapters: AdaptersMap) -> None:
    """Load all values but numbers, flags and bytes as the texts that PostgreSQL writes."""
    for each in psycopg.adapters.types:
        if each.name not in ("bool", "int2", "int4", "int8", "oid", "float4", "float8", "bytea"):
            adapters.register_loader(each.oid, TextLoader)
        if each.array_oid:
            adapters.register_loader(each.array_oid, TextLoader)
    adapters.register_loader("numeric", FloatLoader)


@contextmanager
def _clear_question() -> Generator[None]:
    """Convert errors in the question itself to InvalidInputError within the block."""
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
            f"{SELECT_S} s, of the tables and views of 'webots-mcp help pool'"
        ) from None


class PostgresShipment:
    """The part of the pool of one recording; see `Shipment`."""

    def __init__(self, connection: Connection, address: str, recording_uuid: str) -> None:
        self._connection, self._address, self._uuid = connection, address, recording_uuid

    def progress(self) -> dict[str, int]:
        """Return the progress that the last `write` stored."""
        with clear_errors(self._address):
            query = f"SELECT name, value FROM progress WHERE {OWNER} = %s"
            return dict(self._connection.execute(query.encode(), (self._uuid,)).fetchall())

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        """Return the runs that another recording has shipped, with its UUID."""
        with clear_errors(self._address):
            query = f"SELECT uuid, {OWNER}::text FROM run WHERE uuid = ANY(%s) AND {OWNER} <> %s"
            values = (list(run_uuids), self._uuid)
            return dict(self._connection.execute(query.encode(), values).fetchall())

    def write_picture(self, path: str, content: bytes) -> None:
        """Store a picture at once."""
        with clear_errors(self._address):
            self._connection.execute(
                f"INSERT INTO picture ({OWNER}, path, content) VALUES (%s, %s, %s) "
                f"ON CONFLICT ({OWNER}, path) DO UPDATE SET content = EXCLUDED.content".encode(),
                (self._uuid, path.replace("\0", _REPLACEMENT), content),
            )

    def write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> Counter[str]:
        """Write rows and progress, or nothing; return the number of replaced values by column."""
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
        """Write directly into the table.

        Through a temporary one if a row is refused, or may change.
        """
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
        """Return whether a step succeeded. If a row was refused, nothing of it was done."""
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
    """Return the statement that merges rows of a temporary table into their table."""
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
    # As text, since values of type json cannot be compared.
    olds = ", ".join(f"held.{column}::text" for column in news)
    return (
        f"{insert} ON CONFLICT ({OWNER}, {', '.join(map(_quoted, table.key))}) DO UPDATE "
        f"SET {changes} WHERE ({olds}) IS DISTINCT FROM "
        f"({', '.join(f'{new}::text' for new in news.values())})"
    )


def _holdable(table: ShippedTable, row: PoolRow, replaced: Counter[str]) -> PoolRow:
    """Return a row whose texts PostgreSQL can hold, and count the replaced values."""
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
    """Return a column name in quotes, since some are keywords of SQL."""
    return f'"{name}"'
