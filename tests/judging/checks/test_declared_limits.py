"""A signal that leaves the limits that a person declared of it fails a check; a device's do not."""

from __future__ import annotations

import math
import sqlite3
from typing import Any

import pytest

from tests.recordings.rows import RecordedRobot
from tests.store.test_meanings import state
from webots_mcp.judging.checks.check import Finding
from webots_mcp.judging.checks.check_run import check_run

NAME = "motor_temperature_c"


def found(connection: sqlite3.Connection) -> Finding:
    findings = check_run(connection, 1).findings
    return next(each for each in findings if each.name == "sensors within limits")


@pytest.fixture
def hot(empty: sqlite3.Connection) -> RecordedRobot:
    """From 20 to 95.2 degrees and back to 50 within a minute, a little uneven."""
    robot = RecordedRobot(empty, "rover", 1000.0)
    for row in range(600):
        heat = 20 + 0.188 * row if row <= 400 else 95.2 - 0.226 * (row - 400)
        robot.state(0.1 * row, {NAME: round(heat, 4), "mode": "drive"})
    robot.end_run("finished")
    return robot


@pytest.mark.parametrize(
    ("limits", "says", "since_s", "often"),
    [
        ({"high": 80.0}, "above its declared limit 80 in 148 of 600 rows, up to 95.2", 32.0, 1),
        ({"low": 30.0}, "below its declared limit 30 in 54 of 600 rows, down to 20", 0.0, 1),
    ],
)
def test_it_is_told_how_far_how_often_and_since_when(
    empty: sqlite3.Connection, hot: RecordedRobot, limits: dict[str, Any], says: str,
    since_s: float, often: int,
) -> None:  # fmt: skip
    state(empty, hot.id, NAME, quantity="temperature", set_by="mcp", **limits)
    finding = found(empty)
    assert (finding.outcome, finding.often) == ("fail", often)
    assert finding.evidence.endswith(says)
    assert finding.since_s == pytest.approx(since_s, abs=0.05)


def test_a_value_at_a_limit_is_within_it(empty: sqlite3.Connection, hot: RecordedRobot) -> None:
    state(empty, hot.id, NAME, quantity="temperature", low=20.0, high=95.2, set_by="mcp")
    finding = found(empty)
    assert finding.outcome == "pass"
    assert "none left its declared limits" in finding.evidence


def test_without_a_declaration_no_limit_is_judged(
    empty: sqlite3.Connection, hot: RecordedRobot
) -> None:
    finding = found(empty)
    assert finding.outcome == "pass"
    assert "declared" not in finding.evidence


def test_limits_of_a_device_leave_room_for_its_noise(
    empty: sqlite3.Connection, hot: RecordedRobot
) -> None:
    state(empty, hot.id, NAME, quantity="temperature", high=80.0, source="device")
    assert found(empty).outcome == "pass"


def test_a_declared_quantity_does_not_make_the_limits_of_a_device_declared(
    empty: sqlite3.Connection, hot: RecordedRobot
) -> None:
    state(empty, hot.id, NAME, quantity="temperature", high=80.0, source="device")
    state(empty, hot.id, NAME, quantity="temperature", set_by="mcp")
    assert found(empty).outcome == "pass"


@pytest.mark.parametrize(("quantity", "outcome"), [("joint position", "pass"), ("torque", "fail")])
def test_only_the_soft_stop_of_a_joint_yields_a_little(
    empty: sqlite3.Connection, quantity: str, outcome: str
) -> None:
    robot = RecordedRobot(empty, "arm", 1000.0)
    for row in range(300):
        robot.state(0.1 * row, {"q3": round(1.502 * math.sin(0.05 * row), 5)})
    robot.end_run("finished")
    state(empty, robot.id, "q3", quantity=quantity, low=-1.5, high=1.5, set_by="mcp")
    assert found(empty).outcome == outcome
