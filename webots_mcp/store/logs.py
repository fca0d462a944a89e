"""Log lines of a run, or of all runs of a robot: by text, level and time."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from typing import Final

from webots_mcp.contract import LOG_LEVELS
from webots_mcp.store.rows import columns_of
from webots_mcp.store.window import Window

COUNT_LIMIT: Final = 10_000  # beyond it a count would cost more than it tells


@dataclass(frozen=True)
class LogLine:
    """A line that the controller or the bridge logged."""

    id: int
    run_id: int
    sim_time_s: float
    wall_time_s: float
    level: str
    source: str
    message: str
    logger: str | None


_COLUMNS: Final = columns_of(LogLine)
_RANKS: Final = " ".join(f"WHEN '{level}' THEN {rank}" for rank, level in enumerate(LOG_LEVELS))
_MATCHING: Final = (
    "AND sim_time_s >= :start_s AND sim_time_s < :end_s "
    "AND (:before_id IS NULL OR id < :before_id) "
    "AND (:text = '' OR instr(lower(message), :text) > 0) "
    f"AND CASE level {_RANKS} ELSE {LOG_LEVELS.index('error')} END >= :lowest"
)
_OF_RUN: Final = f"FROM log WHERE run_id = :run_id {_MATCHING}"
# The newest lines are wanted: from the end of the table, not run by run.
_OF_ROBOT: Final = (
    f"FROM log WHERE +run_id IN (SELECT id FROM run WHERE robot_id = :robot_id) {_MATCHING}"
)


@dataclass(frozen=True)
class LogFilter:
    """Which lines are asked for.

    Args:
        run_id: The run; None for all runs of the robot.
        window: Simulation time.
        text: Part of the message; ASCII letters match in either case.
        lowest_level: This level and those above it.
        before_id: Only lines with smaller ids, to page towards older ones.
        robot_id: The robot, where no run is given.
    """

    run_id: int | None
    window: Window
    text: str = ""
    lowest_level: str = "debug"
    before_id: int | None = None
    robot_id: int | None = None


def newest_lines(connection: sqlite3.Connection, asked: LogFilter, limit: int) -> list[LogLine]:
    """The newest lines that match, oldest first; with a limit of -1 all of them."""
    order = "id" if asked.run_id is None else "sim_time_s DESC, id"
    query = f"SELECT {_COLUMNS} {_source(asked)} ORDER BY {order} DESC LIMIT :limit"
    rows = connection.execute(query, {**_values(asked), "limit": limit}).fetchall()
    return [LogLine(*row) for row in reversed(rows)]


def count_lines(connection: sqlite3.Connection, asked: LogFilter) -> int:
    """How many lines match; `COUNT_LIMIT` stands for that many or more."""
    query = f"SELECT count(*) FROM (SELECT 1 {_source(asked)} LIMIT {COUNT_LIMIT})"
    return int(connection.execute(query, _values(asked)).fetchone()[0])


def _source(asked: LogFilter) -> str:
    return _OF_ROBOT if asked.run_id is None else _OF_RUN


def _values(asked: LogFilter) -> dict[str, object]:
    return {
        "run_id": asked.run_id,
        "robot_id": asked.robot_id,
        "start_s": asked.window.start_s,
        "end_s": asked.window.end_s,
        "text": asked.text.lower(),
        "lowest": LOG_LEVELS.index(asked.lowest_level),
        "before_id": asked.before_id,
    }
