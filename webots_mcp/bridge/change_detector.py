"""Detecting when a text or a flag of the published state changes, as it happens."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any, Final

from webots_mcp.bridge.cleaning import MAX_KEY_CHARACTERS, key_text
from webots_mcp.bridge.text import cut

MOST_CHANGES: Final = 1000  # in one run; a text that changes in every row is not a mode
_MOST_KEYS: Final = 1000  # a larger state is data, not a list of modes and flags
_LONGEST: Final = 1000  # characters; a longer text is not a mode either
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
        """A new run has begun: its first values are not changes."""
        self._last.clear()
        self._count = 0

    def look(self, state: Mapping[Any, Any]) -> Iterable[tuple[str, object, object]]:
        """The (name, before, after) of each change since the last call; usually none."""
        changed: list[tuple[str, object, object]] = []
        last = self._last
        if len(state) > _MOST_KEYS:
            return changed
        for key, value in islice(state.items(), _MOST_KEYS):  # a user's mapping may be endless
            if type(value) is not bool and not (type(value) is str and len(value) <= _LONGEST):
                continue
            before = last.get(key, _UNSEEN)
            if before is value or before == value:
                continue
            if before is _UNSEEN and len(last) >= _MOST_KEYS:
                continue  # keys that change all the time would fill the memory
            last[key] = value
            if before is not _UNSEEN and self._count < MOST_CHANGES:
                self._count += 1
                changed.append((cut(key_text(key), MAX_KEY_CHARACTERS), before, value))
        return changed
