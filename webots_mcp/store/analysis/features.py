"""What a numeric signal does over a stretch of time: its slope, swing, spikes and rest.

Each function takes times that do not fall and as many values, all finite numbers; the mean and the
sum of squared deviations are those of the values.
"""

from __future__ import annotations

import math
import statistics
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import mul
from typing import Final

TIME_BINS: Final = 8
DEAD_BAND: Final = 0.3  # standard deviations about the mean within which noise may cross it
MOST_IRREGULAR: Final = 0.4  # coefficient of variation of the half periods of an oscillation
LEAST_CROSSINGS: Final = 6  # four are made by a value that fell, rested, and rose again
SLOW_SHARE: Final = 0.5  # of the variance must be left in means for their course to be the values'
AVERAGED: Final = 8  # values in one mean, where noise hides the crossings
SPIKE_SCORE: Final = 8.0  # 3.5 is the usual; here thousands of values are looked at at once
MOST_SPIKES_SHARE: Final = 0.05  # of the values: more of them are how the signal is
FLAT_BAND: Final = 0.005  # of the range: what moves less is at rest


@dataclass(frozen=True)
class Line:
    """The straight line of least squares; `r2` is the share of the variance it explains."""

    slope_per_s: float
    r2: float


@dataclass(frozen=True)
class Oscillation:
    """A regular swing about the mean.

    Attributes:
        crossings: How often the mean was crossed.
        amplitude: Median of the largest deviation in each half period.
        start_s: Half a period before the first crossing; `end_s` half a one after the last (both
            within the given times).
    """

    crossings: int
    period_s: float
    amplitude: float
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Spike:
    """One value far from both of its neighbours."""

    sim_time_s: float
    value: float


def fit_line(times: Sequence[float], values: Sequence[float], mean: float) -> Line | None:
    """Least squares: slope = S_tv / S_tt, r2 = S_tv**2 / (S_tt * S_vv), sums about the means.

    N. R. Draper, H. Smith, Applied Regression Analysis (3rd ed. 1998), sections 1.2 and 1.3. None
    where time stood still; r2 is 0 for a constant.
    """
    if len(values) < 2:
        return None
    time_mean = math.fsum(times) / len(times)
    dt = [time - time_mean for time in times]
    dv = [value - mean for value in values]
    stt, stv, svv = sum(map(mul, dt, dt)), sum(map(mul, dt, dv)), sum(map(mul, dv, dv))
    if stt == 0:
        return None
    return Line(stv / stt, min(1.0, stv / stt * (stv / svv)) if svv > 0 else 0.0)


def find_oscillation(
    times: Sequence[float], values: Sequence[float], mean: float, deviation: float
) -> tuple[int, Oscillation | None]:
    """Crossings of the mean, and the oscillation that they make if they come regularly.

    A crossing counts when the value leaves a band of 0.3 standard deviations about the mean on the
    other side (a Schmitt trigger), so that noise about the mean makes none. Regular means: at
    least six, at intervals whose standard deviation is at most 0.4 of their mean; noise of any
    colour comes out near 1. Where they are not, stronger noise may hide a swing: then the means of
    eight values each are looked at, if most of the variance is left in them.
    """
    if deviation == 0:
        return 0, None
    band = DEAD_BAND * deviation
    crossings, swing = _regular_crossings(times, values, mean, band)
    if swing is None and crossings >= LEAST_CROSSINGS:
        means = _averaged(values)
        if len(means) > 1 and statistics.variance(means) >= SLOW_SHARE * deviation**2:
            smooth, swing = _regular_crossings(_averaged(times), means, mean, band)
            crossings = smooth if swing else crossings
    return crossings, swing


def _averaged(values: Sequence[float]) -> list[float]:
    ends = range(AVERAGED, len(values) + 1, AVERAGED)
    return [sum(values[end - AVERAGED : end]) / AVERAGED for end in ends]


def _regular_crossings(
    times: Sequence[float], values: Sequence[float], mean: float, band: float
) -> tuple[int, Oscillation | None]:
    moments, peaks = _crossings(times, values, mean, band)
    if len(moments) < LEAST_CROSSINGS:
        return len(moments), None
    halves = [after - before for before, after in pairwise(moments)]
    half_s = statistics.fmean(halves)
    if half_s <= 0 or statistics.pstdev(halves) > MOST_IRREGULAR * half_s:
        return len(moments), None
    ends = (max(times[0], moments[0] - half_s), min(times[-1], moments[-1] + half_s))
    return len(moments), Oscillation(len(moments), 2 * half_s, statistics.median(peaks), *ends)


def _crossings(
    times: Sequence[float], values: Sequence[float], mean: float, band: float
) -> tuple[list[float], list[float]]:
    """Times at which the value changed sides, and the largest deviation between each two."""
    low, high = mean - band, mean + band
    moments: list[float] = []
    peaks: list[float] = []
    side, peak = 0, 0.0
    for time, value in zip(times, values, strict=True):
        if low < value < high:
            continue
        now = 1 if value > mean else -1
        if now != side:
            if side:
                moments.append(time)
                peaks.append(peak)
            side, peak = now, 0.0
        if (size := abs(value - mean)) > peak:
            peak = size
    return moments, peaks[1:] or peaks


def find_spikes(times: Sequence[float], values: Sequence[float]) -> list[Spike]:
    """Single values that stand out from both neighbours, while those agree with each other.

    s = value - mean of both neighbours, judged by the modified z-score 0.6745 * s / MAD(s), and
    where that MAD is 0 by s / (1.2533 * mean |s|): B. Iglewicz, D. C. Hoaglin, How to Detect and
    Handle Outliers (1993). A step is no spike, because its neighbours differ, and no
    turning point, because those differ from the ones beyond them. Where more than one
    in twenty values (and more than three) stand out, none is told: that is how the signal is.
    """
    if len(values) < 5:
        return []
    middle = [b - (a + c) / 2 for a, b, c in zip(values, values[1:], values[2:], strict=False)]
    sizes = sorted(map(abs, middle))
    mad = sizes[len(sizes) // 2]
    limit = SPIKE_SCORE * (mad / 0.6745 if mad > 0 else 1.2533 * sum(sizes) / len(sizes))
    if limit == 0 or sizes[-1] <= limit:
        return []
    found = [
        Spike(times[index + 1], values[index + 1])
        for index, size in enumerate(middle)
        if abs(size) > limit and _stands_alone(values, index + 1, abs(size) / 2)
    ]
    return found if len(found) <= max(3, MOST_SPIKES_SHARE * len(values)) else []


def _stands_alone(values: Sequence[float], index: int, limit: float) -> bool:
    """Whether the neighbours agree with each other, and each with the one beyond it."""
    near = [*values[max(0, index - 2) : index], *values[index + 1 : index + 3]]
    return all(abs(after - before) < limit for before, after in pairwise(near))


def flat_since(times: Sequence[float], values: Sequence[float]) -> float | None:
    """Since when the value has stayed within 0.5 % of its range; None if not for 10 % of the time.

    A signal that never changed is flat since its first value.
    """
    span = max(values) - min(values)
    last, limit = values[-1], FLAT_BAND * span
    index = len(values) - 1
    while index > 0 and abs(values[index - 1] - last) <= limit:
        index -= 1
    whole_s = times[-1] - times[0]
    return times[index] if span == 0 or times[-1] - times[index] >= 0.1 * whole_s else None


def time_effect(
    times: Sequence[float], values: Sequence[float], mean: float, squares: float
) -> float:
    """The share of the variance that lies between eight equal stretches of time, 0 to 1.

    The correlation ratio eta squared (R. A. Fisher, Statistical Methods for Research Workers,
    1925, section 44): near 0 for steady noise and for a swing that is short beside the stretch,
    1 where all change is slow, whether it goes one way or comes back.
    """
    width_s = (times[-1] - times[0]) / TIME_BINS
    if squares == 0 or width_s == 0:
        return 0.0
    borders = [bisect_left(times, times[0] + width_s * index) for index in range(TIME_BINS)]
    between = 0.0
    for start, end in pairwise([*borders, len(values)]):
        if end > start:
            between += (end - start) * (sum(values[start:end]) / (end - start) - mean) ** 2
    return min(1.0, between / squares)


def unwrap(angles: Sequence[float], turn: float = math.tau) -> list[float]:
    """Angles without the jumps of a full turn, as if turns were counted: as numpy does it.

    Each step is taken as the shorter way round (K. Itoh, Analysis of the phase unwrapping
    algorithm, Applied Optics 21, 1982).
    """
    import numpy as np

    return np.unwrap(angles, period=turn).tolist()
