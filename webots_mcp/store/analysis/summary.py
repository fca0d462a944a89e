"""What a stretch of one signal comes to: count, extremes, mean, slope, spikes, rests."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, Indexes, inner, np

LARGEST: Final = 1e100  # beyond it (a stray infinity, a huge integer) squares would overflow
NO_LENGTH: Final = 1e-9  # of a resultant vector that means no direction
_LENGTH_DUST: Final = 1e-14  # what adding unit vectors leaves; less than 1.5e-7 rad


class Summary(NamedTuple):
    """Counts of the values, and figures of the numbers, which are None where there are none.

    Attributes:
        rows: State rows that were looked at.
        present: Of them with a usable number.
        changes: Values unlike the one before.
        squares: Sum of squared deviations from the mean.
        sines: Sum of sines, of an angle in whatever unit.
        cosines: Sum of cosines, of an angle in whatever unit.
    """

    rows: int = 0
    present: int = 0
    changes: int = 0
    first: float | None = None
    first_sim_time_s: float | None = None
    last: float | None = None
    last_sim_time_s: float | None = None
    min: float | None = None
    min_sim_time_s: float | None = None
    max: float | None = None
    max_sim_time_s: float | None = None
    sum: float | None = None
    squares: float | None = None
    sines: float | None = None
    cosines: float | None = None

    @property
    def mean(self) -> float | None:
        """The arithmetic mean."""
        return None if self.sum is None else self.sum / self.present

    def centre(self, turn: float | None) -> float | None:
        """The mean; of an angle the circular one, in its unit: below 0 only where its values are.

        It is the direction of the resultant vector (K. V. Mardia, P. E. Jupp, Directional
        Statistics, 2000, section 2.2.1); None where the vectors cancel out.

        Args:
            turn: A whole turn in its unit; None of what is no angle.
        """
        if turn is None or self.sines is None or self.cosines is None:
            return self.mean
        if math.hypot(self.sines, self.cosines) < NO_LENGTH * self.present:
            return None
        centre = math.atan2(self.sines, self.cosines) * turn / math.tau
        return centre + turn if centre < 0 <= (self.min or 0.0) else centre

    @property
    def deviation(self) -> float | None:
        """The standard deviation of the sample, with n - 1."""
        if self.squares is None or self.present < 2:
            return None
        return 0.0 if self.min == self.max else math.sqrt(self.squares / (self.present - 1))

    def deviation_in(self, turn: float | None) -> float | None:
        """The standard deviation; of an angle the circular one, in its unit (see `centre`).

        That is sqrt(-2 ln R) with the mean resultant length R (Mardia and Jupp, section 2.3.1).
        """
        if turn is None or self.sines is None or self.cosines is None:
            return self.deviation
        length = math.hypot(self.sines, self.cosines) / max(1, self.present)
        if self.present < 2 or not length:
            return None
        return (
            0.0 if length > 1 - _LENGTH_DUST else math.sqrt(-2 * math.log(length)) * turn / math.tau
        )


def summarise_numbers(
    times: Array, numbers: Array, *, rows: int | None = None, turn: float | None = None
) -> Summary:
    """Summarise usable numbers, as `usable_part` gives them, in order.

    The squares are summed in a second pass over the deviations from the mean (T. F. Chan, G. H.
    Golub, R. J. LeVeque, "Algorithms for computing the sample variance", The American
    Statistician 37, 1983): no cancellation where the mean is large.

    Args:
        times: Of the numbers.
        numbers: In order.
        rows: Of which so many held one; None for as many.
        turn: A whole turn of what is an angle, in its unit.
    """
    present = len(numbers)
    if not present:
        return Summary(rows or 0)
    total = float(numbers.sum())
    deviations = numbers - total / present
    angles = numbers * (math.tau / turn) if turn else None
    ends = {"first": 0, "last": -1, "min": numbers.argmin(), "max": numbers.argmax()}
    figures = {name: float(numbers[at]) for name, at in ends.items()}
    figures |= {f"{name}_sim_time_s": float(times[at]) for name, at in ends.items()}
    return Summary(
        present if rows is None else rows,
        present,
        int(np.count_nonzero(np.diff(numbers))),
        sum=total,
        squares=inner(deviations, deviations),
        sines=None if angles is None else float(np.sin(angles).sum()),
        cosines=None if angles is None else float(np.cos(angles).sum()),
        **figures,
    )


def with_extremes(whole: Summary, recorded: Summary) -> Summary:
    """A summary whose extremes are also those of values that it does not count.

    Where it has no value of its own, those are all there is.
    """
    if recorded.min is None or recorded.max is None:
        return whole
    if whole.min is None or whole.max is None:
        return recorded._replace(rows=max(whole.rows, recorded.rows))
    low = recorded if recorded.min < whole.min else whole
    high = recorded if recorded.max > whole.max else whole
    return with_extremes_of(with_extremes_of(whole, low, high=False), high, low=False)


def with_extremes_of(
    whole: Summary, other: Summary, *, low: bool = True, high: bool = True
) -> Summary:
    """With the least, the greatest or both values of another."""
    if low:
        whole = whole._replace(min=other.min, min_sim_time_s=other.min_sim_time_s)
    if high:
        whole = whole._replace(max=other.max, max_sim_time_s=other.max_sim_time_s)
    return whole


def usable_part(times: Array, numbers: Array) -> tuple[Array, Array]:
    """The usable ones of numbers that may be NaN, with their times."""
    usable = np.abs(numbers) <= LARGEST
    return (times, numbers) if usable.all() else (times[usable], numbers[usable])


# -- what it does over time: slope, spikes, rest, slow change --------------------------------------
#
# Each function takes arrays: times that do not fall and as many values, all finite, at least one.


TIME_BINS: Final = 8
SPIKE_SCORE: Final = 8.0  # 3.5 is the usual; here thousands of values are looked at at once
MOST_SPIKES_SHARE: Final = 0.05  # of the values: more of them are how the signal is
FLAT_BAND: Final = 0.005  # of the range: what moves less is at rest
LEAST_RESTING: Final = 3  # rows
STEP_SHARE: Final = 0.5  # of all that it moves, between two rests


@dataclass(frozen=True)
class Line:
    """The straight line of least squares; `r2` is the share of the variance it explains."""

    slope_per_s: float
    r2: float


@dataclass(frozen=True)
class Spike:
    """One value far from both of its neighbours."""

    sim_time_s: float
    value: float


@dataclass(frozen=True)
class Step:
    """The one change from row to row that makes most of the range; the values around it."""

    sim_time_s: float
    before: float
    after: float


def fit_line(times: Array, values: Array, mean: float) -> Line | None:
    """Least squares: slope = S_tv / S_tt, r2 = S_tv**2 / (S_tt * S_vv), sums about the means.

    N. R. Draper, H. Smith, Applied Regression Analysis (3rd ed. 1998), sections 1.2 and 1.3. None
    where time stood still; r2 is 0 for a constant.
    """
    dt, dv = times - times.mean(), values - mean
    stt, stv, svv = inner(dt, dt), inner(dt, dv), inner(dv, dv)
    if stt == 0:
        return None
    return Line(stv / stt, min(1.0, stv / stt * (stv / svv)) if svv > 0 else 0.0)


def find_spikes(times: Array, values: Array, turn: float | None = None) -> list[Spike]:
    """Single values that stand out from both neighbours, while those agree with each other.

    s = value - mean of both neighbours, judged by the modified z-score 0.6745 * s / MAD(s), and
    where that MAD is 0 by s / (1.2533 * mean |s|): B. Iglewicz, D. C. Hoaglin, How to Detect and
    Handle Outliers (1993). A step is no spike, because its neighbours differ, and no
    turning point, because those differ from the ones beyond them. Where more than one
    in twenty values (and more than three) stand out, none is reported: that is normal for it.
    Of an angle, a step over the end of its scale is as large as what is left of a whole turn.
    """
    if len(values) < 5:
        return []
    recorded = values
    values = values if turn is None else unwrap(values, turn)
    sizes = np.abs(values[1:-1] - (values[:-2] + values[2:]) / 2)
    mad = float(np.partition(sizes, len(sizes) // 2)[len(sizes) // 2])
    limit = SPIKE_SCORE * (mad / 0.6745 if mad > 0 else 1.2533 * float(sizes.mean()))
    rows = np.flatnonzero(sizes > limit) + 1
    rows = rows[_apart_around(values, rows) < sizes[rows - 1] / 2]
    if len(rows) > max(3, MOST_SPIKES_SHARE * len(values)):
        return []
    return [
        Spike(*pair) for pair in zip(times[rows].tolist(), recorded[rows].tolist(), strict=True)
    ]


def _apart_around(values: Array, rows: Indexes) -> Array:
    """How far the neighbours are apart from each other, or one of them from the one beyond it."""
    first, last = np.maximum(rows - 2, 0), np.minimum(rows + 2, len(values) - 1)
    near = values[np.stack((first, rows - 1, rows + 1, last))]
    return np.asarray(np.abs(np.diff(near, axis=0)).max(axis=0), np.float64)


def flat_since(
    times: Array, values: Array, *, span: float | None = None, start_s: float | None = None
) -> float | None:
    """Since when the value has stayed within 0.5 % of its range; None if not for 10 % of the time.

    A step within that band from one rest to another is no rest: it is flat since the step. A
    signal that never changed is flat since its first value.

    Args:
        times: In s.
        values: The last ones at least: all from before the last that is outside of the band.
        span: The range of all values; None where these are all.
        start_s: When the first of all values was; None where these are all.
    """
    span = float(np.ptp(values)) if span is None else span
    start_s = float(times[0]) if start_s is None else start_s
    away = np.flatnonzero(np.abs(values - values[-1]) > FLAT_BAND * span)
    row = int(away[-1]) + 1 if len(away) else 0
    since_s = float(times[row + _last_step(values[row:])])
    return since_s if span == 0 or times[-1] - since_s >= 0.1 * (times[-1] - start_s) else None


def find_step(times: Array, values: Array) -> Step | None:
    """The step that parts the values in two, with nothing between for half of their range."""
    row = _step_row(values)
    if not row:
        return None
    return Step(float(times[row]), float(values[row - 1]), float(values[row]))


def _last_step(rest: Array) -> int:
    """The row in which it goes over to another rest, which has no value of the one before; or 0."""
    row = _step_row(rest)
    return row + _last_step(rest[row:]) if row else 0


def _step_row(values: Array) -> int:
    if len(values) < 2 * LEAST_RESTING or np.ptp(values) == 0:
        return 0
    row = int(np.abs(np.diff(values)).argmax()) + 1
    before, after = values[:row], values[row:]
    apart = max(after.min() - before.max(), before.min() - after.max())
    if min(len(before), len(after)) < LEAST_RESTING or apart < STEP_SHARE * np.ptp(values):
        return 0
    return row


def time_effect(times: Array, values: Array, mean: float, squares: float) -> float:
    """The share of the variance that lies between eight equal stretches of time, 0 to 1.

    The correlation ratio eta squared (R. A. Fisher, Statistical Methods for Research Workers,
    1925, section 44): near 0 for steady noise and for a swing that is short compared to the range,
    1 where all change is slow, whether it goes one way or comes back.
    """
    width_s = float(times[-1] - times[0]) / TIME_BINS
    if squares == 0 or width_s == 0:
        return 0.0
    borders: Array = times[0] + width_s * np.arange(TIME_BINS)
    parts = np.split(values, np.searchsorted(times, borders[1:]))
    between = sum(len(part) * (float(part.mean()) - mean) ** 2 for part in parts if len(part))
    return min(1.0, between / squares)


def is_monotonic(values: Array) -> bool:
    """Whether it never goes back; what neither rises nor falls is not meant."""
    steps = np.diff(values) * np.sign(values[-1] - values[0])
    return bool(values[0] != values[-1] and np.all(steps >= 0))


def leaps_in(angles: Array, turn: float) -> bool:
    """Whether it changed, the short way round, by more than a quarter turn from row to row."""
    steps = np.diff(angles)
    steps -= turn * np.rint(steps / turn)
    return bool(np.any(np.abs(steps) > turn / 4))


def unwrap(angles: Array, turn: float = math.tau) -> Array:
    """Angles without the jumps of a full turn, as if turns were counted.

    Each step is taken as the shorter way round (K. Itoh, Analysis of the phase unwrapping
    algorithm, Applied Optics 21, 1982).
    """
    turns = np.rint(np.diff(angles) / turn)
    return angles - turn * np.append(0.0, np.cumsum(turns)) if turns.any() else angles
