"""What went wrong in a bridge: remembered, and said once."""

from __future__ import annotations

from webots_mcp.errors import DatabaseError
from webots_mcp.notice import say

_MOST_CHARACTERS = 2000


class Trouble:
    """The newest thing that could not be recorded, and why.

    Args:
        strict: Raise it as well.
    """

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self._said: set[str] = set()
        self.last_error: str | None = None

    def complain(self, kind: str, text: str) -> None:
        """Remember what went wrong; say it on stderr once a kind; raise in strict mode."""
        text = text[:_MOST_CHARACTERS].encode("utf-8", "replace").decode()
        self.last_error = text
        if kind not in self._said:
            self._said.add(kind)
            say(text)
        if self._strict:
            raise DatabaseError(text)
