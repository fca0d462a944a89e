"""`query_sql`: reading by SQL, for what the other questions do not cover.

What keeps it harmless: an authorizer that lets a statement read and call functions and nothing
else, one statement, a deadline by a progress handler, and limits on rows, bytes and the length of
a value. The deadline is looked at between the steps of SQLite's virtual machine; where one step
must not outlast it either, `sql_process` runs the statement. The connection may be any; one in the
role "reader" cannot write anyway.
"""

from __future__ import annotations

import contextlib
import difflib
import math
import re
import sqlite3
import sys
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from typing import Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.store.questions.schema_text import columns_by_table
from webots_mcp.store.reading.deadline import QUESTION_DEADLINE_S, Deadline

MOST_ROWS: Final = 1000
MAX_BYTES: Final = 20_000  # about 5,000 tokens
MAX_TEXT: Final = 200  # characters of one value
MAX_VALUE_BYTES: Final = 10_000_000  # SQLite may build values of 1 GB otherwise
MAX_COLUMNS: Final = 100  # a row of so many such values still fits into memory

_READING: Final = frozenset(
    {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE}
)
_REFUSED_FUNCTIONS: Final = frozenset(
    {"load_extension", "fts3_tokenizer", "zeroblob", "randomblob"}
)
# Their first use on a connection defines them, which an authorizer would see as writing.
_LOAD_JSON_TABLES: Final = "SELECT 1 FROM json_each('[]'), json_tree('[]')"
_BEGINS: Final = re.compile(r"(?:\s|--[^\n]*\n|/\*.*?\*/)*(\w*)", re.DOTALL)
TOO_LARGE: Final = "it needs too much memory: read fewer or shorter values at a time"
_LONGEST_ERROR: Final = 300
_MISSING: Final = re.compile(r"no such (column|table): (\S+)")

Cell = int | float | str | None


@dataclass(frozen=True)
class Result:
    """The answer of `query_sql`.

    Attributes:
        truncated: Why rows are missing; None if none are.
        shortened: How many values were cut to 200 characters.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    truncated: str | None
    shortened: int


def query_sql(
    connection: sqlite3.Connection,
    statement: str,
    *,
    max_rows: int = 100,
    max_bytes: int = MAX_BYTES,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> Result:
    """Run one SELECT (or WITH ... SELECT, VALUES, EXPLAIN of one) and return its first rows.

    Args:
        connection: Any.
        statement: One SQL statement.
        max_rows: 1 to 1,000.
        max_bytes: The most bytes of values to return.
        deadline_s: Wall time after which it is interrupted.

    Raises:
        InvalidInputError: It is no single SELECT, would do more than read, is wrong, or took too
            long to give its first row; the text says what to do.
    """
    require_max_rows(max_rows)
    require_select(statement)
    deadline = Deadline(deadline_s)
    rows: list[tuple[Cell, ...]] = []
    budget = Budget(max_bytes)
    columns: tuple[str, ...] = ()
    why: str | None = None
    try:
        with (
            _only_reading(connection),
            budget.shortening(connection),
            deadline.interrupting(connection),
        ):
            cursor = connection.execute(statement)
            columns = tuple(str(column[0]) for column in cursor.description or ())
            why = fetch_rows(cursor, rows, max_rows, budget)
            cursor.close()
    except MemoryError as error:
        raise InvalidInputError(TOO_LARGE) from error
    except (sqlite3.Error, sqlite3.Warning, ValueError) as error:  # ValueError: a NUL, on 3.10
        if not (deadline.passed and "interrupted" in str(error)):
            raise InvalidInputError(_explain(connection, statement, error)) from error
        if not rows:
            raise InvalidInputError(too_slow(deadline_s)) from error
        why = f"stopped after {deadline_s:g} s; further rows may exist"
    return Result(columns, tuple(rows), why, budget.shortened)


def require_max_rows(max_rows: int) -> None:
    """Refuse more rows than an answer may have.

    Raises:
        InvalidInputError: The text says how many those are.
    """
    if not 1 <= max_rows <= MOST_ROWS:
        raise InvalidInputError(f"max_rows={max_rows} must be from 1 to {MOST_ROWS}")


def require_select(statement: str) -> None:
    """Refuse what does not even begin as a reading statement.

    Raises:
        InvalidInputError: The text says with what it begins.
    """
    if not statement.strip():
        raise InvalidInputError("the statement is empty: give one such as SELECT count(*) FROM run")
    begin = _BEGINS.match(statement)
    word = begin.group(1).upper() if begin else ""
    if word not in ("SELECT", "WITH", "VALUES", "EXPLAIN"):
        raise InvalidInputError(
            "only one reading statement is allowed (SELECT, WITH ... SELECT, EXPLAIN QUERY PLAN), "
            + (f"this begins with {word!r}" if word else "this begins with no word")
        )


@contextlib.contextmanager
def _only_reading(connection: sqlite3.Connection) -> Generator[None]:
    """Refuse all but reading, and values beyond 10 MB, until the end of the block."""
    connection.execute(_LOAD_JSON_TABLES).fetchall()
    before = _limit_values(connection, (MAX_VALUE_BYTES, MAX_COLUMNS))
    connection.set_authorizer(_authorize)
    try:
        yield
    finally:
        connection.set_authorizer(_allow)  # None is understood from Python 3.11 on only
        _limit_values(connection, before)


def _limit_values(connection: sqlite3.Connection, limits: tuple[int, int]) -> tuple[int, int]:
    """Set the longest value and the longest row that SQLite may build; what they were before."""
    if sys.version_info < (3, 11):
        return limits
    max_bytes, max_columns = limits
    return (
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max_bytes),
        connection.setlimit(sqlite3.SQLITE_LIMIT_COLUMN, max_columns),
    )


def _authorize(action: int, _first: str | None, function: str | None, *_: str | None) -> int:
    allowed = action in _READING and (
        action != sqlite3.SQLITE_FUNCTION or function not in _REFUSED_FUNCTIONS
    )
    return sqlite3.SQLITE_OK if allowed else sqlite3.SQLITE_DENY


def _allow(*_: object) -> int:
    return sqlite3.SQLITE_OK


class Budget:
    """Bytes that are left for values, and how many of these were shortened."""

    def __init__(self, max_bytes: int) -> None:
        self.left = max_bytes
        self.shortened = 0

    @contextlib.contextmanager
    def shortening(self, connection: sqlite3.Connection) -> Generator[None]:
        """Cut texts as they are read: the whole row is never in memory; bad UTF-8 is shown."""
        before = connection.text_factory
        connection.text_factory = self._text
        try:
            yield
        finally:
            connection.text_factory = before

    def take(self, row: Iterable[object]) -> tuple[Cell, ...]:
        """The values of a row as an answer has them; they are paid for."""
        cells = tuple(self._shown(value) for value in row)
        self.left -= sum(len(str(cell).encode("utf-8", "replace")) + 1 for cell in cells)
        return cells

    def _shown(self, value: object) -> Cell:
        if isinstance(value, bytes):
            return f"<blob of {len(value)} bytes>"
        if isinstance(value, float) and not math.isfinite(value):
            return str(value)  # JSON has no such number
        return value if isinstance(value, (int, float, str)) else None

    def _text(self, stored: bytes) -> str:
        text = stored.decode("utf-8", "replace")
        if len(text) <= MAX_TEXT:
            return text
        self.shortened += 1
        return f"{text[:MAX_TEXT]}... ({len(text)} characters)"


def fetch_rows(
    found: Iterable[Iterable[object]],
    rows: list[tuple[Cell, ...]],
    max_rows: int,
    budget: Budget,
) -> str | None:
    """Fill `rows`; why there are more, or None."""
    for row in found:
        if len(rows) == max_rows:
            return f"only the first {max_rows} rows; narrow the question, or count and aggregate"
        rows.append(budget.take(row))
        if budget.left < 0:
            return f"only {len(rows)} rows: their values are too long; name fewer columns"
    return None


def too_slow(deadline_s: float) -> str:
    """What to do about a statement that gave no row in time."""
    return (
        f"no row within {deadline_s:g} s; narrow it by run_id and sim_time_s (there is an index), "
        "use robot_statistics for long ranges, and end every recursion"
    )


def _explain(connection: sqlite3.Connection, statement: str, error: Exception) -> str:
    text = str(error)[:_LONGEST_ERROR]
    if "one statement" in text:
        return "only one statement is allowed"
    if "not authorized" in text or "prohibited" in text or "readonly" in text:
        return f"only reading is allowed ({text}): no writing, no ATTACH, no PRAGMA"
    if "number of bindings" in text:
        return (
            "?, :name, @name and $name are placeholders without values: write values in the SELECT"
        )
    if missing := _MISSING.search(text):
        return f"{text}; {_near(connection, statement, *missing.groups())}"
    return f"SQLite says: {text}"


def _near(connection: sqlite3.Connection, statement: str, what: str, name: str) -> str:
    """Names that were perhaps meant: columns of the tables that the statement names."""
    tables = columns_by_table(connection)
    wanted = name.rpartition(".")[2]
    if what == "table":
        return f"there is {', '.join(difflib.get_close_matches(wanted, tables, 3, 0.4) or tables)}"
    words = set(re.findall(r"\w+", statement))
    named = [table for table in tables if table in words] or list(tables)
    columns = dict.fromkeys(column for table in named for column in tables[table])
    near = difflib.get_close_matches(wanted, columns, 4, 0.5)
    if near:
        return f"there is {', '.join(near)} in {', '.join(named)}"
    return (
        "a published value is inside state.data: json_extract(data, '$.name'); "
        "the signal table has the paths"
    )
