"""`trends`: what each signal did over a range, what changed most first."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final, Literal

from webots_mcp.analysis.arrays import Array, Indexes, np, weighted_mean
from webots_mcp.analysis.oscillations import (
    LEAST_HALF_SWINGS,
    SHORTEST_PERIOD_ROWS,
    Swing,
    find_swings,
)
from webots_mcp.analysis.summary import (
    FLAT_BAND,
    LARGEST,
    FittedLine,
    LevelStep,
    Spike,
    Summary,
    find_spikes,
    find_step,
    fit_line,
    flat_since,
    is_monotonic,
    leaps_in,
    summarise_numbers,
    time_effect,
    unwrap,
    with_extremes,
    with_extremes_of,
)
from webots_mcp.signals.naming import words_of
from webots_mcp.store import chunk_making
from webots_mcp.store.reading import frame_summary
from webots_mcp.store.reading.catalogue import signals_of
from webots_mcp.store.reading.frame import Frame, ZoneMap, read_frame, read_kept
from webots_mcp.store.reading.frame_summary import (
    ChangePoints,
    as_angle,
    change_points,
    reads_values,
    summary_of,
    weighted_sums,
)
from webots_mcp.store.reading.ranges import TimeRange, recorded_bounds
from webots_mcp.store.reading.segment import (
    QUESTION_DEADLINE_S,
    Deadline,
    Segment,
    in_one_snapshot,
    shown_time,
)
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.signal_history import STATES_SHARE, TURNS_COUNTED, WEIGHTED, signals_left

# -- one numeric signal: its trend, and what a person would notice ---------------------------------


SMOOTH_SHARE: Final = 0.2  # of its range, from one value to the next
NET_SHARE: Final = 0.9  # of its range: what ends so far from where it began rose or fell
STRAIGHT_R2: Final = 0.8  # a line that explains less is not how a person would describe it
TOLD_MISSING_SHARE: Final = 0.001
SLOW_SHARE: Final = 0.5  # of the variance must be left in means for their course to be the values'
SWINGING_SHARE: Final = 0.6  # of the range: what swung for less did something else as well
WIDE_SHARE: Final = 0.3  # of the range of values: who swings by less swings about a moving place
TOLD_BEYOND_ENDS: Final = 0.05  # of the range: extremes nearer to the ends are as good as them
# Words of a clock or a counter, and how straight its course is, also in means of a tenth of it.
_CLOCKS: Final = frozenset((
    "time", "clock", "timestamp", "stamp", "elapsed", "t", "seconds", "step", "steps", "tick",
    "ticks", "frame", "frames", "iteration", "iterations",
))  # fmt: skip
_CLOCK_R2: Final = 0.99
_DUST: Final = 1e-12  # of a value: what adding leaves of it

Shape = Literal["constant", "rising", "falling", "oscillating", "resting", "varying"]
Monotonic = Literal["rising", "falling"]
TOO_LARGE: Final = "its numbers are beyond 1e100"


@dataclass(frozen=True)
class Trend:
    """A numeric signal over a range.

    Attributes:
        summary: Count, first, last, extremes with their times, mean, deviation. Where the turns of
            an angle are counted, its extremes are those of the unwrapped angle too.
        mean: Of an angle the circular mean. What is less than a few millionths of the range is
            rounded away: it comes from adding.
        deviation: Standard deviation; of an angle that of the unwrapped angle, or the circular one
            where turns cannot be counted, next to extremes as they were recorded.
        turned: How far an angle turned, positive as it grows, turns counted; else None.
        leaps: An angle that changed by more than a quarter turn from row to row, as the bearing to
            the nearest of several things does: its turns cannot be counted.
        is_angle_by_values: Only its values show that it is an angle: they jump by a full turn.
        is_turned: Its figures count turns and differ from the recorded values by whole turns.
        monotonic: "rising", "falling" (never the other way, and not constant), or None.
        fast: It varies so fast that the means of chunks do not show its course.
        resolution_s: Length of the means in which swings were seen; None where rows were.
        rest_s: Since when its values rest; None if they do not.
        spikes: Values that stand out from both neighbours; None where rows were not looked at.
        step: The one change that makes most of its range; None where rows were not looked at, and
            of an angle.
        missing: Of the rows, those without a value; of many rows also those with one beyond 1e100.
        too_large: Of the rows, those with a number beyond 1e100; None where rows were not read.
        change: How much it changed with time, 0 to 2: the share of its variance that is slow
            (`time_effect`) times its range in units of its largest magnitude. Free of units.
        course: How it went: where it swung is looked for when it is asked for.
    """

    name: str
    kind: str
    unit: str | None
    summary: Summary
    mean: float | None
    deviation: float | None
    turned: float | None
    leaps: bool
    is_angle_by_values: bool
    is_turned: bool
    slope_per_s: float | None
    r2: float | None
    monotonic: Monotonic | None
    fast: bool
    resolution_s: float | None
    rest_s: float | None
    spikes: tuple[Spike, ...] | None
    step: LevelStep | None
    missing: int
    too_large: int | None
    change: float
    course: Course = field(repr=False, compare=False)

    @cached_property
    def swings(self) -> tuple[Swing, ...]:
        """Where it moved to and fro, as `find_events` reports it, but of any period."""
        if self.fast or self.monotonic:
            return ()
        course = self.course
        found = _swings(course.times, course.numbers, course.resolution_s)
        if course.resolution_s is not None:
            return found
        times, numbers, spikes = course.times, course.numbers, self.spikes or ()
        return tuple(_within_range(each, times, numbers, spikes) for each in found)

    @cached_property
    def flat_since_s(self) -> float | None:
        """Since when it rests; None if it does not, or still oscillates, however little."""
        rest_s = self.rest_s
        if rest_s is None or any(each.end_s - rest_s > each.period_s for each in self.swings):
            return None
        return rest_s

    @cached_property
    def shape(self) -> Shape:
        """Its course as a whole, in a word."""
        return "constant" if self.is_constant else _shape(self)

    @cached_property
    def says(self) -> str:
        """What a person would notice."""
        return "; ".join(_remarks(self))

    @cached_property
    def is_constant(self) -> bool:
        """Whether it never changed."""
        return _is_constant(self.summary)

    @property
    def is_lacking(self) -> bool:
        """Whether so many rows have no value that it is reported."""
        return self.missing > TOLD_MISSING_SHARE * self.summary.rows

    @property
    def is_clock(self) -> bool:
        """Whether it rises with simulation time and its name says so: it has no news.

        A straight rise alone is not enough: a robot at constant speed has one too.
        """
        is_straight = self.monotonic == "rising" and (self.r2 or 0.0) >= _CLOCK_R2
        return is_straight and not _CLOCKS.isdisjoint(words_of(self.name.rpartition(".")[2]))


@dataclass(frozen=True)
class Course:
    """How a signal went.

    Attributes:
        times: In s.
        numbers: The values, of an angle with turns counted; or the means of many of them.
        inner: What these come to.
        counted: What the values of an angle come to whose turns are counted; else None.
        leaps: An angle whose turns cannot be counted.
        monotonic: Whether the values go one way; of chunks as far as their ends and extremes tell.
        rest_s: Since when the values rest; None if they do not.
        inner_variance: That of the values within what the means are of. Where more of it lies there
            than between them, the course of the means is not that of the values.
        resolution_s: The usual length of what the means are of; None where the numbers are values.
        weights: How much of the time each number stands for; None where all count alike.
    """

    times: Array
    numbers: Array
    inner: Summary
    counted: Summary | None = None
    leaps: bool = False
    monotonic: Monotonic | None = None
    rest_s: float | None = None
    inner_variance: float = 0.0
    resolution_s: float | None = None
    weights: Array | None = None


def course_of_values(
    times: Array,
    recorded: Array,
    turn: float | None,
    summary: Summary,
    weights: Array | None = None,
) -> Course:
    """The course of a signal of which every value is looked at.

    Args:
        times: In s, one at least.
        recorded: The usable values.
        turn: A whole turn of an angle, in its unit; None of what is none.
        summary: What the values come to.
        weights: How much of the time each value stands for; None where all count alike.
    """
    leaps = turn is not None and leaps_in(recorded, turn)
    numbers = recorded if turn is None or leaps else unwrap(recorded, turn)
    counted = None if turn is None or leaps else summarise_numbers(times, numbers, weights=weights)
    monotonic, rest_s = _monotonic(numbers), flat_since(times, numbers)
    return Course(
        times, numbers, counted or summary, counted, leaps, monotonic, rest_s, weights=weights
    )


def in_means(course: Course, rows: int) -> Course:
    """A course in the means of so many values each, for what takes long to find in all of them."""
    starts = np.arange(0, len(course.times), rows)
    counts = np.diff(starts, append=len(course.times))
    of_rows = course.weights
    weights = counts if of_rows is None else np.add.reduceat(of_rows, starts)

    def means_of(values: Array) -> Array:
        sums = np.add.reduceat(values if of_rows is None else values * of_rows, starts)
        return np.asarray(sums / weights, np.float64)

    means, times = means_of(course.numbers), means_of(course.times)
    off = course.numbers - np.repeat(means, counts)
    return replace(
        course,
        times=times,
        numbers=means,
        inner=summarise_numbers(times, means, weights=weights),
        inner_variance=weighted_mean(off * off, of_rows),
        weights=weights,
        resolution_s=_digits(np.median(np.diff(times))) if len(times) > 1 else None,
    )


def course_of_means(frame: Frame, name: str, zones: ZoneMap) -> Course:
    """The course of a signal with numbers, of many rows, from what its chunks come to."""
    held = np.flatnonzero(~np.isnan(zones.sum))
    weights, sums, squares = (each[held] for each in weighted_sums(frame, name, zones))
    counts, means = zones.value_count[held], sums / weights
    variances = np.where(
        zones.min[held] < zones.max[held],
        squares / weights * (counts / np.maximum(1, counts - 1)),
        0.0,
    )
    starts = zones.start_s[held]
    lengths = np.diff(starts) if len(held) > 1 else zones.end_s[held] - starts
    times = (starts + zones.end_s[held]) / 2
    return Course(
        times,
        means,
        summarise_numbers(times, means, weights=weights),
        monotonic=_monotonic_chunks(zones, held),
        rest_s=_rest_of_chunks(frame, name, zones, held),
        inner_variance=weighted_mean(variances, weights),
        resolution_s=_digits(np.median(lengths)),
        weights=weights,
    )


def _digits(length_s: Any) -> float:
    return float(f"{float(length_s):.3g}")


def _rest_of_chunks(frame: Frame, name: str, zones: ZoneMap, held: Indexes) -> float | None:
    """Since when all values stay within 0.5 % of their range, as `flat_since` says it."""
    low, high = float(zones.min[held].min()), float(zones.max[held].max())
    if low == high:
        return float(frame.rows(0, int(zones.row_count[: held[0] + 1].sum())).usable(name)[0][0])
    last = float(zones.last[held[-1]])
    farthest = np.maximum(zones.max[held] - last, last - zones.min[held])
    away = np.flatnonzero(farthest > FLAT_BAND * (high - low))
    first = int(zones.first_row[held[away[-1] if len(away) else 0]])
    times, values = frame.rows(first, len(frame)).usable(name)
    return flat_since(times, values, span=high - low, start_s=float(zones.start_s[held[0]]))


def _monotonic_chunks(zones: ZoneMap, held: Indexes) -> Monotonic | None:
    """As far as the ends and extremes of the chunks tell, taken in the one order or the other."""
    low, high = zones.min[held], zones.max[held]
    orders = ((low, high), (high, low))
    ends = [np.stack((zones.first[held], *each, zones.last[held]), 1).ravel() for each in orders]
    return _monotonic(ends[0]) or _monotonic(ends[1])


def judge(
    signal: RegisteredSignal,
    summary: Summary,
    course: Course,
    spikes: list[Spike] | None = None,
    too_large: int | None = None,
) -> Trend:
    """Combine the summary with the course of the numbers.

    Args:
        signal: Whose trend.
        summary: Of the whole range.
        course: How it went.
        spikes: None where not every value was looked at.
        too_large: How many of the values are beyond 1e100; None where that is not known.
    """
    times, numbers, inner = course.times, course.numbers, course.inner
    turn = signal.turn if summary.sines is not None else None
    slow = _slow_share(inner, course.inner_variance)
    fast = slow < SLOW_SHARE or course.leaps
    line = (
        None
        if course.leaps
        else _of_all(fit_line(times, numbers, inner.mean or 0.0, course.weights), slow)
    )
    monotonic, rest_s = (None, None) if fast else (course.monotonic, course.rest_s)
    counted = None if fast else course.counted
    recorded = summary
    deviation = summary.deviation_in(turn) if counted is None else counted.deviation_in(None)
    if counted is not None:
        summary = with_extremes_of(summary, counted)._replace(
            first=counted.first, last=counted.last, sum=counted.sum, squares=counted.squares
        )
    mean = summary.mean if turn is None else summary.centre(turn)
    return Trend(
        name=signal.name,
        kind=signal.kind,
        unit=signal.unit,
        summary=summary,
        mean=_rounded(mean, inner),
        deviation=deviation,
        turned=None if counted is None else (counted.last or 0.0) - (counted.first or 0.0),
        leaps=course.leaps,
        is_angle_by_values=signal.wraps_at is not None,
        is_turned=counted is not None and _counts_turns(recorded, course),
        slope_per_s=line.slope_per_s if line else None,
        r2=line.r2 if line else None,
        monotonic=monotonic,
        fast=fast,
        resolution_s=course.resolution_s,
        rest_s=rest_s,
        spikes=None if spikes is None else tuple(spikes),
        step=None if spikes is None or turn is not None else find_step(times, numbers),
        missing=summary.rows - summary.present - (too_large or 0),
        too_large=too_large,
        change=time_effect(times, numbers, inner.mean or 0.0, inner.squares or 0.0, course.weights)
        * slow
        * _relative_range(summary),
        course=course,
    )


def _counts_turns(recorded: Summary, course: Course) -> bool:
    """Whether an angle went over the end of its scale, so that counting its turns shifts values."""
    counted = course.counted
    return counted is not None and (counted.min, counted.max) != (recorded.min, recorded.max)


def _slow_share(means: Summary, inner_variance: float) -> float:
    """The share of the variance that lies between the means."""
    if inner_variance == 0:
        return 1.0
    between = (means.squares or 0.0) / means.present
    return between / (between + inner_variance)


def _of_all(line: FittedLine | None, slow: float) -> FittedLine | None:
    """Of the variance of all values, the line through their means explains so much less."""
    return line and replace(line, r2=line.r2 * slow)


def _swings(times: Array, course: Array, resolution_s: float | None) -> tuple[Swing, ...]:
    """Of any period of which six half swings fit in; means show less of a swing than it is high."""
    longest_s = 2 * float(times[-1] - times[0]) / LEAST_HALF_SWINGS
    found = find_swings(
        times, course, least_half_swings=LEAST_HALF_SWINGS, longest_period_s=longest_s
    )
    if resolution_s is None:
        return tuple(found)
    return tuple(
        replace(swing, amplitude=swing.amplitude / float(np.sinc(resolution_s / swing.period_s)))
        for swing in found
    )


def _within_range(swing: Swing, times: Array, numbers: Array, spikes: Sequence[Spike]) -> Swing:
    """A swing no larger than half of the range of its values: a fitted sine may reach farther."""
    there = (times >= swing.start_s) & (times <= swing.end_s)
    there &= ~np.isin(times, [spike.sim_time_s for spike in spikes])
    if not there.any():
        return swing
    return replace(swing, amplitude=min(swing.amplitude, float(np.ptp(numbers[there])) / 2))


def _rounded(mean: float | None, inner: Summary) -> float | None:
    """A mean to a few millionths of the range: about -1.48e-17 is about 0."""
    span = (inner.max or 0.0) - (inner.min or 0.0)
    if mean is None or span <= 0:
        return mean
    return round(mean, 5 - math.floor(math.log10(span)))


def _monotonic(values: Array) -> Monotonic | None:
    if not is_monotonic(values):
        return None
    return "rising" if values[-1] > values[0] else "falling"


def _shape(trend: Trend) -> Shape:
    """Of one that changed."""
    whole_s = float(trend.course.times[-1] - trend.course.times[0])
    wide = [each for each in trend.swings if _is_wide(each, trend.summary)]
    if wide and sum(each.end_s - each.start_s for each in wide) >= SWINGING_SHARE * whole_s:
        return "oscillating"
    if trend.monotonic is not None:
        return trend.monotonic
    if trend.slope_per_s is not None and (trend.r2 or 0.0) >= STRAIGHT_R2:
        return "rising" if trend.slope_per_s > 0 else "falling"
    summary = trend.summary
    net = (summary.last or 0.0) - (summary.first or 0.0)
    if abs(net) >= NET_SHARE * _range(summary) and _is_smooth(trend):
        return "rising" if net > 0 else "falling"
    return "resting" if trend.flat_since_s is not None else "varying"


def _is_smooth(trend: Trend) -> bool:
    """Whether no value is far from the one before: a step or noise has no course."""
    steps = np.abs(np.diff(trend.course.numbers))
    return len(steps) > 0 and float(steps.max()) <= SMOOTH_SHARE * _range(trend.summary)


def _range(summary: Summary) -> float:
    return (summary.max or 0.0) - (summary.min or 0.0)


def _is_wide(swing: Swing, summary: Summary) -> bool:
    """Whether the swing makes the range, rather than a slow course on which it rides."""
    return 2 * swing.amplitude >= WIDE_SHARE * ((summary.max or 0.0) - (summary.min or 0.0))


def _is_constant(summary: Summary) -> bool:
    """Whether it never changed but for what adding leaves: 6.000000000000005 is 6."""
    low, high = summary.min or 0.0, summary.max or 0.0
    is_whole = low.is_integer() and high.is_integer()  # adding leaves nothing of a large counter
    return high - low <= (0.0 if is_whole else _DUST * max(abs(low), abs(high)))


def _relative_range(summary: Summary) -> float:
    assert summary.min is not None and summary.max is not None
    largest = max(abs(summary.min), abs(summary.max))
    return (summary.max - summary.min) / largest if largest else 0.0


def _remarks(trend: Trend) -> Iterator[str]:
    summary, unit = trend.summary, f" {trend.unit}" if trend.unit else ""
    yield _course(trend, unit)
    if trend.leaps:
        yield "changes by more than a quarter turn between rows: turns are not counted"
    elif trend.fast:
        yield f"varies within {trend.resolution_s:g} s: ask for a shorter range"
    if trend.is_angle_by_values:
        yield "taken for an angle, as it jumps by a full turn"
    yield from _beyond_ends(trend)
    if trend.swings and not any(_is_wide(each, summary) for each in trend.swings):
        yield f"also {_swinging(trend, unit)}"
    if trend.flat_since_s is not None and trend.shape != "constant" and summary.changes != 1:
        value, since_s = _in_digits(summary.last, summary), trend.flat_since_s
        yield f"reaches {value} at {since_s:.6g} s, then flat"
    if trend.spikes:
        largest = max(trend.spikes, key=lambda spike: abs(spike.value - (trend.mean or 0.0)))
        yield (
            f"{len(trend.spikes)} spike{'s' if len(trend.spikes) > 1 else ''}, the largest "
            f"{largest.value:.4g} at {largest.sim_time_s:.6g} s"
        )
    if trend.too_large:
        yield f"beyond {LARGEST:g} in {trend.too_large} of {summary.rows} rows"
    if trend.is_lacking:
        usable = "usable " if trend.too_large is None else ""  # chunks do not tell the two apart
        yield (
            f"no {usable}value in {trend.missing} of {summary.rows} rows, the last value at "
            f"{summary.last_sim_time_s:.6g} s"
        )


def _course(trend: Trend, unit: str) -> str:
    summary = trend.summary
    if trend.shape == "constant":
        return f"constant at {summary.last or 0.0:.4g}{unit}"
    if any(_is_wide(each, summary) for each in trend.swings):
        return _swinging(trend, unit)
    if trend.step is not None:
        before, after = (
            _in_digits(value, summary) for value in (trend.step.before, trend.step.after)
        )
        return f"steps from {before} to {after}{unit} at {trend.step.sim_time_s:.6g} s"
    if trend.shape in ("rising", "falling"):
        slope = f" ({_mean_rate(trend):.3g}{unit}/s)" if _is_straight(trend) else ""
        if trend.turned is not None:
            return f"turns by {trend.turned:.3g}{unit}{slope}"
        verb = "rises" if trend.shape == "rising" else "falls"
        first, last = _in_digits(summary.first, summary), _in_digits(summary.last, summary)
        if summary.changes == 1:
            extreme_s = (summary.min_sim_time_s, summary.max_sim_time_s)[trend.shape == "rising"]
            return f"steps from {first} to {last}{unit} at {extreme_s:.6g} s"
        return f"{verb} from {first} to {last}{unit}{slope}"
    low = _extreme(trend, summary.min, summary.min_sim_time_s, "")
    return f"between {low} and {_extreme(trend, summary.max, summary.max_sim_time_s, unit)}"


def _extreme(trend: Trend, value: float | None, at_s: float | None, unit: str) -> str:
    """Return an extreme with its time.

    One in the flat end, where it differs from the last value by noise at most, has no time: since
    when the signal is flat is said besides.
    """
    text = f"{_in_digits(value, trend.summary)}{unit}"
    flat_s = trend.flat_since_s
    is_end = text == f"{_in_digits(trend.summary.last, trend.summary)}{unit}"
    if at_s is None or (flat_s is not None and at_s >= flat_s and is_end):
        return text
    return f"{text} (at {at_s:.6g} s)"


def _mean_rate(trend: Trend) -> float:
    """From the first value to the last, which are next to it in the sentence."""
    summary = trend.summary
    change = (summary.last or 0.0) - (summary.first or 0.0)
    lasts_s = (summary.last_sim_time_s or 0.0) - (summary.first_sim_time_s or 0.0)
    return (change if trend.turned is None else trend.turned) / lasts_s


def _is_straight(trend: Trend) -> bool:
    """Whether a slope describes its course: a step or an accelerating growth has none."""
    return trend.slope_per_s is not None and (trend.r2 or 0.0) >= STRAIGHT_R2


def _beyond_ends(trend: Trend) -> Iterator[str]:
    """The extremes of what rises or falls that are not its ends: it went the other way in between.

    They are reported where the spikes do not show them.
    """
    summary = trend.summary
    if trend.shape not in ("rising", "falling") or trend.turned is not None or trend.spikes:
        return
    ends = (summary.first or 0.0, summary.last or 0.0)
    span = TOLD_BEYOND_ENDS * ((summary.max or 0.0) - (summary.min or 0.0))
    if summary.min is not None and min(ends) - summary.min > span:
        yield f"min {_in_digits(summary.min, summary)} at {summary.min_sim_time_s:.6g} s"
    if summary.max is not None and summary.max - max(ends) > span:
        yield f"max {_in_digits(summary.max, summary)} at {summary.max_sim_time_s:.6g} s"


def _in_digits(value: float | None, summary: Summary) -> str:
    """A value with four digits, or so many that the range is shown with two.

    0 where it is only a rounding error compared to the extremes.
    """
    largest = max(abs(summary.min or 0.0), abs(summary.max or 0.0))
    if value is None or abs(value) <= _DUST * largest:
        return "0"
    share = _relative_range(summary)
    digits = max(4, 2 - math.floor(math.log10(share))) if share else 4
    return f"{value:.{min(digits, 17)}g}"


def _swinging(trend: Trend, unit: str) -> str:
    """Of several stretches the longest."""
    swing = max(trend.swings, key=lambda each: each.end_s - each.start_s)
    seen = f" (seen in means of {trend.resolution_s:g} s)" if trend.resolution_s else ""
    how = f"amplitude {swing.amplitude:.3g}{unit}, period {swing.period_s:.3g} s{seen}"
    if trend.shape == "oscillating":
        return f"oscillates about {trend.mean or 0.0:.4g}: {how}"
    others = f" (longest of {len(trend.swings)})" if trend.swings[1:] else ""
    stretch = f"from {shown_time(swing.start_s):g} to {shown_time(swing.end_s):g} s"
    return f"oscillated {stretch}{others}: {how}"


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
    shown: int | None = None,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> Trends:
    """What each signal did over a range.

    Args:
        connection: Any.
        time_range: From `find_range`.
        names: Signals, with `*`.
        limit: The most numeric signals to return per run: those that changed most.
        shown: Of those that changed, so many are described before the deadline; None for all.
        deadline_s: After it, what was read so far is the answer, and says so.

    Raises:
        UnknownSignalError: A name meets nothing.
    """
    signals = signals_of(connection, time_range, names)
    deadline = Deadline(deadline_s)
    runs = [
        _run_trends(connection, segment, signals, limit, shown, deadline)
        for segment in time_range.segments
    ]
    notes = [_unseen_swings(run) for run in runs if run.resolution_s is not None]
    notes += [f"run {run.run_id}: {each}" for run in runs for each in run.unread]
    notes += [WEIGHTED] if any(run.numbers for run in runs) else []
    if any(trend.is_turned for run in runs for trend in run.numbers):
        notes.append(TURNS_COUNTED)
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
    signals: Sequence[RegisteredSignal],
    limit: int,
    shown: int | None,
    deadline: Deadline,
) -> RunTrends:
    """The trends of signals in one run."""
    numbers = [signal for signal in signals if signal.is_number and not signal.is_choice]
    states = [signal for signal in signals if not signal.is_number or signal.is_choice]
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
    left = [each.name for each in numbers[len(found) :]] + _undescribed(held, shown, deadline)
    held = [trend for trend in held if trend.name not in left]
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
        unread=(*map(str, frame.unread), *signals_left(left)),
    )


def _undescribed(held: Sequence[Trend], shown: int | None, deadline: Deadline) -> list[str]:
    """Describe those that are shown; return the names of those for which there was no time."""
    changed = [trend for trend in held if not trend.is_constant or trend.is_lacking][:shown]
    for at, trend in enumerate(changed):
        if deadline.passed and at:
            return [each.name for each in changed[at:]]
        _ = trend.says
    return []


def _without_value(frame: Frame, found: Mapping[str, Trend | None]) -> Iterator[str]:
    """Those without a usable number, as far as the range was read."""
    for name in (name for name, trend in found.items() if trend is None):
        if (np.abs(frame.numbers(name)) > LARGEST).any():
            yield f"{name} ({TOO_LARGE})"
        elif frame.cut_at_s is None and frame.was_read(name).any():
            yield name


def _trend(frame: Frame, signal: RegisteredSignal, kept: Frame | None) -> Trend | None:
    """That of every value; of many rows that of the means of chunks."""
    name, is_long = signal.name, len(frame) > frame_summary.FULL_ROWS
    summary = summary_of(frame, signal)
    if summary.sum is None:
        return None
    angle = as_angle(frame, signal, summary)
    if angle is not signal:
        signal, summary = angle, summary_of(frame, angle)
    spikes: list[Spike] | None = None
    too_large: int | None = None
    if reads_values(frame, signal):
        times, numbers = frame.usable(name)
        weights = frame.usable_weights(name)
        course = course_of_values(times, numbers, signal.turn, summary, weights)
        if is_long:
            course = in_means(course, chunk_making.GROUP_ROWS)
        else:
            spikes = find_spikes(times, numbers, signal.turn)
            course = _without_spikes(course, spikes)
        too_large = int(np.count_nonzero(np.abs(frame.numbers(name)) > LARGEST))
    else:
        course = course_of_means(frame, name, frame.zone_map(name))
        course = replace(course, counted=None if signal.turn is None else summary)
    if kept is not None and name in kept:
        summary = with_extremes(summary, summary_of(kept, signal))
        course = _with_kept(course, summary, signal.turn, *kept.usable(name))
    return judge(signal, summary, course, spikes, too_large)


def _without_spikes(course: Course, spikes: Sequence[Spike]) -> Course:
    """A course whose rest is judged by the range of what lies between single values that stand out.

    Beside one spike, whatever else a signal does is small.
    """
    if not spikes or course.rest_s is None:
        return course
    usual = ~np.isin(course.times, [spike.sim_time_s for spike in spikes])
    times, numbers = course.times[usual], course.numbers[usual]
    return replace(course, rest_s=flat_since(times, numbers) if len(times) else None)


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
    connection: sqlite3.Connection, found: ChangePoints, states: Sequence[RegisteredSignal]
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
