"""A limit in wall time on what a question may cost."""

from __future__ import annotations

import sqlite3
import time
from types import TracebackType
from typing import Final

QUESTION_DEADLINE_S: Final = 2.0
_STEPS_PER_LOOK: Final = 20_000  # of SQLite's virtual machine: about 0.5 ms


class Deadline:
    """Interrupts the connection's statements once the time is over.

    An interrupted statement raises `sqlite3.OperationalError`; who reads in chunks keeps what came
    before and says that it was cut (`passed` tells a deadline from another error). A connection
    has one progress handler: deadlines do not nest on it.
    """

    def __init__(self, connection: sqlite3.Connection, limit_s: float = QUESTION_DEADLINE_S):
        self.limit_s = limit_s
        self._connection = connection
        self._until_s = time.monotonic() + limit_s

    @property
    def passed(self) -> bool:
        """Whether the time is over."""
        return time.monotonic() >= self._until_s

    def __enter__(self) -> Deadline:
        self._connection.set_progress_handler(lambda: self.passed, _STEPS_PER_LOOK)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._connection.set_progress_handler(None, 0)
