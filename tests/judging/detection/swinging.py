"""Values that go to and fro for a while, over courses of their own, with the truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from tests.judging.detection.driving import times_of
from tests.judging.detection.labelled import Array, Incident, LabelledRun, interval_of, noise_of

COURSES: Final = ("constant", "ramp", "turns", "wander", "loop")
NAMES: Final = ("heading", "steering", "speed", "error", "left")
LEAST_ROWS: Final = 9  # of a period, for its shape to show
NOISE_SHARES: Final = (0.0, 0.02, 0.1, 0.2)  # of the amplitude
NOISE_SHARE_LEVELS: Final = (0.0, 0.02, 0.2)
_PERIODS_S: Final = (0.3, 4.8)  # up to 5 s count
_INTERVALS_S: Final = (0.008, 0.016, 0.032, 0.08, 0.16, 0.5)


def course_of(rng: np.random.Generator, times: Array, name: str) -> Array:
    """What the value would do without the swing."""
    interval_s = float(times[1] - times[0])
    if name == "constant":
        return np.full(len(times), float(rng.uniform(-1, 1)))
    if name == "ramp":
        return 0.3 * times
    if name == "wander":
        return np.cumsum(rng.normal(0, 0.05 * math.sqrt(interval_s), len(times)))
    if name == "loop":
        return _stairs(rng, times, float(rng.uniform(10, 25)), float(rng.uniform(0.03, 0.12)))
    slopes = np.zeros(len(times))
    start = 0
    while start < len(times):
        end = start + max(1, int(rng.uniform(2, 8) / interval_s))
        slopes[start:end] = rng.choice([0.0, 0.8, -0.8, 0.3])
        start = end
    return np.cumsum(slopes) * interval_s


def _stairs(rng: np.random.Generator, times: Array, period_s: float, ramp_share: float) -> Array:
    """Rests and ramps of a quarter turn each; of some all alike, of others each a little longer."""
    steps = int(times[-1] / period_s * 1.5) + 3
    jitter = float(rng.choice([0.0, 0.03, 0.1]))
    lasts_s = period_s * rng.uniform(1 - jitter, 1 + jitter, steps)
    starts_s = np.cumsum(lasts_s) - lasts_s[0] * float(rng.uniform(1, 2))
    moments = np.stack((starts_s, starts_s + ramp_share * lasts_s), axis=1).ravel()
    heights = np.repeat(np.arange(steps + 1), 2)[1:-1] * np.pi / 2
    return np.asarray(np.interp(times, moments, heights), np.float64)


def _drawn(
    rng: np.random.Generator, course: str, *, swings: bool
) -> tuple[LabelledRun, str, Array]:
    """A run, the name of the one signal that matters, and its values before they are wrapped."""
    interval_s = interval_of(rng, _INTERVALS_S)
    times = times_of(rng, float(rng.uniform(60, 240)), interval_s)
    name = str(rng.choice(NAMES))
    values = course_of(rng, times, course)
    swing = _swing_of(rng, name, interval_s, float(times[-1]))
    values = values + (_values_of(swing, times) if swings else 0.0)
    share = noise_of(float(rng.choice(NOISE_SHARES)), NOISE_SHARE_LEVELS)
    noise = (swing.amplitude or 0.0) * share
    values = values + rng.normal(0, noise, len(times))
    return LabelledRun(times, {}, interval_s, (swing,) if swings else ()), name, values


def _swing_of(rng: np.random.Generator, name: str, interval_s: float, newest_s: float) -> Incident:
    """6 to 30 half periods somewhere in the recording."""
    shortest_s = max(_PERIODS_S[0], LEAST_ROWS * interval_s)
    period_s = float(np.exp(rng.uniform(math.log(shortest_s), math.log(_PERIODS_S[1]))))
    most = int((newest_s - 4) / (period_s / 2))
    lasts_s = min(int(rng.integers(6, 31)), most) * period_s / 2
    start_s = float(rng.uniform(1, newest_s - lasts_s - 1))
    amplitude = float(rng.uniform(0.08, 0.5))
    return Incident("swing", start_s, start_s + lasts_s, name, period_s, amplitude)


def _values_of(swing: Incident, times: Array) -> Array:
    """The sine, and 0 before and after it."""
    angle = 2 * np.pi * (times - swing.start_s) / (swing.period_s or 1)
    inside = (times >= swing.start_s) & (times < swing.end_s)
    return (swing.amplitude or 0.0) * np.sin(angle) * inside


def _published(run: LabelledRun, name: str, values: Array) -> LabelledRun:
    told = np.angle(np.exp(1j * values)) if name == "heading" else values
    columns: dict[str, Sequence[Any]] = {name: told.tolist(), "step": list(range(len(told)))}
    return replace(run, columns=columns)


def _swing(course: str) -> Callable[[np.random.Generator], LabelledRun]:
    return lambda rng: _published(*_drawn(rng, course, swings=True))


def draw_steady(rng: np.random.Generator) -> LabelledRun:
    """Courses of all kinds without a swing."""
    return _published(*_drawn(rng, str(rng.choice(COURSES)), swings=False))


def _calm(rng: np.random.Generator, **columns: Array) -> LabelledRun:
    """Values at times that are their indexes, which no swing is in."""
    interval_s = interval_of(rng, _INTERVALS_S[1:5])
    times: Array = interval_s * np.arange(len(next(iter(columns.values()))), dtype=np.float64)
    return LabelledRun(times, {name: each.tolist() for name, each in columns.items()}, interval_s)


def draw_stairs(rng: np.random.Generator) -> LabelledRun:
    """What never turns back: headings of polygons, ways of stop and go, with round corners or not.

    Ramps take 10 to 90 % of the period.
    """
    interval_s = interval_of(rng, _INTERVALS_S[1:5])
    times = times_of(rng, float(rng.uniform(120, 300)), interval_s)
    period_s = float(np.exp(rng.uniform(math.log(max(0.8, 12 * interval_s)), math.log(10))))
    course = _stairs(rng, times, period_s, float(rng.uniform(0.1, 0.9)))
    rounded = int(float(rng.choice([0, 0, 0.05, 0.1])) * period_s / interval_s)
    course = _smoothed(course, rounded) if rounded > 1 else course
    noise = noise_of(float(rng.choice([0.0, 0.002, 0.01, 0.02])), (0.0, 0.002, 0.02)) * np.pi / 2
    course = course + rng.normal(0, noise, len(course))
    run = LabelledRun(times[: len(course)], {}, interval_s)
    return _published(run, str(rng.choice(["heading", "position"])), course)


def _smoothed(values: Array, rows: int) -> Array:
    return np.asarray(np.convolve(values, np.full(rows, 1 / rows), "valid"), np.float64)


def draw_smoothed(rng: np.random.Generator) -> LabelledRun:
    """Noise that moving means were taken of, twice or thrice."""
    rows = int(np.exp(rng.uniform(math.log(3), math.log(60))))
    values = rng.normal(0, 1, 12_000)
    for _ in range(int(rng.integers(2, 4))):
        values = _smoothed(values, rows)
    return _calm(rng, speed=values)


def draw_roaming(rng: np.random.Generator) -> LabelledRun:
    """A robot that is driven at random: it turns now faster and now slower, and drives on."""
    interval_s = 0.032
    held = int(float(rng.uniform(0.3, 3)) / interval_s)
    held_rows = rng.integers(held // 2, 3 * held // 2 + 1, 30_000 // held + 2)
    turning = np.repeat(rng.normal(0, float(rng.uniform(0.3, 1.5)), len(held_rows)), held_rows)
    turning = turning[:12_000]
    heading = np.cumsum(_smoothed(turning, held) if rng.random() < 0.5 else turning) * interval_s
    speed = float(rng.uniform(0.1, 0.4)) * interval_s
    noise = rng.normal(0, float(rng.choice([0, 0.001, 0.005, 0.01])), (2, len(heading)))
    x, y = np.cumsum(speed * np.cos(heading)), np.cumsum(speed * np.sin(heading))
    places: Array = np.stack((x, y)) + noise
    columns: dict[str, Sequence[Any]] = {
        "heading": np.angle(np.exp(1j * heading)).tolist(),
        "position": [{"x": each[0], "y": each[1]} for each in places.T.tolist()],
    }
    times: Array = interval_s * np.arange(len(x), dtype=np.float64)
    return LabelledRun(times, columns, interval_s)


def draw_with_gap(rng: np.random.Generator) -> LabelledRun:
    """A swing on a constant or a ramp, in a recording with a gap of 6 s, also within the swing."""
    course = str(rng.choice(["constant", "ramp"]))
    run = _published(*_drawn(rng, course, swings=True))
    (swing,) = run.incidents
    gap_s = 6.0
    start_s = float(rng.uniform(2, run.duration_s - gap_s - 2))
    missing = (run.times > start_s) & (run.times < start_s + gap_s)
    before, after = run.times[run.times <= start_s][-1], run.times[run.times >= start_s + gap_s][0]
    gap = Incident("gap", float(before), float(after))
    return replace(run.kept(~missing), incidents=(_cut(swing, gap), gap))


def _cut(swing: Incident, gap: Incident) -> Incident:
    """What the gap leaves of a swing: one that lost an end, or is too short, may be told or not."""
    if gap.end_s <= swing.start_s or gap.start_s >= swing.end_s:
        return swing
    periods_left = [
        (gap.start_s - swing.start_s) / (swing.period_s or 1),
        (swing.end_s - gap.end_s) / (swing.period_s or 1),
    ]
    return replace(swing, split=True, optional=min(periods_left) < 3 or max(periods_left) < 3)


DRAWN: Final[dict[str, Callable[[np.random.Generator], LabelledRun]]] = {
    **{f"swing_{course}": _swing(course) for course in COURSES},
    "swing_gap": draw_with_gap,
    "steady": draw_steady,
    "stairs": draw_stairs,
    "smoothed": draw_smoothed,
    "roaming": draw_roaming,
}
