"""A side of a robot that slips is named, at any rate of rows, and curves are no slip."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from tests.cases.columns import Array, Random, noise, wrapped
from tests.cases.situations import Columns, Recording, Situation, recorded

_STEP_S = 0.01
_RADIUS_M, _TRACK_M = 0.04, 0.3
_LASTS_S = 100.0
_SLIPS_S = (52.5, 60.5)
Wheels = Callable[[float], tuple[float, float]]


def _rounds(time_s: float) -> tuple[float, float]:
    """Straight ahead, a turn on the spot, a curve, and back: wheel speeds in rad/s."""
    at_s = time_s % 25.0
    if at_s < 12:
        return 5.0, 5.0
    if at_s < 15:
        return -1.8, 1.8
    if at_s < 22:
        return 3.0, 5.5
    return (0.0, 0.0) if at_s < 23 else (-3.0, -3.0)


def _spins(time_s: float) -> tuple[float, float]:
    return (4.0, 4.0) if time_s % 20 < 10 else (-2.5, 2.5)


@cache
def _driven(
    lasts_s: float,
    wheels: Wheels,
    grip: Callable[[float], tuple[float, float]],
    radii: tuple[float, float],
    track_m: float,
    *,
    steers_back: bool,
) -> Array:
    """Integrate where wheels take a robot: its place, heading and wheel speeds in each step."""
    x = y = yaw = 0.0
    wanted = 0.0
    rows: list[tuple[float, ...]] = []
    for at in range(round(lasts_s / _STEP_S) + 1):
        time_s = at * _STEP_S
        left, right = wheels(time_s)
        wanted += _RADIUS_M * (right - left) / _TRACK_M * _STEP_S
        if steers_back:  # as a controller does that holds its heading
            error = math.remainder(wanted - yaw, math.tau)
            correction = min(3.0, max(-3.0, 6.0 * error))
            left, right = left - correction, right + correction
        on_left, on_right = grip(time_s)
        rolled = left * on_left * radii[0], right * on_right * radii[1]
        yaw += (rolled[1] - rolled[0]) / track_m * _STEP_S
        x += (rolled[0] + rolled[1]) / 2 * math.cos(yaw) * _STEP_S
        y += (rolled[0] + rolled[1]) / 2 * math.sin(yaw) * _STEP_S
        rows.append((x, y, yaw, left, right))
    return np.array(rows)


def _grips(_time_s: float) -> tuple[float, float]:
    return 1.0, 1.0


def _drive(
    t: Array,
    random: Random,
    wheels: Wheels,
    *,
    grip: Callable[[float], tuple[float, float]] = _grips,
    steers_back: bool = False,
    radii: tuple[float, float] = (_RADIUS_M, _RADIUS_M),
    track_m: float = _TRACK_M,
    beside_m: float = 0.0,
    heading: str | None = "rad",
    names: tuple[str, ...] = ("left_wheel_speed", "right_wheel_speed"),
) -> Columns:
    """Return what a robot records; each side rolls its share of what its wheels turn."""
    rows = _driven(float(t[-1]), wheels, grip, radii, track_m, steers_back=steers_back)
    moments = np.arange(len(rows)) * _STEP_S
    x = rows[:, 0] - beside_m * np.sin(rows[:, 2])
    y = rows[:, 1] + beside_m * np.cos(rows[:, 2])
    curves: list[Array] = [x, y, rows[:, 2], rows[:, 3], rows[:, 4]]
    px, py, course, on_left, on_right = (np.interp(t, moments, column) for column in curves)
    columns: dict[str, Any] = {
        "gps.x": px + noise(random, t, 0.003),
        "gps.y": py + noise(random, t, 0.003),
    }
    for name in names:
        turns = on_left if "left" in name else on_right
        columns[name] = turns + noise(random, t, 0.03)
    if heading == "rad":
        columns["imu.yaw"] = wrapped(course + noise(random, t, 0.004))
    elif heading == "compass":
        columns["compass_heading_deg"] = np.degrees(1.0 - course) % 360
    return columns


@cache  # the same side slips at several rates
def _slips(side: str, share: float) -> Callable[[float], tuple[float, float]]:
    def grip(time_s: float) -> tuple[float, float]:
        here = share if _SLIPS_S[0] <= time_s < _SLIPS_S[1] else 1.0
        return (here, 1.0) if side == "left" else (1.0, here)

    return grip


def _ask(draw: Callable[[Array, Random], Columns], interval_s: float) -> Recording:
    with recorded(Situation("wheels", draw, (), _LASTS_S, interval_s)) as asked:
        asked.events("slip")
        assert asked.checked
        return asked


def _sides(asked: Recording) -> list[str | None]:
    return [each.details.get("side") for each in asked.events("slip").events]


@pytest.mark.parametrize("interval_s", [0.016, 0.05, 0.2])
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(("share", "heading"), [(0.0, "rad"), (0.35, "rad"), (0.2, "compass")])
def test_the_side_that_slips_is_named_with_its_times(
    interval_s: float, side: str, share: float, heading: str
) -> None:
    def draw(t: Array, random: Random) -> Columns:
        grip = _slips(side, share)
        return _drive(t, random, _rounds, grip=grip, steers_back=True, heading=heading)

    asked = _ask(draw, interval_s)
    (found,) = asked.events("slip").events
    assert found.details["side"] == side
    assert found.start_s == pytest.approx(_SLIPS_S[0], abs=1.5)
    assert found.end_s == pytest.approx(_SLIPS_S[1], abs=1.5)
    (check,) = (each for each in asked.checked.findings if each.name == "wheels grip")
    assert check.outcome == "fail"
    assert f"the {side} side slipped" in check.evidence


@pytest.mark.parametrize("name", ["imu.yaw", "gps.x", "left_wheel_speed"])
def test_rows_without_a_value_of_one_sensor_hide_no_slip(name: str) -> None:
    def draw(t: Array, random: Random) -> Columns:
        columns = _drive(t, random, _rounds, grip=_slips("left", 0.2), steers_back=True)
        values = np.array(columns[name])
        values[0] = math.nan  # a sensor has no value in the step in which it is enabled
        values[5::40] = math.nan
        return {**columns, name: values}

    (found,) = _ask(draw, 0.05).events("slip").events
    assert found.details["side"] == "left"
    assert found.start_s == pytest.approx(_SLIPS_S[0], abs=1.5)
    assert found.end_s == pytest.approx(_SLIPS_S[1], abs=1.5)


@pytest.mark.slow
@pytest.mark.parametrize("interval_s", [0.016, 0.05, 0.2])
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"steers_back": True},
        {"track_m": 1.6 * _TRACK_M},  # skid steering: it turns less than its wheels suggest
        {"radii": (_RADIUS_M, 1.15 * _RADIUS_M)},
        {"heading": "compass"},
        {"beside_m": 0.12},  # its receiver is not above the axle
        {
            "names": (
                "front_left_wheel_speed", "rear_left_wheel_speed",
                "front_right_wheel_speed", "rear_right_wheel_speed",
            )
        },
    ],
)  # fmt: skip
def test_curves_and_turns_in_place_are_no_slip(how: dict[str, Any], interval_s: float) -> None:
    for wheels in (_rounds, _spins):

        def draw(t: Array, random: Random, wheels: Wheels = wheels) -> Columns:
            return _drive(t, random, wheels, **how)

        asked = _ask(draw, interval_s)
        assert _sides(asked) == []
        (check,) = (each for each in asked.checked.findings if each.name == "wheels grip")
        assert check.outcome == "pass", check.evidence


def test_without_a_heading_no_side_is_searched() -> None:
    def draw(t: Array, random: Random) -> Columns:
        return _drive(t, random, _rounds, heading=None)

    reasons = _ask(draw, 0.05).events("slip").verdicts.reasons["slip"]
    assert reasons == ("not by side: no heading is recorded",)


def test_a_robot_that_goes_sideways_is_not_searched_by_side() -> None:
    def draw(t: Array, random: Random) -> Columns:
        drives = _drive(t, random, _rounds)
        return {**drives, "gps.y": drives["gps.y"] + 0.15 * t}  # as on a conveyor

    asked = _ask(draw, 0.05)
    assert not {"left", "right"}.intersection(_sides(asked))
    assert any("not by side" in each for each in asked.events("slip").verdicts.reasons["slip"])


@pytest.mark.parametrize("sense", [1, -1])
def test_a_side_that_slips_while_both_turn_alike_is_named_forward_and_back(sense: int) -> None:
    def draw(t: Array, random: Random) -> Columns:
        grip = _slips("left", 0.6)
        return _drive(t, random, lambda time_s: (5.0 * sense, 5.0 * sense), grip=grip)

    (found,) = _ask(draw, 0.05).events("slip").events
    assert found.details["side"] == "left"
    assert found.start_s == pytest.approx(_SLIPS_S[0], abs=1.5)
    assert found.end_s == pytest.approx(_SLIPS_S[1], abs=1.5)


def test_both_sides_that_slip_are_one_slip_without_a_side() -> None:
    def grip(time_s: float) -> tuple[float, float]:
        share = 0.1 if _SLIPS_S[0] <= time_s < _SLIPS_S[1] else 1.0
        return share, share

    def draw(t: Array, random: Random) -> Columns:
        return _drive(t, random, _rounds, grip=grip)

    assert _sides(_ask(draw, 0.05)) == [None]
