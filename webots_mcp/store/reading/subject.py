"""Which robot and which run a question is about."""

from __future__ import annotations

import sqlite3
import time
from dataclasses import dataclass

from webots_mcp.errors import NothingRecordedError
from webots_mcp.store.robots import resolve_robot, robot_name
from webots_mcp.store.runs import current_run, fetch_run


@dataclass(frozen=True)
class Subject:
    """A robot, and the run that is meant unless a question is about all of them."""

    robot_id: int
    robot: str
    run_id: int


def find_subject(
    connection: sqlite3.Connection, robot: str | None = None, run_id: int | None = None
) -> Subject:
    """The run that was named, or the newest run of the robot that was named or is the only one.

    Raises:
        UnknownRobotError, AmbiguousRobotError: As they say.
        UnknownRunError: There is no such run, or it is another robot's.
        NothingRecordedError: No robot, or no run of it, has been recorded.
    """
    if run_id is not None and robot is None:
        robot_id = fetch_run(connection, run_id).robot_id
        return Subject(robot_id, robot_name(connection, robot_id), run_id)
    found = resolve_robot(connection, robot, time.time())
    if run_id is not None:
        return Subject(found.id, found.name, fetch_run(connection, run_id, found.id).id)
    run = current_run(connection, found.id)
    if run is None:
        raise NothingRecordedError(
            f"robot {found.name!r} has no run yet: its controller never recorded"
        )
    return Subject(found.id, found.name, run.id)
