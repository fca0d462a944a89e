"""Answer `query_sql`: reading by SQL, for what the other questions do not cover.

Several limits keep it harmless: an authorizer that only lets a statement read and call functions, a
single statement, a deadline by a progress handler, and limits on rows, bytes and the length of a
value. The deadline is checked between the steps of SQLite's virtual machine. If a single step must
not exceed it either, a separate process runs the statement. The connection may be any; one in the
role "reader" cannot write anyway.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import sqlite3
import sys
import tempfile
import threading
from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.location import Database
from webots_mcp.database.schema import shipped_objects
from webots_mcp.errors import InvalidInputError, WebotsMCPError
from webots_mcp.signals.naming import listed
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.run_rows import reading_texts

MOST_ROWS: Final = 1000
MAX_BYTES: Final = 20_000  # about 5,000 tokens
MAX_TEXT: Final = 200  # characters of one value
MAX_COLUMNS: Final = 100  # a row of that many such values still fits into memory
_READING: Final = frozenset(
    {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE}
)
_REFUSED_FUNCTIONS: Final = frozenset(
    {"load_extension", "fts3_tokenizer", "zeroblob", "randomblob"}
)
TOO_LARGE: Final = "it needs too much memory: read fewer or shorter values at a time"
_MOST_NAMED: Final = 2  # tables whose columns an error lists, even if none is similar
LINE: Final = (sys.executable, "-m", __name__)
# Modules are searched here first, so that no file of the user's folder replaces one.
FOLDER: Final = Path(__file__).parents[2]  # contains the package
_TIMED_OUT: Final = 124  # the exit code of timeout(1), which no other end of the process has
_OBJECTS: Final = (
    "SELECT name, type, sql FROM sqlite_master WHERE type IN ('table', 'view') "
    "AND name NOT LIKE 'sqlite_%' AND name <> 'alembic_version' ORDER BY type, rowid"
)
# Tables that serve the recording itself: a question needs their names at most.
_BOOKKEEPING: Final = (
    "console_line",
    "lease",
    "watermark",
    "recording",
    "retention_limit",
    "kept_state",
    "row_group",
    "chunk",
)
_BOOKKEEPING_COLUMNS: Final = (
    "uuid",
    "process",
    "last_adopted_entry",
    "last_seen_monotonic_s",
    "mode_before_pause",
    "is_chunked",
)


@dataclass(frozen=True)
class QueryLimits:
    """Limits of a query, which keep its process and its answer small.

    Attributes:
        value_bytes: Maximum size of one value; SQLite would build values of 1 GB.
        error_characters: Length at which an error is cut.
        offered_columns: Columns that are offered instead of an unknown one.
        heap_bytes: Maximum memory of SQLite.
        grace_s: Wall time after SQLite's own deadline, which keeps the rows found so far.
    """

    value_bytes: int = 10_000_000
    error_characters: int = 300
    offered_columns: int = 20
    heap_bytes: int = 400_000_000
    grace_s: float = 0.3


_LIMITS: Final = QueryLimits()


Cell = int | float | str | None


@dataclass(frozen=True)
class SqlResult:
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
) -> SqlResult:
    """Run one SELECT (or WITH ... SELECT, VALUES, EXPLAIN of one) and return its first rows.

    Args:
        connection: An open database.
        statement: One SQL statement.
        max_rows: 1 to 1,000.
        max_bytes: Maximum size of the returned values.
        deadline_s: Wall time after which it is interrupted.

    Raises:
        InvalidInputError: It is no single SELECT, would do more than read, is invalid, or took too
            long to produce its first row; the text says what to do.
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
    # ValueError: a NUL character, on 3.10
    except (sqlite3.Error, sqlite3.Warning, ValueError) as error:
        if not (deadline.passed and "interrupted" in str(error)):
            raise InvalidInputError(_explain(connection, statement, error)) from error
        if not rows:
            raise InvalidInputError(too_slow(deadline_s)) from error
        why = f"stopped after {deadline_s:g} s; further rows may exist"
    return SqlResult(columns, tuple(rows), why, budget.shortened)


def require_max_rows(max_rows: int) -> None:
    """Refuse more rows than an answer may have.

    Raises:
        InvalidInputError: The text states the maximum.
    """
    if not 1 <= max_rows <= MOST_ROWS:
        raise InvalidInputError(f"max_rows={max_rows} must be from 1 to {MOST_ROWS}.")


def require_select(statement: str) -> None:
    """Refuse statements that do not begin with a reading keyword.

    Raises:
        InvalidInputError: The text states how the statement begins.
    """
    if not statement.strip():
        raise InvalidInputError(
            "The statement is empty. Give one such as SELECT count(*) FROM run."
        )
    begin = re.match(r"(?:\s|--[^\n]*\n|/\*.*?\*/)*(\w*)", statement, flags=re.DOTALL)
    word = begin.group(1).upper() if begin else ""
    if word not in ("SELECT", "WITH", "VALUES", "EXPLAIN"):
        begins = f"begins with {word!r}" if word else "begins with no word"
        raise InvalidInputError(
            f"The statement {begins}, but only one reading statement is allowed. "
            "Use SELECT, WITH ... SELECT or EXPLAIN QUERY PLAN."
        )


@contextlib.contextmanager
def _only_reading(connection: sqlite3.Connection) -> Generator[None]:
    """Refuse everything but reading, and values beyond 10 MB, until the end of the block."""
    # The first use on a connection defines these functions, which the authorizer counts as writing.
    connection.execute("SELECT 1 FROM json_each('[]'), json_tree('[]')").fetchall()
    before = _limit_values(connection, (_LIMITS.value_bytes, MAX_COLUMNS))
    connection.set_authorizer(_authorize)
    try:
        yield
    finally:
        connection.set_authorizer(_allow)  # None is accepted only from Python 3.11 on
        _limit_values(connection, before)


def _limit_values(connection: sqlite3.Connection, limits: tuple[int, int]) -> tuple[int, int]:
    """Set the longest value and row that SQLite may build. Return the previous limits."""
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
    """Bytes that remain for values, and how many of these were shortened."""

    def __init__(self, max_bytes: int) -> None:
        self.left = max_bytes
        self.shortened = 0

    def shortening(self, connection: sqlite3.Connection) -> AbstractContextManager[None]:
        """Cut texts while reading, so that a long row is never in memory; show invalid UTF-8."""
        return reading_texts(connection, self._text)

    def take(self, row: Iterable[object]) -> tuple[Cell, ...]:
        """Return the values of a row for an answer, and subtract their size."""
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
    """Fill `rows`. Return why there are more, or None."""
    for row in found:
        if len(rows) == max_rows:
            return f"only the first {max_rows} rows; narrow the question, or count and aggregate"
        rows.append(budget.take(row))
        if budget.left < 0:
            return f"only {len(rows)} rows: their values are too long; name fewer columns"
    return None


def too_slow(deadline_s: float) -> str:
    """Return what to do about a statement that gave no row in time."""
    return (
        f"no row within {deadline_s:g} s; narrow it by run_id and sim_time_s (there is an index), "
        "use robot_statistics for long ranges, and end every recursion"
    )


def _explain(connection: sqlite3.Connection, statement: str, error: Exception) -> str:
    text = str(error)[: _LIMITS.error_characters]
    if "one statement" in text:
        return "Only one statement is allowed in a call. Send each in a call of its own."
    if "not authorized" in text or "prohibited" in text or "readonly" in text:
        return f"Only reading is allowed ({text}): no writing, no ATTACH, no PRAGMA. Use SELECT."
    if "number of bindings" in text:
        return (
            "The placeholders ?, :name, @name and $name have no values. "
            "Write the values into the SELECT itself."
        )
    if missing := re.search(r"no such (column|table): (\S+)", text):
        return _near(connection, statement, *missing.groups())
    return f"SQLite reports: {text}."


def _near(connection: sqlite3.Connection, statement: str, what: str, name: str) -> str:
    """Return that it is missing, with the tables or columns that exist, the most similar first."""
    tables = columns_by_table(connection)
    wanted = name.rpartition(".")[2]
    if what == "table":
        return (
            f"No table {name!r}. Tables, the nearest first: "
            f"{', '.join(_by_likeness(wanted, tables))}."
        )
    words = set(re.findall(r"\w+", statement))
    named = [table for table in tables if table in words] or list(tables)
    columns = dict.fromkeys(column for table in named for column in tables[table])
    said = f"No column {name!r}."
    from difflib import get_close_matches

    if len(named) <= _MOST_NAMED or get_close_matches(wanted, columns, 1, 0.5):
        offer = listed(_by_likeness(wanted, columns), _LIMITS.offered_columns)
        whose = ", ".join(named[:_MOST_NAMED])
        said += f" Columns of {whose}, the nearest first: {offer}."
    return (
        f"{said} A published value is in state.data: json_extract(data, '$.name'); "
        "the table signal has the paths."
    )


def _by_likeness(wanted: str, names: Iterable[str]) -> list[str]:
    from difflib import get_close_matches

    return [*dict.fromkeys([*get_close_matches(wanted, names, 4, 0.4), *names])]


# -- a separate process, which the deadline ends whatever the engine is doing ----------------------


@dataclass(frozen=True)
class Statement:
    """A statement to run; see `query_sql`. The database is a file, or the URL of a pool."""

    database: str
    sql: str
    max_rows: int
    max_bytes: int
    deadline_s: float

    def encoded(self) -> bytes:
        """Return the request in the form that the process reads."""
        return json.dumps(asdict(self), ensure_ascii=False).encode()  # fails here if it is no text


def decode(answer: bytes, exit_code: int, asked: Statement, slow: str | None = None) -> SqlResult:
    """Return what the process answered; one that ended before answering took too long.

    Args:
        answer: What it wrote to stdout.
        exit_code: Its exit code.
        asked: The statement.
        slow: What to do about a slow statement, if it was not for SQLite.

    Raises:
        InvalidInputError: As for `query_sql`.
        WebotsMCPError: The process ended for another reason, not because of the statement.
    """
    if exit_code == _TIMED_OUT:
        raise InvalidInputError(slow or too_slow(asked.deadline_s))
    if exit_code < 0:
        raise InvalidInputError(f"signal {-exit_code} ended the statement; perhaps {TOO_LARGE}")
    if exit_code != 0:
        raise WebotsMCPError(
            f"the process that runs the statement ended without an answer (exit code {exit_code}); "
            "the server's stderr may tell why. Was webots-mcp updated or moved since the server "
            "started? Then start the server again"
        )
    found = json.loads(answer)
    if "error" in found:
        raise InvalidInputError(found["error"])
    rows: tuple[tuple[Cell, ...], ...] = tuple(tuple(row) for row in found["rows"])
    return SqlResult(tuple(found["columns"]), rows, found["truncated"], found["shortened"])


@contextlib.contextmanager
def as_file(database: Database) -> Generator[Path]:
    """Return the database as a file for another process; a database in memory is copied."""
    if isinstance(database, Path):
        yield database
        return
    with tempfile.TemporaryDirectory(prefix="webots-mcp-") as folder:
        file = Path(folder) / DATABASE_NAME
        with closing(connect(database, "reader")) as memory, closing(sqlite3.connect(file)) as copy:
            memory.backup(copy)
        yield file


def main(ask: Callable[[Statement], SqlResult]) -> None:
    """Answer the request on stdin."""
    asked = Statement(**json.load(sys.stdin))
    end = threading.Timer(asked.deadline_s + _LIMITS.grace_s, os._exit, [_TIMED_OUT])
    end.daemon = True
    end.start()
    try:
        answer = asdict(ask(asked))
    except (WebotsMCPError, sqlite3.Error) as error:
        answer = {"error": str(error)}
    except MemoryError:
        answer = {"error": TOO_LARGE}
    sys.stdout.write(json.dumps(answer))


def _ask(asked: Statement) -> SqlResult:
    with closing(connect(Path(asked.database), "reader")) as connection:
        connection.execute(f"PRAGMA hard_heap_limit={_LIMITS.heap_bytes}")
        return query_sql(
            connection, asked.sql, max_rows=asked.max_rows, max_bytes=asked.max_bytes,
            deadline_s=asked.deadline_s,
        )  # fmt: skip


# -- the schema as a short text, read from the database itself -------------------------------------


def columns_by_table(connection: sqlite3.Connection) -> dict[str, list[str]]:
    """Return the columns of our tables and views; those of other programs are left out."""
    return {
        name: [
            column
            for (column,) in connection.execute(
                "SELECT name FROM pragma_table_info(?) ORDER BY cid", (name,)
            )
        ]
        for name, _, _ in connection.execute(_OBJECTS).fetchall()
        if name in shipped_objects()
    }


def describe_schema(connection: sqlite3.Connection) -> str:
    """Return one line per group of tables and views with the same columns, with their comments.

    The comment of a column is not repeated in later tables. Bookkeeping tables are only named.
    """
    columns = columns_by_table(connection)
    names: dict[frozenset[str], list[str]] = {}
    listed: dict[frozenset[str], str] = {}
    listed_before = set[tuple[str, str]]()
    for name, kind, sql in connection.execute(_OBJECTS).fetchall():
        if name in _BOOKKEEPING or name not in columns:
            continue
        same = frozenset(columns[name]).difference(_BOOKKEEPING_COLUMNS)
        names.setdefault(same, []).append(f"{kind} {name}")
        if same not in listed:
            found = dict.fromkeys(
                re.findall(r'^\s*"?(\w+)"?\s[^\n,]*?/\* (.*?) \*/', sql, flags=re.MULTILINE)
                if kind == "table"
                else ()
            )
            listed[same] = _listed(columns[name], dict(e for e in found if e not in listed_before))
            listed_before.update(found)
    lines = (f"{', '.join(alike)}: {listed[same]}" for same, alike in names.items())
    rules = (
        "Times are seconds: sim_time_s of the simulation, wall_time_s Unix. state.data is JSON: "
        "json_extract(data, '$.pose[0]'); signal.path has the path of each name. A range of a "
        "run is fast by run_id and sim_time_s; for a long one use robot_statistics (min, max, "
        "mean of about 1,024 rows each, also of purged ones; not of rows in no chunk: the newest "
        "of a run that goes on, up to 1,023, and the last of an ended one where they are fewer "
        "than 256)."
    )
    return "\n".join((rules, *lines, _bookkeeping()))


def _listed(columns: list[str], comments: dict[str, str]) -> str:
    return ", ".join(
        f"{name} [{comments[name]}]" if name in comments else name
        for name in columns
        if name not in _BOOKKEEPING_COLUMNS
    )


def _bookkeeping() -> str:
    tables, columns = ", ".join(_BOOKKEEPING), ", ".join(_BOOKKEEPING_COLUMNS)
    return f"bookkeeping, not listed: tables {tables}; columns {columns}"


if __name__ == "__main__":
    main(_ask)
