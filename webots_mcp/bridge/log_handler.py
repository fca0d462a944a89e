"""Records what a controller logs with Python's `logging`, by a handler that it adds to a logger."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable


class LogHandler(logging.Handler):
    """Records each line with its level and the name of its logger.

    Args:
        record: Receives the text, the level's number and the logger's name; called in any thread.
        level: Lines of this level and of higher levels are recorded.
    """

    def __init__(
        self, record: Callable[[object, object, str | None], None], level: int | str
    ) -> None:
        super().__init__(level.upper() if isinstance(level, str) else level)
        self._record = record
        self._thread = threading.local()  # `is_recording`, since recording may log a line itself

    def emit(self, record: logging.LogRecord) -> None:
        """Record a line, unless the recording itself has logged it."""
        if getattr(self._thread, "is_recording", False):
            return
        self._thread.is_recording = True
        try:
            self._record(self._text_of(record), record.levelno, record.name)
        finally:
            self._thread.is_recording = False

    def _text_of(self, record: logging.LogRecord) -> str:
        """Return the text of a line; where its arguments do not fit, the message as given."""
        try:
            return self.format(record)
        except Exception as error:  # noqa: BLE001  (a message's arguments may raise anything)
            message = record.msg
            if not isinstance(message, str):
                message = f"a {type(message).__name__} without text"
            return f"{message} (not formatted: {type(error).__name__})"
