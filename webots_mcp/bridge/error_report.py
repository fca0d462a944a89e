"""What went wrong in a bridge: remembered, and warned of once."""

from __future__ import annotations

from webots_mcp.errors import DatabaseError
from webots_mcp.notice import warn

_MOST_CHARACTERS = 2000


class ErrorReport:
    """The newest thing that could not be recorded, and why.

    Args:
        strict: Raise it as well.
    """

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self._warned: set[str] = set()
        self.last_error: str | None = None

    def warn(self, kind: str, text: str) -> None:
        """Remember what went wrong; one line a kind on stderr; raise in strict mode."""
        text = text[:_MOST_CHARACTERS].encode("utf-8", "replace").decode()
        self.last_error = text
        if kind not in self._warned:
            self._warned.add(kind)
            warn(text)
        if self._strict:
            raise DatabaseError(text)
