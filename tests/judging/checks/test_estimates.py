"""What was declared to measure the same thing is compared, whatever it is called."""

from __future__ import annotations

import math
import sqlite3
from typing import Any

import pytest

from tests.recordings.rows import RecordedRobot
from tests.store.test_meanings import state
from webots_mcp.judging.checks.check import Finding
from webots_mcp.judging.checks.check_run import check_run


@pytest.fixture
def rover(empty: sqlite3.Connection) -> RecordedRobot:
    return RecordedRobot(empty, "rover", 1000.0)


def estimates(connection: sqlite3.Connection) -> Finding:
    findings = check_run(connection, 1).findings
    return next(each for each in findings if each.name == "estimates agree")


def drive(robot: RecordedRobot, **drift: float) -> None:
    for row in range(300):
        x, y = 0.02 * row, math.sin(row / 40)
        values: dict[str, Any] = {"gps": [x, y], "temp_c": 20 + math.sin(row / 30)}
        values |= {"ex": 100 * x, "ey": 100 * y * (1 + drift.get("of_y", 0.0) * row / 300)}
        values["t2"] = values["temp_c"] + drift.get("of_temperature", 0.0) * (row > 150)
        robot.state(0.1 * row, values)
    robot.end_run("finished")


def declare(connection: sqlite3.Connection, robot: RecordedRobot) -> None:
    for name, other, quantity in (("ex", "gps.0", "x"), ("ey", "gps.1", "y")):
        state(connection, robot.id, name, same_as=other, quantity=quantity, unit="cm",
              set_by="mcp")  # fmt: skip


def test_a_position_in_cm_that_is_the_same_as_the_first_agrees_with_it(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    drive(rover)
    assert estimates(empty).outcome == "not applicable"
    declare(empty, rover)
    found = estimates(empty)
    assert (found.outcome, found.evidence.endswith("limit 5 % of the path")) == ("pass", True)


def test_one_that_drifts_away_fails(empty: sqlite3.Connection, rover: RecordedRobot) -> None:
    drive(rover, of_y=3.0)
    declare(empty, rover)
    assert estimates(empty).outcome == "fail"


def test_two_measurements_of_one_value_are_compared_by_their_range(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    drive(rover, of_temperature=1.0)
    state(empty, rover.id, "t2", same_as="temp_c", quantity="temperature", set_by="mcp")
    found = estimates(empty)
    assert (found.outcome, found.since_s) == ("fail", pytest.approx(15.0, abs=1.1))
    assert found.evidence.startswith("t2 and temp_c: 1 apart")
