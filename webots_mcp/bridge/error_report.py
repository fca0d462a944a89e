"""The errors of a bridge: the newest is kept, and each kind is printed once."""

from __future__ import annotations

from webots_mcp.bridge.text import describe
from webots_mcp.errors import DatabaseError, warn

_MOST_CHARACTERS = 2000


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
        text = text[:_MOST_CHARACTERS].encode("utf-8", "replace").decode()
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
