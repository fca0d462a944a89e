"""Reading a pool in PostgreSQL: what is there, rows to bring back, and one SELECT."""

from __future__ import annotations

import itertools
import re
import sys
import time
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from decimal import Decimal
from typing import Any, Final, TypeVar, cast

import psycopg
from psycopg.abc import Buffer
from psycopg.adapt import Loader

from webots_mcp.errors import InvalidInputError, PoolError
from webots_mcp.plugins.pool.pool_statement import Kind, answered, bounded
from webots_mcp.plugins.pool.postgres.connecting import Connection, clear_errors, connect, one_line
from webots_mcp.plugins.pool.postgres.postgres_schema import OWNER, require_current
from webots_mcp.plugins.pool.row_batch import Batch, Row, batches
from webots_mcp.plugins.pool.shipped_tables import Table, table, tables
from webots_mcp.plugins.pool.target import PooledSize, redacted
from webots_mcp.store.questions.sql import Result, require_max_rows

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
