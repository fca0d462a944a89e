"""Which robot is meant."""

from __future__ import annotations

import time

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.errors import (
    AmbiguousRobotError,
    NothingRecordedError,
    UnknownRobotError,
    UnknownRunError,
)
from webots_mcp.store.robots import list_robots, resolve_robot
from webots_mcp.store.run_rows import count_runs, current_run, fetch_run, runs_of


def ended(recorded: Recorded, name: str) -> None:
    recorded.robot(name, ended_wall_time_s=time.time(), end_reason="finished")


def test_the_only_live_robot_is_meant_when_none_is_named(recorded: Recorded) -> None:
    ended(recorded, "old")
    recorded.robot("rover")
    assert resolve_robot(recorded.connection, None, time.time()).name == "rover"


def test_the_only_robot_ever_seen_is_meant_when_none_is_live(recorded: Recorded) -> None:
    ended(recorded, "rover")
    robot = resolve_robot(recorded.connection, None, time.time())
    assert (robot.name, robot.live) == ("rover", False)


def test_two_live_robots_are_listed_instead_of_guessed(recorded: Recorded) -> None:
    recorded.robot("rover")
    recorded.robot("rover#2", supervisor=0)
    with pytest.raises(AmbiguousRobotError, match=r"'rover' \(Supervisor, live\), 'rover#2'"):
        resolve_robot(recorded.connection, None, time.time())


def test_two_robots_of_the_past_are_listed_instead_of_guessed(recorded: Recorded) -> None:
    ended(recorded, "a")
    ended(recorded, "b")
    with pytest.raises(AmbiguousRobotError, match=r"none is live: .*; start the simulation, or"):
        resolve_robot(recorded.connection, None, time.time())


def test_a_misspelt_robot_is_answered_with_near_names(recorded: Recorded) -> None:
    recorded.robot("rover")
    recorded.robot("crane")
    with pytest.raises(UnknownRobotError, match="did you mean 'rover'"):
        resolve_robot(recorded.connection, "rovr", time.time())


def test_an_empty_database_has_no_robot_to_offer(recorded: Recorded) -> None:
    assert list_robots(recorded.connection, time.time()) == []
    with pytest.raises(NothingRecordedError):
        resolve_robot(recorded.connection, None, time.time())


def test_the_newest_run_is_the_current_one(recorded: Recorded) -> None:
    robot = recorded.robot()
    first = robot.run_id
    second = robot.begin_run("reset")
    run = current_run(recorded.connection, robot.id)
    assert run is not None
    assert (run.id, run.start_reason) == (second, "reset")
    assert [r.id for r in runs_of(recorded.connection, robot.id)] == [first, second]
    assert count_runs(recorded.connection, robot.id) == 2


def test_an_unknown_run_is_answered_with_the_newest_ones(recorded: Recorded) -> None:
    robot = recorded.robot()
    with pytest.raises(UnknownRunError, match=rf"no run 99.*\[{robot.run_id}\]"):
        fetch_run(recorded.connection, 99)


def test_a_run_of_another_robot_is_not_taken(recorded: Recorded) -> None:
    rover, crane = recorded.robot("rover"), recorded.robot("crane")
    with pytest.raises(UnknownRunError, match=rf"no run {crane.run_id} of this robot"):
        fetch_run(recorded.connection, crane.run_id, rover.id)
