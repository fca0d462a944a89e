"""Oscillations of what hangs, turns or flies are searched; one push is not taken for growth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.cases.columns import TURN, Array, Random, noise
from tests.cases.situations import Columns, Situation, recorded


def _crane(t: Array, random: Random, size_rad: Any, name: str = "sway_deg") -> Columns:
    sway = np.degrees(size_rad * np.sin(1.3 * t))
    return {
        "crane_x": 0.1 * t,
        "hoist_m": 5 + 0 * t,
        name: sway + noise(random, t, 0.02),
        "cmd": 0 * t + 0.1,
    }


@pytest.mark.parametrize("interval_s", [0.016, 0.04, 0.2])
@pytest.mark.parametrize("name", ["sway_deg", "load.swing_angle_deg", "hook.deviation_deg"])
def test_growing_sway_of_a_load_is_found(interval_s: float, name: str) -> None:
    def draw(t: Array, random: Random) -> Columns:
        return _crane(t, random, 0.01 * np.exp(np.maximum(0, t - 20) / 30), name)

    with recorded(Situation("growing sway", draw, (), 120, interval_s)) as asked:
        (check,) = (each for each in asked.checked.findings if each.name == "stays stable")
        events = asked.events("oscillation").events
    assert [each.name for each in events] == [name]
    assert check.outcome == "warn"
    assert check.since_s == pytest.approx(20, abs=6)


@pytest.mark.parametrize("interval_s", [0.016, 0.04, 0.2])
@pytest.mark.parametrize("kind", ["steady", "decays", "pushed once"])
def test_sway_that_does_not_grow_is_no_warning(interval_s: float, kind: str) -> None:
    def draw(t: Array, random: Random) -> Columns:
        sizes = {
            "steady": 0.05 + 0 * t,
            "decays": 0.1 * np.exp(-t / 40),
            "pushed once": 0.03 + 0.05 * (t > 15),
        }
        return _crane(t, random, sizes[kind])

    with recorded(Situation(kind, draw, (), 120, interval_s)) as asked:
        (check,) = (each for each in asked.checked.findings if each.name == "stays stable")
    assert check.outcome == "pass"


def test_a_gait_that_becomes_larger_as_commanded_is_no_warning() -> None:
    def draw(t: Array, random: Random) -> Columns:
        aim = (0.05 + 0.01 * t) * np.sin(TURN * t)
        return {
            "hip.target_position": aim,
            "hip.position": np.interp(t - 0.04, t, aim) + noise(random, t, 0.002),
        }

    with recorded(Situation("larger steps", draw, (), 40, 0.016)) as asked:
        (check,) = (each for each in asked.checked.findings if each.name == "stays stable")
    assert check.outcome == "pass"


@pytest.mark.parametrize("interval_s", [0.032, 0.1])
@pytest.mark.parametrize(("doubles_s", "outcome"), [(12.0, "warn"), (np.inf, "pass")])
def test_a_height_that_swings_more_and_more_is_found_though_the_target_ends_with_a_landing(
    interval_s: float, doubles_s: float, outcome: str
) -> None:
    def draw(t: Array, random: Random) -> Columns:
        aim = np.clip(3 - 0.4 * np.maximum(t - 70, 0), 0.1, 3)
        size = 0.05 * 2 ** (np.clip(t - 25, 0, 45) / doubles_s)
        swing = size * np.sin(TURN * t / 2.4) * (t < 70)
        return {"altitude_m": aim + swing + noise(random, t, 0.01), "altitude_target_m": aim}

    with recorded(Situation("growing height", draw, (), 80, interval_s)) as asked:
        (check,) = (each for each in asked.checked.findings if each.name == "stays stable")
    assert check.outcome == outcome


@pytest.mark.slow
def test_of_steady_oscillations_hardly_one_is_said_to_grow() -> None:
    told = 0
    for number in range(40):

        def draw(t: Array, random: Random) -> Columns:
            swing = np.sin(TURN * t / random.uniform(1.5, 4))
            return {"roll": 0.1 * swing + noise(random, t, 0.02)}

        with recorded(Situation(f"steady {number}", draw, (), 60, 0.05)) as asked:
            told += any(each.name == "stays stable" for each in asked.checked.of("warn"))
    assert told == 0
