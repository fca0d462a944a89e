"""Events that are found by looking at values."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.store.analysis.features import unwrap
from webots_mcp.store.analysis.jumps import find_jumps, find_leaps, find_to_and_fro
from webots_mcp.store.analysis.motion import Motion, find_stays
from webots_mcp.store.analysis.summary import Summary, usable_numbers
from webots_mcp.store.detection.event import Event, EventOptions, Kind
from webots_mcp.store.detection.stored import wall_time_at
from webots_mcp.store.reading.intervals import MOSTLY, Beyond, Flat, Silent, Span
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.reading.views import View
from webots_mcp.store.rollup.tables import both
from webots_mcp.store.signals.catalogue import resolve_signals
from webots_mcp.store.signals.registry import Signal

DETECTED: Final[tuple[Kind, ...]] = (
    "stuck", "threshold", "silent", "flat", "jump", "oscillation",
)  # fmt: skip

OF_NUMBERS: Final = frozenset[Kind]({"silent", "flat", "jump", "oscillation"})

_OF_SIGNAL: Final = both("rows, present, changes", "run_id = :run AND signal_id = :signal")
_OF_RUN: Final = (  # also the rows that do not hold the signal
    "SELECT max(sum(rows), (SELECT rows FROM run WHERE id = :run)), sum(present), sum(changes) "
    f"FROM {_OF_SIGNAL}"
)
# What a robot swings with; sensors swing by nature while it drives.
_SWINGING: Final = re.compile(
    r"(^|[._])(heading|yaw|theta|bearing|steer\w*|wheels?|motors?|speed|velocity|pose|position"
    r"|left|right|cmd|command\w*|error)([._]|$)",
    re.IGNORECASE,
)


@dataclass
class Search:
    """What is looked for in one run, and how it is seen.

    Attributes:
        numbers: The numeric signals that are looked at.
        ended_s: The end of the recording in the segment.
    """

    connection: sqlite3.Connection
    segment: Segment
    known: dict[str, Signal]
    numbers: list[Signal]
    motion: Motion
    options: EventOptions
    view: View
    ended_s: float

    def event(self, kind: Kind, start_s: float, end_s: float, name: str | None, **details: Any):
        """An event of this run; what has a duration and reaches the newest row goes on."""
        run_id = self.segment.run_id
        wall_s = wall_time_at(self.connection, run_id, start_s)
        ongoing = end_s >= self.ended_s > start_s
        return Event(kind, run_id, start_s, end_s, wall_s, name, details, ongoing)

    def any_of(self, signal: Signal, here: Summary, holds: Callable[[Summary], bool]) -> bool:
        """Whether it holds of a signal in the segment, or else in the run as far as rolled up."""
        if holds(here):
            return True
        values = {"run": self.segment.run_id, "signal": signal.id}
        of_run = self.connection.execute(_OF_RUN, values).fetchone()
        return of_run[0] is not None and holds(Summary(*of_run))


def stuck_events(search: Search) -> Iterator[Event]:
    """It should have moved and stayed where it was."""
    if search.motion.position is None:
        search.view.notes.append("stuck was not searched: no position is published (pose.0, ...)")
        return
    columns = search.view.places(search.motion.signals, search.options.stuck_s)
    if missing := [each.name for each in search.motion.signals if each.name not in columns.values]:
        search.view.notes.append(f"stuck was not searched: {missing[0]} is not in every row")
        return
    for stay in find_stays(columns, search.motion, search.options):
        details = {"x_m": stay.x_m, "y_m": stay.y_m}
        details |= {"mode": stay.mode} if search.motion.mode else {}
        details |= {"commanded": stay.commanded} if search.motion.commanded else {}
        yield search.event("stuck", stay.start_s, stay.end_s, None, **details)


def threshold_events(search: Search) -> Iterator[Event]:
    """A signal was beyond a threshold for long enough."""
    for threshold in search.options.thresholds:
        for signal in resolve_signals(search.known, [threshold.signal]):
            limit = {"above": threshold.above, "below": threshold.below}
            given = {name: value for name, value in limit.items() if value is not None}
            for span in search.view.spans(signal, Beyond(threshold)):
                if span.end_s - span.start_s >= threshold.for_s:
                    ends = (span.start_s, span.end_s)
                    details = {**given, "min": span.low, "max": span.high}
                    yield search.event("threshold", *ends, signal.name, **details)


def silent_events(search: Search) -> Iterator[Event]:
    """A signal that mostly has a value had none."""
    for signal in search.numbers:
        here = search.view.summary(signal)
        if here.present < here.rows and search.any_of(signal, here, _mostly_present):
            for span in search.view.spans(signal, Silent()):
                if span.end_s - span.start_s >= search.options.silent_s:
                    yield search.event("silent", span.start_s, span.end_s, signal.name)


def flat_events(search: Search) -> Iterator[Event]:
    """A signal that mostly changes had exactly the same value."""
    least_s = max(search.options.flat_s, search.view.shortest_rest_s)
    for signal in search.numbers:
        here = search.view.summary(signal)
        if here.changes < here.present - 1 and search.any_of(signal, here, _mostly_changing):
            spans = search.view.spans(signal, Flat())
            yield from _flat(search, signal, spans, least_s)


def _mostly_present(summary: Summary) -> bool:
    return summary.present >= MOSTLY * summary.rows > 0


def _mostly_changing(summary: Summary) -> bool:
    return summary.changes >= MOSTLY * summary.present > 0


def _flat(search: Search, signal: Signal, spans: list[Span], least_s: float) -> Iterator[Event]:
    for span in spans:
        if span.end_s - span.start_s >= least_s:
            yield search.event("flat", span.start_s, span.end_s, signal.name, value=span.key)


def jump_events(search: Search) -> Iterator[Event]:
    """A value changed from one row to the next by much more than it usually does."""
    position = search.motion.position or ()
    for signal in search.numbers:
        if signal.kind == "angle" or signal in position:
            continue
        for course in search.view.courses(signal):
            score = search.options.jump_score
            for jump in find_jumps(course.times, course.numbers, score, course.usual_steps):
                details = {"before": jump.before, "after": jump.after}
                end_s = jump.sim_time_s if jump.back_s is None else jump.back_s
                yield search.event("jump", jump.sim_time_s, end_s, signal.name, **details)
    yield from _leaps(search)


def _leaps(search: Search) -> Iterator[Event]:
    """The position changed by more than driving explains."""
    if search.motion.position is None:
        return
    columns = search.view.newest(search.motion.signals)
    x, y = (columns.values[signal.name] for signal in search.motion.position)
    rows = [
        (time_s, (float(a), float(b)))
        for time_s, a, b in zip(columns.times, x, y, strict=True)
        if isinstance(a, (int, float)) and isinstance(b, (int, float))
    ]
    times, places = [time_s for time_s, _ in rows], [place for _, place in rows]
    for time_s, length_m in find_leaps(times, places, search.options.jump_m):
        yield search.event("jump", time_s, time_s, "position", distance_m=length_m)


def oscillation_events(search: Search) -> Iterator[Event]:
    """It went to and fro: heading, wheels, speed, position and the like, and what is asked for."""
    asked = search.options.signals != EventOptions.signals
    signals = [each for each in search.numbers if asked or _SWINGING.search(each.name)]
    columns = search.view.newest(signals)
    for signal in signals:
        times, numbers = usable_numbers(columns.times, columns.values[signal.name])
        course = unwrap(numbers) if signal.kind == "angle" else numbers
        options = search.options
        for swing in find_to_and_fro(
            times, course, options.oscillation_turns, options.oscillation_period_s
        ):
            details = {"period_s": swing.period_s, "amplitude": swing.amplitude}
            ends = (swing.start_s, swing.end_s)
            yield search.event("oscillation", *ends, signal.name, turns=swing.turns, **details)


DETECTORS: Final = {
    "stuck": stuck_events,
    "threshold": threshold_events,
    "silent": silent_events,
    "flat": flat_events,
    "jump": jump_events,
    "oscillation": oscillation_events,
}
