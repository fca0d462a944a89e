"""One numeric signal over a range: its trend, and what a person would notice."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from webots_mcp.naming import words_of
from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.analysis.features import (
    Line,
    Spike,
    Step,
    find_step,
    fit_line,
    flat_since,
    is_monotonic,
    leaps_in,
    time_effect,
)
from webots_mcp.store.analysis.summaries import Summaries
from webots_mcp.store.analysis.summary import LARGEST, Summary, summarise_numbers
from webots_mcp.store.analysis.swings import LEAST_HALF_SWINGS, Swing, find_swings
from webots_mcp.store.reading.moments import shown_time
from webots_mcp.store.signals.registry import Signal

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
_HALF_TURN_VARIANCE: Final = -2 * math.log(2 / math.pi)  # of angles spread over half a turn

Shape = Literal["constant", "rising", "falling", "oscillating", "resting", "varying"]
Monotonic = Literal["rising", "falling"]


@dataclass(frozen=True)
class Trend:
    """A numeric signal over a range.

    Attributes:
        summary: Count, first, last, extremes with their times, mean, deviation. Where the turns of
            an angle are counted, its extremes are those of the unwrapped angle too (from rollups
            in which it passed the border of a turn those of their means).
        mean: Of an angle the circular mean. What is less than a few millionths of the range is
            rounded away: it comes from adding.
        deviation: Standard deviation; of an angle that of the unwrapped angle, or the circular one
            where turns cannot be counted, next to extremes as they were recorded.
        turned: How far an angle turned, positive as it grows, turns counted; else None.
        leaps: An angle that changed by more than a quarter turn from row to row, as the bearing to
            the nearest of several things does: its turns cannot be counted.
        monotonic: "rising", "falling" (never the other way, and not constant), or None.
        fast: It varies so fast that the means of buckets do not show its course.
        swings: Where it moved to and fro, as `find_events` reports it, but of any period.
        resolution_s: Length of the means in which swings were seen; None where rows were.
        flat_since_s: Since when it rests; None if it does not.
        spikes: Values that stand out from both neighbours; None where rows were not looked at.
        step: The one change that makes most of its range; None where rows were not looked at, and
            of an angle.
        missing: Of the rows, those without a value; from rollups also those with one beyond 1e100.
        too_large: Of the rows, those with a number beyond 1e100; None where rows were not read.
        change: How much it changed with time, 0 to 2: the share of its variance that is slow
            (`time_effect`) times its range in units of its largest magnitude. Free of units.
        says: What a person would notice.
    """

    name: str
    kind: str
    unit: str | None
    summary: Summary
    mean: float | None
    deviation: float | None
    turned: float | None
    leaps: bool
    slope_per_s: float | None
    r2: float | None
    shape: Shape
    monotonic: Monotonic | None
    fast: bool
    swings: tuple[Swing, ...]
    resolution_s: float | None
    flat_since_s: float | None
    spikes: tuple[Spike, ...] | None
    step: Step | None
    missing: int
    too_large: int | None
    change: float
    says: str

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


def judge(
    signal: Signal,
    summary: Summary,
    times: Array,
    numbers: Array,
    spikes: list[Spike] | None,
    inner_variance: float = 0.0,
    resolution_s: float | None = None,
    pieces: Summaries | None = None,
    too_large: int | None = None,
    *,
    rows_left: bool = True,
) -> Trend:
    """Combine the summary with the course of the numbers.

    Args:
        signal: Whose trend.
        summary: Of the whole range.
        times: Of the numbers.
        numbers: The values, or the means of buckets; at least one.
        spikes: None where only buckets were looked at.
        inner_variance: That of the values within the buckets. Where more of it lies there than
            between them, a course of their means is not that of the values (it may be an alias).
        resolution_s: The length of the buckets; None where the numbers are the values.
        pieces: The buckets, of which ends and extremes are known in addition to the means.
        too_large: How many of the values are beyond 1e100; None where that is not known.
        rows_left: Whether less time would be seen in rows.
    """
    of_rows = spikes is not None
    turn = signal.turn if of_rows else summary.turn_of(signal.turn)
    leaps = turn is not None and of_rows and leaps_in(numbers, turn)
    course = _unwrapped(numbers, summary, turn) if turn and not leaps else numbers
    inner = summary if of_rows and course is numbers else summarise_numbers(times, course)
    slow = _slow_share(inner, inner_variance, turn)
    fast = slow < SLOW_SHARE or leaps
    line = None if leaps else _of_all(fit_line(times, course, inner.mean or 0.0), slow)
    monotonic = None if fast else _monotonic(course)
    swings = () if fast or monotonic else _swings(times, course, resolution_s)
    rest_s = None
    if not fast:
        known = (times, course) if pieces is None or turn else pieces.known_values()
        rest_s = flat_since(*known)
    mean = _mean(signal, summary, inner, numbers)
    counted = course is not numbers and not fast
    deviation = summary.deviation_in(signal.turn)
    if counted:
        deviation = _deviation(inner, inner_variance)
    if counted and pieces is not None and turn is not None:
        summary = _with_extremes_in(pieces, course - numbers, course, turn, summary)
    elif counted:
        summary = _with_extremes_of(inner, summary)
    shape = _shape(summary, line, monotonic, swings, rest_s, float(times[-1] - times[0]))
    trend = Trend(
        name=signal.name,
        kind=signal.kind,
        unit=signal.unit,
        summary=summary,
        mean=_rounded(mean, inner),
        deviation=deviation,
        turned=_turned(summary, numbers, turn) if turn and not fast else None,
        leaps=leaps,
        slope_per_s=line.slope_per_s if line else None,
        r2=line.r2 if line else None,
        shape=shape,
        monotonic=monotonic,
        fast=fast,
        swings=swings,
        resolution_s=resolution_s,
        flat_since_s=rest_s,
        spikes=None if spikes is None else tuple(spikes),
        step=None if spikes is None or turn else find_step(times, numbers),
        missing=summary.rows - summary.present - (too_large or 0),
        too_large=too_large,
        change=time_effect(times, course, inner.mean or 0.0, inner.squares or 0.0)
        * slow
        * _relative_range(summary),
        says="",
    )
    return replace(trend, says="; ".join(_remarks(trend, rows_left=rows_left)))


def _slow_share(means: Summary, inner_variance: float, turn: float | None) -> float:
    """The share of the variance between the means; 0 where an angle's turns cannot be counted."""
    countable = math.inf if turn is None else _HALF_TURN_VARIANCE * (turn / math.tau) ** 2
    if inner_variance == 0 or inner_variance > countable:
        return float(inner_variance == 0)
    between = (means.squares or 0.0) / means.present
    return between / (between + inner_variance)


def _of_all(line: Line | None, slow: float) -> Line | None:
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


def _unwrapped(angles: Array, summary: Summary, turn: float) -> Array:
    """With turns counted, beginning where the first value is."""
    course: Array = np.unwrap(angles, period=turn)
    return course + turn * round(((summary.first or 0.0) - float(course[0])) / turn)


def _with_extremes_of(course: Summary, summary: Summary) -> Summary:
    """With the extremes of the course in which turns are counted."""
    return summary._replace(
        min=course.min,
        min_sim_time_s=course.min_sim_time_s,
        max=course.max,
        max_sim_time_s=course.max_sim_time_s,
    )


def _with_extremes_in(
    pieces: Summaries, turned: Array, course: Array, turn: float, summary: Summary
) -> Summary:
    """With those of the buckets, turned on as far as their means are.

    Of one that reaches over half a turn, because it passed the border of a turn, only the mean is
    known to be in the course.
    """
    narrow = pieces["max"] - pieces["min"] < turn / 2
    lows = np.where(narrow, pieces["min"] + turned, course)
    highs = np.where(narrow, pieces["max"] + turned, course)
    least, most = int(lows.argmin()), int(highs.argmax())
    return summary._replace(
        min=float(lows[least]),
        min_sim_time_s=float(pieces["min_sim_time_s"][least]),
        max=float(highs[most]),
        max_sim_time_s=float(pieces["max_sim_time_s"][most]),
    )


def _mean(signal: Signal, summary: Summary, course: Summary, numbers: Array) -> float | None:
    """Of an angle the circular one, or where its sines are not known that of the unwrapped one."""
    if summary.turn_of(signal.turn) is not None:
        return summary.centre(signal.turn)
    if signal.turn is None or course is summary or course.mean is None:
        return summary.mean
    return (
        course.mean % signal.turn
        if numbers.min() >= 0
        else math.remainder(course.mean, signal.turn)
    )


def _deviation(means: Summary, inner_variance: float) -> float | None:
    """Of the means of buckets and of the values within them; of values the usual one."""
    between = means.deviation
    return None if between is None else math.hypot(between, math.sqrt(inner_variance))


def _turned(summary: Summary, numbers: Array, turn: float) -> float:
    turned = np.unwrap([summary.first or 0.0, *numbers, summary.last or 0.0], period=turn)
    return float(turned[-1] - turned[0])


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


def _shape(
    summary: Summary,
    line: Line | None,
    monotonic: Monotonic | None,
    swings: Sequence[Swing],
    rest_s: float | None,
    whole_s: float,
) -> Shape:
    if _is_constant(summary):
        return "constant"
    wide = [each for each in swings if _is_wide(each, summary)]
    if wide and sum(each.end_s - each.start_s for each in wide) >= SWINGING_SHARE * whole_s:
        return "oscillating"
    if monotonic is not None:
        return monotonic
    if line is not None and line.r2 >= STRAIGHT_R2:
        return "rising" if line.slope_per_s > 0 else "falling"
    return "resting" if rest_s is not None else "varying"


def _is_wide(swing: Swing, summary: Summary) -> bool:
    """Whether the swing makes the range, rather than a slow course on which it rides."""
    return 2 * swing.amplitude >= WIDE_SHARE * ((summary.max or 0.0) - (summary.min or 0.0))


def _is_constant(summary: Summary) -> bool:
    """Whether it never changed but for what adding leaves: 6.000000000000005 is 6."""
    low, high = summary.min or 0.0, summary.max or 0.0
    return high - low <= _DUST * max(abs(low), abs(high))


def _relative_range(summary: Summary) -> float:
    assert summary.min is not None and summary.max is not None
    largest = max(abs(summary.min), abs(summary.max))
    return (summary.max - summary.min) / largest if largest else 0.0


def _remarks(trend: Trend, *, rows_left: bool) -> Iterator[str]:
    summary, unit = trend.summary, f" {trend.unit}" if trend.unit else ""
    yield _course(trend, unit)
    if trend.leaps:
        yield "changes by more than a quarter turn between rows: turns are not counted"
    elif trend.fast:
        advice = ": ask for a shorter range" if rows_left else ", and its rows were purged"
        yield f"varies within {trend.resolution_s:g} s{advice}"
    yield from _beyond_ends(trend)
    if trend.swings and not any(_is_wide(each, summary) for each in trend.swings):
        yield f"also {_swinging(trend, unit)}"
    if trend.flat_since_s is not None and trend.shape != "constant" and summary.changes != 1:
        yield f"flat at {_in_digits(summary.last, summary)} since {trend.flat_since_s:.6g} s"
    if trend.spikes:
        largest = max(trend.spikes, key=lambda spike: abs(spike.value - (trend.mean or 0.0)))
        yield (
            f"{len(trend.spikes)} spike{'s' if len(trend.spikes) > 1 else ''}, the largest "
            f"{largest.value:.4g} at {largest.sim_time_s:.6g} s"
        )
    if trend.too_large:
        yield f"beyond {LARGEST:g} in {trend.too_large} of {summary.rows} rows"
    if trend.is_lacking:
        usable = "usable " if trend.too_large is None else ""  # rollups do not tell the two apart
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
    low, high = _in_digits(summary.min, summary), _in_digits(summary.max, summary)
    return f"between {low} (at {summary.min_sim_time_s:.6g} s) and {high}{unit} " + (
        f"(at {summary.max_sim_time_s:.6g} s)"
    )


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
    return f"{value:.{min(digits, 15)}g}"


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
