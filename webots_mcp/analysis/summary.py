"""What a stretch of one signal comes to: count, extremes, mean, slope, spikes, rests."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal, NamedTuple, TypeAlias

from webots_mcp.analysis.arrays import Array, Indexes, in_order, inner, np, weighted_mean

LARGEST: Final = 1e100  # beyond it (a stray infinity, a huge integer) squares would overflow
_GOES_ON: Final = 3.0  # times the steps around it: a step over the end of a scale is no longer
_MOSTLY_GOES_ON: Final = 0.9  # of such steps
_SLACK: Final = 1e-6  # of a turn
NO_LENGTH: Final = 1e-9  # of a resultant vector that means no direction
_LENGTH_DUST: Final = 1e-14  # what adding unit vectors leaves; less than 1.5e-7 rad
TIME_BINS: Final = 8
SPIKE_SCORE: Final = 8.0  # 3.5 is the usual; here thousands of values are looked at at once
MOST_SPIKES_SHARE: Final = 0.05  # of the values: more of them are how the signal is
FLAT_BAND: Final = 0.005  # of the range: what moves less is at rest
LEAST_RESTING: Final = 3  # rows
STEP_SHARE: Final = 0.5  # of all that it moves, between two rests
MOST_CHANCE: Final = 0.002  # of reporting any difference between repeated runs, over all figures
MIN_EFFECT_SD: Final = 1.0  # smallest relevant difference, in deviations of repeated runs
MOST_REPEATED: Final = 10  # runs of each group: who asks for more of them has no answer
_OUTSIDE: Final = 0.1  # how often an interval does not hold the difference
MIN_REPEATED: Final = (
    4  # runs of each group, to tell how much they differ and that no two clusters do
)
_DUST: Final = 1e-9  # of the largest figure: what differs by less differs by rounding
MOST_CHANCE_OF_BEST: Final = 0.01  # that a set is called better than the next one, and is not


class Summary(NamedTuple):
    """Counts of the values, and figures of the numbers, which are None where there are none.

    Sums are weighted by time, in such a way that the weights of all numbers add up to their count.

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

        Where the values count turns, it is that direction next to their arithmetic mean.

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
        low, high = self.min or 0.0, self.max or 0.0
        if high - low > turn or not -turn / 2 - _SLACK * turn <= low <= high <= turn * (1 + _SLACK):
            return near_turns(centre, turn, self.mean or 0.0)  # turns are counted
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
    times: Array,
    numbers: Array,
    *,
    rows: int | None = None,
    turn: float | None = None,
    weights: Array | None = None,
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
        weights: How much each number counts; None where all count alike.
    """
    present = len(numbers)
    if not present:
        return Summary(rows or 0)
    weights = _per_number(weights)
    mean = float(numbers.sum()) / present if weights is None else weighted_mean(numbers, weights)
    total = mean * present
    deviations = numbers - mean
    squares = deviations if weights is None else deviations * weights
    angles = numbers * (math.tau / turn) if turn else None
    ends = {"first": 0, "last": -1, "min": numbers.argmin(), "max": numbers.argmax()}
    figures = {name: float(numbers[at]) for name, at in ends.items()}
    figures |= {f"{name}_sim_time_s": float(times[at]) for name, at in ends.items()}
    return Summary(
        present if rows is None else rows,
        present,
        int(np.count_nonzero(np.diff(numbers))),
        sum=total,
        squares=inner(squares, deviations),
        sines=None if angles is None else _weighted_sum(np.sin(angles), weights),
        cosines=None if angles is None else _weighted_sum(np.cos(angles), weights),
        **figures,
    )


def _per_number(weights: Array | None) -> Array | None:
    """Weights that add up to the count of the numbers."""
    return None if weights is None else weights * (len(weights) / float(weights.sum()))


def _weighted_sum(values: Array, weights: Array | None) -> float:
    return float(values.sum()) if weights is None else inner(values, weights)


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
    if len(numbers) and numbers.min() >= -LARGEST and numbers.max() <= LARGEST:  # none is NaN
        return times, numbers
    usable = np.abs(numbers) <= LARGEST
    return times[usable], numbers[usable]


# -- what it does over time: slope, spikes, rest, slow change --------------------------------------
#
# Each function takes arrays: times that do not fall and as many values, all finite, at least one.


@dataclass(frozen=True)
class FittedLine:
    """The straight line of least squares; `r2` is the share of the variance it explains."""

    slope_per_s: float
    r2: float


@dataclass(frozen=True)
class Spike:
    """One value far from both of its neighbours."""

    sim_time_s: float
    value: float


@dataclass(frozen=True)
class LevelStep:
    """The one change from row to row that makes most of the range; the values around it."""

    sim_time_s: float
    before: float
    after: float


def fit_line(
    times: Array, values: Array, mean: float, weights: Array | None = None
) -> FittedLine | None:
    """Least squares: slope = S_tv / S_tt, r2 = S_tv**2 / (S_tt * S_vv), sums about the means.

    N. R. Draper, H. Smith, Applied Regression Analysis (3rd ed. 1998), sections 1.2, 1.3 and, for
    weights, 9.2. None where time stood still; r2 is 0 for a constant.
    """
    dt, dv = times - weighted_mean(times, weights), values - mean
    wt, wv = (dt, dv) if weights is None else (dt * weights, dv * weights)
    stt, stv, svv = inner(wt, dt), inner(wt, dv), inner(wv, dv)
    if stt == 0:
        return None
    return FittedLine(stv / stt, min(1.0, stv / stt * (stv / svv)) if svv > 0 else 0.0)


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
    # Where the largest one cannot stand out from half of them, their median need not be known.
    least = float(sizes.max()) * (0.6745 / SPIKE_SCORE) * (1 + 1e-9)
    if np.count_nonzero(sizes < least) <= len(sizes) // 2:
        return []
    mad = in_order(sizes, len(sizes) // 2)
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
    rested_s, lasted_s = times[-1] - since_s, times[-1] - start_s
    return since_s if span == 0 or rested_s >= 0.1 * lasted_s > 0 else None


def find_step(times: Array, values: Array) -> LevelStep | None:
    """The step that parts the values in two, with nothing between for half of their range."""
    row = _step_row(values)
    if not row:
        return None
    return LevelStep(float(times[row]), float(values[row - 1]), float(values[row]))


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


def time_effect(
    times: Array, values: Array, mean: float, squares: float, weights: Array | None = None
) -> float:
    """The share of the variance that lies between eight equal stretches of time, 0 to 1.

    The correlation ratio eta squared (R. A. Fisher, Statistical Methods for Research Workers,
    1925, section 44): near 0 for steady noise and for a swing that is short compared to the range,
    1 where all change is slow, whether it goes one way or comes back.
    """
    width_s = float(times[-1] - times[0]) / TIME_BINS
    if squares == 0 or width_s == 0:
        return 0.0
    borders: Array = times[0] + width_s * np.arange(TIME_BINS)
    cuts = np.searchsorted(times, borders[1:])
    parts = np.split(values, cuts)
    if weights is None:
        between = sum(len(part) * (float(part.mean()) - mean) ** 2 for part in parts if len(part))
        return min(1.0, between / squares)
    weights = weights * (len(weights) / float(weights.sum()))
    between = sum(
        float(of.sum()) * (weighted_mean(part, of) - mean) ** 2
        for part, of in zip(parts, np.split(weights, cuts), strict=True)
        if len(part)
    )
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


def may_wrap(low: float, high: float) -> float | None:
    """Return the turn of which values of this range may be angles: 2 pi, or 360; else None."""
    for turn in (math.tau, 360.0):
        slack = 1e-6 * turn
        for begin in (0.0, -turn / 2):
            if begin - slack <= low and high <= begin + turn + slack and high - low > turn / 2:
                return turn
    return None


def wraps(numbers: Array, turn: float) -> bool:
    """Return whether numbers within one turn behave as an angle that passes the end of its scale.

    Each step is less than a quarter turn, the short way round; some are a jump from one end of the
    scale to the other, and those go on, the short way round, as the steps next to them do. What
    switches between two values near the ends stands still next to its jumps, and is no angle.
    """
    steps = np.diff(numbers)
    turns = np.rint(steps / turn)
    short = steps - turn * turns
    jumps = np.flatnonzero(turns)
    if not len(jumps) or np.abs(short).max() > turn / 4:
        return False
    around = jumps[:, None] + np.array([-2, -1, 1, 2])
    around = np.minimum(np.maximum(around, 0), len(short) - 1)
    near = np.abs(short[around])
    near[around == jumps[:, None]] = 0.0  # at the ends
    goes_on = np.abs(short[jumps]) <= _GOES_ON * near.max(axis=1)
    return bool(np.count_nonzero(goes_on) >= _MOSTLY_GOES_ON * len(jumps))


def near_turns(angle: float, turn: float, at: float) -> float:
    """Return the same direction, as many whole turns away as brings it next to another angle."""
    return angle + turn * round((at - angle) / turn)


def unwrap(angles: Array, turn: float = math.tau) -> Array:
    """Angles without the jumps of a full turn, as if turns were counted.

    Each step is taken as the shorter way round (K. Itoh, Analysis of the phase unwrapping
    algorithm, Applied Optics 21, 1982). What is not finite stays as it is, and the step across it
    is one from the angle before it to the one after it.
    """
    turns = np.rint(np.diff(angles) / turn)
    if not turns.any():
        return angles
    counted = np.cumsum(turns)
    if math.isfinite(counted[-1]):
        return angles - turn * np.append(0.0, counted)
    known = np.isfinite(angles)
    course = np.array(angles)
    course[known] = unwrap(angles[known], turn)
    return course


# Whether groups of runs differ by more than like runs do.


class Spread(NamedTuple):
    """A figure of each run of a group, in the group: its median, and the least and the greatest."""

    median: float
    low: float
    high: float


def spread_of(figures: Sequence[float | None]) -> Spread | None:
    """None where the figure of any run is not known."""
    known = [figure for figure in figures if figure is not None]
    if not known or len(known) < len(figures):
        return None
    return Spread(statistics.median(known), min(known), max(known))


class Verdict(NamedTuple):
    """Whether a group differs from the first by more than like runs do.

    Attributes:
        different: None where that cannot be decided yet; False where a difference that matters is
            excluded.
        runs_wanted: So many runs of each would tell, if they went on like these; None where they
            need not, or where even 10 would not.
        interval: The difference from the mean of the first group lies in it nine times of ten;
            None where runs agree to the last digit and are too few to tell.
    """

    different: bool | None
    runs_wanted: int | None = None
    interval: tuple[float, float] | None = None


Chance: TypeAlias = Callable[[Sequence[float], Sequence[float]], "float | None"]


class _Apart(NamedTuple):
    """How far the means of two groups are apart, and how well that is known.

    Attributes:
        by: The other mean less the first.
        deviation: The standard deviation between like runs, pooled over both groups; 0 where they
            agree but for rounding.
        error: The standard error of `by`, from `deviation` or, in groups of unequal size, from that
            of each by itself if that is more: so a few runs of a code that scatters are not judged
            by the many of one that does not (B. L. Welch, The generalization of "Student's"
            problem, Biometrika 34, 1947). A single run is taken to scatter as the other group does.
        freedom: The degrees of freedom of `error`.
        split: How often runs that fall into two clusters by chance alone, whatever their figures,
            would be parted as these groups are: two of all ways to choose the runs of one group
            (R. A. Fisher, The Design of Experiments, 1935, section 21).
    """

    by: float
    deviation: float
    error: float
    freedom: float
    split: float


def _apart(first: Sequence[float], other: Sequence[float]) -> _Apart | None:
    """None for one run each: then it is unknown how much equal runs differ."""
    groups, free = (first, other), len(first) + len(other) - 2
    if free < 1 or not first or not other:
        return None
    means = [math.fsum(group) / len(group) for group in groups]
    pairs = zip(means, groups, strict=True)
    squares = [math.fsum((each - mean) ** 2 for each in group) for mean, group in pairs]
    dust = _DUST * max(map(abs, (*first, *other)))
    by, deviation = means[1] - means[0], math.sqrt(sum(squares) / free)
    by, deviation = (0.0 if abs(each) <= dust else each for each in (by, deviation))
    split = 2 / math.comb(free + 2, len(first))
    error = deviation * math.sqrt(1 / len(first) + 1 / len(other))
    if not deviation or len(first) == len(other) or min(map(len, groups)) < 2:
        return _Apart(by, deviation, error, free, split)
    errors = [of / (len(group) - 1) / len(group) for of, group in zip(squares, groups, strict=True)]
    parts = sum(of**2 / (len(group) - 1) for of, group in zip(errors, groups, strict=True))
    error = max(error, math.sqrt(sum(errors)))
    return _Apart(by, deviation, error, sum(errors) ** 2 / parts, split)


def chance_of(first: Sequence[float], other: Sequence[float]) -> float | None:
    """How often two groups of like runs would lie as far apart as these: Student's t test.

    Two-sided. 0 where like runs agree to the last digit and the groups do not. None for one run
    each: then it is unknown how much equal runs differ.
    """
    apart = _apart(first, other)
    if apart is None:
        return None
    return chance_beyond(abs(apart.by), apart.error**2, apart.freedom) if apart.by else 1.0


def chance_beyond(apart: float, variance: float, freedom: float) -> float:
    """How often chance alone makes a difference this large, of a known variance: Student's t.

    Args:
        apart: The difference, 0 or more.
        variance: That of such differences, as far as so many degrees of freedom tell it.
        freedom: 1 or more.
    """
    return _student_tail(apart / math.sqrt(variance), freedom) if variance > 0 else float(not apart)


def chance_of_counts(first: Sequence[float], other: Sequence[float]) -> float | None:
    """The same of counted events in stretches of one length.

    Neither chance alone makes such counts (the conditional test of two Poisson means, J.
    Przyborowski, H. Wilenski, Biometrika 31, 1940: of all events each falls on a group as often as
    the group has runs), nor the spread of like runs, which may be larger than that of chance.
    """
    chance = chance_of(first, other)
    if chance is None:
        return None
    share = len(first) / (len(first) + len(other))
    return max(chance, _chance_of_split(round(sum(first)), round(sum(other)), share))


def may_differ(groups: Sequence[Sequence[float]]) -> bool:
    """Whether any split of so many events on two groups would show that counts differ.

    A test whose least chance is above the limit adds nothing to the chance of a false claim (R. E.
    Tarone, A modified Bonferroni method for discrete data, Biometrics 46, 1990).
    """
    first = groups[0]
    for other in groups[1:]:
        events = round(sum(first) + sum(other))
        share = min(len(first), len(other)) / (len(first) + len(other))
        if _chance_of_split(events, 0, share) < MOST_CHANCE:
            return True
    return False


def _chance_of_split(first: int, other: int, share: float) -> float:
    """How often so many events fall as unevenly on two groups: twice the lesser binomial tail."""
    events = first + other
    fewer, part = (first, share) if first <= events * share else (other, 1 - share)
    ways = math.lgamma(events + 1) - math.lgamma(first + 1) - math.lgamma(other + 1)
    chance = math.exp(ways + first * math.log(share) + other * math.log(1 - share))
    tail = 0.0
    for count in range(fewer, -1, -1):  # each of fewer events is less likely than the one before
        tail += chance
        chance *= count / (events - count + 1) * (1 - part) / part
    return min(1.0, 2 * tail)


def verdicts_on(
    groups: Sequence[Sequence[float | None]],
    tests: int,
    chance: Chance = chance_of,
    tests_of_more: int = 0,
    min_effect_sd: float = MIN_EFFECT_SD,
) -> list[Verdict]:
    """Of each group whether it differs from the first by more than like runs do.

    True where like runs would lie as far apart too seldom, both as normal figures (`chance`) and as
    figures that fall into two clusters (`_Apart.split`); the latter takes at least 4 runs of each,
    and 7 where the runs of each group agree to the last digit. False where a difference that
    matters is excluded: two one-sided tests at 5 %, which is the same as an interval of 90 % within
    the margin (D. J. Schuirmann, A comparison of the two one-sided tests procedure, J.
    Pharmacokinetics and Biopharmaceutics 15, 1987). Of a figure whose unit is unknown, the one
    scale there is is how much like runs differ: the margin is `min_effect_sd` of their standard
    deviations, as far as these runs tell it. Where like runs agree to the last digit and the groups
    do as well, False takes as many runs as True would. The first is False; None where that cannot
    be decided, or a figure of any run is missing.

    Args:
        groups: A figure of each run of each group.
        tests: How many such questions are asked at once: the more, the surer True has to be.
        chance: How often like runs lie as far apart.
        tests_of_more: How many are asked once there are more runs, if not as many.
        min_effect_sd: The least difference that matters.
    """
    known = [[each for each in group if each is not None] for group in groups]
    if any(len(a) < len(b) for a, b in zip(known, groups, strict=True)):
        return [Verdict(None)] * len(groups)
    limits = [MOST_CHANCE / max(each, 1) for each in (tests, tests_of_more or tests)]
    others = (_verdict(known[0], other, limits, chance, min_effect_sd) for other in known[1:])
    return [Verdict(False), *others]


def _verdict(
    first: Sequence[float],
    other: Sequence[float],
    limits: Sequence[float],
    chance: Chance,
    min_effect_sd: float,
) -> Verdict:
    apart = _apart(first, other)
    if apart is None:
        return Verdict(None)
    within = apart.error * _student_quantile(apart.freedom)
    interval = (apart.by - within, apart.by + within) if apart.deviation else None
    different = _differs(first, other, limits[0], chance, min_effect_sd)
    if different is not None:  # runs that agree to the last digit know the difference exactly
        return Verdict(different, None, interval or (apart.by, apart.by))
    fewest = min(len(first), len(other)) + 1
    for runs in range(fewest, MOST_REPEATED + 1):
        more = _so_many(first, runs), _so_many(other, runs)
        if _differs(*more, limits[1], chance, min_effect_sd) is not None:
            return Verdict(None, runs, interval)
    return Verdict(None, None, interval)


def _differs(
    first: Sequence[float],
    other: Sequence[float],
    limit: float,
    chance: Chance,
    min_effect_sd: float,
) -> bool | None:
    apart, found = _apart(first, other), chance(first, other)
    if apart is None or found is None:
        return None
    is_repeated = min(len(first), len(other)) >= MIN_REPEATED
    is_repeated &= bool(apart.deviation) or apart.split < MOST_CHANCE
    if found < limit and is_repeated:
        return True
    if not apart.deviation:
        return False if is_repeated and not apart.by else None
    farthest = abs(apart.by) + apart.error * _student_quantile(apart.freedom)
    return False if farthest < min_effect_sd * apart.deviation else None


def _so_many(figures: Sequence[float], runs: int) -> list[float]:
    """Figures of at least so many runs, of which the further ones are as the first were."""
    return [figures[index % len(figures)] for index in range(max(runs, len(figures)))]


def _student_tail(t: float, freedom: float) -> float:
    """The chance of a greater |t|, for 1 degree of freedom or more.

    M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions (1964), 26.7.3 and 26.7.4;
    between two whole numbers of degrees, for which those are, its logarithm is almost straight.
    """
    part = freedom % 1 if freedom > 1 else 0.0  # rounding leaves a little less
    if part:
        few, more = (_student_tail(t, freedom - part + each) for each in (0, 1))
        return few ** (1 - part) * more**part
    freedom = max(1, int(freedom))
    angle = math.atan(t / math.sqrt(freedom))
    sine, square = math.sin(angle), math.cos(angle) ** 2
    odd = freedom % 2
    term = math.cos(angle) if odd else 1.0
    total = term if freedom > 1 else 0.0
    for power in range(2 + odd, freedom, 2):
        term *= square * (power - 1) / power
        total += term
    inside = 2 / math.pi * (angle + sine * total) if odd else sine * total
    return max(0.0, 1 - inside)


@lru_cache(1000)
def _student_quantile(freedom: float) -> float:
    """The |t| that chance exceeds in one case of ten."""
    low, high = 0.0, 10.0  # of one degree of freedom it is 6.3
    while high - low > 1e-9:
        middle = (low + high) / 2
        low, high = (middle, high) if _student_tail(middle, freedom) > _OUTSIDE else (low, middle)
    return high


# -- which parameters did best, and whether by more than repeats of the same ones differ -----------


Best = Literal["highest", "lowest"]


class Outcome(NamedTuple):
    """What became of a trial: a score, or why there is none; one that was pruned has not failed."""

    parameters: dict[str, Any]
    score: float | None
    failure: str | None = None
    pruned: bool = False


class ScoreSpread(NamedTuple):
    """Of the trials of a set: by the mean they are ranked and compared."""

    mean: float
    low: float
    high: float


class Ranked(NamedTuple):
    """A parameter set and its trials.

    Attributes:
        score: Mean, least and greatest of those that gave one; None if none did.
        scores: Of each of them.
        failures: Why others gave none.
        pruned: How many were ended early because they were not worth going on with.
    """

    parameters: dict[str, Any]
    score: ScoreSpread | None
    scores: list[float]
    failures: list[str]
    pruned: int = 0

    @property
    def is_whole(self) -> bool:
        """Whether every trial gave a score."""
        return not self.failures and not self.pruned


class Noise(NamedTuple):
    """How much the scores of repeats differ.

    Attributes:
        deviation: The standard deviation, pooled over all sets.
        freedom: The degrees of freedom that it rests on; 0 where nothing was repeated.
    """

    deviation: float
    freedom: int


class Ranking(NamedTuple):
    """Parameter sets, the best first; those of which every trial gave a score come first.

    Attributes:
        better: True where the best beats the next by more than its trials and those of the next
            differ; None where they do not show it.
        chance: How often that alone would set the two as far apart; None where it is not known.
        verdict: The same as a sentence.
    """

    sets: list[Ranked]
    noise: Noise
    better: Literal[True] | None
    chance: float | None
    verdict: str


def rank(outcomes: Sequence[Outcome], best: Best = "highest") -> Ranking:
    """Rank the parameter sets of finished trials."""
    sets = sorted(_grouped(outcomes), key=lambda each: _place(each, best))
    chance = _chance(sets)
    better = True if chance is not None and chance < MOST_CHANCE_OF_BEST else None
    return Ranking(sets, _noise(sets), better, chance, _in_words(sets, chance))


def _grouped(outcomes: Sequence[Outcome]) -> list[Ranked]:
    groups: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(repr(sorted(outcome.parameters.items())), []).append(outcome)
    return [_ranked(group) for group in groups.values()]


def _ranked(group: Sequence[Outcome]) -> Ranked:
    scores = [each.score for each in group if each.score is not None]
    failures = [e.failure or "no score" for e in group if e.score is None and not e.pruned]
    pruned = sum(each.pruned for each in group)
    score = ScoreSpread(statistics.fmean(scores), min(scores), max(scores)) if scores else None
    return Ranked(group[0].parameters, score, scores, failures, pruned)


def _place(ranked: Ranked, best: Best) -> tuple[bool, bool, float]:
    if ranked.score is None:
        return True, True, 0.0
    mean = ranked.score.mean
    return False, not ranked.is_whole, -mean if best == "highest" else mean


def _noise(sets: Sequence[Ranked]) -> Noise:
    freedom = sum(len(each.scores) - 1 for each in sets if each.scores)
    squares = sum(statistics.pvariance(e.scores) * len(e.scores) for e in sets if e.scores)
    return Noise(math.sqrt(squares / freedom) if freedom else 0.0, freedom)


def _chance(sets: Sequence[Ranked]) -> float | None:
    """Of the best and the next; where one is not whole, they are not compared by their scores.

    That they are the best of many makes a false claim no likelier: of more sets that are alike, the
    first two lie nearer to each other.

    How much like trials differ has to be known of each of the two, from its own repeats (B. L.
    Welch, The generalization of "Student's" problem, Biometrika 34, 1947). However close those are
    to each other, they may be so by chance, as where half of all trials fall over and score less.
    """
    if len(sets) < 2 or not sets[1].is_whole:
        return None
    groups = [each.scores for each in sets[:2]]
    if min(map(len, groups)) < 2:
        return None
    first, other = groups
    apart = abs(statistics.fmean(first) - statistics.fmean(other))
    if math.isclose(apart, 0, abs_tol=1e-9 * max(map(abs, (*first, *other)))):
        return 1.0
    parted = _chance_of_parting(len(first) + len(other))
    errors = [statistics.variance(each) / len(each) for each in groups]
    if not any(errors):
        return parted
    parts = sum(e**2 / (len(g) - 1) for e, g in zip(errors, groups, strict=True))
    return max(parted, chance_beyond(apart, sum(errors), sum(errors) ** 2 / parts))


def _chance_of_parting(trials: int) -> float:
    """How often, of two outcomes that are as likely, the one set has all of one and the other not.

    More trials of one set than of the other make it no likelier.
    """
    return 0.5 ** (trials - 1)


def _in_words(sets: Sequence[Ranked], chance: float | None) -> str:
    scores = [score for each in sets for score in each.scores]
    if not scores:
        return "no trial has a score"
    if len(sets) == 1:
        return "one parameter set: there is nothing to compare it with"
    if not sets[1].is_whole:
        which = "every other" if sets[0].is_whole else "every"
        failed = ["had failures"] if any(each.failures for each in sets) else []
        pruned = ["was pruned"] if any(each.pruned for each in sets) else []
        return f"{which} parameter set {' or '.join(failed + pruned)}"
    if min(scores) == max(scores):
        return f"all {len(scores)} scores are {scores[0]:g}: no tried value changed the score"
    if chance is None:
        return "the best and second best were not both repeated: their spread is unknown"
    if chance < MOST_CHANCE_OF_BEST:
        return "the best is ahead of the second best by more than the spread of repeats"
    trials = sum(len(each.scores) for each in sets[:2])
    if chance == _chance_of_parting(trials):
        wanted = next(n for n in range(2, 100) if _chance_of_parting(2 * n) < MOST_CHANCE_OF_BEST)
        return (
            "the best is clearly ahead of the second best, but with so few repeats that may be "
            f"chance: repeat each {wanted} times"
        )
    return "the best and second best differ by no more than repeats may: repeat more"
