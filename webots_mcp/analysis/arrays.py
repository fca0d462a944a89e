"""numpy at its first use, and what is asked of arrays: medians, noise, runs of rows, gaps.

Neither a server's start nor a summary waits for numpy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
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
_ORDER: Final = 4
# The fourth difference of independent noise has sqrt(1 + 16 + 36 + 16 + 1) = sqrt(70) times its
# standard deviation, and a normal variable has a median magnitude of 0.6745 of it.
_GAIN: Final = 0.6745 * 70**0.5
LEAST_ROWS: Final = 3 * _ORDER
GAP_INTERVALS: Final = 3.0  # a longer pause between two rows is a gap; in median intervals
EVEN_STEPS: Final = 1e-3  # of the mean step: steps that differ by less are even
LEAST_WEIGHT: Final = 1e-9  # of rows of the same moment, so that no sum of weights is 0
ANOTHER_RATE: Final = 5  # this many long intervals in a row are a slower rate, not gaps


def inner(one: Array, other: Array) -> float:
    """The sum of products, without the threads of `@`, which wait for each other actively."""
    return float(np.einsum("i,i->", one, other))


def median(values: Array) -> float:
    """That of at least one finite value; for few of them in a fifth of the time of numpy's."""
    below, above = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, (below, above))
    return float(ordered[below] + ordered[above]) / 2


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
    sizes = np.abs(np.diff(values, _ORDER))
    return median(sizes) / _GAIN if len(sizes) >= LEAST_ROWS - _ORDER else 0.0


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
    """The rhythm of the given times; a gap is an interval of more than three median ones."""
    interval_s = usual_interval_s(times)
    return Rhythm(interval_s, interruptions(gaps_in(times, interval_s)) if interval_s else ())


def interruptions(gaps: Sequence[Gap]) -> tuple[Gap, ...]:
    """The gaps without those that are the intervals of another, slower rate.

    Where five or more follow one another directly, only what is longer than three of them is one.
    """
    cuts = [at for at in range(1, len(gaps)) if gaps[at].start_s != gaps[at - 1].end_s]
    edges = pairwise([0, *cuts, len(gaps)]) if gaps else ()
    return tuple(gap for start, end in edges for gap in _longest(gaps[start:end]))


def _longest(chain: Sequence[Gap]) -> Iterator[Gap]:
    lengths_s = sorted(gap.end_s - gap.start_s for gap in chain)
    usual_s = lengths_s[len(chain) // 2] if len(chain) >= ANOTHER_RATE else 0.0
    return (gap for gap in chain if gap.end_s - gap.start_s > GAP_INTERVALS * usual_s * (1 + 1e-6))


def usual_interval_s(times: Sequence[float] | Array) -> float | None:
    """The median interval; those of zero, while a simulation is paused, do not count."""
    intervals: Array = np.diff(np.asarray(times, np.float64))
    moving = intervals[intervals > 0]
    return median(moving) if len(moving) else None


def gaps_in(times: Sequence[float] | Array, interval_s: float) -> tuple[Gap, ...]:
    """The gaps between rows that usually come at such intervals."""
    moments: Array = np.asarray(times, np.float64)
    rows = gap_borders(moments, interval_s)
    return tuple(
        Gap(*pair) for pair in zip(moments[rows - 1].tolist(), moments[rows].tolist(), strict=True)
    )


def gap_borders(times: Array, interval_s: float) -> Indexes:
    """The indexes of the rows right after a gap."""
    return np.flatnonzero(np.diff(times) > GAP_INTERVALS * interval_s * (1 + 1e-6)) + 1
