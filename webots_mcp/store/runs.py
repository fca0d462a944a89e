"""Runs: stretches of rising simulation time."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from typing import Final

from webots_mcp.errors import UnknownRunError
from webots_mcp.store.rows import columns_of


@dataclass(frozen=True)
class Run:
    """A stretch of rising simulation time in one session. Columns as in `store.models`."""

    id: int
    session_id: int
    robot_id: int
    world: str | None
    basic_time_step_ms: float | None
    start_reason: str
    started_wall_time_s: float
    started_sim_time_s: float
    last_wall_time_s: float
    last_sim_time_s: float
    ended_wall_time_s: float | None
    end_reason: str | None
    rows: int
    label: str | None


_COLUMNS: Final = columns_of(Run)
_CURRENT: Final = f"SELECT {_COLUMNS} FROM run WHERE robot_id = ? ORDER BY id DESC LIMIT 1"
_BY_ID: Final = f"SELECT {_COLUMNS} FROM run WHERE id = ?"
_OF_ROBOT: Final = f"SELECT {_COLUMNS} FROM run WHERE robot_id = ? ORDER BY id"
_NEWEST_IDS: Final = (
    "SELECT id FROM run WHERE :robot_id IS NULL OR robot_id = :robot_id ORDER BY id DESC LIMIT 10"
)
_COUNT: Final = "SELECT count(*) FROM run WHERE robot_id = ?"


def current_run(connection: sqlite3.Connection, robot_id: int) -> Run | None:
    """The robot's newest run, going on or not."""
    row = connection.execute(_CURRENT, (robot_id,)).fetchone()
    return Run(*row) if row else None


def fetch_run(connection: sqlite3.Connection, run_id: int, robot_id: int | None = None) -> Run:
    """The run of that id.

    Args:
        connection: An open database.
        run_id: The run.
        robot_id: Whose run it has to be; None for anybody's.

    Raises:
        UnknownRunError: There is no such run, or it is another robot's.
    """
    row = connection.execute(_BY_ID, (run_id,)).fetchone()
    if row is None or robot_id not in (None, Run(*row).robot_id):
        raise UnknownRunError(_no_such_run(connection, run_id, robot_id))
    return Run(*row)


def runs_of(connection: sqlite3.Connection, robot_id: int) -> list[Run]:
    """All runs of the robot, oldest first."""
    return [Run(*row) for row in connection.execute(_OF_ROBOT, (robot_id,)).fetchall()]


def count_runs(connection: sqlite3.Connection, robot_id: int) -> int:
    """How many runs of the robot were recorded."""
    return int(connection.execute(_COUNT, (robot_id,)).fetchone()[0])


def _no_such_run(connection: sqlite3.Connection, run_id: int, robot_id: int | None) -> str:
    ids = [row[0] for row in connection.execute(_NEWEST_IDS, {"robot_id": robot_id}).fetchall()]
    whose = "" if robot_id is None else " of this robot"
    known = f"the newest runs{whose} are {ids}" if ids else f"no run{whose} was recorded"
    return f"no run {run_id}{whose}: {known}"
