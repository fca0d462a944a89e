"""Sudden jumps, and stretches of to and fro."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from webots_mcp.store.analysis.features import MOST_IRREGULAR
from webots_mcp.store.reading.gaps import rhythm_of

MOST_JUMPS_SHARE: Final = 0.001  # more of them are how the signal is
LEAST_STEPS: Final = 10
POSITION_STEPS: Final = 5.0  # a position jumps by so many times its 99th percentile step
WHOLE_TURNS: Final = (math.tau, 360.0)
TURN_SHARE: Final = 0.2  # of the range (5th to 95th percentile): what turns by less is noise


@dataclass(frozen=True)
class Jump:
    """The value changed between two rows by much more than it usually does.

    Attributes:
        back_s: When the next row or so was back where it had been; None for a jump that stayed.
    """

    sim_time_s: float
    before: float
    after: float
    back_s: float | None = None


@dataclass(frozen=True)
class ToAndFro:
    """A stretch of regular turning points."""

    start_s: float
    end_s: float
    turns: int
    period_s: float
    amplitude: float


def find_jumps(
    times: Sequence[float], values: Sequence[float], score: float, usual: Sequence[float] = ()
) -> list[Jump]:
    """Steps whose modified z-score (see `shapes.find_spikes`) is above the score.

    Compared is with the steps that are not zero, of which there have to be ten: for counters and
    commanded values a step is what they do. Where more than one in a thousand steps (and more
    than three) stand out, none is told. After a gap a step may be larger by as many times as the
    gap is longer than the usual interval; and the step of an angle over the end of its scale (pi,
    180 degrees, 360 degrees) is as large as what is left of a whole turn.

    Args:
        times: Of the values.
        values: In order.
        score: How much larger than usual a step has to be.
        usual: The sizes of steps to compare with; empty for those of the values themselves.
    """
    steps = [abs(after - before) for before, after in pairwise(values)]
    sizes = sorted(size for size in usual or steps if size > 0)
    if len(sizes) < LEAST_STEPS:
        return []
    median = sizes[len(sizes) // 2]
    limit = median + score * median / 0.6745
    wide = [index for index, step in enumerate(steps) if step > limit]
    found = [
        Jump(times[index + 1], values[index], values[index + 1])
        for index, intervals in zip(wide, _intervals(times, wide), strict=True)
        if _step(values[index], values[index + 1]) > limit * intervals
    ]
    jumps = list(_with_return(found))
    return jumps if len(jumps) <= max(3, MOST_JUMPS_SHARE * len(steps)) else []


def _intervals(times: Sequence[float], indexes: Sequence[int]) -> list[float]:
    """How many usual intervals, at least one, lie between each of those rows and the next."""
    usual_s = (rhythm_of(times).interval_s if indexes else None) or math.inf
    return [max(1.0, (times[index + 1] - times[index]) / usual_s) for index in indexes]


def _step(before: float, after: float) -> float:
    """How far it is from one to the other; the short way round where they may be angles."""
    far = abs(after - before)
    turns = (turn for turn in WHOLE_TURNS if max(abs(before), abs(after)) <= turn and far <= turn)
    return min((far, *(turn - far for turn in turns)))


def _with_return(jumps: Sequence[Jump]) -> Iterator[Jump]:
    """A jump and the next one back to about where it began are one."""
    index = 0
    while index < len(jumps):
        jump = jumps[index]
        following = jumps[index + 1] if index + 1 < len(jumps) else None
        size = abs(jump.after - jump.before)
        if following is not None and abs(following.after - jump.before) < 0.2 * size:
            yield Jump(jump.sim_time_s, jump.before, jump.after, following.sim_time_s)
            index += 2
        else:
            yield jump
            index += 1


def find_leaps(
    times: Sequence[float], places: Sequence[tuple[float, float]], at_least_m: float
) -> list[tuple[float, float]]:
    """Times and lengths of steps of a position that no driving explains.

    Longer than `at_least_m`, and than five times the 99th percentile of all steps; after a gap, by
    as many times as it is longer than the usual interval.
    """
    steps = [math.dist(before, after) for before, after in pairwise(places)]
    if not steps:
        return []
    usual_m = sorted(steps)[min(len(steps) - 1, int(0.99 * len(steps)))]
    limit_m = max(at_least_m, POSITION_STEPS * usual_m if len(steps) > 100 else 0.0)
    long = [index for index, step in enumerate(steps) if step > limit_m]
    return [
        (times[index + 1], steps[index])
        for index, intervals in zip(long, _intervals(times, long), strict=True)
        if steps[index] > limit_m * intervals
    ]


def find_to_and_fro(
    times: Sequence[float], values: Sequence[float], turns: int, longest_period_s: float
) -> Iterator[ToAndFro]:
    """Stretches of at least `turns` turning points, each soon after the last, at regular times.

    A turning point counts when the value has come back by a fifth of its range (zigzag filter).
    Regular means that the half periods' standard deviation is at most 0.4 of their mean.
    """
    points = _turning_points(times, values)
    start = 0
    for end in range(1, len(points) + 1):
        soon = end < len(points) and points[end][0] - points[end - 1][0] <= longest_period_s / 2
        if soon:
            continue
        if end - start >= turns and (found := _regular(points[start:end])) is not None:
            yield found
        start = end


def _turning_points(times: Sequence[float], values: Sequence[float]) -> list[tuple[float, float]]:
    if len(values) < 3:
        return []
    ordered = sorted(values)
    size = ordered[int(0.95 * (len(ordered) - 1))] - ordered[int(0.05 * (len(ordered) - 1))]
    least = TURN_SHARE * size
    if least <= 0:
        return []
    points: list[tuple[float, float]] = []
    extreme, direction = (times[0], values[0]), 0
    for time, value in zip(times, values, strict=True):
        change = value - extreme[1]
        if direction == 0:
            direction = (change > least) - (change < -least)
            extreme = (time, value) if direction else extreme
        elif change * direction > 0:
            extreme = (time, value)
        elif -change * direction > least:
            points.append(extreme)
            extreme, direction = (time, value), -direction
    return points


def _regular(points: Sequence[tuple[float, float]]) -> ToAndFro | None:
    halves = [after[0] - before[0] for before, after in pairwise(points)]
    half_s = statistics.fmean(halves)
    if half_s <= 0 or statistics.pstdev(halves) > MOST_IRREGULAR * half_s:
        return None
    swings = [abs(after[1] - before[1]) for before, after in pairwise(points)]
    amplitude = statistics.median(swings) / 2
    return ToAndFro(points[0][0], points[-1][0], len(points), 2 * half_s, amplitude)
