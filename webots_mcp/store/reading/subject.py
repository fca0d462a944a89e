"""Which robot and which run a question is about."""

from __future__ import annotations

import sqlite3
import time
from dataclasses import dataclass

from webots_mcp.errors import NothingRecordedError
from webots_mcp.store.robots import Robot, resolve_robot, robot_name
from webots_mcp.store.run_rows import Run, current_run, fetch_run


@dataclass(frozen=True)
class Subject:
    """A robot, and the run that is meant unless a question is about all of them."""

    robot_id: int
    robot: str
    run_id: int


def choose(
    connection: sqlite3.Connection, robot: str | None, run_id: int | None, now_s: float
) -> tuple[Robot, Run | None]:
    """The run that was named, or the newest run of the robot that was named or is the only one.

    Without a run the robot's controller has never recorded.

    Raises:
        UnknownRobotError, AmbiguousRobotError: As they say.
        UnknownRunError: There is no such run, or it is another robot's.
        NothingRecordedError: No robot has been recorded.
    """
    if robot is None and run_id is not None:
        robot = robot_name(connection, fetch_run(connection, run_id).robot_id)
    chosen = resolve_robot(connection, robot, now_s)
    if run_id is not None:
        return chosen, fetch_run(connection, run_id, chosen.id)
    return chosen, current_run(connection, chosen.id)


def require_run(robot: Robot, run: Run | None) -> Run:
    """The run.

    Raises:
        NothingRecordedError: The robot's controller has begun none.
    """
    if run is None:
        raise NothingRecordedError(
            f"robot {robot.name!r} has no run yet: its controller never recorded"
        )
    return run


def find_subject(
    connection: sqlite3.Connection, robot: str | None = None, run_id: int | None = None
) -> Subject:
    """The subject of a question; see `choose` and `require_run`."""
    chosen, run = choose(connection, robot, run_id, time.time())
    return Subject(chosen.id, chosen.name, require_run(chosen, run).id)
