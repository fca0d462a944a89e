"""Events as intervals: what is marked in a picture."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from webots_mcp.plotting.parts import Part
from webots_mcp.plotting.plotted_intervals import Interval, Lane
from webots_mcp.store.detection.events import Events, drawn_kinds, find_events
from webots_mcp.store.detection.kinds import Event, EventOptions, Verdicts

MOST_EVENTS: Final = 500
MOST_LANES: Final = 5  # in one picture


def event_lanes(
    connection: sqlite3.Connection, part: Part, names: Sequence[str], rows: int = MOST_LANES
) -> tuple[list[Lane], list[str]]:
    """One lane per kind of event, and notes: of the drawn signals, and of the robot as a whole.

    Args:
        connection: Any.
        part: The run.
        names: The drawn signals.
        rows: How many lanes have room.
    """
    most = min(rows, MOST_LANES)
    drawn = tuple(kind.name for kind in drawn_kinds())
    options = EventOptions(kinds=drawn, signals=tuple(names))
    found = find_events(connection, part.range, options, limit=MOST_EVENTS, around=(), group=False)
    kinds = [kind for kind in drawn if any(event.kind == kind for event in found.events)]
    lanes = [_lane(kind, found, part) for kind in kinds[:most]]
    notes = [note for note in found.notes if note not in part.notes]
    notes += _not_looked_for(found.verdicts)
    if found.left_out:
        kind, rest = max(found.left_out.items(), key=lambda item: item[1].count)
        notes.append(
            f"{rest.count} events of kind {kind} up to {rest.last.start_s:.3f} s are not drawn"
        )
    if left_out := kinds[most:]:
        notes.append(f"events left out: {', '.join(left_out)}")
    return lanes, notes


def _not_looked_for(verdicts: Verdicts) -> list[str]:
    """Where a picture shows no number, there is none to be judged: that is no news."""
    of_numbers = [kind.name for kind in drawn_kinds() if kind.of_numbers]
    told = {
        kind: reasons
        for kind, reasons in verdicts.reasons.items()
        if kind not in of_numbers or verdicts.unlooked(kind) is None
    }
    gaps = replace(verdicts, reasons=told).gaps
    return [f"not looked for: {kinds}: {why}" for kinds, why in gaps.items()]


def _lane(kind: str, found: Events, part: Part) -> Lane:
    events = sorted((e for e in found.events if e.kind == kind), key=lambda event: event.start_s)
    intervals = [_interval(event, part).moved(part.origin_s) for event in events]
    return Lane(kind, intervals, ())


def _interval(event: Event, part: Part) -> Interval:
    """Named by what it is about: the signal, the action, the level, or what the bridge noticed."""
    what = event.details.get("what") if event.kind == "bridge_event" else event.name
    return _within(Interval(str(what or ""), event.start_s, event.end_s), part)


def _within(interval: Interval, part: Part) -> Interval:
    """What of an event is in the picture: it may have begun before, and gone on."""
    start_s = max(interval.start_s, min(part.start_s, interval.end_s))
    return Interval(interval.value, start_s, min(interval.end_s, max(part.end_s, start_s)))


def stuck_mark(
    connection: sqlite3.Connection, part: Part, position: tuple[str, str], deadline_s: float
) -> tuple[Lane, list[str]]:
    """When the robot was stuck, and where that was not looked for."""
    options = EventOptions(kinds=("stuck",), signals=position, position=position)
    found = find_events(
        connection, part.range, options, limit=MOST_EVENTS, around=(), group=False,
        deadline_s=deadline_s,
    )  # fmt: skip
    intervals = [_within(Interval("stuck", e.start_s, e.end_s), part) for e in found.events]
    lane = Lane(f"stuck over {options.stuck_s:g} s", intervals, ())
    return lane, _not_looked_for(found.verdicts)
