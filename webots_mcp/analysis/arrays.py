"""numpy at its first use, and what is asked of arrays: medians, noise, runs of rows, gaps.

Neither a server's start nor a summary waits for numpy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Flags = NDArray[np.bool_]
    Indexes = NDArray[np.intp]
else:
    Array = Flags = Indexes = Any

    class _AtFirstUse:
        def __getattr__(self, name: str) -> Any:
            import numpy

            setattr(self, name, getattr(numpy, name))
            return getattr(numpy, name)

    np = _AtFirstUse()

MOSTLY: Final = 0.5  # of the rows
MOSTLY_KNOWN: Final = 0.75  # of the rows
LONGEST_DROPOUT_S: Final = 0.25
SINGLE_PRECISION: Final = 2.0**-23  # of a value: the last bit of a 32-bit float, as sensors give
EVEN_LOSS: Final = 0.1  # of the usual interval: by so much others may differ from multiples of it
_ORDER: Final = 4
# The fourth difference of independent noise has sqrt(1 + 16 + 36 + 16 + 1) = sqrt(70) times its
# standard deviation, and a normal variable has a median magnitude of 0.6745 of it.
_GAIN: Final = 0.6745 * 70**0.5
LEAST_ROWS: Final = 3 * _ORDER
_AT_ONCE: Final = 16_384  # values, which stay in the cache of a processor
_MANY: Final = 50_000  # values, of which a sample tells about where their median is
_SAMPLED: Final = 4096
_MARGIN: Final = 160  # of the sample: five standard deviations of the rank of its median
GAP_INTERVALS: Final = 3.0  # a longer pause between two rows is a gap; in median intervals
EVEN_STEPS: Final = 1e-3  # of the mean step: steps that differ by less are even
LEAST_WEIGHT: Final = 1e-9  # of rows of the same moment, so that no sum of weights is 0


@dataclass(frozen=True)
class GapSettings:
    """What counts as a gap in a recording.

    Attributes:
        around: Intervals on each side with which one is compared.
        fewest_around: Of fewer on a side nothing is known.
        least_intervals: A gap is longer than so many usual intervals: two rows are missing.
        jitter_power: How far beyond its upper quartile a usual interval may be, as a power of the
            ratio of the quartiles. For a logarithmic normal jitter that is 5.4 deviations.
        another_rate: So many long intervals in a row are a slower rate.
        at_once: Intervals that are judged at once, which limits the memory.
    """

    around: int = 20
    fewest_around: int = 5
    least_intervals: float = 2.5
    jitter_power: float = 3.5
    another_rate: int = 5
    at_once: int = 50_000


_GAPS: Final = GapSettings()


def inner(one: Array, other: Array) -> float:
    """The sum of products, without the threads of `@`, which wait for each other actively."""
    return float(np.einsum("i,i->", one, other))


def median(values: Array) -> float:
    """That of at least one finite value, in a fifth of the time of numpy's.

    Of many values only those are ordered that lie next to the middle of a sample of them.
    """
    low, high = (len(values) - 1) // 2, len(values) // 2
    if len(values) >= _MANY:
        bounds: Array = np.sort(values[:: len(values) // _SAMPLED])
        middle = len(bounds) // 2
        least, most = bounds[[middle - _MARGIN, middle + _MARGIN]]
        below = int(np.count_nonzero(values < least))
        if least == most and below <= low and high < below + int(np.count_nonzero(values == least)):
            return float(least)
        inside = values[(values >= least) & (values <= most)]
        if below <= low and high < below + len(inside):  # they are the ones in the middle
            values, low, high = inside, low - below, high - below
    ordered: Array = np.array(values)
    ordered.partition((low, high))
    return float(ordered[low] + ordered[high]) / 2


def in_order(values: Array, place: int) -> float:
    """Return the value at a place of the sorted ones.

    numpy is many times slower where it is asked for one place of values that repeat.
    """
    ordered: Array = np.array(values)
    ordered.partition((place, place))
    return float(ordered[place])


def rounding_of(values: Array) -> float:
    """Return by how much rounding to 32-bit floats changes the largest of some values."""
    return SINGLE_PRECISION * max(float(values.max()), -float(values.min()))


def sums_of(values: Array, rows: int) -> Array:
    """Of so many values that follow each other; put together of sums of half as many."""
    if rows == 1:
        return values
    halves = sums_of(values, rows // 2)
    sums = halves[: len(halves) - rows // 2] + halves[rows // 2 :]
    return sums[:-1] + values[rows - 1 :] if rows % 2 else sums


def noise_of(values: Array) -> float:
    """Standard deviation of the independent noise in evenly recorded values.

    The median magnitude of the fourth differences: a course that a polynomial of third degree
    describes over five rows adds nothing to it, and single outliers hardly anything (T. Gasser,
    L. Sroka, C. Jennen-Steinmetz, Residual variance and residual pattern in nonlinear regression,
    Biometrika 73, 1986, of which this is the robust form with a higher order). 0 for fewer than
    12 values.
    """
    if len(values) < LEAST_ROWS:
        return 0.0
    sizes = np.empty(len(values) - _ORDER)
    for first in range(0, len(sizes), _AT_ONCE):
        part = np.diff(values[first : first + _AT_ONCE + _ORDER], _ORDER)
        np.abs(part, out=sizes[first : first + _AT_ONCE])
    return median(sizes) / _GAIN


class RowSpan(NamedTuple):
    """One of them: rows [start, stop) of a frame, the times of its first and last row.

    Attributes:
        value: Where all of them have the same.
    """

    start: int
    stop: int
    start_s: float
    end_s: float
    value: float = math.nan

    @property
    def duration_s(self) -> float:
        """From the first row to the last."""
        return self.end_s - self.start_s


@dataclass(frozen=True)
class Runs:
    """All of them, in order: rows [start, stop) of each, and their times."""

    starts: Indexes
    stops: Indexes
    starts_s: Array
    ends_s: Array

    @property
    def durations_s(self) -> Array:
        """From the first row of each to its last."""
        return self.ends_s - self.starts_s

    def only(self, wanted: Flags) -> Runs:
        """Some of them."""
        rows, times = (self.starts[wanted], self.stops[wanted]), (self.starts_s, self.ends_s)
        return Runs(*rows, times[0][wanted], times[1][wanted])

    def spans(self) -> Iterator[RowSpan]:
        """One by one."""
        columns = (self.starts, self.stops, self.starts_s, self.ends_s)
        return map(RowSpan, *(column.tolist() for column in columns))

    def __len__(self) -> int:
        return len(self.starts)


@lru_cache(1)  # the same for all
def no_runs() -> Runs:
    """Return none at all."""
    return _runs(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0))


def runs_of(holds: Flags, times: Array) -> Runs:
    """Where something holds in each row."""
    edges = np.flatnonzero(np.diff(holds, prepend=False, append=False))
    return _runs(edges[::2], edges[1::2], times)


def _runs(starts: Indexes, stops: Indexes, times: Array) -> Runs:
    return Runs(starts, stops, times[starts], times[stops - 1])


def constant_runs(numbers: Array, times: Array) -> Runs:
    """Where a number stays exactly the same in two rows at least; NaN is never the same."""
    edges = np.flatnonzero(np.append(True, numbers[1:] != numbers[:-1]))
    stops = np.append(edges[1:], len(numbers))
    long = stops - edges >= 2
    return _runs(edges[long], stops[long], times)


# -- how much of the time a row stands for ---------------------------------------------------------


def time_weights(times: Array) -> Array | None:
    """Return how much of the time each row stands for, in units of the mean share.

    A row stands for half of the step before it and half of the step after it, which is the
    trapezoidal rule; the first and the last stand for half a usual step beyond the ends. So rows
    that follow each other evenly count alike, rows that were recorded at a higher rate count for
    less each, and a gap belongs to the rows around it.

    Args:
        times: They do not fall.

    Returns:
        None where the rows count alike: their steps are even, or no time passes.
    """
    if len(times) < 3:
        return None
    steps = np.diff(times)
    if steps.max() - steps.min() <= EVEN_STEPS * steps.mean():
        return None
    usual_s = median(steps)
    weights = np.empty(len(times))
    weights[1:-1] = (steps[1:] + steps[:-1]) / 2
    weights[0] = (steps[0] + min(steps[0], usual_s)) / 2
    weights[-1] = (steps[-1] + min(steps[-1], usual_s)) / 2
    total_s = float(weights.sum())
    if total_s <= 0:
        return None
    return np.maximum(weights * (len(times) / total_s), LEAST_WEIGHT)


def weighted_mean(values: Array, weights: Array | None) -> float:
    """Return the mean of at least one value; None as weights lets all count alike."""
    if weights is None:
        return float(values.mean())
    mean = inner(values, weights) / float(weights.sum())
    return min(max(mean, float(values.min())), float(values.max()))  # sums round


# -- single values that are missing ----------------------------------------------------------------


def without_dropouts(values: Array, times: Array) -> Array:
    """Return values with straight lines in place of short dropouts.

    A dropout is short if one row has no value, or if it lasts at most 0.25 s: no robot goes
    somewhere and comes back in it. A signal that has no value in a quarter of its rows is not
    changed, since it is recorded less often by its nature.

    Args:
        values: NaN where there is none.
        times: Of the rows.
    """
    rows = np.flatnonzero(np.isfinite(values))
    if len(rows) == len(values) or len(rows) < MOSTLY_KNOWN * len(values):
        return values
    short = (np.diff(rows) == 2) | (np.diff(times[rows]) <= LONGEST_DROPOUT_S)
    missing = np.flatnonzero(~np.isfinite(values))
    after = np.searchsorted(rows, missing)
    inside = (after > 0) & (after < len(rows))
    missing, after = missing[inside], after[inside]
    missing = missing[short[after - 1]]
    found: Array = np.array(values)
    found[missing] = np.interp(times[missing], times[rows], values[rows])
    return found


def with_lost_rows(times: Array, interval_s: float) -> Array:
    """Return times with those of rows that were lost out of evenly recorded ones.

    Rows that come unevenly, or of which more than a quarter is missing, are returned as they are.
    Longer gaps than those that `without_dropouts` bridges stay.

    Args:
        times: They rise.
        interval_s: The usual interval.
    """
    intervals = np.diff(times)
    if interval_s <= 0 or not len(intervals) or intervals.max() < 1.5 * interval_s:
        return times
    lost = np.rint(intervals / interval_s).astype(np.intp) - 1
    lost[(lost > 1) & (intervals > LONGEST_DROPOUT_S)] = 0
    lost[np.abs(intervals - (lost + 1) * interval_s) > EVEN_LOSS * interval_s] = 0
    lost = np.maximum(lost, 0)
    count = int(lost.sum())
    if not count or len(times) < MOSTLY_KNOWN * (len(times) + count):
        return times
    places = np.concatenate(([0], np.cumsum(lost + 1)))  # of the recorded rows among all
    return np.interp(np.arange(len(times) + count), places, times)


# -- how regularly rows were recorded, and where some are missing ----------------------------------


@dataclass(frozen=True)
class Gap:
    """No row between two rows of a run, for longer than usual."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class Rhythm:
    """How regularly rows were recorded.

    Attributes:
        interval_s: The median simulated time between rows; None for fewer than two rows.
        gaps: In order.
    """

    interval_s: float | None
    gaps: tuple[Gap, ...]


def rhythm_of(times: Sequence[float] | Array) -> Rhythm:
    """Return the rhythm of some times, and where it is interrupted; see `find_gaps`."""
    return Rhythm(usual_interval_s(times), find_gaps(times))


def find_gaps(times: Sequence[float] | Array) -> tuple[Gap, ...]:
    """Return the intervals that are longer than those around them let expect.

    An interval is a gap if it is longer than 2.5 usual ones before it and after it, so that two
    rows are missing, and beyond what the jitter of those explains: their upper quartile times the
    3.5th power of its ratio to the lower one. Of intervals with logarithmic normal, normal or
    exponential jitter at most one in 50,000 is taken for a gap. Where five or more long intervals
    follow each other, rows come at another rate; only what is longer than those is a gap.

    Args:
        times: They do not fall. Those that stand still, while a simulation is paused, do not count.
    """
    moments: Array = np.asarray(times, np.float64)
    intervals = np.diff(moments)
    rows = np.flatnonzero(intervals > 0)
    intervals = intervals[rows]
    at = _suspects(intervals)
    at = at[intervals[at] > _longest_usual(intervals, at) * (1 + 1e-6)]
    rows = rows[at]
    return tuple(
        Gap(*pair) for pair in zip(moments[rows].tolist(), moments[rows + 1].tolist(), strict=True)
    )


def longest_usual_s(times: Array) -> float | None:
    """Return how long no row may follow the last one before that is a gap; None if not known."""
    intervals = np.diff(times)
    intervals = intervals[intervals > 0]
    if len(intervals) < _GAPS.fewest_around:
        return None
    at: Indexes = np.array([len(intervals)])
    return float(_longest_usual(np.append(intervals, np.inf), at)[0])


def _suspects(intervals: Array) -> Indexes:
    """The intervals that are far longer than one near them, which all gaps are."""
    if len(intervals) < 3 or intervals.max() <= _GAPS.least_intervals * intervals.min():
        return np.zeros(0, np.intp)
    near = _GAPS.around // 2 + 1
    beyond = np.full(near, np.inf)
    least = np.concatenate((beyond, intervals, beyond))
    window = 1
    while window < near:  # the minimum of each `near` intervals, from those of half as many
        step = min(window, near - window)
        least = np.minimum(least[:-step], least[step:])
        window += step
    before, after = least[: len(intervals)], least[near + 1 :][: len(intervals)]
    return np.flatnonzero(intervals > _GAPS.least_intervals * np.minimum(before, after))


def _longest_usual(intervals: Array, at: Indexes) -> Array:
    """How long some intervals may be for those around them."""
    found: list[Array] = []
    for first in range(0, len(at), _GAPS.at_once):
        part = at[first : first + _GAPS.at_once]
        steps = np.arange(1, _GAPS.around + 1)
        sides = (_usual_of(intervals, part, steps), _usual_of(intervals, part, -steps))
        usual = np.maximum(*sides)
        unknown = usual == 0
        usual[unknown] = _GAPS.least_intervals * median(intervals) if unknown.any() else 0.0
        found.append(np.maximum(usual, _GAPS.least_intervals * _slowest_rate(intervals, part)))
    return np.concatenate(found) if found else np.zeros(0)


def _usual_of(intervals: Array, at: Indexes, steps: Indexes) -> Array:
    """What the intervals so many places away let expect; 0 where there are too few of them."""
    places = at[:, None] + steps
    there = (places >= 0) & (places < len(intervals))
    around = np.where(
        there, intervals[np.minimum(np.maximum(places, 0), len(intervals) - 1)], np.inf
    )
    around.sort(axis=1)
    count = there.sum(axis=1)
    around[count == 0] = 1.0  # the answer is 0 then
    each = np.arange(len(at))
    last = np.maximum(count - 1, 0)
    low, middle, high = (
        around[each, np.ceil(share * last).astype(np.intp)] for share in (0.25, 0.5, 0.75)
    )
    usual = np.maximum(_GAPS.least_intervals * middle, high * (high / low) ** _GAPS.jitter_power)
    return np.where(count >= _GAPS.fewest_around, usual, 0.0)


def _slowest_rate(intervals: Array, at: Indexes) -> Array:
    """The shortest of five intervals in a row, of which one is that in question: of all such fives.

    An interval that is as long as four others around it is one of a slower rate.
    """
    width = _GAPS.another_rate
    places = at[:, None, None] + np.arange(-width + 1, 1)[:, None] + np.arange(width)
    there = (places >= 0) & (places < len(intervals))
    rows = np.where(there, intervals[np.minimum(np.maximum(places, 0), len(intervals) - 1)], 0.0)
    return np.asarray(rows.min(axis=2).max(axis=1), np.float64)


def usual_interval_s(times: Sequence[float] | Array) -> float | None:
    """The median interval; those of zero, while a simulation is paused, do not count."""
    intervals: Array = np.diff(np.asarray(times, np.float64))
    moving = intervals[intervals > 0]
    return median(moving) if len(moving) else None


def gap_borders(times: Array, interval_s: float) -> Indexes:
    """The indexes of the rows right after a gap."""
    return np.flatnonzero(np.diff(times) > GAP_INTERVALS * interval_s * (1 + 1e-6)) + 1
