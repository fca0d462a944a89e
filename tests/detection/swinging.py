"""Values that go to and fro for a while, over courses of their own, with the truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from tests.detection.driving import times_of
from tests.detection.labelled import Array, Incident, LabelledRun

COURSES: Final = ("constant", "ramp", "turns", "wander")
NAMES: Final = ("heading", "steering", "speed", "error", "left")
LEAST_ROWS: Final = 9  # of a period, for its shape to show
NOISE_SHARES: Final = (0.0, 0.02, 0.1, 0.2)  # of the amplitude
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
    slopes = np.zeros(len(times))
    start = 0
    while start < len(times):
        end = start + max(1, int(rng.uniform(2, 8) / interval_s))
        slopes[start:end] = rng.choice([0.0, 0.8, -0.8, 0.3])
        start = end
    return np.cumsum(slopes) * interval_s


def _drawn(
    rng: np.random.Generator, course: str, *, swings: bool
) -> tuple[LabelledRun, str, Array]:
    """A run, the name of the one signal that matters, and its values before they are wrapped."""
    interval_s = float(rng.choice(_INTERVALS_S))
    times = times_of(rng, float(rng.uniform(60, 240)), interval_s)
    name = str(rng.choice(NAMES))
    values = course_of(rng, times, course)
    swing = _swing_of(rng, name, interval_s, float(times[-1]))
    values = values + (_values_of(swing, times) if swings else 0.0)
    noise = (swing.amplitude or 0.0) * float(rng.choice(NOISE_SHARES))
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
}
