"""The stored breakpoints and expectations: conditions that a bridge evaluates on published states.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import sqlite3
import time
from typing import Final, NamedTuple

from webots_mcp.contract import MAX_BREAKPOINTS, PROJECT_FILE, BreakpointAction
from webots_mcp.database.transactions import transaction
from webots_mcp.errors import InvalidInputError

VIOLATION: Final = "violation"  # the kind of the event: what was expected did not hold
# `created_by`: those of the controller's own code end with their session.
OF_CONTROLLER: Final = "controller"
OF_PROJECT: Final = "project"  # those of the project's file
_MEANT: Final = "(b.robot_id = r.id OR b.robot_name IN ('*', r.name))"
_OF_ROBOT: Final = (
    f"FROM robot r JOIN breakpoint b ON {_MEANT} LEFT JOIN session s ON s.id = b.session_id "
    f"WHERE r.id = ? AND (b.created_by IS NOT '{OF_CONTROLLER}' "
    "OR (s.id IS NOT NULL AND s.ended_wall_time_s IS NULL))"
)
# What a bridge arms; texts come as bytes, because one that is no UTF-8 would fail the statement.
ARMED: Final = (
    "SELECT b.id, CAST(b.condition AS BLOB), CAST(b.action AS BLOB), b.after_hits, "
    "CAST(b.name AS BLOB), CAST(b.expects AS BLOB), CAST(b.during AS BLOB) "
    f"FROM robot r JOIN breakpoint b ON {_MEANT} "
    "WHERE r.id = :robot AND b.enabled AND typeof(b.after_hits) = 'integer' "
    f"AND (b.created_by IS NOT '{OF_CONTROLLER}' OR b.session_id = :session) "
    "ORDER BY b.id LIMIT :most"
)
# What was expected of a run: by its controller's code, and by the project.
EXPECTED: Final = (
    "SELECT b.expects, b.during, b.name, b.created_by FROM run u JOIN robot r ON r.id = u.robot_id "
    f"JOIN breakpoint b ON {_MEANT} WHERE u.id = ? AND b.expects IS NOT NULL "
    f"AND (b.created_by IS NOT '{OF_CONTROLLER}' OR b.session_id = u.session_id) ORDER BY b.id"
)
_LISTED: Final = (
    "SELECT b.id, r.id, b.condition, b.action, b.after_hits, b.enabled, b.hit_count, "
    f"b.created_wall_time_s, b.created_by, b.error {_OF_ROBOT} ORDER BY b.id"
)
_IDS: Final = f"SELECT b.id {_OF_ROBOT} ORDER BY b.id"
_COUNT: Final = f"SELECT count(*) {_OF_ROBOT} AND b.enabled"
_LIKE: Final = (
    f"SELECT b.id {_OF_ROBOT} AND b.enabled AND b.condition = ? AND b.action = ? "
    "AND b.after_hits = ? AND b.expects IS NULL"
)
# Of a controller's own code with its session, else without one.
SET: Final = (
    "INSERT INTO breakpoint (robot_id, session_id, condition, action, after_hits, "
    "created_wall_time_s, created_by, name, expects, during) "
    "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?) RETURNING id"
)
# What is not listed is not removed either: of a controller that ended its expectations stay.
_REMOVE: Final = (
    "DELETE FROM breakpoint WHERE id = :id AND robot_id = :robot AND id IN "
    f"(SELECT b.id {_OF_ROBOT.replace('?', ':robot')}) RETURNING id"
)


class StoredBreakpoint(NamedTuple):
    """A breakpoint as the database has it.

    Attributes:
        enabled: False once its condition failed; `error` says why.
        hit_count: How often the condition began to hold, in all runs.
    """

    id: int
    robot_id: int
    condition: str
    action: str
    after_hits: int
    enabled: bool
    hit_count: int
    created_wall_time_s: float
    created_by: str | None
    error: str | None


def list_breakpoints(connection: sqlite3.Connection, robot_id: int) -> list[StoredBreakpoint]:
    """List the breakpoints of a robot, the oldest first."""
    return [StoredBreakpoint(*row) for row in connection.execute(_LISTED, (robot_id,)).fetchall()]


def set_breakpoint(
    connection: sqlite3.Connection,
    robot_id: int,
    condition: str,
    action: BreakpointAction,
    after_hits: int,
    created_by: str,
) -> int:
    """Store a breakpoint, unless an identical one is stored; return its id.

    Raises:
        InvalidInputError: If the robot has the maximum number of breakpoints.
    """
    with transaction(connection):
        asked = (condition, action, after_hits)
        if (like := connection.execute(_LIKE, (robot_id, *asked)).fetchone()) is not None:
            return int(like[0])
        if connection.execute(_COUNT, (robot_id,)).fetchone()[0] >= MAX_BREAKPOINTS:
            raise InvalidInputError(
                f"This robot has {MAX_BREAKPOINTS} breakpoints, the maximum. Remove one with "
                "webots_remove_breakpoint first."
            )
        values = (robot_id, None, *asked, time.time(), created_by, None, None, None)
        return int(connection.execute(SET, values).fetchall()[0][0])


def remove_breakpoint(connection: sqlite3.Connection, robot_id: int, breakpoint_id: int) -> None:
    """Delete a breakpoint; the events of its hits stay.

    Raises:
        InvalidInputError: If the robot has none with that id.
    """
    with transaction(connection):
        removed = connection.execute(_REMOVE, {"id": breakpoint_id, "robot": robot_id}).fetchall()
    if removed:
        return
    there = [str(number) for (number,) in connection.execute(_IDS, (robot_id,)).fetchall()]
    if str(breakpoint_id) in there:
        raise InvalidInputError(
            f"Breakpoint {breakpoint_id} is an expectation in {PROJECT_FILE}. Remove it there."
        )
    known = f"Its breakpoints are {', '.join(there)}." if there else "It has no breakpoints."
    raise InvalidInputError(f"This robot has no breakpoint {breakpoint_id}. {known}")


def newest_hit(
    connection: sqlite3.Connection, robot_id: int, breakpoint_id: int
) -> tuple[int, float] | None:
    """Run and simulation time of the newest hit whose action was taken; None without any."""
    statement = (
        "SELECT e.run_id, e.sim_time_s FROM event e JOIN run u ON u.id = e.run_id "
        "WHERE u.robot_id = ? AND e.kind IN ('breakpoint', 'violation') "
        "AND json_extract(e.data, '$.breakpoint_id') = ? ORDER BY e.id DESC LIMIT 1"
    )
    row = connection.execute(statement, (robot_id, breakpoint_id)).fetchone()
    return None if row is None else (row[0], row[1])
