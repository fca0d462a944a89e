"""The bridges that are open in this process: one a robot, and none of a parent that forked it.

A second bridge on the same robot takes over from the first.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import NamedTuple


class OpenBridge(NamedTuple):
    """What can be asked of a bridge here.

    Attributes:
        bridge: The bridge itself.
        close: End its session, for a reason.
        abandon: In a forked child: leave the session to the parent.
    """

    bridge: object
    close: Callable[[str], object]
    abandon: Callable[[], object]


_bridges: dict[int, OpenBridge] = {}


def enter(robot: object, bridge: OpenBridge) -> None:
    """From now on this is the robot's bridge."""
    _bridges[id(robot)] = bridge


def find(robot: object) -> object | None:
    """The robot's bridge, if it has one that is open."""
    open_bridge = _bridges.get(id(robot))
    return None if open_bridge is None else open_bridge.bridge


def leave(robot: object) -> None:
    """The robot's bridge is closed."""
    _bridges.pop(id(robot), None)


def close_former(robot: object) -> None:
    """Close the bridge that the robot had until now, if any."""
    former = _bridges.get(id(robot))
    if former is not None:
        former.close("replaced")


def _leave_to_parent() -> None:
    for bridge in _bridges.values():
        bridge.abandon()
    _bridges.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)
