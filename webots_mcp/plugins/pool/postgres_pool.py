"""A pool in PostgreSQL: shipping to it, and reading it.

Rows go in by COPY, in one transaction with how far they go. Where PostgreSQL refuses a batch (a
value that it cannot hold, a row that is there already), it goes the way of rows that change:
through a temporary table, where JSON is text still, and from there row by row.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from decimal import Decimal
from typing import Any, Final, cast

import psycopg
from psycopg.abc import Buffer
from psycopg.adapt import AdaptersMap, Loader
from psycopg.types.string import TextLoader

from webots_mcp.errors import InvalidInputError, PoolBusyError, PoolError
from webots_mcp.plugins.pool.duckdb_statement import answered
from webots_mcp.plugins.pool.pool_interface import (
    LISTED,
    Batch,
    PooledSize,
    Row,
    SQLValue,
    Table,
    batches,
    redacted,
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

SELECT_S: Final = 60
_SHIPPER: Final = 1_463_962_947  # the seed of the lock of who ships a recording
_TYPES: Final = {int: "bigint", float: "double precision", str: "text", bytes: "bytea"}
_REPLACEMENT: Final = "\N{REPLACEMENT CHARACTER}"
# Of values, where a batch has one that PostgreSQL cannot hold; and of rows that are there already.
_REFUSED: Final = (
    psycopg.DataError, psycopg.IntegrityError, psycopg.errors.ProgramLimitExceeded,
    psycopg.errors.StatementTooComplex,
)  # fmt: skip
_FETCHED: Final = 2000  # rows that are asked of the server at a time
_COUNTED_BYTES: Final = 200_000_000  # larger tables are not counted, which would take long
_SIZE: Final = """
SELECT sum(pg_total_relation_size(oid))::bigint,
  sum(reltuples) FILTER (WHERE relkind = 'r')::bigint,
  coalesce(bool_and(reltuples >= 0) FILTER (WHERE relkind = 'r'), false)
FROM pg_class WHERE oid = %(name)s::regclass
  OR oid IN (SELECT relid FROM pg_partition_tree(%(name)s))"""
_PATHS: Final = f"""
SELECT u.id, s.path FROM run u JOIN signal s USING ({OWNER}, robot_id)
WHERE {OWNER} = %s ORDER BY s.id"""
_STEP: Final = re.compile(r'\.("(?:[^"\\]|\\.)*"|[^."\[\]]+)|\[(\d+)\]')
_ENCODED: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode
_LONG: Final = re.compile(r"\d{19}")
KeyOrder = dict[str, Any]
_AS_THEY_ARE: Final = ("bool", "int2", "int4", "int8", "oid", "float4", "float8", "bytea")
_PARAMETER: Final = "08P01"  # one SQLSTATE of what the client did wrong: it gave no values
_ASKED_WRONG: Final = ("22", "25006", "42", "57014", "0A", _PARAMETER)  # that a question has


class PostgresTarget:
    """A PostgreSQL database as a pool to ship to; see `Target`."""

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
        """See `postgres_schema.prepare`."""
        prepare(self._url, self.address)

    @contextmanager
    def shipment(self, recording_uuid: str) -> Generator[PostgresShipment]:
        """Be the one who ships this recording, as long as the connection lasts."""
        if self._connection is None or self._connection.closed:  # it was lost
            self._connection = connect(self._url, self.address)
        connection, values = self._connection, (recording_uuid, _SHIPPER)
        with clear_errors(self.address):
            require_current(connection, self.address)
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


class PostgresShipment:
    """One recording's part of the pool; see `Shipment`."""

    def __init__(self, connection: Connection, address: str, recording_uuid: str) -> None:
        self._connection, self._address, self._uuid = connection, address, recording_uuid
        self._parts: set[tuple[str, int, int]] = set()  # partitions that are there

    def progress(self) -> dict[str, int]:
        """What the last `write` left."""
        with clear_errors(self._address):
            query = f"SELECT name, value FROM progress WHERE {OWNER} = %s"
            return dict(self._connection.execute(query.encode(), (self._uuid,)).fetchall())

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        """Those that another recording has shipped."""
        with clear_errors(self._address):
            found = self._connection.execute(
                f"SELECT uuid, {OWNER}::text FROM run_owner WHERE uuid = ANY(%s) AND {OWNER} <> %s "
                "ORDER BY uuid".encode(),
                (list(run_uuids), self._uuid),
            )
            return dict(found.fetchall())

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
        with clear_errors(self._address):
            try:
                return self._write(batches, progress)
            except psycopg.errors.CheckViolation:  # somebody dropped the months that are over
                self._parts.clear()
                return self._write(batches, progress)

    def _write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> Counter[str]:
        for part in set[tuple[str, int, int]]().union(*map(_parts, batches)) - self._parts:
            # Apart from the transaction of the rows: others wait for the end of this one.
            self._connection.execute("SELECT make_partition(%s, %s, %s)", part)
            self._parts.add(part)
        replaced = Counter[str]()
        with self._connection.transaction():
            self._keep_others_waiting()
            for batch in batches:
                self._write_batch(batch, replaced)
            self._connection.execute(
                f"INSERT INTO progress ({OWNER}, name, value) "
                "SELECT %s, unnest(%s::text[]), unnest(%s::bigint[]) "
                f"ON CONFLICT ({OWNER}, name) DO UPDATE SET value = EXCLUDED.value".encode(),
                (self._uuid, list(progress), list(progress.values())),
            )
            self._connection.execute(
                "UPDATE shipment SET replaced_values = replaced_values + %s, "
                f"shipped_wall_time_s = %s WHERE {OWNER} = %s".encode(),
                (replaced.total(), time.time(), self._uuid),
            )
        return replaced

    def _keep_others_waiting(self) -> None:
        """All who ship this recording, until the end of the transaction."""
        values = (self._uuid,)
        insert = f"INSERT INTO shipment ({OWNER}) VALUES (%s) ON CONFLICT DO NOTHING"
        self._connection.execute(insert.encode(), values)
        lock = f"SELECT 1 FROM shipment WHERE {OWNER} = %s FOR UPDATE"
        self._connection.execute(lock.encode(), values)

    def _write_batch(self, batch: Batch, replaced: Counter[str]) -> None:
        if batch.table.name == "run":
            self._own_runs(batch)
        if batch.table.is_appended:
            names = ", ".join([OWNER, *map(_quoted, batch.table.columns)])
            rows = ((self._uuid, *row) for row in batch.rows)
            if self._tried(lambda: self._copy(f"{batch.table.name} ({names})", rows)):
                return
        self._merge(batch, replaced)

    def _own_runs(self, batch: Batch) -> None:
        """Say that these runs are this recording's; those of two at once wait for each other."""
        at = batch.table.columns.index("uuid")
        uuids = sorted({str(row[at]) for row in batch.rows if row[at] is not None})
        self._connection.execute(
            f"INSERT INTO run_owner (uuid, {OWNER}) SELECT unnest(%s::text[]), %s "
            "ON CONFLICT DO NOTHING".encode(),
            (uuids, self._uuid),
        )
        if others := self.foreign_runs(uuids):
            uuid, owner = next(iter(others.items()))
            raise PoolError(f"the run {uuid} was shipped to {self._address} by recording {owner}")

    def _merge(self, batch: Batch, replaced: Counter[str]) -> None:
        """Through a temporary table, where JSON is text and a row may be there already."""
        table, staged = batch.table, f"staged_{batch.table.name}"
        columns = ", ".join(
            f"{_quoted(column)} {_TYPES[kind]}"
            for column, kind in zip(table.columns, table.types, strict=True)
        )
        make = f"CREATE TEMPORARY TABLE IF NOT EXISTS {staged} ({columns}) ON COMMIT DELETE ROWS"
        self._connection.execute(make.encode())
        self._connection.execute(f"TRUNCATE {staged}".encode())
        if not self._tried(lambda: self._copy(staged, batch.rows)):
            self._copy(staged, [_without_nul(table, row, replaced) for row in batch.rows])
        self._connection.execute(_merging(table, staged).encode(), (self._uuid,))

    def _tried(self, step: Callable[[], None]) -> bool:
        """Whether a step was done; otherwise, where a row was refused, nothing of it."""
        try:
            with self._connection.transaction():
                step()
        except _REFUSED:
            return False
        return True

    def _copy(self, into: str, rows: Iterable[Row]) -> None:
        with (
            self._connection.cursor() as cursor,
            cursor.copy(f"COPY {into} FROM STDIN".encode()) as copy,
        ):
            for row in rows:
                copy.write_row(row)


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
    news = {
        _quoted(each): f"coalesce(EXCLUDED.{_quoted(each)}, held.{_quoted(each)})"
        if each in table.lasting
        else f"EXCLUDED.{_quoted(each)}"
        for each in table.columns
        if each not in table.key
    }
    if table.is_appended or not news:
        return f"{insert} ON CONFLICT DO NOTHING"
    changes = ", ".join(f"{column} = {new}" for column, new in news.items())
    olds = ", ".join(f"held.{column}" for column in news)
    return (
        f"{insert} ON CONFLICT ({OWNER}, {', '.join(map(_quoted, table.key))}) DO UPDATE "
        f"SET {changes} WHERE ({olds}) IS DISTINCT FROM ({', '.join(news.values())})"
    )


def _parts(batch: Batch) -> set[tuple[str, int, int]]:
    """The table and the months of a batch that is cut by time."""
    if (column := batch.table.time_column) is None:
        return set()
    at = batch.table.columns.index(column)
    times = [cast("float", row[at]) for row in batch.rows]
    days = {time_s // 86_400 * 86_400 for time_s in times if FIRST_S <= time_s < END_S}
    months = (datetime.fromtimestamp(day_s, timezone.utc) for day_s in days)
    return {(batch.table.name, day.year, day.month) for day in months}


def _without_nul(table: Table, row: Row, replaced: Counter[str]) -> Row:
    """A row whose texts have what PostgreSQL can hold in the place of NUL, which is counted."""
    nul = [isinstance(value, str) and "\0" in value for value in row]
    replaced.update(f"{table.name}.{table.columns[at]}" for at, has in enumerate(nul) if has)
    return tuple(
        str(value).replace("\0", _REPLACEMENT) if has else value
        for value, has in zip(row, nul, strict=True)
    )


def _quoted(name: str) -> str:
    """A name of ours in SQL; some are words of it."""
    return f'"{name}"'


# -- reading ----------------------------------------------------------------------------------


class _NumericLoader(Loader):
    """As a number; one that is larger than any float as its text, with 17 digits."""

    def load(self, data: Buffer) -> float | str:
        number = Decimal(bytes(data).decode())
        if number.is_finite() and abs(number) > sys.float_info.max:
            return f"{number:.16e}"
        return float(number)


def _as_texts(adapters: AdaptersMap) -> None:
    """Have all values as PostgreSQL writes them, but numbers, flags and bytes."""
    for each in psycopg.adapters.types:
        if each.name not in _AS_THEY_ARE:
            adapters.register_loader(each.oid, TextLoader)
        if each.array_oid:
            adapters.register_loader(each.array_oid, TextLoader)
    adapters.register_loader("numeric", _NumericLoader)


class PostgresPool:
    """A PostgreSQL database as a pool to read from, in one moment of it; see `Pool`."""

    def __init__(self, url: str) -> None:
        self._url, self.address = url, redacted(url)
        self._names = (f"rows_{number}" for number in itertools.count())
        self._opened: Connection | None = None

    def __enter__(self) -> PostgresPool:
        self._opened = connect(self._url, self.address)
        try:
            with clear_errors(self.address):
                self._opened.execute("SET idle_in_transaction_session_timeout = '15min'")
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

    def listed(self, name: str) -> Iterator[tuple[str, Sequence[Any]]]:
        """The columns `LISTED` of all rows of such a table, behind their recording's UUID."""
        columns = ", ".join(map(_quoted, LISTED[name]))
        for owner, *row in self._asked(f"SELECT {OWNER}::text, {columns} FROM {name}"):
            yield owner, row

    def sizes(self) -> Iterator[PooledSize]:
        """Bytes with those of indexes; rows of large tables as PostgreSQL last estimated them."""
        for each in (*(each.name for each in tables()), "picture"):
            ((size_bytes, rows, is_estimated),) = self._asked(_SIZE, {"name": each})
            if size_bytes < _COUNTED_BYTES or not is_estimated:
                ((rows,),) = self._asked(f"SELECT count(*) FROM {each}")
            yield PooledSize(each, rows, size_bytes)

    def progress(self, recording_uuid: str) -> dict[str, int]:
        """How far the recording was shipped."""
        query = f"SELECT name, value FROM progress WHERE {OWNER} = %s"
        return {str(name): int(value) for name, value in self._asked(query, (recording_uuid,))}

    def rows(
        self, recording_uuid: str, table: Table, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        """Rows with their JSON as text, in PostgreSQL's notation; keys of states as they came."""
        conditions = "".join(f' AND "{column}" = ANY(%s)' for column in where)
        query = (
            f"SELECT {', '.join(_as_recorded(table, each) for each in table.columns)} "
            f"FROM {table.name} WHERE {OWNER} = %s{conditions}"
        )
        asked = (recording_uuid, *(list(ids) for ids in where.values()))
        rows = cast("Iterator[Row]", self._asked(query, asked))
        if table.name in ("state", "kept_state"):
            rows = self._ordered(recording_uuid, table, rows)
        yield from batches(table, rows)

    def _ordered(self, recording_uuid: str, table: Table, rows: Iterable[Row]) -> Iterator[Row]:
        """States with their keys in the order in which signals came: jsonb has one of its own."""
        orders = dict[SQLValue, KeyOrder]()
        for run_id, path in self._asked(_PATHS, (recording_uuid,)):
            _add_path(orders.setdefault(run_id, {}), path)
        run, data = (table.columns.index(each) for each in ("run_id", "data"))
        for row in rows:
            text = _in_order(str(row[data]), orders.get(row[run], {}))
            yield (*row[:data], text, *row[data + 1 :])

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


def _add_path(order: KeyOrder, path: str) -> None:
    """Note the keys on the path of a signal, unless they are known."""
    for key, index in _STEP.findall(path):
        order = order.setdefault(_key(key) if key else index, {})


def _key(step: str) -> str:
    try:
        return str(json.loads(step)) if step.startswith('"') else step
    except ValueError:
        return step[1:-1]


def _in_order(text: str, order: KeyOrder) -> str:
    """A state as JSON text with its keys in that order; what the order lacks comes last.

    A whole number beyond those of SQLite was a float, which PostgreSQL spells out.
    """
    try:
        state = json.loads(text, parse_int=_number if _LONG.search(text) else None)
        ordered = _ENCODED(_sorted(state, order))
        ordered.encode()
    except (ValueError, OverflowError, RecursionError):
        return text  # no JSON, or halves of characters: it is held as the text that it was
    return ordered


def _number(digits: str) -> int | float:
    number = int(digits)
    return number if -(2**63) <= number < 2**63 else float(number)


def _sorted(value: Any, order: KeyOrder) -> Any:
    if isinstance(value, dict):
        members = cast("dict[str, Any]", value)
        known = {key: _sorted(members[key], order[key]) for key in order if key in members}
        return known if len(known) == len(members) else known | members | known
    if isinstance(value, list) and any(order.values()):
        items = cast("list[Any]", value)
        return [_sorted(item, order.get(str(at), {})) for at, item in enumerate(items)]
    return cast("Any", value)


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
    name = _quoted(column)
    if column not in table.json_columns:
        return name
    is_text = f"jsonb_typeof({name}) = 'string'"
    if column in table.json_values:  # where a text is JSON as well
        is_text += f" AND position('\\u0000' in {name} #>> '{{}}') > 0"
    return f"CASE WHEN {is_text} THEN {name} #>> '{{}}' ELSE {name}::text END"
