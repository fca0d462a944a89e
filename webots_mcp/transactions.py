"""Transactions on a database that control loops write to as well, and what SQLite's errors mean.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from typing import Final, TypeVar

Result = TypeVar("Result")

_UNINTERRUPTED_MS: Final = 100
LONGEST_WRITE_S: Final = 0.001  # of maintenance: a robot that wants to write waits so long
_UNWRITABLE: Final = ("readonly database", "unable to open database file")
_CALLED_OFF: Final = "called off"
_DAMAGE: Final = ("malformed", "not a database", "unsupported file format")
_SAYS_NOTHING: Final = "malformed database, which SQLite names in bytes that are not text"
_ABOUT_A_VALUE: Final = (
    "malformed JSON", "JSON cannot hold", "JSON path", "to UTF-8 column", "integer overflow",
    "user-defined function",
)  # fmt: skip

# All that a statement may raise because of the database.
FAILURES: Final = (sqlite3.Error, sqlite3.Warning, UnicodeDecodeError, SystemError)


def never_wait(connection: sqlite3.Connection) -> None:
    """From now on a lock that is held by another is an error at once, not a wait."""
    connection.execute("PRAGMA busy_timeout=0")


@contextmanager
def transaction(connection: sqlite3.Connection) -> Generator[None]:
    """All that is written inside is stored, or nothing; the write lock is taken before the first.

    Args:
        connection: In autocommit mode and in no transaction, as `connect` gives it.

    Raises:
        sqlite3.Error: Also where the lock is not to be had (`is_busy`); then nothing ran inside.
    """
    try:
        _begin(connection)
        yield
        connection.execute("COMMIT")
    except BaseException:
        roll_back(connection)
        raise


def _begin(connection: sqlite3.Connection) -> None:
    """Take the write lock, waiting for it in pieces: SQLite's own wait cannot be interrupted."""
    (patience_ms,) = connection.execute("PRAGMA busy_timeout").fetchone()
    if patience_ms <= _UNINTERRUPTED_MS:
        connection.execute("BEGIN IMMEDIATE")
        return
    until_s = time.monotonic() + patience_ms / 1000
    connection.execute(f"PRAGMA busy_timeout={_UNINTERRUPTED_MS}")
    try:
        while not _begun(connection, last=time.monotonic() > until_s):
            pass
    finally:
        connection.execute(f"PRAGMA busy_timeout={patience_ms}")


def _begun(connection: sqlite3.Connection, *, last: bool) -> bool:
    """Whether the write lock is had; the last attempt raises where it is not."""
    try:
        connection.execute("BEGIN IMMEDIATE")
    except sqlite3.OperationalError as error:
        if last or not is_busy(error):
            raise
        return False
    return True


def in_transaction(connection: sqlite3.Connection, act: Callable[[], Result]) -> Result:
    """As `transaction`, also where a KeyboardInterrupt comes between any two lines.

    A `with` statement has a moment after BEGIN and one before COMMIT that are outside of it.
    """
    try:
        connection.execute("BEGIN IMMEDIATE")
        result = act()
        connection.execute("COMMIT")
    except BaseException:
        roll_back(connection)
        raise
    return result


def roll_back(connection: sqlite3.Connection) -> None:
    """End the transaction, if one is still open: on a full disk SQLite has ended it already."""
    if connection.in_transaction:
        connection.execute("ROLLBACK")


class ShortWrites:
    """Work in transactions that hold the write lock for about a millisecond, commit included.

    What an item costs differs a hundredfold from one recording to another, so it is measured: a
    transaction ends when the next item and the commit of all of them would go beyond the time.

    Attributes:
        held_s: How long the last transaction held the lock.
        longest_held_s: How long the longest one did.
    """

    def __init__(self, connection: sqlite3.Connection, limit_s: float = LONGEST_WRITE_S) -> None:
        self._connection = connection
        self._limit_s = limit_s
        self._commit_s = 0.0  # of an item, about
        self.held_s = 0.0
        self.longest_held_s = 0.0

    def write(self, items: Iterable[Result], store: Callable[[Result], object]) -> int:
        """Store the first items in one transaction; returns how many: one at least, if any.

        Raises:
            sqlite3.Error: Also where the lock is not to be had (`is_busy`); nothing was stored.
        """
        stored, started_s, working_s = 0, 0.0, 0.0
        with transaction(self._connection):
            started_s = time.perf_counter()
            for item in items:
                store(item)
                stored += 1
                working_s = time.perf_counter() - started_s
                if (stored + 1) * (working_s / stored + self._commit_s) > self._limit_s:
                    break
        self._measure(time.perf_counter() - started_s, working_s, stored)
        return stored

    def _measure(self, held_s: float, working_s: float, stored: int) -> None:
        self.held_s = held_s
        self.longest_held_s = max(self.longest_held_s, held_s)
        if stored:
            self._commit_s = (self._commit_s + (held_s - working_s) / stored) / 2


class Step:
    """Statements that SQLite runs as one: one short transaction in one call.

    Work done while control loops run holds the write lock for a millisecond at most. In a
    process with several threads a `transaction` cannot promise that: between any two of its
    statements another thread may run for 5 ms and more, while every robot waits for the lock.
    Statements in the body of a trigger run without Python in between.

    What a step writes is prepared before it, in temporary tables, which lock no other process out.

    Args:
        name: Of the step, unlike that of any table.
        parameters: Names of the values that it is run with: `NEW.name` in the statements.
        statements: Tables without the name of a database, no LIMIT on a DELETE or an UPDATE (so
            SQLite wants it in triggers).
        unless: A condition in SQL under which nothing is done: what was prepared is out of date.
    """

    def __init__(
        self, name: str, parameters: tuple[str, ...], *statements: str, unless: str = "0"
    ) -> None:
        call_off = f"SELECT RAISE(ABORT, '{_CALLED_OFF}') WHERE {unless}"
        body = "".join(f"{statement}; " for statement in (call_off, *statements))
        nulls, marks = (", ".join([one] * len(parameters)) for one in ("NULL", "?"))
        self._prepare = (
            f"CREATE TEMP VIEW IF NOT EXISTS {name} ({', '.join(parameters)}) AS SELECT {nulls}",
            f"CREATE TEMP TRIGGER IF NOT EXISTS do_{name} INSTEAD OF INSERT ON {name} "
            f"BEGIN {body}END",
        )
        self._run = f"INSERT INTO {name} VALUES ({marks})"

    def run(self, connection: sqlite3.Connection, *values: object) -> bool:
        """Do all of it and return True, or nothing.

        Args:
            connection: In autocommit mode; it has the temporary tables that the statements name.
            values: One for each parameter.

        Raises:
            sqlite3.Error: Also where the write lock is not to be had (`is_busy`).
        """
        for statement in self._prepare:
            connection.execute(statement)
        try:
            connection.execute(self._run, values)
        except sqlite3.IntegrityError as error:
            if str(error) != _CALLED_OFF:
                raise
            return False
        return True


def is_busy(error: Exception) -> bool:
    """Whether another connection held the lock at that instant: trying again helps.

    `sqlite3` raises more than its own errors: a damaged file makes it quote bytes in a message,
    which are no UTF-8. So who writes catches any Exception, and asks here what it means.
    """
    return isinstance(error, sqlite3.OperationalError) and "locked" in str(error)


def is_about_a_value(error: Exception) -> bool:
    """Whether a single value cannot be read, by SQLite or as text; the file is whole."""
    if isinstance(error, UnicodeDecodeError):  # else it is SQLite's own message that is no text
        return not any(words in text_of(error) for words in _DAMAGE)
    return isinstance(error, sqlite3.Error) and any(s in str(error) for s in _ABOUT_A_VALUE)


def is_damage(error: Exception) -> bool:
    """Whether SQLite says that the file itself is broken, or never was a database."""
    if not isinstance(error, FAILURES) or is_about_a_value(error):
        return False
    return any(words in text_of(error) for words in _DAMAGE)


def text_of(error: Exception) -> str:
    """What went wrong, also where SQLite's own message is no text."""
    if isinstance(error, UnicodeDecodeError):
        return error.object.decode("utf-8", "replace")
    # Python 3.10 leaves such a message out; of this class itself, it was about the file.
    return str(error) or (_SAYS_NOTHING if type(error) is sqlite3.DatabaseError else "")


def is_unwritable(error: Exception) -> bool:
    """Whether the file, or the folder that it needs for its log, cannot be written."""
    return isinstance(error, sqlite3.OperationalError) and any(
        text in str(error) for text in _UNWRITABLE
    )
