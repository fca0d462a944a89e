"""The stored breakpoints: conditions that a robot's bridge asks of each published state."""

from __future__ import annotations

import sqlite3
import time
from dataclasses import dataclass
from typing import Final

from webots_mcp.conditions import Condition
from webots_mcp.contract import MAX_BREAKPOINTS, BreakpointAction
from webots_mcp.errors import InvalidInputError
from webots_mcp.transactions import transaction

# Those of a controller's own code end with its session.
_OF_ROBOT: Final = (
    "FROM breakpoint b LEFT JOIN session s ON s.id = b.session_id WHERE b.robot_id = ? "
    "AND (b.created_by IS NOT 'controller' OR (s.id IS NOT NULL AND s.ended_wall_time_s IS NULL))"
)
_LISTED: Final = (
    "SELECT b.id, b.robot_id, b.condition, b.action, b.after_hits, b.enabled, b.hits, "
    f"b.created_wall_time_s, b.created_by, b.error {_OF_ROBOT} ORDER BY b.id"
)
_IDS: Final = f"SELECT b.id {_OF_ROBOT} ORDER BY b.id"
_COUNT: Final = f"SELECT count(*) {_OF_ROBOT} AND b.enabled"
_LIKE: Final = (
    f"SELECT b.id {_OF_ROBOT} AND b.enabled AND b.condition = ? AND b.action = ? "
    "AND b.after_hits = ?"
)
_SET: Final = (
    "INSERT INTO breakpoint (robot_id, condition, action, after_hits, created_wall_time_s, "
    "created_by) VALUES (?, ?, ?, ?, ?, ?) RETURNING id"
)
_REMOVE: Final = "DELETE FROM breakpoint WHERE id = ? AND robot_id = ? RETURNING id"
_NEWEST_HIT: Final = (
    "SELECT e.run_id, e.sim_time_s FROM event e JOIN run u ON u.id = e.run_id "
    "WHERE u.robot_id = ? AND e.kind = 'breakpoint' "
    "AND json_extract(e.data, '$.breakpoint_id') = ? ORDER BY e.id DESC LIMIT 1"
)


@dataclass(frozen=True)
class StoredBreakpoint:
    """A breakpoint as the database has it.

    Attributes:
        enabled: False once its condition failed; `error` says why.
        hits: How often the condition began to hold, in all runs.
    """

    id: int
    robot_id: int
    condition: str
    action: str
    after_hits: int
    enabled: bool
    hits: int
    created_wall_time_s: float
    created_by: str | None
    error: str | None


def list_breakpoints(connection: sqlite3.Connection, robot_id: int) -> list[StoredBreakpoint]:
    """Those of a robot, the oldest first."""
    return [StoredBreakpoint(*row) for row in connection.execute(_LISTED, (robot_id,)).fetchall()]


def set_breakpoint(
    connection: sqlite3.Connection,
    robot_id: int,
    condition: Condition,
    action: BreakpointAction,
    after_hits: int,
    created_by: str,
) -> int:
    """Store one; the one that is there already is the answer to its like. Returns its id.

    Raises:
        InvalidInputError: The robot has as many as there may be.
    """
    with transaction(connection):
        asked = (condition.text, action, after_hits)
        if (like := connection.execute(_LIKE, (robot_id, *asked)).fetchone()) is not None:
            return int(like[0])
        if connection.execute(_COUNT, (robot_id,)).fetchone()[0] >= MAX_BREAKPOINTS:
            raise InvalidInputError(
                f"this robot has {MAX_BREAKPOINTS} breakpoints: remove one first"
            )
        values = (robot_id, *asked, time.time(), created_by)
        return int(connection.execute(_SET, values).fetchall()[0][0])


def remove_breakpoint(connection: sqlite3.Connection, robot_id: int, breakpoint_id: int) -> None:
    """Delete one; the events of its hits stay.

    Raises:
        InvalidInputError: The robot has none of that id.
    """
    with transaction(connection):
        removed = connection.execute(_REMOVE, (breakpoint_id, robot_id)).fetchall()
    if removed:
        return
    there = [str(number) for (number,) in connection.execute(_IDS, (robot_id,)).fetchall()]
    known = f"there are {', '.join(there)}" if there else "it has none"
    raise InvalidInputError(f"this robot has no breakpoint {breakpoint_id}; {known}")


def newest_hit(
    connection: sqlite3.Connection, robot_id: int, breakpoint_id: int
) -> tuple[int, float] | None:
    """Run and simulation time of the newest hit whose action was taken; None without any."""
    row = connection.execute(_NEWEST_HIT, (robot_id, breakpoint_id)).fetchone()
    return None if row is None else (row[0], row[1])
