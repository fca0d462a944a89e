"""A target that keeps moving is judged by how it is followed, at any rate and with any lag."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.cases.columns import TURN, Array, Random, chosen, noise
from tests.cases.situations import Columns, Situation, recorded

_LASTS_S = 60.0


def _hexapod(t: Array, random: Random, *, limp: bool, lag_s: float, gain: float) -> Columns:
    columns: dict[str, Any] = {"x": 0.05 * t, "y": 0 * t}
    for leg in range(6):
        phase = TURN * 0.5 * t + np.pi * (leg % 2)
        follows = 0.35 * gain * np.sin(phase - TURN * 0.5 * lag_s)
        hangs = limp & (leg == 4) & (t > 30)
        columns[f"leg{leg}.hip_target"] = 0.35 * np.sin(phase)
        columns[f"leg{leg}.hip_pos"] = np.where(hangs, -0.2, follows) + noise(random, t, 0.002)
    return columns


@pytest.mark.slow
@pytest.mark.parametrize("interval_s", [0.008, 0.02, 0.1, 0.25])
@pytest.mark.parametrize(("lag_s", "gain"), [(0.0, 1.0), (0.3, 0.7)])
def test_a_leg_that_goes_limp_is_found_whatever_its_lag(
    interval_s: float, lag_s: float, gain: float
) -> None:
    def draw(t: Array, random: Random) -> Columns:
        return _hexapod(t, random, limp=True, lag_s=lag_s, gain=gain)

    with recorded(Situation("limp leg", draw, (), _LASTS_S, interval_s)) as asked:
        (found,) = asked.events("off_target").events
        (check,) = (e for e in asked.checked.findings if e.name == "follows its targets")
    assert found.name == "leg4.hip_pos"
    assert found.start_s == pytest.approx(30, abs=1.5)
    assert found.end_s == pytest.approx(60, abs=1.5)
    assert "0 % of the motion of its target" in found.details["says"]
    assert check.outcome == "fail"


@pytest.mark.slow
@pytest.mark.parametrize("interval_s", [0.008, 0.02, 0.1, 0.25])
@pytest.mark.parametrize(("lag_s", "gain"), [(0.0, 1.0), (0.3, 0.7), (0.9, 0.4)])
def test_a_healthy_hexapod_follows(interval_s: float, lag_s: float, gain: float) -> None:
    def draw(t: Array, random: Random) -> Columns:
        return _hexapod(t, random, limp=False, lag_s=lag_s, gain=gain)

    with recorded(Situation("healthy legs", draw, (), _LASTS_S, interval_s)) as asked:
        assert asked.events("off_target").events == ()
        (check,) = (e for e in asked.checked.findings if e.name == "follows its targets")
    assert check.outcome == "pass"


def test_a_servo_that_follows_slow_motion_only_is_not_off_its_target() -> None:
    def draw(t: Array, random: Random) -> Columns:
        rate_hz = np.where(t < 40, 0.3, 3.0)
        phase = TURN * np.cumsum(rate_hz) * t[0]
        share = np.where(t < 40, 0.95, 0.3)
        return {
            "elbow.target": 0.3 * np.sin(phase),
            "elbow.position": 0.3 * share * np.sin(phase - 0.2) + noise(random, t, 0.002),
        }

    with recorded(Situation("slow servo", draw, (), _LASTS_S, 0.02)) as asked:
        assert asked.events("off_target").events == ()


def test_what_never_follows_its_moving_target_is_not_searched() -> None:
    def draw(t: Array, random: Random) -> Columns:
        return {
            "elbow.target": 0.3 * np.sin(TURN * t / 2),
            "elbow.position": 0.1 + noise(random, t, 0.002),
        }

    with recorded(Situation("never follows", draw, (), _LASTS_S, 0.02)) as asked:
        verdicts = asked.events("off_target").verdicts
        (check,) = (e for e in asked.checked.findings if e.name == "follows its targets")
    assert any("elbow.position" in each for each in verdicts.reasons["off_target"])
    assert check.outcome == "not judged"


def _arm(t: Array, random: Random, *, sags: tuple[str, ...], mode: str) -> Columns:
    away = (t >= 20) & (t < 40)
    columns: dict[str, Any] = {}
    for at, joint in enumerate(("shoulder", "elbow", "wrist")):
        planned = 0.6 * np.sin(TURN * t / 12 + at)
        target = np.where(away, planned[t < 20][-1], planned)
        sag = (joint in sags) * away * 0.5 * np.sin(np.pi * (t - 20) / 20)
        columns[f"{joint}.target"] = target
        columns[f"{joint}.position"] = target + sag + noise(random, t, 3e-4)
    columns["mode"] = chosen((away, mode), otherwise="running")
    return columns


@pytest.mark.parametrize(
    ("sags", "mode", "expected"),
    [
        (("shoulder", "elbow", "wrist"), "freedrive", "not judged"),
        (("elbow",), "hold", "fail"),  # one brake that slips is no limp mode
        (("shoulder", "elbow", "wrist"), "running", "fail"),  # no mode of its own
    ],
)
def test_limp_drives_of_a_mode_are_told_from_a_joint_that_sags(
    sags: tuple[str, ...], mode: str, expected: str
) -> None:
    def draw(t: Array, random: Random) -> Columns:
        return _arm(t, random, sags=sags, mode=mode)

    with recorded(Situation(f"arm in {mode}", draw, (), _LASTS_S, 0.032)) as asked:
        (check,) = (e for e in asked.checked.findings if e.name == "follows its targets")
        events = asked.events("off_target").events
    assert check.outcome == expected
    assert bool(events) is (expected == "fail")
