"""`trends`: what each signal did over a range, what changed most first."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from webots_mcp.store import chunk_making
from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.analysis.features import FLAT_BAND, Spike, find_spikes
from webots_mcp.store.analysis.summary import LARGEST, Summary, summarise_numbers, with_extremes
from webots_mcp.store.analysis.swings import SHORTEST_PERIOD_ROWS
from webots_mcp.store.questions.series import STATES_SHARE, signals_left
from webots_mcp.store.questions.trend import (
    Course,
    Trend,
    course_of_means,
    course_of_values,
    in_means,
    judge,
)
from webots_mcp.store.reading import frame_summary
from webots_mcp.store.reading.changes import Changes, change_points
from webots_mcp.store.reading.deadline import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.reading.frame import Frame, read_frame, read_kept
from webots_mcp.store.reading.frame_summary import reads_values, summary_of
from webots_mcp.store.reading.ranges import Segment, TimeRange, recorded_bounds
from webots_mcp.store.reading.snapshot import in_one_snapshot
from webots_mcp.store.signals.catalogue import signals_of
from webots_mcp.store.signals.registry import Signal

TOO_LARGE: Final = "its numbers are beyond 1e100"


@dataclass(frozen=True)
class StateTrend:
    """A text or boolean signal over a range, or whole numbers that name a mode.

    Attributes:
        changes: How often it changed within the range.
        since_s: Since when it has its last value; None where that was not found.
        time_by_value_s: Simulated seconds in each value, the longest first.
    """

    name: str
    kind: str
    changes: int
    last: str | bool | None
    since_s: float | None
    time_by_value_s: dict[str, float]


@dataclass(frozen=True)
class RunTrends:
    """The part of an answer that is about one run.

    Attributes:
        resolution_s: None if every row was looked at; else the length of the chunks from whose
            means shape, slope and swings come (counts, extremes, mean and deviation stay exact).
        numbers: What changed most comes first, clocks come last; at most `limit` of `total`.
        without_value: Names that have no value in the range, or none that can be reckoned with.
        rows: Rows of the range, as far as it was read.
        cut_at_s: The deadline passed; from there on something is missing in the answer.
        unread: What else was not read, and why.
    """

    run_id: int
    start_s: float
    end_s: float
    resolution_s: float | None
    rows: int
    numbers: tuple[Trend, ...]
    states: tuple[StateTrend, ...]
    without_value: tuple[str, ...]
    total: int
    cut_at_s: float | None
    unread: tuple[str, ...] = ()


@dataclass(frozen=True)
class Trends:
    """The answer of `trends`, one part per run."""

    robot: str
    runs: tuple[RunTrends, ...]
    notes: tuple[str, ...]


@in_one_snapshot
def trends(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    names: Sequence[str] = ("*",),
    *,
    limit: int = 100,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> Trends:
    """What each signal did over a range.

    Args:
        connection: Any.
        time_range: From `find_range`.
        names: Signals, with `*`.
        limit: The most numeric signals to return per run: those that changed most.
        deadline_s: After it, what was read so far is the answer, and says so.

    Raises:
        UnknownSignalError: A name meets nothing.
    """
    signals = signals_of(connection, time_range, names)
    deadline = Deadline(deadline_s)
    runs = [
        _run_trends(connection, segment, signals, limit, deadline)
        for segment in time_range.segments
    ]
    notes = [_unseen_swings(run) for run in runs if run.resolution_s is not None]
    notes += [f"run {run.run_id}: {each}" for run in runs for each in run.unread]
    return Trends(time_range.robot, tuple(runs), (*time_range.notes, *notes))


def _unseen_swings(run: RunTrends) -> str:
    shortest_s = SHORTEST_PERIOD_ROWS * (run.resolution_s or 0.0)
    return (
        f"run {run.run_id} is seen in means of {run.resolution_s:g} s: oscillations with a period "
        f"under {shortest_s:g} s were not searched for; ask for less time to see them"
    )


def _run_trends(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    limit: int,
    deadline: Deadline,
) -> RunTrends:
    """The trends of signals in one run."""
    numbers = [signal for signal in signals if signal.is_number and not signal.is_choice]
    states = [signal for signal in signals if signal not in numbers]
    for_states = deadline.part(STATES_SHARE) if numbers else deadline
    frame = read_frame(connection, segment, deadline)
    changes = change_points(connection, segment, states, for_states, frame=frame)
    kept = read_kept(connection, segment, deadline) if numbers else None
    found: dict[str, Trend | None] = {}
    for signal in numbers:
        if deadline.passed and found:
            break
        found[signal.name] = _trend(frame, signal, kept)
    # Sums differ in their last digits from one processor to the next, and the order must not.
    held = sorted(
        (trend for trend in found.values() if trend),
        key=lambda trend: (trend.is_clock, -round(trend.change, 9)),
    )
    changes = changes.cut(frame.cut_at_s)
    kept_cut_s = None if kept is None else kept.cut_at_s
    cuts_s = [e for e in (frame.cut_at_s, kept_cut_s, changes.unread_from_s) if e is not None]
    return RunTrends(
        run_id=segment.run_id,
        start_s=segment.start_s,
        end_s=segment.end_s,
        resolution_s=max(
            (t.resolution_s for t in held if t.resolution_s is not None), default=None
        ),
        rows=len(frame),
        numbers=tuple(held[:limit]),
        states=_state_trends(connection, changes, states),
        without_value=tuple(_without_value(frame, found)),
        total=len(held),
        cut_at_s=min(cuts_s, default=None),
        unread=(*map(str, frame.unread), *signals_left([e.name for e in numbers[len(found) :]])),
    )


def _without_value(frame: Frame, found: Mapping[str, Trend | None]) -> Iterator[str]:
    """Those without a usable number, as far as the range was read."""
    for name in (name for name, trend in found.items() if trend is None):
        if (np.abs(frame.numbers(name)) > LARGEST).any():
            yield f"{name} ({TOO_LARGE})"
        elif frame.cut_at_s is None and frame.was_read(name).any():
            yield name


def _trend(frame: Frame, signal: Signal, kept: Frame | None) -> Trend | None:
    """That of every value; of many rows that of the means of chunks."""
    name, is_long = signal.name, len(frame) > frame_summary.FULL_ROWS
    summary = summary_of(frame, signal)
    if summary.sum is None:
        return None
    spikes: list[Spike] | None = None
    too_large: int | None = None
    if reads_values(frame, signal):
        times, numbers = frame.usable(name)
        course = course_of_values(times, numbers, signal.turn, summary)
        if is_long:
            course = in_means(course, chunk_making.GROUP_ROWS)
        else:
            spikes = find_spikes(times, numbers, signal.turn)
        too_large = int(np.count_nonzero(np.abs(frame.numbers(name)) > LARGEST))
    else:
        course = course_of_means(frame, name, frame.zones(name))
        course = replace(course, counted=None if signal.turn is None else summary)
    if kept is not None and name in kept:
        summary = with_extremes(summary, summary_of(kept, signal))
        course = _with_kept(course, summary, signal.turn, *kept.usable(name))
    return judge(signal, summary, course, spikes, too_large)


def _with_kept(
    course: Course, summary: Summary, turn: float | None, times: Array, numbers: Array
) -> Course:
    """A course with the numbers of kept stretches: extremes of an angle, and when it rests.

    It rests no earlier than the last of them that lies elsewhere.
    """
    if course.counted is not None and turn is not None:
        near = np.interp(times, course.times, course.numbers)
        numbers = numbers + turn * np.round((near - numbers) / turn)
        summary = with_extremes(course.counted, summarise_numbers(times, numbers))
        course = replace(course, counted=summary)
    if course.rest_s is None or summary.last is None:
        return course
    band = FLAT_BAND * ((summary.max or 0.0) - (summary.min or 0.0))
    away = times[np.abs(numbers - summary.last) > band]
    later = course.times[course.times > away.max(initial=-math.inf)]
    least_s = 0.1 * (course.times[-1] - course.times[0])
    rest_s = max(course.rest_s, float(later[0])) if len(later) else math.inf
    return replace(course, rest_s=rest_s if course.times[-1] - rest_s >= least_s else None)


def _state_trends(
    connection: sqlite3.Connection, found: Changes, states: Sequence[Signal]
) -> tuple[StateTrend, ...]:
    """Text, flags and numbers that name a mode, those that changed most often first."""
    segment = found.segment
    bounds = recorded_bounds(connection, segment.run_id) or (segment.start_s, segment.end_s)
    end_s = min(segment.end_s, bounds[1])
    of_texts = [
        StateTrend(
            name=signal.name,
            kind=signal.kind,
            changes=len(points) - 1,
            last=points[-1].value,
            since_s=None if is_open else points[-1].sim_time_s,
            time_by_value_s=found.longest_values(signal.name, end_s),
        )
        for signal in states
        if (points := found.points[signal.name])
        for is_open in [len(points) == 1 and signal.name in found.since_before]
    ]
    return tuple(sorted(of_texts, key=lambda state: -state.changes))
