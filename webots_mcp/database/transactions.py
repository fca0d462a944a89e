"""Transactions on a database that control loops write to as well, and what SQLite's errors mean.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Final, TypeVar

Result = TypeVar("Result")
_UNINTERRUPTED_MS: Final = 100
LONGEST_WRITE_S: Final = 0.001  # of maintenance: a robot that wants to write waits this long
_CALLED_OFF: Final = "called off"
_DAMAGE: Final = ("malformed", "not a database", "unsupported file format")
_ABOUT_A_VALUE: Final = (
    "malformed JSON", "JSON cannot hold", "JSON path", "to UTF-8 column", "integer overflow",
    "user-defined function",
)  # fmt: skip
# All that a statement may raise because of the database.
FAILURES: Final = (sqlite3.Error, sqlite3.Warning, UnicodeDecodeError, SystemError)


def never_wait(connection: sqlite3.Connection) -> None:
    """Make a lock that another connection holds an error at once from now on, not a wait."""
    connection.execute("PRAGMA busy_timeout=0")


@contextmanager
def transaction(connection: sqlite3.Connection) -> Generator[None]:
    """Open a transaction that takes the write lock first: all writes in it are stored, or none.

    Args:
        connection: A connection in autocommit mode and in no transaction, as `connect` opens it.

    Raises:
        sqlite3.Error: If a write fails, or the lock cannot be acquired (`is_busy`); in that case
            nothing inside has run.
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
    """Try once to take the write lock.

    Args:
        connection: A connection that is in no transaction.
        last: Raise if the lock is held by another connection.

    Returns:
        Whether the lock was acquired.
    """
    try:
        connection.execute("BEGIN IMMEDIATE")
    except sqlite3.OperationalError as error:
        if last or not is_busy(error):
            raise
        return False
    return True


def in_transaction(connection: sqlite3.Connection, act: Callable[[], Result]) -> Result:
    """Call `act` in a transaction that no KeyboardInterrupt can leave open.

    A `with` statement cannot promise that: an interrupt may come right after BEGIN, before its
    block has begun, or right before COMMIT, after its block has ended.
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


class AtomicStatements:
    """Statements that SQLite runs as one short transaction in one call.

    Maintenance holds the write lock for a millisecond at most while control loops run. In a process
    with several threads a `transaction` cannot promise that: between two of its statements another
    thread may run for 5 ms and more, while every robot waits for the lock. The statements in the
    body of a trigger run without Python in between.

    The rows to write are prepared in temporary tables, which lock out no other process.

    Args:
        name: The name of the trigger's view; no table may have it.
        parameters: Names of the values of a call, which the statements use as `NEW.name`.
        statements: The statements. As in any trigger, tables have no schema name, and a DELETE or
            UPDATE has no LIMIT.
        unless: A condition in SQL; if it holds, the prepared rows are out of date, and nothing is
            done.
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
        """Run all statements, or none of them.

        Args:
            connection: A connection in autocommit mode, with the temporary tables.
            values: One value for each parameter.

        Returns:
            False if the condition `unless` held, and nothing was done.

        Raises:
            sqlite3.Error: If a statement fails, or the write lock cannot be acquired (`is_busy`).
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
    """Return whether another connection held the lock at that instant, so that a retry helps.

    `sqlite3` raises more than its own errors: for a damaged file it may quote bytes in a message
    that are not UTF-8. So code that writes catches any Exception, and checks its meaning here.
    """
    return isinstance(error, sqlite3.OperationalError) and "locked" in str(error)


def is_about_a_value(error: Exception) -> bool:
    """Return whether a single value cannot be read, while the file itself is intact."""
    if isinstance(error, UnicodeDecodeError):  # else it is SQLite's own message that is no text
        return not any(words in text_of(error) for words in _DAMAGE)
    return isinstance(error, sqlite3.Error) and any(s in str(error) for s in _ABOUT_A_VALUE)


def is_damage(error: Exception) -> bool:
    """Return whether SQLite says that the file itself is broken, or never was a database."""
    if not isinstance(error, FAILURES) or is_about_a_value(error):
        return False
    return any(words in text_of(error) for words in _DAMAGE)


def text_of(error: Exception) -> str:
    """Return the message of an error, even if SQLite's own message is not valid text."""
    if isinstance(error, UnicodeDecodeError):
        return error.object.decode("utf-8", "replace")
    # Python 3.10 leaves such a message out; of this class itself, it was about the file.
    return str(error) or (
        "malformed database, which SQLite names in bytes that are not text"
        if type(error) is sqlite3.DatabaseError
        else ""
    )


def is_unwritable(error: Exception) -> bool:
    """Return whether the file, or the folder that it needs for its log, cannot be written."""
    return isinstance(error, sqlite3.OperationalError) and any(
        text in str(error) for text in ("readonly database", "unable to open database file")
    )


def repeat_while_busy(execute: Callable[[], Result], attempts: int = 3) -> Result:
    """Repeat a statement that is safe to repeat while another process holds the write lock.

    A writer connection waits 5 s for the lock by itself before each new attempt.

    Args:
        execute: Runs the statement.
        attempts: How often it runs at most.

    Raises:
        sqlite3.OperationalError: The last attempt found the lock held, or the error is another.
    """
    try:
        return execute()
    except sqlite3.OperationalError as error:
        if not is_busy(error) or attempts == 1:
            raise
    return repeat_while_busy(execute, attempts - 1)
