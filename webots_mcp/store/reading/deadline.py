"""A limit in wall time on what a question may cost."""

from __future__ import annotations

import contextlib
import sqlite3
import time
from collections.abc import Callable, Generator
from typing import Final

from webots_mcp.connection import keep_deadline

QUESTION_DEADLINE_S: Final = 2.0
_STEPS_PER_LOOK: Final = 20_000  # of SQLite's virtual machine: about 0.5 ms


class Deadline:
    """When a question has to be answered with what is known by then."""

    def __init__(
        self, limit_s: float = QUESTION_DEADLINE_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._until_s = clock() + limit_s

    def part(self, share: float) -> Deadline:
        """One for a part of the work: after that share of the time that is left."""
        return Deadline(share * self.left_s, self._clock)

    @contextlib.contextmanager
    def narrowed(self, share: float) -> Generator[None]:
        """Inside, the time is over after that share of what is left, for all that hold this one."""
        until_s = self._until_s
        self._until_s = self._clock() + share * self.left_s
        try:
            yield
        finally:
            self._until_s = until_s

    @property
    def passed(self) -> bool:
        """Whether the time is over."""
        return self._clock() >= self._until_s

    @property
    def left_s(self) -> float:
        """Seconds that are left; 0 once it has passed."""
        return max(0.0, self._until_s - self._clock())

    @contextlib.contextmanager
    def interrupting(self, connection: sqlite3.Connection) -> Generator[None]:
        """Interrupt the connection's statements once the time is over.

        An interrupted statement raises `sqlite3.OperationalError`; `passed` distinguishes it from
        other errors. A connection has one progress handler, so these blocks do not nest.
        """
        connection.set_progress_handler(lambda: self.passed, _STEPS_PER_LOOK)
        try:
            yield
        finally:
            keep_deadline(connection)
