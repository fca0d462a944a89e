"""A sensor that is null where it cannot measure is no fault; one that goes silent is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.cases.columns import Array, Random, noise
from tests.cases.situations import Columns, Situation, recorded


def _submarine(t: Array, random: Random, *, silent: Any) -> Columns:
    depth = np.clip((t - 20) * 0.15, 0, 12) - np.clip((t - 160) * 0.15, 0, 12)
    fixes: list[Any] = [
        None if gone else {"x": 0.8 * now, "y": 0.0}
        for now, gone in zip(t.tolist(), silent.tolist(), strict=True)
    ]
    return {
        "depth_m": np.round(depth + noise(random, t, 0.02), 2),
        "prop_rpm": 220 + noise(random, t, 2),
        "gps": fixes,
    }


def _asked(interval_s: float, *, fails: bool) -> tuple[str, str]:
    def draw(t: Array, random: Random) -> Columns:
        below = (t > 22) & (t < 238)
        return _submarine(t, random, silent=(t > 60) & (t < 100) if fails else below)

    with recorded(Situation("submarine", draw, (), 240, interval_s)) as asked:
        (check,) = (each for each in asked.checked.findings if each.name == "sensors speak")
    return check.outcome, check.evidence


@pytest.mark.parametrize("interval_s", [0.05, 0.1, 0.5])
def test_a_receiver_below_the_surface_is_no_fault(interval_s: float) -> None:
    outcome, evidence = _asked(interval_s, fails=False)
    assert outcome == "pass"
    assert "while depth_m was above" in evidence


@pytest.mark.parametrize("interval_s", [0.05, 0.1, 0.5])
def test_a_receiver_that_goes_silent_at_depth_is_a_warning(interval_s: float) -> None:
    outcome, evidence = _asked(interval_s, fails=True)
    assert outcome == "warn"
    assert "gps" in evidence


@pytest.mark.parametrize(("name", "expected"), [("ball", "pass"), ("imu", "warn")])
def test_what_is_out_of_sight_is_no_device_without_a_value(name: str, expected: str) -> None:
    def draw(t: Array, random: Random) -> Columns:
        seen = (t % 10 > 3.5) | (t < 10)
        reading = noise(random, t, 0.1).tolist()
        values: list[Any] = [
            {"bearing_rad": each} if is_seen else None
            for each, is_seen in zip(reading, seen.tolist(), strict=True)
        ]
        return {"x": 0.1 * t, "y": 0 * t, name: values}

    with recorded(Situation(f"sees a {name}", draw, (), 60, 0.05)) as asked:
        (check,) = (each for each in asked.checked.findings if each.name == "sensors speak")
    assert check.outcome == expected


@pytest.mark.slow
def test_hardly_a_silence_at_a_random_moment_is_explained() -> None:
    dice = np.random.default_rng(3)
    explained = 0
    for number in range(30):
        start_s = float(dice.uniform(30, 150))
        end_s = start_s + float(dice.uniform(5, 60))

        def draw(t: Array, random: Random) -> Columns:
            return _submarine(t, random, silent=(t > start_s) & (t < end_s))  # noqa: B023

        with recorded(Situation(f"silence {number}", draw, (), 240, 0.2)) as asked:
            explained += not asked.checked.of("warn", "fail")
    assert explained <= 2
