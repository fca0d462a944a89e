"""Robots unlike a rover: what is normal for them is no fault, and their faults are not denied."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable
from random import Random
from typing import Any

import pytest

from tests.recordings.rover import start_run
from webots_mcp.judging.checks.check_run import check_run
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Events, find_events
from webots_mcp.signals.meaning import meanings_by_name, targets_in
from webots_mcp.signals.naming import REDUCTIONS
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range

State = Callable[[float], dict[str, Any]]


def record(empty: sqlite3.Connection, state: State, until_s: float, step_s: float) -> None:
    recorder = start_run(empty)
    empty.execute("BEGIN")
    for step in range(1, round(until_s / step_s) + 1):
        recorder.publish(round(step * step_s, 6), state(round(step * step_s, 6)))
    empty.execute("COMMIT")
    make_chunks(empty, 1_000_000)


def ask(empty: sqlite3.Connection, kind: str) -> Events:
    return find_events(empty, find_range(empty, Scope(run_id=1)), EventOptions(kinds=(kind,)))


def outcome(empty: sqlite3.Connection, name: str) -> str:
    return next(each.outcome for each in check_run(empty, 1).findings if each.name == name)


def test_a_target_is_of_the_joint_with_the_same_number() -> None:
    names = [f"leg{leg}.{what}" for leg in range(3) for what in ("hip_pos", "hip_target")]
    names += [f"joint_{joint}_{what}_rad" for joint in (1, 2) for what in ("actual", "target")]
    found = targets_in(meanings_by_name(dict.fromkeys(names, "num"), {}))
    assert sorted(found) == [
        ("joint_1_actual_rad", "joint_1_target_rad"),
        ("joint_2_actual_rad", "joint_2_target_rad"),
        ("leg0.hip_pos", "leg0.hip_target"),
        ("leg1.hip_pos", "leg1.hip_target"),
        ("leg2.hip_pos", "leg2.hip_target"),
    ]


def test_what_sums_up_an_array_is_measured_or_a_count_and_no_limit() -> None:
    kinds = dict.fromkeys([f"lidar.{each}" for each in REDUCTIONS], "num")
    found = {name: each.words for name, each in meanings_by_name(kinds, {}).items()}
    measured = "measured distance"
    assert [found[f"lidar.{each}"] for each in ("min", "max", "mean")] == [measured] * 3
    assert [found[f"lidar.{each}"] for each in ("count", "argmin")] == ["measured count"] * 2
    assert meanings_by_name({"torque.max": "num"}, {})["torque.max"].role == "limit"


def test_a_heading_is_known_whoever_measures_it_but_not_its_error() -> None:
    names = ("compass_heading_deg", "gyro_heading_deg", "heading_error_deg")
    found = meanings_by_name(dict.fromkeys(names, "num"), {})
    assert [found[name].quantity for name in names] == ["heading", "heading", None]


def test_a_turn_in_place_just_shorter_than_a_standstill_is_not_stuck(
    empty: sqlite3.Connection,
) -> None:
    def explores(time_s: float) -> dict[str, Any]:
        lap, u = divmod(time_s, 12.0)
        turned = 1.5 * max(0.0, u - 9.07)
        left, right = (3.0, 3.0) if u < 9.07 else (-2.0, 2.0)
        return {
            "x": 0.1 * (9.07 * lap + min(u, 9.07)),
            "y": 0.0,
            "theta": math.remainder(turned + 4.395 * lap, math.tau),
            "left_speed": left,
            "right_speed": right,
        }

    record(empty, explores, 60.0, 0.064)
    assert not ask(empty, "stuck").events


def test_a_height_that_never_comes_to_its_target_is_off_it(empty: sqlite3.Connection) -> None:
    random = Random(1)

    def climbs(time_s: float) -> dict[str, Any]:
        height = min(3.1, 0.8 * time_s) + random.gauss(0, 0.03)
        return {"altitude_m": height, "altitude_setpoint_m": 5.0}

    record(empty, climbs, 60.0, 0.05)
    (event,) = ask(empty, "off_target").events
    assert event.start_s < 6 < 59 < event.end_s


def test_a_height_that_waits_and_then_comes_to_its_target_is_not_off_it(
    empty: sqlite3.Connection,
) -> None:
    def waits(time_s: float) -> dict[str, Any]:
        return {"lift_height_m": min(3.0, max(0.0, time_s - 40)), "lift_height_target_m": 3.0}

    record(empty, waits, 60.0, 0.05)
    assert not ask(empty, "off_target").events


def test_a_target_in_degrees_is_compared_with_what_follows_in_radians(
    empty: sqlite3.Connection,
) -> None:
    def follows(time_s: float) -> dict[str, Any]:
        angle = math.sin(0.3 * time_s)
        return {"elbow_actual_rad": angle, "elbow_target_deg": math.degrees(angle)}

    record(empty, follows, 40.0, 0.05)
    assert outcome(empty, "follows its targets") == "pass"


def test_noise_of_a_gyro_that_grew_is_never_denied(empty: sqlite3.Connection) -> None:
    random = Random(2)

    def shakes(time_s: float) -> dict[str, Any]:
        return {"imu": {"gyro": [random.gauss(0, 0.004 if time_s < 30 else 0.06)] * 3}}

    record(empty, shakes, 60.0, 0.02)
    assert "degradation" not in ask(empty, "degradation").verdicts.not_found
    assert outcome(empty, "sensors keep their noise") == "not judged"


@pytest.mark.slow
def test_postures_of_a_joint_and_stops_of_a_lift_are_no_faults(
    empty: sqlite3.Connection,
) -> None:
    def moves(time_s: float) -> dict[str, Any]:
        u, stop = time_s % 0.6, time_s % 60
        height = round(min(4.0, 0.4 * stop) if time_s % 120 < 60 else max(0.0, 4 - 0.4 * stop), 3)
        return {
            "knee_deg": 60 + 35 * max(0.0, math.sin(math.pi * u / 0.25) if u < 0.25 else 0.0),
            "cabin": {"height_m": height, "speed": 0.0 if stop > 10 else 0.4},
        }

    record(empty, moves, 240.0, 0.02)
    assert outcome(empty, "sensors within limits") == "pass"
    assert outcome(empty, "sensors live") == "pass"


def test_a_signal_that_swings_in_between_did_not_drop_out(empty: sqlite3.Connection) -> None:
    random = Random(3)

    def steers(time_s: float) -> dict[str, Any]:
        swings = 20 * math.cos(5 * (time_s - 40)) if 40 <= time_s < 75 else random.gauss(0, 0.2)
        return {"steering_deg": swings, "x": 0.4 * time_s, "y": 0.0}

    record(empty, steers, 100.0, 0.032)
    assert outcome(empty, "sensors drop nothing") == "pass"
