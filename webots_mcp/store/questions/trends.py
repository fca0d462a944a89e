"""`trends`: what each signal did over a range, what changed most first."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.analysis.features import find_spikes
from webots_mcp.store.analysis.summaries import Summaries
from webots_mcp.store.analysis.summary import LARGEST, Summary, summarise_numbers, with_extremes
from webots_mcp.store.analysis.swings import SHORTEST_PERIOD_ROWS
from webots_mcp.store.questions.series import STATES_SHARE
from webots_mcp.store.questions.trend import Trend, judge
from webots_mcp.store.reading.changes import Changes, change_points
from webots_mcp.store.reading.coverage import purged_until_s
from webots_mcp.store.reading.deadline import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.reading.ranges import Segment, TimeRange, recorded_bounds
from webots_mcp.store.reading.rollups import piece_length_s, read_pieces
from webots_mcp.store.reading.rows import Columns, Numbers, exceeds, kept_columns, read_numbers
from webots_mcp.store.reading.snapshot import in_one_snapshot
from webots_mcp.store.signals.catalogue import signals_of
from webots_mcp.store.signals.registry import Signal

TOO_LARGE: Final = "its numbers are beyond 1e100"
LEAST_PIECES: Final = 100  # of a long range, whose means tell its course


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
        resolution_s: None if every row was looked at; else the length of the rollups from which
            shape, slope and swings come (counts, extremes, mean and deviation stay exact).
        numbers: What changed most comes first, clocks come last; at most `limit` of `total`.
        silent: Names that have no value in the range, or none that can be reckoned with.
        rows: Rows that were read, be it as rollups.
        cut_at_s: The deadline passed; from there on something is missing in the answer.
        rows_left: Whether less time would be seen in rows: they were not purged, or not all.
    """

    run_id: int
    start_s: float
    end_s: float
    resolution_s: float | None
    rows: int
    numbers: tuple[Trend, ...]
    states: tuple[StateTrend, ...]
    silent: tuple[str, ...]
    total: int
    cut_at_s: float | None
    rows_left: bool = True


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
    return Trends(time_range.robot, tuple(runs), (*time_range.notes, *notes))


def _unseen_swings(run: RunTrends) -> str:
    shortest_s = SHORTEST_PERIOD_ROWS * (run.resolution_s or 0.0)
    advice = "; ask for less time to see them" if run.rows_left else ""
    return (
        f"run {run.run_id} is seen in means of {run.resolution_s:g} s: oscillations with a period "
        f"under {shortest_s:g} s were not searched for{advice}"
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
    found: list[Trend | None]
    for_states = deadline.part(STATES_SHARE) if numbers else deadline
    changes = change_points(connection, segment, states, for_states)
    purged_s = purged_until_s(connection, segment.run_id, segment.start_s)
    rows_left = purged_s is None or purged_s < segment.end_s
    if exceeds(connection, segment):
        piece_s = piece_length_s(connection, segment, LEAST_PIECES)
        pieces = read_pieces(connection, segment, numbers, deadline, piece_s)
        kept = kept_columns(connection, segment, numbers, deadline)
        parts = [pieces.summaries(signal.name) for signal in numbers]
        found = [
            _trend_of_pieces(signal, of_signal, piece_s, kept, rows_left=rows_left)
            for signal, of_signal in zip(numbers, parts, strict=True)
        ]
        has_values = [bool(of_signal["present"].any()) for of_signal in parts]
        rows, numbers_cut_s = pieces.rows, pieces.cut_at_s
        resolution_s = piece_s if numbers else None
    else:
        read = read_numbers(connection, segment, numbers, deadline)
        kept = None if segment.full_rate else kept_columns(connection, segment, numbers, deadline)
        found = [_trend_of_rows(signal, read, kept) for signal in numbers]
        has_values = [not np.isnan(read.values[signal.name]).all() for signal in numbers]
        rows, resolution_s, numbers_cut_s = len(read.times), None, read.cut_at_s
    # Sums differ in their last digits from one processor to the next, and the order must not.
    held = sorted(
        (trend for trend in found if trend),
        key=lambda trend: (trend.is_clock, -round(trend.change, 9)),
    )
    silent = [
        f"{signal.name} ({TOO_LARGE})" if has_value else signal.name
        for signal, trend, has_value in zip(numbers, found, has_values, strict=True)
        if trend is None and (has_value or numbers_cut_s is None)
    ]
    kept_cut_s = None if kept is None else kept.cut_at_s
    changes = changes.cut(numbers_cut_s)
    cuts_s = [e for e in (numbers_cut_s, kept_cut_s, changes.unread_from_s) if e is not None]
    return RunTrends(
        run_id=segment.run_id,
        start_s=segment.start_s,
        end_s=segment.end_s,
        resolution_s=resolution_s,
        rows=rows,
        numbers=tuple(held[:limit]),
        states=_state_trends(connection, changes, states),
        silent=tuple(silent),
        total=len(held),
        cut_at_s=min(cuts_s, default=None),
        rows_left=rows_left,
    )


def _with_kept(signal: Signal, summary: Summary, kept: Columns | None) -> Summary:
    """With the extremes of what only kept stretches have."""
    if kept is None:
        return summary
    return with_extremes(summary, signal.summarise(kept.times, kept.values[signal.name]))


def _trend_of_rows(signal: Signal, read: Numbers, kept: Columns | None) -> Trend | None:
    times, numbers = read.of(signal.name)
    if not len(numbers):
        return None
    summary = summarise_numbers(times, numbers, rows=len(read.times), turn=signal.turn)
    summary = _with_kept(signal, summary, kept)
    spikes = find_spikes(times, numbers, signal.turn)
    too_large = int(np.count_nonzero(np.abs(read.values[signal.name]) > LARGEST))
    return judge(signal, summary, times, numbers, spikes, too_large=too_large)


def _trend_of_pieces(
    signal: Signal,
    pieces: Summaries,
    piece_s: float,
    kept: Columns | None,
    *,
    rows_left: bool,
) -> Trend | None:
    summary = pieces.whole()
    if summary.sum is None:
        return None
    summary = _with_kept(signal, summary, kept)
    turn = summary.turn_of(signal.turn)
    centres = pieces.centres(turn)
    middles: Array = (pieces["first_sim_time_s"] + pieces["last_sim_time_s"]) / 2
    held = ~np.isnan(centres) & ~np.isnan(middles)
    variance = math.fsum(pieces.variances(turn)[held].tolist()) / int(held.sum())
    course, pieces = (middles[held], centres[held]), Summaries(pieces.table[held])
    return judge(signal, summary, *course, None, variance, piece_s, pieces, rows_left=rows_left)


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
