"""Entering the names of recorded values into the register of signals, once in a session each."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any, Final, cast

from webots_mcp.bridge.recorder import Recorder
from webots_mcp.naming import flatten
from webots_mcp.signal_register import (
    ADDED_AT_ONCE,
    MAX_SIGNALS,
    Kind,
    Seen,
    ends_pose,
    kind_of,
    places,
    widen,
)
from webots_mcp.waiting_file import Kind as EntryKind
from webots_mcp.waiting_file import Values

_MOST_SHAPES: Final = 64  # keys made of ids or times would make every state a new one
_MOST_KEYS: Final = 1000  # of a state that are compared


class SignalNames:
    """What the register has of this session's names.

    A state is looked at where its keys at the top or the number of its values are new, and in the
    2nd, 4th, 8th, ... row of the session: what was null at first may have a value by then.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._shapes: set[tuple[Any, ...]] = set()
        self._rows = 0
        self._known: dict[str, tuple[Kind, bool]] = {}  # kind, and whether numbers are whole
        self._waiting: dict[str, Seen] = {}
        recorder.session.new_database_entries.append(self._begin_anew)

    def look(self, state: Mapping[Any, Any], text: str) -> None:
        """Enter the names that are new, some of many.

        Args:
            state: Which was recorded.
            text: Its JSON.
        """
        self._rows = rows = self._rows + 1
        # Cheaper than a walk through the state: a name more is mostly a comma more.
        keys = state if state.__class__ is dict else ()
        shape = (text.count(","), *islice(keys, _MOST_KEYS))
        if shape not in self._shapes and len(self._shapes) < _MOST_SHAPES:
            self._shapes.add(shape)
        elif rows & (rows - 1):
            if self._waiting:
                self._enter()
            return
        self._take(text)
        if self._waiting:
            self._enter()

    def _take(self, text: str) -> None:
        state = cast("dict[str, Any]", json.loads(text))
        found, now_s = places(state), time.time()
        for name, value in flatten(state).items():
            if name not in self._known and len(self._known) >= MAX_SIGNALS:
                continue
            kind, is_whole = before = self._known.get(name, ("null", True))
            kind = widen(kind, kind_of(name, value, ends_pose=ends_pose(name, found)))
            is_whole = is_whole and (value is None or type(value) is int)
            if name not in self._known or (kind, is_whole) != before:
                self._known[name] = kind, is_whole
                self._waiting[name] = Seen(*found[name], kind, is_whole, now_s)

    def _enter(self) -> None:
        some = dict(islice(self._waiting.items(), ADDED_AT_ONCE))
        if self._recorder.enter_signals(some):
            for name in some:
                del self._waiting[name]

    def _begin_anew(self) -> Iterable[tuple[EntryKind, bool, Values]]:
        """Another database does not have the names."""
        self._shapes.clear()
        self._known.clear()
        self._waiting.clear()
        return ()
