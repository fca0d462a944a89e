"""Events that are found by looking at values."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

from webots_mcp.store.analysis.features import unwrap
from webots_mcp.store.analysis.jumps import Jump, are_usual, find_jumps, find_leaps
from webots_mcp.store.analysis.motion import Motion
from webots_mcp.store.analysis.summary import Summary, usable_numbers
from webots_mcp.store.detection.event import USUAL_KINDS, Event, EventOptions, Kind
from webots_mcp.store.detection.stored import wall_time_at
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.intervals import MOSTLY, Beyond, Flat, Silent, Span, common
from webots_mcp.store.reading.ranges import Segment, recorded_bounds
from webots_mcp.store.reading.rows import Columns
from webots_mcp.store.reading.views import View
from webots_mcp.store.rollup.rolling import watermark
from webots_mcp.store.signals.catalogue import other_form, resolve_signals
from webots_mcp.store.signals.registry import Signal

DETECTED: Final[tuple[Kind, ...]] = (
    "still", "stuck", "threshold", "silent", "flat", "jump", "oscillation",
)  # fmt: skip

OF_NUMBERS: Final = frozenset[Kind]({"silent", "flat", "jump", "oscillation"})

# Whether it changed in most rows of a stretch of 10 s that the run has rollups of.
_LIVELY: Final = (
    "SELECT EXISTS (SELECT 1 FROM all_rollup WHERE run_id = ? AND signal_id = ? "
    "AND present >= 10 AND changes >= ? * present)"
)
# Whether it had a value before, in the rollups or in rows that are not rolled up yet.
_HAD_VALUE: Final = (
    "SELECT EXISTS (SELECT 1 FROM all_rollup WHERE run_id = :run AND signal_id = :signal "
    "AND first_sim_time_s < :before) OR EXISTS (SELECT 1 FROM state WHERE id > :mark "
    "AND +run_id = :run AND sim_time_s < :before AND json_extract(data, :path) IS NOT NULL)"
)
_TYPES_AT: Final = (  # of the array, and of the item in it
    "SELECT json_type(data, ?), json_type(data, ?) FROM state WHERE run_id = ? "
    "AND sim_time_s >= ? ORDER BY sim_time_s, id LIMIT 1"
)
LEAST_CHANGES: Final = 10  # of who mostly changes
MANY_SILENCES: Final = 10  # of a signal that mostly has no value: it comes so by nature
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
    deadline: Deadline

    @cached_property
    def standing(self) -> list[Event]:
        """The standstills, found once for both of their kinds; numpy is imported at the first."""
        from webots_mcp.store.detection.standing import standing_events

        return standing_events(self)

    def event(self, kind: Kind, start_s: float, end_s: float, name: str | None, **details: Any):
        """An event of this run; what has a duration and reaches the newest row goes on."""
        run_id = self.segment.run_id
        wall_s = wall_time_at(self.connection, run_id, start_s)
        ongoing = end_s >= self.ended_s > start_s
        return Event(kind, run_id, start_s, end_s, wall_s, name, details, ongoing)

    @cached_property
    def began_s(self) -> float:
        """The run's first row."""
        bounds = recorded_bounds(self.connection, self.segment.run_id)
        return bounds[0] if bounds else self.segment.start_s

    def has_begun(self, signal: Signal, at_s: float) -> bool:
        """Whether it had a value before."""
        run_id = self.segment.run_id
        asked = {"run": run_id, "signal": signal.id, "before": at_s, "path": signal.path}
        asked["mark"] = watermark(self.connection, run_id)
        return bool(self.connection.execute(_HAD_VALUE, asked).fetchone()[0])

    def is_lively(self, signal: Signal) -> bool:
        """Whether it mostly changed for 10 s somewhere in the run, as far as rolled up."""
        asked = (self.segment.run_id, signal.id, MOSTLY)
        return bool(self.connection.execute(_LIVELY, asked).fetchone()[0])

    def is_over(self, kind: Kind, left: Sequence[Signal]) -> bool:
        """Whether the time is over; then a note says of which signals it was not searched."""
        if not self.deadline.passed:
            return False
        names = ", ".join(signal.name for signal in left[:3]) + (", ..." if left[3:] else "")
        self.view.notes.append(
            f"the time was over: {kind} was not searched in {len(left)} signals ({names}): "
            "name them, or ask for less time"
        )
        return True


def stuck_events(search: Search) -> Iterator[Event]:
    """It should have moved and stayed where it was."""
    return (event for event in search.standing if event.kind == "stuck")


def still_events(search: Search) -> Iterator[Event]:
    """It stayed where it was."""
    return (event for event in search.standing if event.kind == "still")


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
    """A signal that had a value has none: it has begun, and lasts to its next one, if any."""
    for index, signal in enumerate(search.numbers):
        here = search.view.summary(signal)
        if here.present == here.rows:
            continue
        if search.is_over("silent", search.numbers[index:]):
            return
        spans = [
            span
            for span in _without_value(search, signal)
            if _has_begun(search, signal, span) and not _is_shorter(search, signal, span)
        ]
        least_s = _least_silence_s(search, signal, here, spans)
        for span in spans:
            if span.end_s - span.start_s >= least_s:
                yield search.event("silent", span.start_s, span.end_s, signal.name)


def _without_value(search: Search, signal: Signal) -> list[Span]:
    """Where neither the signal has a value nor its array in its other form, long or short."""
    spans = search.view.spans(signal, Silent())
    other = other_form(search.known, signal)
    if other is None or not spans:
        return spans
    return list(common(spans, search.view.spans(other, Silent())))


def _has_begun(search: Search, signal: Signal, span: Span) -> bool:
    """What had no value before its first one was not there yet; that is no silence."""
    if span.start_s <= search.began_s:
        return False
    if not span.from_first:
        return True
    other = other_form(search.known, signal)
    return any(search.has_begun(each, span.start_s) for each in (signal, other) if each)


def _is_shorter(search: Search, signal: Signal, span: Span) -> bool:
    """Whether the array was there when it began, but so short or long that it has no such item."""
    array = signal.path if signal.reduce else signal.path.rpartition("[")[0]
    if not array:
        return False
    asked = (array, signal.path, search.segment.run_id, span.start_s)
    types = search.connection.execute(_TYPES_AT, asked).fetchone()
    return types is not None and types[0] == "array" and types[1] != "null"


def _least_silence_s(search: Search, signal: Signal, here: Summary, spans: Sequence[Span]) -> float:
    """Longer, where a signal comes now and then: it is silent who stays away longer than usual."""
    least_s = search.options.silent_s
    lengths = sorted(span.end_s - span.start_s for span in spans)
    if here.present >= MOSTLY * here.rows or len(lengths) < MANY_SILENCES:
        return least_s
    usual_s = lengths[len(lengths) // 2]
    if 3 * usual_s <= least_s:
        return least_s
    search.view.notes.append(
        f"{signal.name} has a value about every {usual_s:.3g} s: it counts as silent from "
        f"{3 * usual_s:.3g} s on"
    )
    return 3 * usual_s


def flat_events(search: Search) -> Iterator[Event]:
    """A signal that otherwise mostly changes had exactly the same value."""
    least_s = max(search.options.flat_s, search.view.shortest_rest_s)
    for index, signal in enumerate(search.numbers):
        here = search.view.summary(signal)
        if here.changes >= here.present - 1:
            continue
        if search.is_over("flat", search.numbers[index:]):
            return
        spans = search.view.spans(signal, Flat())
        flat = [span for span in spans if span.end_s - span.start_s >= least_s]
        if flat and (_changes_otherwise(search, here, flat) or search.is_lively(signal)):
            for span in flat:
                yield search.event("flat", span.start_s, span.end_s, signal.name, value=span.key)


def _changes_otherwise(search: Search, here: Summary, flat: Sequence[Span]) -> bool:
    """Whether it changed in most of the rows outside of those spans, and in ten at least."""
    whole_s = min(search.segment.end_s, search.ended_s) - search.segment.start_s
    flat_s = sum(span.end_s - span.start_s for span in flat)
    rows = here.present * max(0.0, 1 - flat_s / whole_s) if whole_s > 0 else 0.0
    return here.changes >= max(LEAST_CHANGES, MOSTLY * rows)


def jump_events(search: Search) -> Iterator[Event]:
    """A value changed from one row to the next by much more than it usually does."""
    position = search.motion.position or ()
    signals = [s for s in search.numbers if s.kind != "angle" and s not in position]
    for index, signal in enumerate(signals):
        if search.is_over("jump", signals[index:]):
            break
        jumps = [
            jump
            for course in search.view.courses(signal)
            for jump in find_jumps(
                course.times, course.numbers, search.options.jump_score, course.usual_steps
            )
        ]
        if are_usual(jumps, search.view.summary(signal).present):
            search.view.notes.append(
                f"jumps of {signal.name} were not judged: {len(jumps)} large steps are how it is"
            )
            continue
        yield from (_jump(search, signal, jump) for jump in jumps)
    yield from _leaps(search)


def _jump(search: Search, signal: Signal, jump: Jump) -> Event:
    end_s = jump.sim_time_s if jump.back_s is None else jump.back_s
    details = {"before": jump.before, "after": jump.after}
    return search.event("jump", jump.sim_time_s, end_s, signal.name, **details)


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
    left = len(search.numbers) - len(signals)
    if left and len(search.options.kinds) < len(USUAL_KINDS):  # who asks about it is told
        search.view.notes.append(
            f"oscillation was not searched in {left} of {len(search.numbers)} signals, whose names "
            "are not of what a robot swings with: name them in signals"
        )
    columns = search.view.newest(signals)
    for index, signal in enumerate(signals):
        if search.is_over("oscillation", signals[index:]):
            return
        yield from _swings(search, signal, columns)


def _swings(search: Search, signal: Signal, columns: Columns) -> Iterator[Event]:
    import numpy as np  # at the first question, not at the start of the server

    from webots_mcp.store.analysis.swings import find_swings

    times, numbers = usable_numbers(columns.times, columns.values[signal.name])
    for swing in find_swings(
        np.asarray(times, np.float64),
        np.asarray(unwrap(numbers, signal.turn) if signal.turn else numbers, np.float64),
        least_half_swings=search.options.oscillation_turns,
        longest_period_s=search.options.oscillation_period_s,
    ):
        details = {"period_s": swing.period_s, "amplitude": swing.amplitude}
        ends = (swing.start_s, swing.end_s)
        yield search.event("oscillation", *ends, signal.name, turns=swing.half_swings, **details)


DETECTORS: Final = {
    "still": still_events,
    "stuck": stuck_events,
    "threshold": threshold_events,
    "silent": silent_events,
    "flat": flat_events,
    "jump": jump_events,
    "oscillation": oscillation_events,
}
