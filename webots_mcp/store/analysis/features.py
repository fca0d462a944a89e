"""What a numeric signal does over a stretch of time: its slope, spikes, rest, and slow change.

Each function takes arrays: times that do not fall and as many values, all finite, at least one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Indexes, inner, np

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
