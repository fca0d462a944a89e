"""What the generator says happened is what stands in the rows."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from tests.detection.drawing import KINDS, draw_case
from tests.detection.driving import drive_of, driven, held, phase
from tests.detection.labelled import Incident, LabelledRun, cut_at, repeated
from tests.detection.sensing import draw_dead, draw_leaps, draw_silent
from tests.detection.swinging import DRAWN as SWINGS

SEEDS = range(4)


def drawn(draw: Any, seed: int) -> LabelledRun:
    return draw(np.random.default_rng(seed))


def places(run: LabelledRun) -> list[tuple[float, float]]:
    name = next(each for each in ("pose", "position", "gps", "odom") if each in run.columns)
    values: Any = run.columns[name]
    if isinstance(values[0], dict):
        return [(value["x"], value["y"]) for value in values]
    return [(value[0], value[1]) for value in values]


def steps_m(run: LabelledRun) -> list[float]:
    return [math.dist(before, after) for before, after in pairwise(places(run))]


def of(run: LabelledRun, measure: str) -> list[Incident]:
    return [each for each in run.incidents if each.measure == measure]


def is_without_noise(run: LabelledRun) -> bool:
    """Whether the value rests before it begins to swing."""
    return len(set(run.columns[str(run.incidents[0].name)][:5])) == 1


def holds(incident: Incident, time_s: float) -> bool:
    return incident.start_s <= time_s <= incident.end_s


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_draws_the_same_case(kind: str) -> None:
    first, again = (draw_case(kind, 3, 1, most_values=20_000) for _ in range(2))
    assert repr(first.runs[-1].columns) == repr(again.runs[-1].columns)
    assert [run.incidents for run in first.runs] == [run.incidents for run in again.runs]
    other = draw_case(kind, 4, 1, most_values=20_000)
    assert repr(other.runs[-1].columns) != repr(first.runs[-1].columns)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_robot_without_noise_moves_except_where_it_stands(seed: int) -> None:
    rng = np.random.default_rng(seed)
    phases = [*drive_of(rng, 10, 0.2, "a"), phase(6, 0, "b"), *drive_of(rng, 5, 0.2, "a")]
    run = driven(rng, [*phases, held(7, 0.2, "a"), phase(4, 0, "b", 1.0)], 0.1, 0.0, "wheels")
    stood, stuck, turned = of(run, "standstill")
    assert (stuck.start_s, stuck.end_s) == pytest.approx((21.0, 28.0))
    assert turned.optional and of(run, "stuck") == [replace(stuck, measure="stuck")]
    ends = [end_s for each in (stood, stuck, turned) for end_s in (each.start_s, each.end_s)]
    for time_s, step_m in zip(run.times[1:].tolist(), steps_m(run), strict=True):
        if all(abs(time_s - end_s) > 0.15 for end_s in ends):
            at_rest = any(holds(each, time_s) for each in (stood, stuck, turned))
            assert (step_m == 0) == at_rest


@pytest.mark.parametrize("seed", SEEDS)
def test_a_sensor_has_no_value_exactly_while_it_is_silent(seed: int) -> None:
    for run in (drawn(draw_silent, seed), drawn(draw_dead, seed)):
        silent = of(run, "missing")
        for name in {each.name for each in silent}:
            for time_s, value in zip(run.times.tolist(), run.columns[str(name)], strict=True):
                missing = value is None or (isinstance(value, float) and math.isnan(value))
                assert missing == any(holds(each, time_s) for each in silent)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("copies", [1, 3])
def test_leaps_are_the_only_long_steps_also_where_a_run_is_repeated(seed: int, copies: int) -> None:
    run = drawn(draw_leaps, seed)
    run = repeated(run, copies * len(run.times))
    found = zip(run.times[1:].tolist(), steps_m(run), strict=True)
    assert [time_s for time_s, step_m in found if step_m > 0.3] == pytest.approx(
        [each.start_s for each in of(run, "leap")]
    )


def test_what_a_reset_cut_off_may_be_told_or_not() -> None:
    run = drawn(draw_dead, 1)
    (dead,) = run.incidents
    assert cut_at(run, dead.start_s - 1).incidents == ()
    (cut,) = cut_at(run, dead.start_s + 5).incidents
    assert cut.optional and cut.end_s == dead.start_s + 5


@pytest.mark.parametrize("seed", SEEDS)
def test_a_swing_reaches_as_far_and_as_often_as_it_is_said_to(seed: int) -> None:
    runs = (drawn(SWINGS["swing_constant"], 1000 * seed + number) for number in range(200))
    run = next(each for each in runs if is_without_noise(each))
    (swing,) = run.incidents
    values = run.columns[str(swing.name)]
    pairs = zip(run.times.tolist(), values, strict=True)
    about = np.array([value - values[0] for time_s, value in pairs if holds(swing, time_s)])
    assert swing.period_s and swing.amplitude
    assert np.abs(about).max() == pytest.approx(swing.amplitude, rel=0.07)
    halves = (swing.end_s - swing.start_s) / (swing.period_s / 2)
    assert halves == pytest.approx(round(halves)) and 6 <= round(halves) <= 30
    crossings = int(np.count_nonzero(np.diff(about[1:-1] > 0)))
    assert abs(crossings - (round(halves) - 1)) <= 1
