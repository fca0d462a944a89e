"""Log lines of a run: by text, level and time."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from typing import Final

from webots_mcp.store.window import Window

LEVELS: Final = ("debug", "info", "warning", "error")
COUNT_LIMIT: Final = 10_000  # beyond it a count would cost more than it tells

_COLUMNS: Final = "id, run_id, sim_time_s, wall_time_s, level, source, message"
_MATCHING: Final = (
    "FROM log WHERE run_id = :run_id AND sim_time_s >= :start_s AND sim_time_s < :end_s "
    "AND (:before_id IS NULL OR id < :before_id) "
    "AND (:text = '' OR instr(lower(message), :text) > 0) "
    "AND CASE level WHEN 'debug' THEN 0 WHEN 'info' THEN 1 WHEN 'warning' THEN 2 ELSE 3 END "
    ">= :lowest"
)
_NEWEST: Final = f"SELECT {_COLUMNS} {_MATCHING} ORDER BY sim_time_s DESC, id DESC LIMIT :limit"
_COUNT: Final = f"SELECT count(*) FROM (SELECT 1 {_MATCHING} LIMIT {COUNT_LIMIT})"
_AFTER: Final = (
    f"SELECT {_COLUMNS} FROM log WHERE run_id = :run_id AND id > :after_id ORDER BY sim_time_s, id "
    "LIMIT :limit"
)
_NEWEST_ID: Final = "SELECT coalesce(max(id), 0) FROM log"


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
    """The newest lines that match, oldest first."""
    rows = connection.execute(_NEWEST, {**_values(asked), "limit": limit}).fetchall()
    return [LogLine(*row) for row in reversed(rows)]


def count_lines(connection: sqlite3.Connection, asked: LogFilter) -> int:
    """How many lines match; `COUNT_LIMIT` stands for that many or more."""
    return int(connection.execute(_COUNT, _values(asked)).fetchone()[0])


def lines_after(
    connection: sqlite3.Connection, run_id: int, after_id: int, limit: int
) -> list[LogLine]:
    """The lines of a run with greater ids, in order."""
    values = {"run_id": run_id, "after_id": after_id, "limit": limit}
    return [LogLine(*row) for row in connection.execute(_AFTER, values).fetchall()]


def newest_log_id(connection: sqlite3.Connection) -> int:
    """A cursor: lines logged from now on have greater ids."""
    return int(connection.execute(_NEWEST_ID).fetchone()[0])


def _values(asked: LogFilter) -> dict[str, object]:
    return {
        "run_id": asked.run_id,
        "start_s": asked.window.start_s,
        "end_s": asked.window.end_s,
        "text": asked.text.lower(),
        "lowest": LEVELS.index(asked.lowest_level),
        "before_id": asked.before_id,
    }
