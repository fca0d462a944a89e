"""Watched variables: the value at an attribute path, recorded as a signal with each state.

A path is followed at each call of `publish`, or at each step of an attached robot. Its signal is
`watched.` and the path, with dots in place of brackets. A path that ends on the way is null, and
is named once in the log.
"""

from __future__ import annotations

from collections import OrderedDict, defaultdict
from collections.abc import Mapping
from contextlib import suppress
from types import FrameType
from typing import Any, Final, cast

from webots_mcp.bridge.error_report import describe
from webots_mcp.bridge.inspection.attribute_paths import (
    PathEndsError,
    find_root,
    follow,
)
from webots_mcp.bridge.inspection.frames import OwnFrame, own_frames
from webots_mcp.bridge.inspection.objects import class_of, name_of
from webots_mcp.bridge.inspection.values import signal_value
from webots_mcp.bridge.journal import Journal
from webots_mcp.contract import WATCHED
from webots_mcp.database.variable_paths import AttributePath
from webots_mcp.errors import CommandRefusedError

MOST_WATCHED: Final = 20
MOST_EVERY: Final = 1_000_000
_STATES: Final = frozenset(map(id, (dict, OrderedDict, defaultdict)))
_MISSING: Final = object()
_WATCHING: Final = "watch {}: {}; null is recorded while that is so"


class WatchedPath:
    """One watched path.

    Attributes:
        key: Its name among the watched values of a state.
        every: Its value is recorded in every Nth state.
        waited: States since the last recorded one that had its value, or since it is watched.
        code: The function whose variable the path begins with, where it was found last.
        failing: A state had no value for it, and the log says so.
    """

    def __init__(self, path: AttributePath, every: int) -> None:
        self.path = path
        self.key = path.signal.removeprefix(f"{WATCHED}.")
        self.every = every
        self.waited = 0
        self.code: object = None
        self.failing = False


class Watches:
    """The watched paths of a controller, until it ends."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._paths: dict[str, WatchedPath] = {}  # by their signals
        self._is_refused = False  # the log says that the states have no place for the values

    def add(self, path: AttributePath, every: int) -> None:
        """Watch a path from now on; a path that is watched already gets the new interval.

        Raises:
            CommandRefusedError: Too many are watched.
        """
        if path.signal not in self._paths and len(self._paths) >= MOST_WATCHED:
            raise CommandRefusedError(f"{MOST_WATCHED} paths are watched already: stop one first")
        self._paths[path.signal] = WatchedPath(path, every)

    def remove(self, path: AttributePath) -> None:
        """Watch a path no longer.

        Raises:
            CommandRefusedError: It is not watched.
        """
        if self._paths.pop(path.signal, None) is None:
            known = ", ".join(each.path.text for each in self._paths.values()) or "none"
            raise CommandRefusedError(f"{path.text!r} is not watched; watched: {known}")

    @property
    def signals(self) -> list[str]:
        """The names of their signals."""
        return list(self._paths)

    def added_to(self, state: Mapping[Any, Any], frame: FrameType | None) -> Mapping[Any, Any]:
        """Return a state with the values of the watched paths; the state itself stays as it is.

        Args:
            state: A state that is published; one that is no dict is returned as it is.
            frame: The call of the bridge, whose callers have the variables.
        """
        if not self._paths:
            return state
        if id(class_of(state)) not in _STATES:
            self._refuse(f"a {name_of(class_of(state))} is published, not a dict")
            return state
        values = self.read(frame)
        if not values:
            return state
        own = cast("dict[Any, Any]", state).get(WATCHED)
        if own is not None and type(own) is not dict:
            self._refuse(f"the controller itself publishes {WATCHED!r}")
            return state
        return {**state, WATCHED: {**(own or {}), **values}}

    def recorded(self) -> None:
        """Begin to count anew for the paths whose values the state had that was just recorded."""
        for watched in tuple(self._paths.values()):
            if watched.waited >= watched.every:
                watched.waited = 0

    def read(self, frame: FrameType | None) -> dict[str, Any]:
        """Return the value of each path that is due, from a frame and its callers.

        A path stays due until a state is recorded: many may only be held, or dropped.
        """
        values: dict[str, Any] = {}
        variables: dict[int, Mapping[str, Any]] = {}  # by the id of a function: each is read once
        for watched in tuple(self._paths.values()):
            watched.waited += 1
            if watched.waited >= watched.every:
                values[watched.key] = self._value(watched, frame, variables)
        return values

    def _refuse(self, why: str) -> None:
        """Log once why watched values are not recorded."""
        if not self._is_refused:
            self._is_refused = True
            self._journal.log("warning", "bridge", f"watched values are not recorded: {why}")

    def _value(
        self,
        watched: WatchedPath,
        frame: FrameType | None,
        variables: dict[int, Mapping[str, Any]],
    ) -> Any:
        path = watched.path
        try:
            names = variables.get(id(watched.code))
            if names is None and (names := _variables_of(watched.code, frame)) is not None:
                variables[id(watched.code)] = names
            root = _MISSING if names is None else names.get(path.root, _MISSING)
            if root is _MISSING:
                root, watched.code = _search_root(path, frame)
            value = signal_value(follow(path, root))
        except Exception as error:  # noqa: BLE001  (the row must not be lost)
            self._fail(watched, error)
            return None
        watched.failing = False
        return value

    def _fail(self, watched: WatchedPath, error: Exception) -> None:
        """Log once that a path has no value."""
        if not watched.failing:
            watched.failing = True
            is_end = isinstance(error, PathEndsError)
            why = str(error) if is_end else describe(error)
            with suppress(RecursionError):  # called where the stack is almost full
                text = _WATCHING.format(watched.path.text, why)
                self._journal.log("warning", "bridge", text)


def _variables_of(code: object, frame: FrameType | None) -> Mapping[str, Any] | None:
    """Return the variables of the function that had the root last; None if it is not running."""
    while frame is not None and frame.f_code is not code:
        frame = frame.f_back
    return None if frame is None else OwnFrame(frame, 0).variables


def _search_root(path: AttributePath, frame: FrameType | None) -> tuple[Any, object]:
    """Return the variable that a path begins with, and the function that has it."""
    frames = own_frames(frame)
    found = find_root(path, frames)
    own = (each.frame.f_code for each in frames if path.root in each.variables)
    return found, next(own, None)
