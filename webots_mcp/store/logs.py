"""Log lines of a run: by text, level and time."""

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


_COLUMNS: Final = columns_of(LogLine)
_MATCHING: Final = (
    "FROM log WHERE run_id = :run_id AND sim_time_s >= :start_s AND sim_time_s < :end_s "
    "AND (:before_id IS NULL OR id < :before_id) "
    "AND (:text = '' OR instr(lower(message), :text) > 0) "
    "AND CASE level WHEN 'debug' THEN 0 WHEN 'info' THEN 1 WHEN 'warning' THEN 2 ELSE 3 END "
    ">= :lowest"
)
_NEWEST: Final = f"SELECT {_COLUMNS} {_MATCHING} ORDER BY sim_time_s DESC, id DESC LIMIT :limit"
_COUNT: Final = f"SELECT count(*) FROM (SELECT 1 {_MATCHING} LIMIT {COUNT_LIMIT})"


@dataclass(frozen=True)
class LogFilter:
    """Which lines are asked for.

    Args:
        run_id: The run.
        window: Simulation time.
        text: Part of the message; ASCII letters match in either case.
        lowest_level: This level and those above it.
        before_id: Only lines with smaller ids, to page towards older ones.
    """

    run_id: int
    window: Window
    text: str = ""
    lowest_level: str = "debug"
    before_id: int | None = None


def newest_lines(connection: sqlite3.Connection, asked: LogFilter, limit: int) -> list[LogLine]:
    """The newest lines that match, oldest first; with a limit of -1 all of them."""
    rows = connection.execute(_NEWEST, {**_values(asked), "limit": limit}).fetchall()
    return [LogLine(*row) for row in reversed(rows)]


def count_lines(connection: sqlite3.Connection, asked: LogFilter) -> int:
    """How many lines match; `COUNT_LIMIT` stands for that many or more."""
    return int(connection.execute(_COUNT, _values(asked)).fetchone()[0])


def _values(asked: LogFilter) -> dict[str, object]:
    return {
        "run_id": asked.run_id,
        "start_s": asked.window.start_s,
        "end_s": asked.window.end_s,
        "text": asked.text.lower(),
        "lowest": LOG_LEVELS.index(asked.lowest_level),
        "before_id": asked.before_id,
    }
