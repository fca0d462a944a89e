"""Shipping to PostgreSQL: rows by COPY, in one transaction with how far they go.

Rows that are new, as a rule, go straight to their table. Where PostgreSQL refuses a batch (a value
that it cannot hold, a row that is there already), it goes the way of all others: through a
temporary table, where JSON is text still, and from there row by row.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from typing import Any, Final, TypeVar, cast

import psycopg
from psycopg.adapt import Buffer, Dumper

from webots_mcp.errors import PoolBusyError, PoolError
from webots_mcp.plugins.pool.postgres.connecting import Connection, clear_errors, connect
from webots_mcp.plugins.pool.postgres.postgres_schema import (
    END_S,
    FIRST_S,
    OWNER,
    prepare,
    require_current,
)
from webots_mcp.plugins.pool.row_batch import Batch, Row, nearest, number_in
from webots_mcp.plugins.pool.shipped_tables import SQLValue, Table
from webots_mcp.plugins.pool.target import redacted

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
