"""Answer `query_history`: signals over a range of any length, in buckets."""

from __future__ import annotations

import json
import math
import sqlite3
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.analysis.arrays import Array, Gap, np
from webots_mcp.analysis.summary import LARGEST, Summary, summarise_numbers, with_extremes
from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.naming import Value, flatten, listed
from webots_mcp.store.chunks import parse
from webots_mcp.store.reading.catalogue import signals_of
from webots_mcp.store.reading.frame import Frame, read_frame, read_kept
from webots_mcp.store.reading.frame_summary import (
    Buckets,
    ChangePoints,
    Point,
    as_angle,
    beside,
    buckets_of,
    cells_of,
    change_points,
    rhythm_in,
    summary_of,
    unwrapped,
)
from webots_mcp.store.reading.ranges import TimeRange, recorded_bounds
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S, Deadline, Segment, in_one_snapshot
from webots_mcp.store.registered_signals import RegisteredSignal, cleaned

DEFAULT_POINTS: Final = 50
MOST_POINTS: Final = 500
MOST_NAMED: Final = 5  # signals that an error lists as unread
TURNS_COUNTED: Final = (
    "angles: extremes, last values and slopes count turns (unwrapped); means are circular"
)
WEIGHTED: Final = "means and deviations are weighted by time"
STATES_SHARE: Final = 0.5  # share of the time, if numbers are requested as well

MOST_ROWS: Final = 1000


@dataclass(frozen=True)
class NumberColumns:
    """A numeric signal: one item per bucket in each list, None if the bucket has no value.

    Attributes:
        turn: A full turn in its unit if it is an angle, else None.
        is_turned: Whether its values are those of an angle with counted turns, which differ from
            the recorded ones by full turns.
        mean: The mean; the circular mean for an angle.
        whole: The same for the whole range, with the times of its extremes.
        too_large: The number of values beyond 1e100, if there are no others.
        replaced: How often each value that JSON cannot hold ("nan", "inf") occurred.
    """

    name: str
    kind: str
    unit: str | None
    turn: float | None
    is_turned: bool
    min: list[float | None]
    max: list[float | None]
    mean: list[float | None]
    last: list[float | None]
    count: list[int]
    whole: Summary
    too_large: int
    replaced: dict[str, int]


@dataclass(frozen=True)
class ChangeColumns:
    """A text or boolean signal.

    Attributes:
        points: The newest of its changes, [from then on, value]; the first of all is the value in
            force at the start of the range.
        total: How many points there are; `points` are the last of them.
        time_by_value_s: Simulated seconds in each value, the longest first.
        since_before: Whether the first of all points was in force before its time.
        cut_at_s: Where the deadline passed; later points are missing.
    """

    name: str
    kind: str
    points: list[Point]
    total: int
    time_by_value_s: dict[str, float]
    since_before: bool = False
    cut_at_s: float | None = None


@dataclass(frozen=True)
class RunHistory:
    """The part of an answer about one run.

    Attributes:
        step_s: Length of a bucket; None where each row is one.
        sim_time_s: Start of each bucket.
        rows: Number of rows of the range that were read.
        interval_s: Median simulated time between rows.
        gaps: Intervals without rows.
        cut_at_s: Where the deadline passed; the answer is incomplete from there on.
        unread: What else was not read, and why.
        age_s: Wall time since the run's newest row.
    """

    run_id: int
    start_s: float
    end_s: float
    step_s: float | None
    sim_time_s: list[float]
    numbers: tuple[NumberColumns, ...]
    changes: tuple[ChangeColumns, ...]
    rows: int
    interval_s: float | None
    gaps: tuple[Gap, ...]
    cut_at_s: float | None
    unread: tuple[str, ...]
    age_s: float


@dataclass(frozen=True)
class History:
    """The answer of `query_history`, one part per run."""

    robot: str
    runs: tuple[RunHistory, ...]
    notes: tuple[str, ...]


@in_one_snapshot
def query_history(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    names: Sequence[str],
    *,
    max_points: int = DEFAULT_POINTS,
    max_changes: int | None = None,
    least_step_s: float = 0.0,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> History:
    """Return signals over a range, in columns of at most `max_points` buckets.

    Buckets begin at multiples of their length. An extreme is never lost: each bucket has its
    minimum and maximum. In a long range, only the chunks at edges of buckets are opened, because
    the statistics of the others suffice.

    Args:
        connection: An open database.
        time_range: From `find_range`; over several runs each gets its share of the points.
        names: Signals, with `*`.
        max_points: 1 to 500.
        max_changes: Maximum number of changes of a text or flag in a run; None for `max_points`.
        least_step_s: Minimum length of a bucket, so that runs of different length can be drawn over
            each other; 0 leaves it open.
        deadline_s: Time after which the answer consists of what was read, and reports that.
            151.UnknownSignalError, InvalidInputError: A name matches nothing; `max_points` is out
            of bounds.

    Raises:
        UnknownSignalError, InvalidInputError: A name meets nothing; `max_points` is out of bounds.
    """
    if not 1 <= max_points <= MOST_POINTS:
        raise InvalidInputError(f"max_points={max_points} must be from 1 to {MOST_POINTS}.")
    signals = signals_of(connection, time_range, names)
    total_s = sum(segment.end_s - segment.start_s for segment in time_range.segments)
    deadline = Deadline(deadline_s)
    runs = [
        _run_history(
            connection, segment, signals, _share(max_points, segment, total_s), max_changes,
            deadline, least_step_s,
        )
        for segment in time_range.segments
    ]  # fmt: skip
    unread = [f"run {run.run_id}: {each}" for run in runs for each in run.unread]
    return History(time_range.robot, tuple(runs), (*time_range.notes, *unread, *_weighted(runs)))


def _weighted(runs: Sequence[RunHistory]) -> Iterator[str]:
    """Note that means are weighted by time, if some are shown."""
    if any(run.numbers and run.step_s is not None for run in runs):
        yield WEIGHTED
    if any(columns.is_turned for run in runs for columns in run.numbers):
        yield TURNS_COUNTED


def _share(max_points: int, segment: Segment, total_s: float) -> int:
    return max(1, int(max_points * (segment.end_s - segment.start_s) / total_s))


def _run_history(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[RegisteredSignal],
    max_points: int,
    max_changes: int | None,
    deadline: Deadline,
    least_step_s: float,
) -> RunHistory:
    numbers = [signal for signal in signals if signal.is_number]
    states = [signal for signal in signals if not signal.is_number]
    for_states = deadline.part(STATES_SHARE) if numbers else deadline
    frame = read_frame(connection, segment, deadline)
    changes = change_points(connection, segment, states, for_states, frame=frame)
    kept = read_kept(connection, segment, deadline) if numbers else None
    buckets = buckets_of(frame, max_points, least_step_s)
    columns: list[NumberColumns] = []
    for signal in numbers:
        if columns and deadline.passed:
            break
        columns.append(_columns(frame, signal, buckets, kept))
    left = [signal.name for signal in numbers[len(columns) :]]
    cuts_s = [frame.cut_at_s, None if kept is None else kept.cut_at_s, changes.unread_from_s]
    bounds = recorded_bounds(connection, segment.run_id) or (segment.start_s, segment.end_s)
    rhythm = rhythm_in(frame)
    query = (
        "SELECT coalesce((SELECT wall_time_s FROM state WHERE run_id = run.id "
        "ORDER BY sim_time_s DESC, id DESC LIMIT 1), last_wall_time_s) FROM run WHERE id = ?"
    )
    return RunHistory(
        run_id=segment.run_id,
        start_s=segment.start_s,
        end_s=segment.end_s,
        step_s=buckets.step_s,
        sim_time_s=buckets.starts_s.tolist(),
        numbers=tuple(columns),
        changes=tuple(
            _change_columns(signal, changes, bounds[1], max_changes or max_points)
            for signal in states
        ),
        rows=len(frame),
        interval_s=rhythm.interval_s,
        gaps=rhythm.gaps,
        cut_at_s=min((each for each in cuts_s if each is not None), default=None),
        unread=(*_unread(frame), *signals_left(left)),
        age_s=time.time() - connection.execute(query, (segment.run_id,)).fetchone()[0],
    )


def _unread(frame: Frame) -> Iterator[str]:
    """Return what the frame could not read, except what `cut_at_s` reports."""
    return (str(each) for each in frame.unread if each.end_s < (frame.cut_at_s or math.inf))


def signals_left(names: Sequence[str]) -> Iterator[str]:
    """Note which signals there was no time for."""
    if names:
        yield f"time limit reached, {len(names)} signals left: ask for {listed(names, MOST_NAMED)}"


def _columns(
    frame: Frame, signal: RegisteredSignal, buckets: Buckets, kept: Frame | None
) -> NumberColumns:
    whole, too_large = summary_of(frame, signal, kept), 0
    angle = as_angle(frame, signal, whole)
    if angle is not signal:
        signal, whole = angle, summary_of(frame, angle, kept)
    cells = cells_of(frame, signal, buckets, kept)
    turned = unwrapped(frame, signal)
    if turned is not None and signal.turn is not None:
        whole = _turned_summary(frame, signal, turned, whole, kept)
    if not whole.present:
        too_large = int(np.count_nonzero(np.abs(frame.numbers(signal.name)) > LARGEST))
    return NumberColumns(
        name=signal.name,
        kind=signal.kind,
        unit=signal.unit,
        turn=signal.turn,
        is_turned=turned is not None,
        min=_figures(cells.min),
        max=_figures(cells.max),
        mean=_figures(cells.mean),
        last=_figures(cells.last),
        count=cells.counts.tolist(),
        whole=whole,
        too_large=too_large,
        replaced=dict(frame.replaced(signal.name)),
    )


def _turned_summary(
    frame: Frame, signal: RegisteredSignal, turned: Array, whole: Summary, kept: Frame | None
) -> Summary:
    """Return the summary of an angle whose turns are counted; its mean is the circular one."""
    assert signal.turn is not None
    there = ~np.isnan(turned)
    weights = frame.usable_weights(signal.name)
    found = summarise_numbers(frame.times[there], turned[there], rows=whole.rows, weights=weights)
    if kept is not None and signal.name in kept:
        times, angles = kept.usable(signal.name)
        angles = beside(frame, turned, signal.turn, times, angles)
        found = with_extremes(found, summarise_numbers(times, angles))
    return found._replace(sines=whole.sines, cosines=whole.cosines)


def _figures(column: Array) -> list[float | None]:
    return [None if math.isnan(figure) else figure for figure in column.tolist()]


def _change_columns(
    signal: RegisteredSignal, changes: ChangePoints, newest_s: float, most: int
) -> ChangeColumns:
    points = changes.points[signal.name]
    return ChangeColumns(
        signal.name,
        signal.kind,
        points[-most:],
        len(points),
        changes.longest_values(signal.name, min(changes.segment.end_s, newest_s)),
        since_before=signal.name in changes.since_before,
        cut_at_s=changes.unread_from_s,
    )


# -- `query_rows`: the rows of a range as they are, page by page -----------------------------------


@dataclass(frozen=True)
class StatePage:
    """State rows as columns, in order.

    Attributes:
        values: One value per row and signal; None if the row has none.
        replaced: How often each value that JSON cannot hold occurred, by signal.
        cursor: The `after_id` of the next page; None after the last row, or if time ran out before
            any was read.
        cut: Whether time ran out: more rows may exist even if none is here.
    """

    robot: str
    run_ids: list[int]
    ids: list[int]
    sim_time_s: list[float]
    wall_time_s: list[float]
    values: dict[str, list[Value]]
    replaced: dict[str, dict[str, int]]
    cursor: int | None
    notes: tuple[str, ...]
    cut: bool = False


@in_one_snapshot
def query_rows(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    names: Sequence[str],
    *,
    limit: int = 50,
    after_id: int = 0,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> StatePage:
    """Return the rows of a range with the values of some signals, at most `limit` of them.

    Args:
        connection: An open database.
        time_range: From `find_range`.
        names: Signals, with `*`.
        limit: 1 to 1,000.
        after_id: The `cursor` of the previous page. Ids are not reused, so pages neither repeat nor
            miss a row when rows are recorded or deleted meanwhile.
        deadline_s: Time after which the page ends early; its cursor continues from there.
            359.UnknownSignalError, InvalidInputError: A name matches nothing; `limit` is out of
            bounds.

    Raises:
        UnknownSignalError, InvalidInputError: A name meets nothing; `limit` is out of bounds.
    """
    if not 1 <= limit <= MOST_ROWS:
        raise InvalidInputError(f"limit={limit} must be from 1 to {MOST_ROWS}.")
    signals = signals_of(connection, time_range, names)
    deadline = Deadline(deadline_s)
    parts: list[Frame] = []
    budget, cut = limit + 1, False  # one more, to know whether another page follows
    for segment in time_range.segments:
        if budget <= 0 or cut:
            break
        frame = read_frame(connection, segment, deadline)
        start = _place_after(frame, after_id)
        parts.append(frame.rows(start, start + budget))
        budget -= len(parts[-1])
        cut = frame.cut_at_s is not None and budget > 0
    return _page(connection, time_range, signals, parts, limit, cut=cut)


def _place_after(frame: Frame, after_id: int) -> int:
    """Return the index of the row after an id; if it was deleted, of the next greater id."""
    if after_id == 0:
        return 0
    ids = frame.ids
    at = np.flatnonzero(ids == after_id)
    if len(at):
        return int(at[0]) + 1
    later = np.flatnonzero(ids > after_id)
    return int(later[0]) if len(later) else len(frame)


def _page(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    signals: Sequence[RegisteredSignal],
    parts: Sequence[Frame],
    limit: int,
    *,
    cut: bool,
) -> StatePage:
    rows = sum(map(len, parts))
    more = rows > limit or (cut and rows > 0)
    shown = [*parts[:-1], parts[-1].rows(0, len(parts[-1]) - max(0, rows - limit))] if parts else []
    ids = [row_id for part in shown for row_id in part.ids.tolist()]
    states = _states_by_id(connection, ids)
    values: dict[str, list[Value]] = {}
    replaced: dict[str, dict[str, int]] = {}
    for signal in signals:
        name = signal.name
        held = [value for part in shown for value in part.values(name)]
        exact = [  # as recorded, if the rows still exist
            states[row_id].get(name) if row_id in states else value
            for row_id, value in zip(ids, held, strict=True)
        ]
        values[name] = cleaned(signal, exact)
        if found := sum((part.replaced(name) for part in shown), Counter[str]()):
            replaced[name] = dict(found)
    return StatePage(
        time_range.robot,
        [part.run_id for part in shown for _ in range(len(part))],
        ids,
        [time_s for part in shown for time_s in part.times.tolist()],
        [time_s for part in shown for time_s in part.wall_times.tolist()],
        values,
        replaced,
        ids[-1] if more else None,
        (*time_range.notes, *(str(each) for part in shown for each in part.unread)),
        cut,
    )


def _states_by_id(
    connection: sqlite3.Connection, ids: Sequence[int]
) -> dict[int, dict[str, Value]]:
    listed = json.dumps([abs(row_id) for row_id in ids])
    return {
        sign * row_id: flatten(parse(data))
        for query, sign in (
            ("SELECT id, data FROM state WHERE id IN (SELECT value FROM json_each(?))", 1),
            ("SELECT id, data FROM kept_state WHERE id IN (SELECT value FROM json_each(?))", -1),
        )
        if any(row_id * sign > 0 for row_id in ids)
        for row_id, data in connection.execute(query, (listed,))
    }
