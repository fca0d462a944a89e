"""Summarise the rows of a frame: counts, extremes, means, in all and in buckets, and gaps."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count, pairwise
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import (
    EVEN_STEPS,
    Array,
    Flags,
    Indexes,
    Rhythm,
    inner,
    np,
    rhythm_of,
    weighted_mean,
)
from webots_mcp.analysis.summary import (
    LARGEST,
    NO_LENGTH,
    Summary,
    leaps_in,
    may_wrap,
    summarise_numbers,
    unwrap,
    with_extremes,
    wraps,
)
from webots_mcp.signals.meaning import ANGLES, meaning_by_name, own_names
from webots_mcp.signals.naming import Value
from webots_mcp.store.chunks import shown
from webots_mcp.store.reading.frame import Frame, Unread, ZoneMap, read_frame
from webots_mcp.store.reading.segment import Deadline, Segment, full_rate_parts, just_after
from webots_mcp.store.registered_signals import RegisteredSignal

_MAY_TURN: Final = frozenset((None, *ANGLES))  # quantities whose values may be angles
# frames with at most this many values are read completely; more have at least 100 chunks
FULL_ROWS: Final = 120_000
MOST_VALUES: Final = 20


@dataclass(frozen=True)
class SummaryReading:
    """How much is read around a place, and the tolerance of bucket edges.

    Attributes:
        rows_around: Rows before and after a segment that show the usual interval.
        edge_share: Tolerance for rounding at bucket edges, as a share of the bucket's length.
        first_rows_back: Rows that are searched before a row at first.
        growth: Factor by which each further search is longer.
    """

    rows_around: int = 20
    edge_share: float = 1e-9
    first_rows_back: int = 1024
    growth: int = 4


_READING: Final = SummaryReading()


def reads_values(frame: Frame, signal: RegisteredSignal) -> bool:
    """Return whether every value is read, for few rows and to count the turns of an angle."""
    if len(frame) <= FULL_ROWS or signal.turn is None:
        return len(frame) <= FULL_ROWS
    zones = frame.zone_map(signal.name)
    held = ~np.isnan(zones.sum)
    if not held.any():
        return False
    between = np.abs(zones.first[held][1:] - zones.last[held][:-1])
    largest_step = max(zones.largest_step[held].max(), between.max(initial=0.0))
    span = zones.max[held].max() - zones.min[held].min()
    return bool(span > signal.turn / 2 or largest_step > signal.turn / 4)


def as_angle(frame: Frame, signal: RegisteredSignal, found: Summary) -> RegisteredSignal:
    """Return a signal as an angle if its values show that it is one, else unchanged.

    Args:
        frame: The rows.
        signal: A numeric one.
        found: The summary of its values.
    """
    if not signal.may_be_angle or found.min is None or found.max is None:
        return signal
    turn = may_wrap(found.min, found.max)
    name = own_names([signal.name])[signal.name]
    if turn is None or meaning_by_name(name, signal.kind).quantity not in _MAY_TURN:
        return signal
    return replace(signal, wraps_at=turn) if wraps(frame.usable(signal.name)[1], turn) else signal


def unwrapped(frame: Frame, signal: RegisteredSignal) -> Array | None:
    """Return an angle in each row with its turns counted, NaN where it has no value.

    Return None if the signal is no angle, never crosses the end of its scale, or changes so much
    between rows that its turns cannot be counted.
    """
    if signal.turn is None or not reads_values(frame, signal):
        return None
    numbers = frame.numbers(signal.name)
    rows = np.flatnonzero(np.abs(numbers) <= LARGEST)
    angles = numbers[rows]
    if not len(rows) or leaps_in(angles, signal.turn):
        return None
    turned = unwrap(angles, signal.turn)
    if turned is angles:
        return None
    found: Array = np.full(len(numbers), np.nan)
    found[rows] = turned
    return found


def summary_of(frame: Frame, signal: RegisteredSignal, kept: Frame | None = None) -> Summary:
    """Return counts, extremes, mean and deviation of all rows; circular ones as well for angles.

    Args:
        frame: The rows.
        signal: A numeric one.
        kept: Rows that only full-rate segments have; they count for extremes.
    """
    if kept is not None and signal.name in kept:
        return with_extremes(summary_of(frame, signal), summary_of(kept, signal))
    if reads_values(frame, signal):
        numbers = frame.usable(signal.name)
        rows = int(np.count_nonzero(frame.was_read(signal.name)))
        weights = frame.usable_weights(signal.name)
        return summarise_numbers(*numbers, rows=rows, turn=signal.turn, weights=weights)
    found = _summary_of_zone_map(frame, signal.name)
    if signal.turn is None or not found.present:
        return found
    numbers = frame.usable(signal.name)
    circular = summarise_numbers(
        *numbers, turn=signal.turn, weights=frame.usable_weights(signal.name)
    )
    return found._replace(sines=circular.sines, cosines=circular.cosines)


def _summary_of_zone_map(frame: Frame, name: str) -> Summary:
    """Summarise from chunks, opening only those with the ends and the extremes.

    The squares are combined by the formula of T. F. Chan, G. H. Golub, R. J. LeVeque, "Algorithms
    for computing the sample variance", The American Statistician 37 (1983): each chunk's own plus
    count * (its mean - the mean) ** 2.
    """
    zones = frame.zone_map(name)
    held = np.flatnonzero(~np.isnan(zones.sum))
    if not len(held):
        return Summary(len(frame))
    present = int(zones.value_count[held].sum())
    counts, sums, own_squares = (each[held] for each in weighted_sums(frame, name, zones))
    scale = present / math.fsum(counts.tolist())
    total = math.fsum(sums.tolist()) * scale
    shifts = sums / counts - total / present
    squares = (own_squares + counts * shifts * shifts) * scale
    stepped = zones.last[held][:-1] != zones.first[held][1:]
    low, high = int(np.nanargmin(zones.min)), int(np.nanargmax(zones.max))
    return Summary(
        rows=len(frame),
        present=present,
        changes=int(zones.change_count[held].sum() + np.count_nonzero(stepped)),
        first=float(zones.first[held[0]]),
        first_sim_time_s=_time_of(frame, name, zones, int(held[0]), None),
        last=float(zones.last[held[-1]]),
        last_sim_time_s=_time_of(frame, name, zones, int(held[-1]), None, last=True),
        min=float(zones.min[low]),
        min_sim_time_s=_time_of(frame, name, zones, low, float(zones.min[low])),
        max=float(zones.max[high]),
        max_sim_time_s=_time_of(frame, name, zones, high, float(zones.max[high])),
        sum=total,
        squares=math.fsum(squares.tolist()),
    )


def weighted_sums(frame: Frame, name: str, zones: ZoneMap) -> tuple[Array, Array, Array]:
    """Return weights, weighted sums and weighted squares of the deviations from the mean, by chunk.

    If the rows of a chunk are evenly spaced, its statistics are multiplied by the weight of a row.
    Other chunks are opened.
    """
    weight, is_even = weights_of_chunks(frame, zones)
    found = (
        zones.value_count * weight,
        zones.sum * weight,
        zones.squared_deviations * weight,
    )
    if frame.weights is None or is_even.all():
        return found
    for start, numbers in frame.opened(name, ~is_even & (zones.value_count > 0)):
        stop_row = start + len(numbers)
        inside = (zones.first_row >= start) & (zones.first_row < stop_row)
        edges: list[int] = [*(zones.first_row[inside] - start).tolist(), len(numbers)]
        for first, stop in pairwise(edges):
            part = numbers[first:stop]
            usable = np.abs(part) <= LARGEST
            values, weights = part[usable], frame.weights[start + first : start + stop][usable]
            at = int(np.searchsorted(zones.first_row, start + first, "right")) - 1
            if len(values):
                own, mean = float(weights.sum()), weighted_mean(values, weights)
                off = values - mean
                found[0][at], found[1][at] = own, mean * own
                found[2][at] = inner(off * weights, off)
    return found


def weights_of_chunks(frame: Frame, zones: ZoneMap) -> tuple[Array, Flags]:
    """Return the mean weight of a row in each chunk, and in which chunks all rows count equally."""
    chunks = len(zones)
    if frame.weights is None or not chunks:
        return np.ones(chunks), np.ones(chunks, np.bool_)
    starts = zones.first_row
    weight = np.add.reduceat(frame.weights, starts) / zones.row_count
    low = np.minimum.reduceat(frame.weights, starts)
    high = np.maximum.reduceat(frame.weights, starts)
    return weight, high - low <= EVEN_STEPS * weight


def _time_of(
    frame: Frame, name: str, zones: ZoneMap, place: int, value: float | None, *, last: bool = False
) -> float:
    """Return when a chunk first or last had a value."""
    start = int(zones.first_row[place])
    times, numbers = frame.rows(start, start + int(zones.row_count[place])).usable(name)
    rows = np.flatnonzero(numbers == value) if value is not None else np.arange(len(times))
    return float(times[rows[-1 if last else 0]])


def frame_around(connection: sqlite3.Connection, segment: Segment, deadline: Deadline) -> Frame:
    """Return a segment with some rows around it, so that a gap at its end or around it shows."""
    run = read_frame(connection, Segment(segment.run_id, -math.inf, math.inf), deadline)
    return rows_around(run, segment)


def rows_around(run: Frame, segment: Segment) -> Frame:
    """Return a part of a frame with some rows around it."""
    start, stop = run.places([segment.start_s, segment.end_s]).tolist()
    return run.rows(start - _READING.rows_around, stop + _READING.rows_around)


def rhythm_in(frame: Frame) -> Rhythm:
    """Return the rhythm of the rows of a frame."""
    return rhythm_of(frame.times)


@dataclass(frozen=True)
class Buckets:
    """Buckets that begin at multiples of their length, including empty ones.

    Attributes:
        step_s: Length of a bucket; None if each row is one.
        starts_s: Start of each bucket.
        edges: Index of the first row of each in the frame, followed by the number of rows.
    """

    step_s: float | None
    starts_s: Array
    edges: Indexes


class BucketFigures(NamedTuple):
    """Statistics of a signal in each bucket; NaN if it has no usable number there.

    Attributes:
        mean: For an angle the circular mean in its unit; below 0 only if its values are.
    """

    counts: Indexes
    min: Array
    max: Array
    mean: Array
    last: Array


def buckets_of(frame: Frame, max_points: int, least_step_s: float = 0.0) -> Buckets:
    """Return at most N buckets for the rows of a frame; each row is one if there are few.

    Args:
        frame: The frame.
        max_points: Maximum number of buckets.
        least_step_s: Minimum length of a bucket; above 0, no row is a bucket of its own.
    """
    rows = len(frame)
    if not rows or (least_step_s <= 0 and rows <= max_points):
        return Buckets(None, frame.times, np.arange(rows + 1))
    first_s, last_s = frame.bounds_s
    step_s = _step(first_s, last_s, max_points, least_step_s)
    numbers: Array = np.arange(
        _number(first_s, step_s), _number(last_s, step_s) + 2, dtype=np.float64
    )
    borders_s: Array = (numbers - _READING.edge_share) * step_s
    edges = frame.places(borders_s)
    edges[0], edges[-1] = 0, rows
    starts_s: Array = np.round(numbers[:-1] * step_s, 9)
    return Buckets(step_s, starts_s, edges)


def _number(time_s: float, step_s: float) -> int:
    """Return the number of the bucket that holds a time."""
    return math.floor(time_s / step_s + _READING.edge_share)


def _step(first_s: float, last_s: float, max_points: int, least_s: float) -> float:
    """Return the shortest round bucket length that needs no more buckets."""
    for step_s in _round_steps(max(least_s, (last_s - first_s) / max_points / 10, 1e-9)):
        if step_s >= least_s and _number(last_s, step_s) - _number(first_s, step_s) < max_points:
            return step_s
    raise AssertionError("the steps never end")


def _round_steps(at_least_s: float) -> Iterator[float]:
    for exponent in count(math.floor(math.log10(at_least_s))):
        for nice in (1, 1.5, 2, 3, 4, 5, 6, 8):
            yield nice * 10**exponent if exponent >= 0 else nice / 10**-exponent


def cells_of(
    frame: Frame, signal: RegisteredSignal, buckets: Buckets, kept: Frame | None
) -> BucketFigures:
    """Return the statistics of a signal in each bucket.

    Args:
        frame: The rows.
        signal: A numeric one.
        buckets: Buckets from `buckets_of` of the same frame.
        kept: Rows that only full-rate segments have; they count for extremes.
    """
    turned = unwrapped(frame, signal)
    cells = _cells(_parts(frame, signal, buckets, turned), signal.turn, buckets.edges)
    if turned is not None and signal.turn is not None:
        middle = (cells.min + cells.max) / 2
        turns = np.nan_to_num(np.rint((middle - cells.mean) / signal.turn))
        cells = cells._replace(mean=cells.mean + turns * signal.turn)
    if kept is not None and len(buckets.starts_s):
        times, numbers = kept.usable(signal.name)
        if turned is not None and signal.turn is not None:
            numbers = beside(frame, turned, signal.turn, times, numbers)
        places = np.searchsorted(buckets.starts_s, times + 1e-9, "right") - 1
        np.fmin.at(cells.min, np.maximum(places, 0), numbers)
        np.fmax.at(cells.max, np.maximum(places, 0), numbers)
    return cells


def beside(frame: Frame, turned: Array, turn: float, times: Array, angles: Array) -> Array:
    """Return angles of other rows in the turns of the frame's rows around them."""
    there = ~np.isnan(turned)
    near = np.interp(times, frame.times[there], turned[there])
    return np.asarray(angles + turn * np.rint((near - angles) / turn), np.float64)


class _Parts(NamedTuple):
    """Rows, and chunks within one bucket, in order, with the statistics of each.

    Attributes:
        weights: Share of the time that each stands for; `sum` is weighted by it.
    """

    first_row: Indexes
    counts: Indexes
    weights: Array
    min: Array
    max: Array
    sum: Array
    last: Array


def _parts(
    frame: Frame, signal: RegisteredSignal, buckets: Buckets, turned: Array | None
) -> _Parts:
    """Return the parts; chunks within one bucket are not opened if there are many rows."""
    name = signal.name
    if len(frame) <= FULL_ROWS or signal.turn is not None:
        return _of_rows(frame, 0, frame.numbers(name) if turned is None else turned)
    zones = frame.zone_map(name)
    edges = buckets.edges[buckets.edges < len(frame)]
    borders = np.searchsorted(zones.first_row, edges, "right") - 1
    cut: Flags = np.zeros(len(zones), np.bool_)
    cut[borders[zones.first_row[borders] != edges]] = True
    weight, is_even = weights_of_chunks(frame, zones)
    cut |= ~is_even
    whole = ~cut & (zones.value_count > 0) & ~np.isnan(zones.sum)
    chunks = _Parts(
        zones.first_row[whole],
        zones.value_count[whole],
        (zones.value_count * weight)[whole],
        zones.min[whole],
        zones.max[whole],
        (zones.sum * weight)[whole],
        zones.last[whole],
    )
    opened = [_of_rows(frame, *each) for each in frame.opened(name, cut)]
    return _in_order([chunks, *opened])


def _in_order(some: Sequence[_Parts]) -> _Parts:
    joined = [np.concatenate(column) for column in zip(*some, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    return _Parts(*(column[order] for column in joined))


def _of_rows(frame: Frame, start: int, numbers: Array) -> _Parts:
    """Return one part per row with a usable number."""
    rows = np.flatnonzero(np.abs(numbers) <= LARGEST)
    held = numbers if len(rows) == len(numbers) else numbers[rows]
    ones = np.ones(len(rows))
    weights = ones if frame.weights is None else frame.weights[rows + start]
    return _Parts(rows + start, ones.astype(np.intp), weights, held, held, held * weights, held)


def _cells(parts: _Parts, turn: float | None, edges: Indexes) -> BucketFigures:
    cells = len(edges) - 1
    places = np.searchsorted(edges, parts.first_row, "right") - 1
    starts = np.flatnonzero(np.diff(places, prepend=-1))
    if not len(starts):
        nothing = (np.full(cells, np.nan) for _ in range(4))
        return BucketFigures(np.zeros(cells, np.intp), *nothing)
    filled = places[starts]

    def spread(figures: Array) -> Array:
        whole = np.full(cells, np.nan)
        whole[filled] = figures
        return whole

    counts = np.add.reduceat(parts.counts, starts)
    low = np.minimum.reduceat(parts.min, starts)
    high = np.maximum.reduceat(parts.max, starts)
    if turn is None:
        mean = _weighted_means(parts, starts)
        mean = np.minimum(np.maximum(mean, low), high)  # sums are rounded
    else:
        mean = _circular_means(parts, starts, turn, low)
    count_of: Indexes = np.zeros(cells, np.intp)
    count_of[filled] = counts
    last = parts.last[np.append(starts[1:], len(places)) - 1]
    return BucketFigures(count_of, spread(low), spread(high), spread(mean), spread(last))


def _weighted_means(parts: _Parts, starts: Indexes) -> Array:
    weights = np.add.reduceat(parts.weights, starts)
    return np.asarray(np.add.reduceat(parts.sum, starts) / weights, np.float64)


def _circular_means(parts: _Parts, starts: Indexes, turn: float, low: Array) -> Array:
    """Return the direction of the resultant vector; NaN if the vectors cancel out.

    K. V. Mardia, P. E. Jupp, Directional Statistics (2000), section 2.2.1.
    """
    weights = np.add.reduceat(parts.weights, starts)
    angles = parts.last * (math.tau / turn)
    sines = np.add.reduceat(np.sin(angles) * parts.weights, starts)
    cosines = np.add.reduceat(np.cos(angles) * parts.weights, starts)
    means = np.arctan2(sines, cosines) * (turn / math.tau)
    means[np.hypot(sines, cosines) < NO_LENGTH * weights] = np.nan
    return np.where((means < 0) & (low >= 0), means + turn, means)


# -- texts, flags and modes: when they change, and the time in each value --------------------------


class Point(NamedTuple):
    """From `sim_time_s` on the signal had this value."""

    sim_time_s: float
    value: str | bool | None


@dataclass(frozen=True)
class ChangePoints:
    """The change points of signals in a segment.

    Attributes:
        points: By signal, in order. The first is the value in force when the segment begins; its
            time may be earlier. If that value is unknown, there are only later points, or none.
        since_before: Signals whose first value was in force before the time of its point, for an
            unknown time.
        unread_from_s: Where the deadline passed: there are no later points, and the last point of a
            signal need not be its last change. None if all was read.
        unread: Parts of the segment that could not be read, and why; they contain no points.
    """

    segment: Segment
    points: Mapping[str, list[Point]]
    since_before: frozenset[str] = frozenset()
    unread_from_s: float | None = None
    unread: tuple[Unread, ...] = ()

    def read_to_s(self, end_s: float) -> float:
        """Return up to when before `end_s` the values are known."""
        return end_s if self.unread_from_s is None else min(end_s, self.unread_from_s)

    def cut(self, unread_from_s: float | None) -> ChangePoints:
        """Return the points up to a time, for an answer that ends there."""
        if unread_from_s is None or self.read_to_s(unread_from_s) < unread_from_s:
            return self
        points = {name: _until(each, unread_from_s) for name, each in self.points.items()}
        return replace(self, points=points, unread_from_s=unread_from_s)

    def longest_values(self, name: str, end_s: float) -> dict[str, float]:
        """Return the seconds in each value up to `end_s`, of what was read.

        See `longest_values`.
        """
        return longest_values(self.points[name], self.segment.start_s, self.read_to_s(end_s))


def change_points(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[RegisteredSignal],
    deadline: Deadline,
    *,
    frame: Frame | None = None,
    since: bool = True,
) -> ChangePoints:
    """Return the change points of signals in a segment of any length.

    Args:
        connection: An open database.
        segment: The segment.
        signals: Texts, flags and numbers; each value of a number counts as its text.
        deadline: For all reading; the start of the first values is searched last.
        frame: The rows of the segment, if they were read already.
        since: Whether to find out when the value in force at the start began; otherwise the time of
            that point may be any earlier time.
    """
    frame = frame or read_frame(connection, segment, deadline)
    before: Frame | None = None  # read only on access
    points: dict[str, list[Point]] = {}
    since_before = set[str]()
    for signal in signals:
        found = _points_in(frame, signal)
        first = found[0] if found and found[0].sim_time_s <= segment.start_s else None
        known = first is not None
        if since or not known:
            if before is None:
                whole = Segment(segment.run_id, -math.inf, segment.start_s)
                before = read_frame(connection, whole, deadline)
            late = since and deadline.passed and len(before) > 0
            first = None if late else _in_force(before, signal, first, since=since)
            if first is not None and since and _is_hidden(before, signal, first.sim_time_s):
                since_before.add(signal.name)
        if first is None:
            since_before.update([signal.name] * (known and since))
        else:
            found[: int(found[:1] == [] or known or found[0].value == first.value)] = [first]
        points[signal.name] = found
    if not segment.full_rate:
        _splice_kept(connection, segment, signals, deadline, points)
    if frame.cut_at_s is None:
        return ChangePoints(segment, points, frozenset(since_before), unread=frame.unread)
    unread_s = max(segment.start_s, frame.cut_at_s)
    found = {name: _until(each, unread_s) for name, each in points.items()}
    return ChangePoints(segment, found, frozenset(since_before), unread_s, frame.unread)


def _in_force(
    before: Frame, signal: RegisteredSignal, at_begin: Point | None, *, since: bool
) -> Point | None:
    """Return the point of the value in force when a segment begins; None if it is not found.

    Args:
        before: The rows before the segment.
        signal: The signal.
        at_begin: The value in the row at the start; None without such a row.
        since: Whether to search the time at which that value began.
    """
    rows = len(before)
    if before.cut_at_s is not None or not rows:
        return at_begin if before.cut_at_s is None else None
    if at_begin is None:
        at_begin = next(iter(_points_in(before.rows(rows - 1, rows), signal)), None)
    if at_begin is None:
        return None
    row = _first_of_last_equal(before, signal, at_begin.value) if since else rows
    if row == rows:
        return at_begin
    return Point(float(before.rows(row, row + 1).times[0]), at_begin.value)


def _is_hidden(before: Frame, signal: RegisteredSignal, time_s: float) -> bool:
    """Return whether the value of the row before a time could not be read."""
    row = int(before.places([time_s])[0])
    return row > 0 and not before.rows(row - 1, row).was_read(signal.name).all()


def _first_of_last_equal(frame: Frame, signal: RegisteredSignal, value: str | bool | None) -> int:
    """Return the first of the last rows that all have this value, or the number of rows."""
    stop, rows = len(frame), _READING.first_rows_back
    while stop > 0:
        start = max(0, stop - rows)
        values, codes = _valued(frame.rows(start, stop), signal)
        unlike = np.flatnonzero(codes != (values.index(value) if value in values else -1))
        if len(unlike):
            return start + int(unlike[-1]) + 1
        stop, rows = start, rows * _READING.growth
    return 0


def _points_in(frame: Frame, signal: RegisteredSignal) -> list[Point]:
    """Return the first value of a frame, and each that differs from the one before."""
    values, codes = _valued(frame, signal)
    times = frame.times
    if frame.unread:
        read = frame.was_read(signal.name)
        times, codes = times[read], codes[read]
    rows = np.flatnonzero(np.append(True, codes[1:] != codes[:-1])[: len(codes)])
    at = zip(times[rows].tolist(), codes[rows].tolist(), strict=True)
    return [Point(time_s, values[code]) for time_s, code in at]


def _valued(frame: Frame, signal: RegisteredSignal) -> tuple[list[str | bool | None], Indexes]:
    """Return the distinct values of a signal, and the index of the value of each row."""
    codes, labels = frame.coded(signal.name)
    of_label = [_value(signal, label) for label in labels]
    values = list(dict.fromkeys(of_label))
    if values == of_label:
        return values, codes
    places = {value: place for place, value in enumerate(values)}
    return values, np.array([places[value] for value in of_label], np.intp)[codes]


def _value(signal: RegisteredSignal, label: Value) -> str | bool | None:
    if signal.kind == "bool":
        return None if label is None else label in (1, True)
    if signal.is_number and isinstance(label, str):
        return None
    return shown(label)


def _splice_kept(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[RegisteredSignal],
    deadline: Deadline,
    points: dict[str, list[Point]],
) -> None:
    """Replace the points within full-rate segments by those of each call, which miss no step."""
    for each in full_rate_parts(connection, segment.run_id, segment.start_s, segment.end_s):
        start_s = max(each.start_s, segment.start_s)
        end_s = min(just_after(each.end_s), segment.end_s)
        stretch = Segment(segment.run_id, start_s, end_s, full_rate=True)
        frame = read_frame(connection, stretch, deadline)
        if frame.cut_at_s is not None:
            return
        for signal in signals:
            outside = points[signal.name]
            before = [point for point in outside if point.sim_time_s < start_s]
            after = [point for point in outside if point.sim_time_s >= end_s]
            whole = [*before, *_points_in(frame, signal), *after]
            alike = [False, *(was.value == now.value for was, now in pairwise(whole))]
            points[signal.name] = [
                point for point, same in zip(whole, alike, strict=True) if not same
            ]


def _until(points: list[Point], end_s: float) -> list[Point]:
    """Return the points up to a time."""
    return [point for point in points if point.sim_time_s <= end_s]


def time_by_value(points: Sequence[Point], start_s: float, end_s: float) -> dict[str, float]:
    """Return simulated seconds in each value within [start_s, end_s), the longest first.

    Between two rows the value of the earlier one is in force; null counts as "null".
    """
    seconds: dict[str, float] = {}
    for point, after in pairwise([*points, Point(end_s, None)]):
        begin_s, stop_s = max(point.sim_time_s, start_s), min(after.sim_time_s, end_s)
        if stop_s > begin_s:
            key = spelled(point.value)
            seconds[key] = seconds.get(key, 0.0) + stop_s - begin_s
    return dict(sorted(seconds.items(), key=lambda item: -item[1]))


def longest_values(points: Sequence[Point], start_s: float, end_s: float) -> dict[str, float]:
    """Return the seconds in the 20 longest values: a text that is no mode has too many."""
    return dict(list(time_by_value(points, start_s, end_s).items())[:MOST_VALUES])


def spelled(value: str | bool | None) -> str:
    """Return the text of a value: true, false, null, or the text itself."""
    return value if isinstance(value, str) else {True: "true", False: "false", None: "null"}[value]
