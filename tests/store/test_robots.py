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


@pytest.mark.parametrize(
    ("live", "past", "asked", "said"),
    [
        (["rover"], ["old"], None, "rover"),
        ([], ["rover"], None, "rover"),
        (["rover", "rover#2"], [], None, r"'rover' \(Supervisor, live\), 'rover#2'"),
        ([], ["a", "b"], None, "none is live: .*. Start the simulation, or"),
        (["rover", "crane"], [], "rovr", "Did you mean 'rover'"),
    ],
)
def test_which_robot_is_meant_and_what_is_said_where_it_could_be_several(
    recorded: Recorded, live: list[str], past: list[str], asked: str | None, said: str
) -> None:
    for name in past:
        recorded.robot(name, ended_wall_time_s=time.time(), end_reason="finished")
    for name in live:
        recorded.robot(name)
    if asked is None and len(live or past) == 1:
        robot = resolve_robot(recorded.connection, asked, time.time())
        assert (robot.name, robot.live) == (said, bool(live))
        return
    with pytest.raises((AmbiguousRobotError, UnknownRobotError), match=said):
        resolve_robot(recorded.connection, asked, time.time())


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
    with pytest.raises(UnknownRunError, match=rf"No run 99 .*: {robot.run_id}\."):
        fetch_run(recorded.connection, 99)


def test_a_run_of_another_robot_is_not_taken(recorded: Recorded) -> None:
    rover, crane = recorded.robot("rover"), recorded.robot("crane")
    with pytest.raises(UnknownRunError, match=rf"Run {crane.run_id} belongs to another robot"):
        fetch_run(recorded.connection, crane.run_id, rover.id)
