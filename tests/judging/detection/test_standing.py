"""Who stands still, and what shows, or speaks against it, that it should have moved."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.recordings.rover import start_run
from webots_mcp.judging.checks.check_run import check_run
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Events, find_events
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range

OPTIONS = EventOptions(kinds=("standstill", "stuck"))


def ask(
    connection: sqlite3.Connection,
    state: Callable[[float], dict[str, Any]],
    interval_s: float = 0.1,
    seconds: float = 60.0,
) -> Events:
    """What is told of so many seconds with a row at each interval."""
    recorder = start_run(connection)
    connection.execute("BEGIN")
    for step in range(round(seconds / interval_s)):
        recorder.publish(round(step * interval_s, 6), state(step * interval_s))
    connection.execute("COMMIT")
    make_chunks(connection, 100_000)
    return find_events(connection, find_range(connection, Scope()), OPTIONS)


def flight(time_s: float) -> dict[str, Any]:
    """Climbs for 10 s, hovers for 10 s, flies for 10 s, sinks."""
    height_m = min(5.0, 0.5 * time_s) - max(0.0, 0.1 * (time_s - 30))
    x_m = 0.5 * min(10.0, max(0.0, time_s - 20))
    return {"pose": {"x": x_m, "y": 0.0, "z": height_m}, "mode": "fly"}


def test_a_drone_that_climbs_or_sinks_does_not_stand_still(
    empty: sqlite3.Connection,
) -> None:
    (hovers,) = ask(empty, flight).events
    assert (hovers.start_s, hovers.end_s) == pytest.approx((10.0, 20.0), abs=0.3)


def test_a_drone_that_hovers_with_noise_and_a_little_drift_in_its_height_stands(
    empty: sqlite3.Connection,
) -> None:
    noise = np.random.default_rng(1).normal(0, 0.01, 600)

    def hovering(time_s: float) -> dict[str, Any]:
        return {"gps": [0.0, 0.0, 1.0 + 0.04 * time_s / 60 + noise[round(10 * time_s)]]}

    (hovers,) = ask(empty, hovering).events
    assert (hovers.kind, hovers.start_s) == ("standstill", 0.0)
    assert hovers.end_s == pytest.approx(60.0, abs=0.2)


def test_who_only_climbs_is_said_to_have_climbed(empty: sqlite3.Connection) -> None:
    found = ask(empty, lambda time_s: {"gps": [0.0, 0.0, 0.5 * time_s]})
    assert found.verdicts.not_found["standstill"].endswith(
        "but its height changed; 3 s within 0.05 m count"
    )


@pytest.mark.parametrize("turns", [0.2, 5.0])  # beyond half a turn it is counted on
@pytest.mark.parametrize("name", ["odom", "odometry", "robotPose", "pose"])
def test_the_third_of_odometry_is_where_it_looks_and_no_height(
    empty: sqlite3.Connection, name: str, turns: float
) -> None:
    def turning(time_s: float) -> dict[str, Any]:
        heading = turns * math.sin(math.tau * time_s / 20)
        return {name: [0.2 * min(time_s, 30.0), 0.0, heading]}

    (still,) = ask(empty, turning).events
    assert (still.start_s, still.end_s) == pytest.approx((29.9, 59.9), abs=0.2)


@pytest.mark.parametrize("name", ["altitude", "altitudeM", "alt_m"])
def test_an_altitude_is_a_height(empty: sqlite3.Connection, name: str) -> None:
    def climbs(time_s: float) -> dict[str, Any]:
        place = {"x": max(0.0, time_s - 30), "y": 0.0, name: 0.5 * min(30.0, time_s)}
        return {"position": place, "mode": "fly"}

    found = ask(empty, climbs)
    assert not found.events
    assert found.verdicts.not_found["stuck"].endswith(
        "but its height changed; 3 s within 0.05 m count"
    )


def test_a_slow_drift_in_much_noise_is_not_called_a_standstill(empty: sqlite3.Connection) -> None:
    random = np.random.default_rng(7)

    def drifts_then_runs_aground(time_s: float) -> dict[str, Any]:
        x_m = 0.15 * (min(200.0, time_s) + max(0.0, time_s - 280.0))
        return {"gps": [x_m + random.normal(0, 0.3), random.normal(0, 0.3)], "mode": "drift"}

    found = ask(empty, drifts_then_runs_aground, 0.5, 300.0)
    (aground,) = found.events
    assert aground.start_s == pytest.approx(200, abs=10)
    speed_m_s = float(aground.details["evidence_for"].split()[-2])
    assert speed_m_s == pytest.approx(0.15, rel=0.1)
    assert "hides slow motion" in found.verdicts.not_searched["standstill"]


def drives(time_s: float, aside_m: float = 0.0) -> dict[str, Any]:
    """30 s at 0.2 m/s, then it stands."""
    return {"pose": {"x": 0.2 * min(30.0, time_s) + aside_m, "y": 0.0}}


def drives_on(time_s: float) -> dict[str, Any]:
    """As `drives`, and at the end it drives on."""
    return {"pose": {"x": 0.2 * (min(30.0, time_s) + max(0.0, time_s - 58.5)), "y": 0.0}}


def turns(time_s: float, speed: float) -> float:
    return speed * max(0.0, time_s - 30)


def sways(time_s: float, period_s: float) -> dict[str, Any]:
    swing = math.sin(math.tau * (time_s - 30) / period_s) if time_s > 30 else 0.0
    wheel = math.copysign(5.0, swing) if time_s > 30 else 5.0
    return drives(time_s, 0.03 * swing) | {"mode": "drive", "wheels": [wheel, wheel]}


def seen(time_s: float, other: str) -> dict[str, Any]:
    """By an observer."""
    one = {"x_m": 0.2 * min(30.0, time_s), "y_m": 0.0, "speed_mps": 0.2 * (time_s < 30)}
    return {"world": {"ONE": one}, "solid": {other: {"x_m": time_s, "speed_mps": 1.0}}}


MOVED = "in mode {}, in which it moved at 0.2 m/s"
# What it publishes, what it is told to have been, and a detail of that.
EVIDENCE: dict[str, tuple[Callable[[float], dict[str, Any]], str, str, Any]] = {
    **{
        str(command): (lambda t, c=command: drives(t) | c, "stuck", "commanded", 0.2)
        for command in (
            {"targetSpeed": 0.2}, {"cmdVel": 0.2}, {"commandedSpeed": 0.2}, {"cmd_vel": [0.2, 0.0]},
            {"speedSetpoint": 0.2}, {"cmd": {"v": 0.2, "w": 0.0}}, {"cmdVel": {"linear": [0.2, 0]}},
            {"commanded_m_s": 0.2, "status": "ready", "arm": {"state": "idle"}},
        )
    },
    **{
        mode: (
            lambda t, m=mode: drives_on(t) | {"mode": m},
            "stuck", "evidence_for", MOVED.format(mode),
        )
        for mode in ("returning", "threshold_wait", "forest", "already_home", "idle")
    },
    "measured speed of 0": (
        lambda t: drives_on(t) | {"speed": 0.2 * (t < 30), "mode": "go"},
        "stuck", "evidence_for", MOVED.format("go"),
    ),
    "command for a moment": (
        lambda t: drives_on(t) | {"speed": 0.2 * (t < 30.05), "mode": "go"},
        "stuck", "evidence_for", MOVED.format("go"),
    ),
    "until its mode ends": (
        lambda t: drives(t) | {"mode": "go"}, "standstill", "why_not_stuck",
        "it stood until mode go ended, as a robot does that has arrived",
    ),
    "told to stand": (
        lambda t: drives(t) | {"commanded_m_s": 0.2 * (t < 30), "mode": "drive"},
        "standstill", "why_not_stuck", "commanded_m_s 0",
    ),
    "in another mode": (
        lambda t: drives(t) | {"mode": "go" if t < 30 else "S0"},
        "standstill", "why_not_stuck", "not seen moving in mode S0",
    ),
    "no evidence": (
        lambda t: drives(t) | {"volts": 12.0 + t}, "standstill", "why_not_stuck",
        "no published signal shows",
    ),
    "wheels": (
        lambda t: drives(t) | {"wheels": {"left": 4.0, "right": 4.0}},
        "stuck", "evidence_for", "wheels at 4",
    ),
    "motors": (
        lambda t: drives(t) | {"leftMotor": 5.0, "rightMotor": 5.0},
        "stuck", "evidence_for", "wheels at 5",
    ),
    "wheels at rest": (
        lambda t: drives_on(t) | {"mode": "drive", "wheels": [5.0 * (t < 30)] * 2},
        "stuck", "evidence_against", "wheels at rest",
    ),
    "wheels against each other": (
        lambda t: drives(t) | {"wheels": {"left": 5.0, "right": 5 - 10 * (t >= 30)}, "mode": "go"},
        "standstill", "why_not_stuck", "its wheels turned in opposite directions",
    ),
    "turns in place, in radians": (
        lambda t: {"pose": [0.2 * min(30.0, t), 0.0, math.remainder(turns(t, 0.5), math.tau)],
                   "mode": "go"},
        "standstill", "why_not_stuck", "it turned in place",
    ),
    "turns in place, in degrees": (
        lambda t: drives(t) | {"headingDeg": turns(t, 30.0) % 360, "mode": "go"},
        "standstill", "why_not_stuck", "it turned in place",
    ),
    **{
        f"to and fro in {period_s} s": (
            lambda t, p=period_s: sways(t, p), "standstill", "why_not_stuck",
            "it moved back and forth within 0.06 m",
        )
        for period_s in (0.8, 2.0, 5.0)
    },
    "trembles at a wall": (
        lambda t: drives(t, 0.002 * math.sin(40 * t) * (t > 30)) | {"wheels": [5.0, 5.0]},
        "stuck", "evidence_for", "wheels at 5",
    ),
    **{
        f"an observer sees {other}": (
            lambda t, o=other: seen(t, o), "standstill", "why_not_stuck",
            "no published signal shows",
        )
        for other in ("TWO", "LEFT_WHEEL")
    },
}  # fmt: skip


@pytest.mark.parametrize(("state", "kind", "detail", "said"), EVIDENCE.values(), ids=EVIDENCE)
def test_what_a_robot_publishes_tells_whether_it_is_stuck(
    empty: sqlite3.Connection, state: Callable[[float], dict[str, Any]], kind: str, detail: str,
    said: Any,
) -> None:  # fmt: skip
    (event,) = ask(empty, state).events
    assert (event.kind, event.start_s) == (kind, pytest.approx(30.0, abs=1.0))
    assert event.end_s > 57
    told = event.details[detail]
    assert said in told if isinstance(said, str) else told == said


def test_wheels_that_come_to_rest_as_it_does_are_no_reason_to_call_it_stuck(
    empty: sqlite3.Connection,
) -> None:
    (event,) = ask(
        empty, lambda t: drives_on(t) | {"mode": "drive", "wheels": [5.0 * (t < 30.25)] * 2}
    ).events
    assert event.details["evidence_for"] == MOVED.format("drive"), "of a row no wheels turn"
    (told,) = [each for each in check_run(empty, 1).findings if each.name == "moves when commanded"]
    assert told.outcome == "warn" and told.evidence.endswith(", but wheels at rest")


def test_where_the_position_had_no_value_it_is_not_said_that_it_moved(
    empty: sqlite3.Connection,
) -> None:
    told = ask(empty, lambda t: {"pose": [0.2 * t if t < 20 or t > 50 else None, 0.0]})
    assert not told.events
    for kind in ("standstill", "stuck"):
        why = told.verdicts.not_searched[kind]
        assert "the position had no value for 3" in why and "from 20 s on" in why


def test_who_stands_while_rows_come_seldom_stands(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    times = [0.032 * step for step in range(1000)] + [32.0 + 0.5 * step for step in range(60)]
    for time_s in times:
        recorder.publish(time_s, {"pose": [0.2 * min(time_s, 32.0), 0.0]})
    (still,) = find_events(empty, find_range(empty, Scope()), OPTIONS).events
    assert (still.start_s, still.end_s) == (32.0, 61.5)


@pytest.mark.parametrize(
    ("x", "y", "per_m"),
    [("x_mm", "y_mm", 1000), ("x_cm", "y_cm", 100), ("odom.x_mm", "odom.y_mm", 1000)],
)
def test_a_position_in_another_unit_is_understood_by_its_name(
    empty: sqlite3.Connection, x: str, y: str, per_m: float
) -> None:
    def drives_then_stands(time_s: float) -> dict[str, Any]:
        return {x: 0.02 * min(30.0, time_s) * per_m, y: 0.0}

    (still,) = ask(empty, drives_then_stands).events
    assert (still.start_s, still.end_s) == pytest.approx((30.0, 59.9), abs=0.3)
    assert still.details["x_m"] == pytest.approx(0.6, abs=0.01)


@pytest.mark.parametrize(
    ("noise_m", "interval_s", "held_s"), [(0.002, 0.008, 40.0), (0.02, 0.5, 5.0)]
)
def test_noise_alone_is_no_going_to_and_fro(
    empty: sqlite3.Connection, noise_m: float, interval_s: float, held_s: float
) -> None:
    noise = np.random.default_rng(1)

    def drives_and_is_held(time_s: float) -> dict[str, Any]:
        x_m = 0.2 * (min(30.0, time_s) + max(0.0, time_s - 30 - held_s))
        return {"pose": noise.normal((x_m, 0.0), noise_m).tolist(), "mode": "drive"}

    (stuck,) = ask(empty, drives_and_is_held, interval_s=interval_s, seconds=held_s + 60).events
    assert stuck.kind == "stuck"
