"""Counts and reports the errors of a bridge, and makes texts of them that a database can hold."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from webots_mcp.database.thread_stacks import is_library
from webots_mcp.errors import DatabaseError, WebotsMCPError, warn

if TYPE_CHECKING:
    from types import TracebackType

_LONGEST_TEXT: Final = 2000  # characters of an error


class ErrorReport:
    """Counts failures, keeps the newest error, and prints one line per kind on stderr.

    Args:
        strict: Raise each error as well.

    Attributes:
        failures: Calls of the bridge's methods that failed.
    """

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self._warned: set[str] = set()
        self.last_error: str | None = None
        self.failures = 0

    def warn(self, kind: str, text: str) -> None:
        """Keep an error as the newest one; print the first of its kind; raise in strict mode."""
        text = text[:_LONGEST_TEXT].encode("utf-8", "replace").decode()
        self.last_error = text
        if kind not in self._warned:
            self._warned.add(kind)
            warn(text)
        if self._strict:
            raise DatabaseError(text)

    def failed(self, method: str, error: Exception) -> None:
        """Count a call that failed, and warn of it; in strict mode raise what it raised."""
        self.failures += 1
        if self._strict:
            raise error
        self.warn(f"{method} {type(error).__name__}", f"{method} failed: {describe(error)}")


def cut(text: str, most_characters: int) -> str:
    """Return the text, or its beginning with the original length."""
    if len(text) <= most_characters:
        return text
    return f"{text[:most_characters]}... (cut: it had {len(text)} characters)"


def storable(text: str) -> str:
    """Replace what the database cannot show: surrogates, and NULs, where SQLite's shell stops."""
    return text.encode("utf-8", "replace").decode().replace("\0", "\\0")


def describe(error: BaseException) -> str:
    """Return the text of an error; for one of the user's code also its type, file and line.

    The line is the innermost one in the user's own files, which they can change. If a library
    raised the error, its line follows.
    """
    text = _text_of(error)
    if isinstance(error, WebotsMCPError):
        return text
    own = innermost = None
    frame = error.__traceback__
    while frame is not None:
        innermost = frame
        own = own if is_library(frame.tb_frame.f_code.co_filename) else frame
        frame = frame.tb_next
    if innermost is None:
        return f"{type(error).__name__}: {text}"
    place = _place_of(own or innermost)
    if own is not None and own is not innermost:
        place += f"; raised in {_place_of(innermost)}"
    return f"{type(error).__name__}: {text} ({place})"


def _place_of(frame: TracebackType) -> str:
    return f"{Path(frame.tb_frame.f_code.co_filename).name}, line {frame.tb_lineno}"


def _text_of(error: BaseException) -> str:
    try:
        return cut(str(error), _LONGEST_TEXT)
    except Exception as failure:  # noqa: BLE001  (an exception of the user's own kind)
        return f"(no text: its str() raised {type(failure).__name__})"
