"""A handler of Python's `logging` that records the lines."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable


class LogHandler(logging.Handler):
    """Records each line with its level and the name of its logger.

    Args:
        record: Receives the text, the level's number and the logger's name; called in any thread.
        level: Lines of this level and those above it are recorded.
    """

    def __init__(
        self, record: Callable[[object, object, str | None], None], level: int | str
    ) -> None:
        super().__init__(level.upper() if isinstance(level, str) else level)
        self._record = record
        self._inside = threading.local()

    def emit(self, record: logging.LogRecord) -> None:
        """Record a line; one that is logged by the recording itself is ignored."""
        if getattr(self._inside, "busy", False):
            return
        self._inside.busy = True
        try:
            self._record(self._text_of(record), record.levelno, record.name)
        finally:
            self._inside.busy = False

    def _text_of(self, record: logging.LogRecord) -> str:
        try:
            return self.format(record)
        except Exception as error:  # noqa: BLE001  (a message's arguments may raise anything)
            return f"{_as_given(record.msg)} (not formatted: {type(error).__name__})"


def _as_given(message: object) -> str:
    return message if isinstance(message, str) else f"a {type(message).__name__} without text"
