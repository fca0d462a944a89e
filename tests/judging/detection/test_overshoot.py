"""A target that is passed by a quarter of its step or more is an event, however short that is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.cases.columns import Array, Random, noise
from tests.cases.situations import Columns, Recording, Situation, recorded

_STEP_S = 0.002


def _second_order(t: Array, aims: Array, damping: float, turns_rad_s: float) -> Array:
    """What follows a target as a mass on a damped spring does."""
    at, speed = float(aims[0]), 0.0
    moments = np.arange(0.0, float(t[-1]) + _STEP_S, _STEP_S)
    course = np.empty(len(moments))
    for row, aim in enumerate(np.interp(moments, t, aims).tolist()):
        speed += (turns_rad_s**2 * (aim - at) - 2 * damping * turns_rad_s * speed) * _STEP_S
        at += speed * _STEP_S
        course[row] = at
    return np.interp(t, moments, course)


def _ask(
    damping: float, interval_s: float, noise_rad: float = 0.002, turns_rad_s: float = 6.0
) -> Recording:
    def draw(t: Array, random: Random) -> Columns:
        aims = np.where(t % 16 < 8, 0.4, 1.5)
        # From 40 s on it is damped less.
        healthy = _second_order(t, aims, 0.9, turns_rad_s)
        less = _second_order(t, aims, damping, turns_rad_s)
        return {
            "elbow.target": aims,
            "elbow.position": np.where(t < 36, healthy, less) + noise(random, t, noise_rad),
        }

    with recorded(Situation("arm", draw, (), 80, interval_s)) as asked:
        asked.events("off_target")
        assert asked.checked
        return asked


@pytest.mark.parametrize("interval_s", [0.008, 0.032, 0.1])
@pytest.mark.parametrize("noise_rad", [0.0, 0.002, 0.02])
def test_short_overshoots_are_found_each_with_its_share(
    interval_s: float, noise_rad: float
) -> None:
    damping = 0.3
    share = math.exp(-math.pi * damping / math.sqrt(1 - damping**2))  # 37 %
    asked = _ask(damping, interval_s, noise_rad)
    events = asked.events("off_target").events
    assert [round(each.start_s / 8) for each in events] == [5, 6, 7, 8, 9]
    for each in events:
        assert each.details["overshoot_percent"] == pytest.approx(100 * share, abs=6)
        assert each.duration_s < 3
    (check,) = (each for each in asked.checked.findings if each.name == "follows its targets")
    assert check.outcome == "warn"
    assert "overshot 5 times" in check.evidence


@pytest.mark.parametrize("interval_s", [0.008, 0.032, 0.1, 0.5])
@pytest.mark.parametrize("damping", [0.5, 0.7, 1.5])
def test_what_is_damped_well_does_not_overshoot(interval_s: float, damping: float) -> None:
    asked = _ask(damping, interval_s, 0.02)
    assert asked.events("off_target").events == ()
    (check,) = (each for each in asked.checked.findings if each.name == "follows its targets")
    assert check.outcome == "pass"


def test_an_oscillation_long_after_a_step_is_no_overshoot() -> None:
    def draw(t: Array, random: Random) -> Columns:
        aims = np.where(t < 10, 0.0, 1.0)
        sway = np.where(t > 30, 0.4 * np.sin(math.tau * t / 2.4), 0.0)
        return {
            "alt_ref_m": aims,
            "alt_m": _second_order(t, aims, 0.9, 3.0) + sway + noise(random, t, 0.005),
        }

    with recorded(Situation("drone", draw, (), 60, 0.04)) as asked:
        assert asked.events("off_target").events == ()
