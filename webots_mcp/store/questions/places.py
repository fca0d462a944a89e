"""The place of each event in the one order of all, by which pages and cursors go on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

from webots_mcp.store.detection.event import Event

Place = tuple[float, int, float, str, int]


def _in_order(event: Event) -> tuple[float, int, float]:
    """The one clock of all events: wall time, and where that is equal simulation time."""
    return event.wall_time_s, event.run_id, event.start_s


def placed(events: Iterable[Event]) -> list[tuple[Place, Event]]:
    """The events in order, each with its place; those of one kind and moment are numbered."""
    seen: Counter[tuple[float, int, float, str]] = Counter()
    entries: list[tuple[Place, Event]] = []
    for event in sorted(events, key=lambda each: (*_in_order(each), each.kind, each.name or "")):
        moment = (*_in_order(event), event.kind)
        entries.append(((*moment, seen[moment]), event))
        seen[moment] += 1
    return entries


def read_place(value: Any) -> Place:
    """A place as it comes out of JSON.

    Raises:
        ValueError, TypeError: It is none.
    """
    wall_s, run_id, start_s, kind, number = value
    return float(wall_s), int(run_id), float(start_s), str(kind), int(number)
