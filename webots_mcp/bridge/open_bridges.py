"""The open bridges of this process, one per robot; those of a parent that forked it are dropped.

A second bridge for the same robot closes the first.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import NamedTuple


class OpenBridge(NamedTuple):
    """A bridge, and how to close it.

    Attributes:
        bridge: The bridge itself.
        close: Ends its session, for a reason.
        abandon: In a forked child: leaves the session to the parent.
    """

    bridge: object
    close: Callable[[str], object]
    abandon: Callable[[], object]


_bridges: dict[int, OpenBridge] = {}


def enter(robot: object, bridge: OpenBridge) -> None:
    """Register a robot's bridge."""
    _bridges[id(robot)] = bridge


def find(robot: object) -> object | None:
    """The open bridge of a robot, or None."""
    open_bridge = _bridges.get(id(robot))
    return None if open_bridge is None else open_bridge.bridge


def leave(robot: object) -> None:
    """Remove a robot's closed bridge."""
    _bridges.pop(id(robot), None)


def close_former(robot: object) -> None:
    """Close the robot's previous bridge, if it has one."""
    former = _bridges.get(id(robot))
    if former is not None:
        former.close("superseded")


def _leave_to_parent() -> None:
    for bridge in _bridges.values():
        bridge.abandon()
    _bridges.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)
