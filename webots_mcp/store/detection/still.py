"""`still` and `stuck`: the robot stayed where it was, and should have moved besides."""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from typing import Final

from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import Alike, EventKind
from webots_mcp.store.detection.search import Search


def stuck_events(search: Search) -> Iterator[Event]:
    """It should have moved and stayed where it was."""
    return _of_kind(search, "stuck")


def still_events(search: Search) -> Iterator[Event]:
    """It stayed where it was."""
    return _of_kind(search, "still")


def _of_kind(search: Search, kind: str) -> Iterator[Event]:
    found = search.standings
    search.not_searched(kind, *found.not_searched)
    if kind == "stuck":
        search.not_searched(kind, *found.not_weighed)
    if found.nearest is not None:
        search.came_near(kind, *found.nearest)
    return (event for event in found.events if event.kind == kind)


def _least_s(options: EventOptions) -> float:
    return options.stuck_s


def _mode(event: Event) -> Hashable:
    return event.details.get("mode")


STILL: Final = EventKind(
    "still",
    "stands",
    still_events,
    lasts=True,
    least_s=_least_s,
    drawn=8,
    alike=Alike(lambda events, unit: "standstills", sort=_mode),
    effort=3,
)
STUCK: Final = EventKind(
    "stuck",
    "stands when it should move",
    stuck_events,
    lasts=True,
    least_s=_least_s,
    drawn=0,
    alike=Alike(lambda events, unit: "times stuck", sort=_mode),
    effort=3,
)
