"""Sensors that fall silent, freeze, drop out, wake late and change their shape, with the truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from tests.judging.detection.driving import NOISE_LEVELS_M, drive_of, driven, moved, times_of
from tests.judging.detection.labelled import Flags, Incident, LabelledRun, interval_of, noise_of

RANGE_M: Final = 2.0  # of the distance sensor: what it reads where it sees nothing
LIDAR_BEAMS: Final = 32
READING_NOISES_M: Final = (0.0, 0.003, 0.05)  # of the distance sensor
LEAST_FROZEN_S: Final = 25.0  # 20 s count
MOST_DROPOUTS: Final = 40


def sensors(rng: np.random.Generator, interval_s: float, duration_s: float) -> LabelledRun:
    """A robot whose sensors all work: what they read changes slowly, with noise."""
    times = times_of(rng, duration_s, interval_s)
    rows = len(times)
    wave = 0.35 * np.sin(times / rng.uniform(3, 9)) + 0.25 * np.sin(times / rng.uniform(10, 30))
    front = 1.0 + wave + rng.normal(0, noise_of(0.003, READING_NOISES_M), rows)
    beams = 1.5 + wave[:, None] * np.linspace(0.5, 1, LIDAR_BEAMS)
    lidar = np.round(beams + rng.normal(0, 0.01, beams.shape), 4)
    columns: dict[str, Sequence[Any]] = {
        "front": front.tolist(),
        "lidar": lidar.tolist(),
        "gyro": rng.normal(0, 0.02, (rows, 3)).tolist(),
        "battery_v": (12.6 - 0.001 * times).tolist(),
        "task": ["follow_wall"] * rows,
    }
    return LabelledRun(times, columns, interval_s)


def _drawn(rng: np.random.Generator) -> LabelledRun:
    interval_s = interval_of(rng, [0.016, 0.032, 0.064, 0.1, 0.25])
    return sensors(rng, interval_s, float(rng.uniform(60, 150)))


def with_values(run: LabelledRun, name: str, rows: Flags, value: object) -> LabelledRun:
    """The run with that value in the rows that are marked."""
    values = list(run.columns[name])
    for at in np.flatnonzero(rows).tolist():
        values[at] = value
    return replace(run, columns={**run.columns, name: values})


def with_incidents(run: LabelledRun, *incidents: Incident) -> LabelledRun:
    """The run with more truth."""
    return replace(run, incidents=(*run.incidents, *incidents))


def _between(run: LabelledRun, start_s: float, end_s: float) -> Flags:
    return (run.times >= start_s) & (run.times <= end_s)


def _ends_of(run: LabelledRun, rows: Flags) -> tuple[float, float]:
    marked = run.times[rows]
    return float(marked[0]), float(marked[-1])


def _stretches(
    rng: np.random.Generator, run: LabelledRun, count: int, lasting_s: tuple[float, float]
) -> list[tuple[float, float]]:
    """So many stretches that neither touch each other nor the ends of the run."""
    share_s = run.duration_s / count
    found: list[tuple[float, float]] = []
    for index in range(count):
        lasts_s = min(float(rng.uniform(*lasting_s)), 0.7 * share_s)
        start_s = index * share_s + float(rng.uniform(0.1, 0.9)) * (share_s - lasts_s)
        found.append((start_s, start_s + lasts_s))
    return found


def silenced(run: LabelledRun, name: str, rows: Flags, nothing: float | None) -> LabelledRun:
    """The run with a sensor that gives nothing in the rows that are marked."""
    truth = Incident("missing", *_ends_of(run, rows), name)
    return with_incidents(with_values(run, name, rows, nothing), truth)


def draw_silent(rng: np.random.Generator) -> LabelledRun:
    """A distance sensor without a value, or with NaN, for 1.5 to 12 s, one to four times."""
    run = _drawn(rng)
    nothing = None if rng.random() < 0.5 else math.nan
    for ends_s in _stretches(rng, run, int(rng.integers(1, 5)), (2.0, 12.0)):
        run = silenced(run, "front", _between(run, *ends_s), nothing)
    return run


def draw_short_silence(rng: np.random.Generator) -> LabelledRun:
    """A distance sensor without a value for 2 to 10 s, once in a short recording."""
    run = sensors(rng, 0.1, 100.0)
    return silenced(run, "front", _between(run, 40, 40 + float(rng.uniform(2, 10))), None)


def draw_late(rng: np.random.Generator) -> LabelledRun:
    """Null until the first scan, which comes after 0.2 to 10 s; from then on all is well."""
    run = _drawn(rng)
    name = str(rng.choice(["lidar", "front"]))
    rows = run.times < rng.uniform(0.2, 10)
    run = with_values(run, name, rows, None)
    return with_incidents(run, Incident("missing", *_ends_of(run, rows), name, optional=True))


def draw_dead(rng: np.random.Generator) -> LabelledRun:
    """A sensor dies for good, at any time: then it gives nothing, NaN, or its last value."""
    run = _drawn(rng)
    name = str(rng.choice(["front", "lidar"]))
    dies_s = float(rng.uniform(0.05, 0.75)) * run.duration_s
    rows = run.times >= dies_s
    if name == "front" and rng.random() < 0.4:
        last = run.columns[name][int(np.argmax(rows))]
        run = with_values(run, name, rows, last)
        lasts_s = run.duration_s - dies_s
        optional = lasts_s < LEAST_FROZEN_S
        return with_incidents(run, Incident("flat", *_ends_of(run, rows), name, optional=optional))
    return silenced(run, name, rows, math.nan if name == "front" and rng.random() < 0.5 else None)


def draw_frozen(rng: np.random.Generator) -> LabelledRun:
    """The distance sensor gives one and the same value for 25 to 50 s, and lives again."""
    interval_s = interval_of(rng, [0.032, 0.064, 0.1, 0.25])
    run = sensors(rng, interval_s, float(rng.uniform(100, 160)))
    ((start_s, end_s),) = _stretches(rng, run, 1, (LEAST_FROZEN_S, 50.0))
    rows = _between(run, start_s, end_s)
    run = with_values(run, "front", rows, run.columns["front"][int(np.argmax(rows))])
    first_s, last_s = _ends_of(run, rows)
    waking = Incident("dropout", last_s, last_s + run.interval_s, "front", optional=True)
    return with_incidents(run, Incident("flat", first_s, last_s, "front"), waking)


def draw_dropouts(rng: np.random.Generator) -> LabelledRun:
    """1 to 40 dropouts of one or two rows to 0, or to the end of the range."""
    run = _drawn(rng)
    value = float(rng.choice([0.0, RANGE_M]))
    count = int(rng.choice([1, 2, 3, 5, 10, 20, MOST_DROPOUTS]))
    for start_s, _ in _stretches(rng, run, count, (0.0, 0.0)):
        first = int(np.searchsorted(run.times, start_s))
        last = first + int(rng.integers(0, 2))
        ends = (float(run.times[first]), float(run.times[last]))
        run = with_values(run, "front", _between(run, *ends), value)
        run = with_incidents(run, Incident("dropout", *ends, "front"))
    return run


def draw_growing(rng: np.random.Generator) -> LabelledRun:
    """A list of what is seen that holds 3 to 30 items; nothing is wrong with that."""
    run = _drawn(rng)
    lengths = 16 + 13 * np.sin(run.times / rng.uniform(3, 10))
    seen = [np.round(rng.uniform(0.2, 2, int(n)), 3).tolist() for n in lengths]
    return replace(run, columns={**run.columns, "seen_m": seen})


def draw_gaps(rng: np.random.Generator) -> LabelledRun:
    """Working sensors, and no rows for 3 to 8 s, once to three times."""
    run = _drawn(rng)
    kept = np.ones(len(run.times), dtype=bool)
    for start_s, end_s in _stretches(rng, run, int(rng.integers(1, 4)), (3.0, 8.0)):
        missing = _between(run, start_s, end_s)
        first, last = (int(at) for at in np.flatnonzero(missing)[[0, -1]])
        kept &= ~missing
        ends = (float(run.times[first - 1]), float(run.times[last + 1]))
        run = with_incidents(run, Incident("gap", *ends))
    return run.kept(kept)


def draw_leaps(rng: np.random.Generator) -> LabelledRun:
    """Something lifts a driving robot to another place, 0.5 to 3 m away, once to three times."""
    interval_s = interval_of(rng, [0.032, 0.064, 0.1, 0.25])
    phases = drive_of(rng, 90.0, float(rng.uniform(0.1, 0.3)), "returning")
    noise_m = noise_of(float(rng.choice([0.0, 0.005, 0.01])), NOISE_LEVELS_M)
    run = driven(rng, phases, interval_s, noise_m)
    for start_s, _ in _stretches(rng, run, int(rng.integers(1, 4)), (0.0, 0.0)):
        first = int(np.searchsorted(run.times, start_s))
        at_s = float(run.times[first])
        away = rng.uniform(0.5, 2.0, 2) * rng.choice([-1, 1], 2)
        run = replace(moved(run, first, (float(away[0]), float(away[1]))), distance_m=None)
        run = with_incidents(run, Incident("leap", at_s, at_s))
    return run


def draw_healthy(rng: np.random.Generator) -> LabelledRun:
    """A drive without a stop whose sensors all work: there is nothing to tell."""
    interval_s = interval_of(rng, [0.032, 0.064, 0.1, 0.25])
    phases = drive_of(rng, 120.0, float(rng.uniform(0.1, 0.3)), "returning")
    noise_m = noise_of(float(rng.choice([0.0, 0.005, 0.01, 0.02])), NOISE_LEVELS_M)
    drive = driven(rng, phases, interval_s, noise_m)
    working = sensors(rng, interval_s, 120.0)
    rows = min(len(drive.times), len(working.times))
    both = {**working.columns, **drive.columns}
    columns: dict[str, Sequence[Any]] = {name: each[:rows] for name, each in both.items()}
    return LabelledRun(drive.times[:rows], columns, interval_s, (), drive.noise_m)


DRAWN: Final[dict[str, Callable[[np.random.Generator], LabelledRun]]] = {
    "missing": draw_silent,
    "late": draw_late,
    "dead": draw_dead,
    "frozen": draw_frozen,
    "dropouts": draw_dropouts,
    "growing": draw_growing,
    "gaps": draw_gaps,
    "leaps": draw_leaps,
    "healthy": draw_healthy,
}
