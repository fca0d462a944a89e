"""Noticing when a text or a flag of the published state changes, while it happens."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

MOST_CHANGES: Final = 1000  # in one run; a text that changes in every row is no mode
_UNSEEN: Final = object()


class Changes:
    """Compares the texts and booleans at the top of each recorded state with the last one.

    Only the top level: a comparison of every leaf would cost more than writing the row. Changes
    deeper down are found in the rows.
    """

    def __init__(self) -> None:
        self._last: dict[Any, object] = {}
        self._count = 0

    def forget(self) -> None:
        """A new run has begun: its first values are no changes."""
        self._last.clear()
        self._count = 0

    def look(self, state: Mapping[Any, Any]) -> Iterable[tuple[str, object, object]]:
        """The (name, before, after) of what changed since the last look; usually nothing."""
        changed: list[tuple[str, object, object]] = []
        last = self._last
        for key, value in state.items():
            if type(value) is not str and type(value) is not bool:
                continue
            before = last.get(key, _UNSEEN)
            if before is value or before == value:
                continue
            last[key] = value
            if before is not _UNSEEN and self._count < MOST_CHANGES:
                self._count += 1
                changed.append((str(key), before, value))
        return changed
