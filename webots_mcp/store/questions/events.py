"""`find_events`: what happened in a range, on one clock."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Final, NamedTuple

from webots_mcp.settlement import gone_sessions
from webots_mcp.store.analysis.motion import find_motion
from webots_mcp.store.detection.event import Event, EventOptions, Kind
from webots_mcp.store.detection.grouping import grouped
from webots_mcp.store.detection.search import Detection
from webots_mcp.store.detection.stored import (
    change_events,
    command_events,
    gap_events,
    image_events,
    log_events,
    noticed_events,
    run_events,
)
from webots_mcp.store.reading.deadline import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.reading.ranges import Segment, TimeRange, just_after, recorded_bounds
from webots_mcp.store.reading.snapshot import in_one_snapshot
from webots_mcp.store.signals.catalogue import known_signals, resolve_signals
from webots_mcp.store.signals.flatten import Value, flatten, parse
from webots_mcp.store.signals.registry import Signal

MOST_AROUND: Final = 6  # values that are told with an event

_IS_OPEN: Final = "SELECT id, session_id, ended_wall_time_s IS NULL FROM run WHERE id = ?"
_ROW_AT: Final = (
    "SELECT data FROM state WHERE run_id = ? AND sim_time_s <= ? "
    "ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)


@dataclass(frozen=True)
class Events:
    """The answer of `find_events`.

    Attributes:
        events: In the order of wall time; at most `limit` of all that were found.
        totals: How many of each kind were found.
        notes: What was not searched, or left out, and where the range leaves the recording.
    """

    robot: str
    events: tuple[Event, ...]
    totals: dict[Kind, int]
    notes: tuple[str, ...]


@in_one_snapshot
def find_events(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    options: EventOptions | None = None,
    *,
    limit: int = 50,
    around: Sequence[str] | None = None,
    group: bool = True,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> Events:
    """What happened in a range: with its true begin and end, also where it reaches out of it.

    Up to 30,000 rows of a run are all looked at. Of a longer range the rollups and the change
    table tell where to look, and the notes say what may have been missed.

    Args:
        connection: Any.
        time_range: From `resolve_range`.
        options: What counts as an event; None for the defaults.
        limit: At most so many events. Where there are more, rare kinds are kept whole, and of the
            others the newest.
        around: Signals whose values are told with each event; None for mode, position and
            commanded speed.
        group: Many dropouts, steps or silences of one signal are told as one event, which counts
            them; else each is one.
        deadline_s: After it, what was found so far is the answer, and the notes say so.

    Raises:
        UnknownSignalError: A name in the options or in `around` meets nothing.
    """
    options = options or EventOptions()
    known = known_signals(connection, time_range)
    context = _context(known, options, around)
    found, notes = collect(connection, time_range, options, deadline_s)
    found = grouped(found, known) if group else found
    chosen = choose(found, limit)
    if len(chosen) < len(found):
        notes.append(f"{len(found) - len(chosen)} of {len(found)} events are left out: ask by kind")
    return Events(
        time_range.robot,
        tuple(_with_values(connection, event, context) for event in chosen),
        dict(Counter(event.kind for event in found)),
        tuple(dict.fromkeys(notes)),
    )


@in_one_snapshot
def collect(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    options: EventOptions,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> tuple[list[Event], list[str]]:
    """All events of a range, in no order and without values around them; and the notes.

    Raises:
        UnknownSignalError: A name in the options meets nothing.
    """
    known = known_signals(connection, time_range)
    import_module("numpy")  # once per process, before the time counts
    deadline = Deadline(deadline_s)
    notes = list(time_range.notes)
    found: list[Event] = []
    for segment in time_range.segments:
        found += _stored(connection, segment, known, options, deadline)
        recorded = _recorded(connection, segment)
        if recorded is not None:
            detection = Detection(connection, known, options, deadline, *recorded.bounds)
            found += detection.events_touching(recorded.segment, notes)
    over = _runs_over(connection, [segment.run_id for segment in time_range.segments])
    ended = [replace(e, ongoing=False) if e.ongoing and e.run_id in over else e for e in found]
    return ended, notes


def _runs_over(connection: sqlite3.Connection, run_ids: Sequence[int]) -> set[int]:
    """Those in which nothing goes on any more: they have ended, or their process is gone."""
    gone = dict(gone_sessions(connection))
    told = [connection.execute(_IS_OPEN, (run_id,)).fetchone() for run_id in set(run_ids)]
    return {run_id for run_id, session_id, is_open in told if not is_open or session_id in gone}


def _context(
    known: dict[str, Signal], options: EventOptions, around: Sequence[str] | None
) -> list[Signal]:
    if around is None:
        return find_motion(known, options).signals[:MOST_AROUND]
    return resolve_signals(known, around)[:MOST_AROUND] if around else []


def _stored(
    connection: sqlite3.Connection,
    segment: Segment,
    known: dict[str, Signal],
    options: EventOptions,
    deadline: Deadline,
) -> Iterator[Event]:
    """Events of the kinds that tables tell."""
    recorded = _recorded(connection, segment)
    signals = resolve_signals(known, options.signals) if known else []
    if "run" in options.kinds:
        yield from run_events(connection, segment)
    if "command" in options.kinds:
        yield from command_events(connection, segment)
    if "log" in options.kinds:
        yield from log_events(connection, segment, options)
    if "noticed" in options.kinds:
        yield from noticed_events(connection, segment)
    if "image" in options.kinds:
        yield from image_events(connection, segment)
    if "gap" in options.kinds and recorded is not None:
        yield from gap_events(connection, recorded.segment, deadline)
    if "change" in options.kinds and recorded is not None:
        newest_s = recorded.bounds[1]
        yield from change_events(connection, recorded.segment, newest_s, signals, deadline)


class _Recorded(NamedTuple):
    """The part of a segment that was recorded, and the simulation times of the whole recording."""

    segment: Segment
    bounds: tuple[float, float]


def _recorded(connection: sqlite3.Connection, segment: Segment) -> _Recorded | None:
    """None where nothing of a segment was recorded."""
    bounds = recorded_bounds(connection, segment.run_id)
    if bounds is None or bounds[1] < segment.start_s or bounds[0] >= segment.end_s:
        return None
    start_s, end_s = max(segment.start_s, bounds[0]), min(segment.end_s, just_after(bounds[1]))
    return _Recorded(replace(segment, start_s=start_s, end_s=end_s), bounds)


def in_order(event: Event) -> tuple[float, int, float]:
    """The one clock of all events: wall time, and where that is equal simulation time."""
    return event.wall_time_s, event.run_id, event.start_s


def choose(events: Sequence[Event], limit: int) -> list[Event]:
    """At most `limit` events in order of time: rare kinds whole, of the others the newest."""
    ordered = sorted(events, key=in_order)
    left = limit
    kept: set[int] = set()
    counts = Counter(event.kind for event in ordered)
    for rank, (kind, _) in enumerate(reversed(counts.most_common())):
        share = left // (len(counts) - rank)
        newest = [event for event in ordered if event.kind == kind][-share:] if share else []
        kept.update(id(event) for event in newest)
        left -= len(newest)
    return [event for event in ordered if id(event) in kept]


def _with_values(connection: sqlite3.Connection, event: Event, context: Sequence[Signal]) -> Event:
    row = connection.execute(_ROW_AT, (event.run_id, event.start_s)).fetchone()
    leaves: dict[str, Value] = flatten(parse(row[0])) if row and context else {}
    return replace(event, around={signal.name: leaves.get(signal.name) for signal in context})
