"""One state of the database for a whole answer, while a robot records and chunks are made."""

from __future__ import annotations

import functools
import sqlite3
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def in_one_snapshot(
    question: Callable[Concatenate[sqlite3.Connection, P], T],
) -> Callable[Concatenate[sqlite3.Connection, P], T]:
    """Let a question that takes several statements see one state of the database.

    Without it rows could be put into chunks between two of its statements, and be counted twice. It
    neither waits nor makes another process wait (write-ahead log); a transaction that is already
    open is used as it is.
    """

    @functools.wraps(question)
    def answer(connection: sqlite3.Connection, *args: P.args, **kwargs: P.kwargs) -> T:
        if connection.in_transaction:
            return question(connection, *args, **kwargs)
        connection.execute("BEGIN")
        try:
            return question(connection, *args, **kwargs)
        finally:
            connection.execute("COMMIT")

    return answer
