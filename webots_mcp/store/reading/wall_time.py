"""Wall times as a person gives them, and the part of a run that lies between two of them."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable
from datetime import datetime
from typing import TYPE_CHECKING, Final

from webots_mcp.errors import InvalidRangeError
from webots_mcp.store.analysis.arrays import np
from webots_mcp.store.chunks import WALL_TIMES
from webots_mcp.store.reading.deadline import Deadline

if TYPE_CHECKING:
    from webots_mcp.store.reading.frame import Frame

_ENDS: Final = (
    "SELECT started_sim_time_s, started_wall_time_s, last_sim_time_s, last_wall_time_s "
    "FROM run WHERE id = ?"
)
_IS_PURGED: Final = "SELECT 1 FROM run WHERE id = ? AND purged_rows > 0"
_FIRST_ROW: Final = (
    "SELECT sim_time_s, wall_time_s FROM state WHERE run_id = ? ORDER BY sim_time_s, id LIMIT 1"
)
UP_TO: Final = (  # of the last row at or before a simulation time
    "SELECT wall_time_s FROM state WHERE run_id = ? AND sim_time_s <= ? "
    "ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)
_FROM: Final = (  # of the first row at or after a simulation time
    "SELECT wall_time_s FROM state WHERE run_id = ? AND sim_time_s >= ? "
    "ORDER BY sim_time_s, id LIMIT 1"
)
_SET_BACK_S: Final = 1.0  # less is what keeps a clock right
# Whether wall time falls with simulation time: by what chunks come to, and by rows in none.
_FALLS: Final = (
    "SELECT 1 FROM (SELECT min, max, first, last, lag(last) OVER (ORDER BY at_s, id) AS before "
    "FROM (SELECT g.start_sim_time_s AS at_s, 0 AS id, min, max, first, last FROM chunk c "
    "JOIN row_group g ON g.id = c.group_id "
    f"WHERE c.run_id = :run AND c.signal_id = {WALL_TIMES} AND g.is_complete = 1 UNION ALL "
    "SELECT sim_time_s, id, wall_time_s, wall_time_s, wall_time_s, wall_time_s FROM state "
    "WHERE run_id = :run AND sim_time_s > coalesce((SELECT max(end_sim_time_s) FROM row_group "
    "WHERE run_id = :run AND is_complete = 1), -9e999))) "
    f"WHERE first < before - {_SET_BACK_S} OR min < first - {_SET_BACK_S} "
    f"OR max > last + {_SET_BACK_S} LIMIT 1"
)
_BISECTIONS: Final = 60
_LONGEST_SHOWN: Final = 80


def parse_wall_time(value: float | str | None, default_s: float = math.nan) -> float:
    """Unix seconds of a wall time, given as such or in ISO 8601.

    Without an offset ISO times are local times of this machine.

    Raises:
        InvalidRangeError: Neither a finite number nor ISO 8601.
    """
    if value is None:
        return default_s
    try:
        seconds = float(value)
    except ValueError:
        seconds = _iso_seconds(str(value))
    if not math.isfinite(seconds):
        raise InvalidRangeError(f"{value!r} is not a finite time in Unix seconds")
    return seconds


def _iso_seconds(text: str) -> float:
    try:
        return datetime.fromisoformat(text.strip().replace("Z", "+00:00")).timestamp()
    except (ValueError, OverflowError, OSError) as error:
        raise InvalidRangeError(
            f"{text[:_LONGEST_SHOWN]!r} is no time: give Unix seconds or ISO 8601 such as "
            "2026-05-04T13:30:00+02:00"
        ) from error


def rising_parts(
    connection: sqlite3.Connection, run_id: int, recorded: tuple[float, float]
) -> list[tuple[float, float]]:
    """Simulation times between which the wall clock of a run was not set back, the newest first.

    Args:
        connection: Any.
        run_id: Which.
        recorded: Simulation times of its first and newest row.
    """
    if not connection.execute(_FALLS, {"run": run_id}).fetchone():
        return [recorded]
    frame = _all_rows(connection, run_id)
    after = np.flatnonzero(np.diff(frame.wall_times) < -_SET_BACK_S) + 1
    starts = [recorded[0], *frame.times[after].tolist()]
    return list(zip(starts, [*frame.times[after - 1].tolist(), recorded[1]], strict=True))[::-1]


def simulation_times(
    connection: sqlite3.Connection,
    run_id: int,
    recorded: tuple[float, float],
    walls: tuple[float, float],
) -> tuple[float, float] | None:
    """First and last simulation time of a run in [start, end) of wall time; None without any.

    Wall time rises with simulation time there, so both are found by bisection.

    Args:
        connection: Any.
        run_id: Which.
        recorded: Simulation times between which to look; see `rising_parts`.
        walls: Unix times.
    """
    clock = RunClock(connection, run_id)

    def begun(time_s: float) -> bool:
        return clock.wall_s(UP_TO, time_s) >= walls[0]

    def over(time_s: float) -> bool:
        return clock.wall_s(_FROM, time_s) >= walls[1]

    first_s, newest_s = recorded
    if not begun(newest_s) or over(first_s):
        return None
    start_s = first_s if begun(first_s) else _turning_point(first_s, newest_s, begun)[1]
    last_s = _turning_point(first_s, newest_s, over)[0] if over(newest_s) else newest_s
    return (start_s, last_s) if start_s <= last_s else None  # else between two rows


def frame_of_purged(connection: sqlite3.Connection, run_id: int) -> Frame | None:
    """All rows of a run that has lost some from `state`; None where that table has all of them."""
    if not connection.execute(_IS_PURGED, (run_id,)).fetchone():
        return None
    return _all_rows(connection, run_id)


def _all_rows(connection: sqlite3.Connection, run_id: int) -> Frame:
    from webots_mcp.store.reading.frame import read_frame  # which imports this module
    from webots_mcp.store.reading.ranges import Segment

    return read_frame(connection, Segment(run_id, -math.inf, math.inf), Deadline())


class RunClock:
    """The wall times of a run; of rows that are in no chunk either as if it had risen evenly."""

    def __init__(self, connection: sqlite3.Connection, run_id: int) -> None:
        self._connection = connection
        self._run_id = run_id
        *start, last_s, last_wall_s = connection.execute(_ENDS, (run_id,)).fetchone()
        self._frame = frame_of_purged(connection, run_id)
        first_row: tuple[float, float] | None = None
        if self._frame is None:
            first_row = connection.execute(_FIRST_ROW, (run_id,)).fetchone()
        elif len(self._frame):
            first_row = self._frame.bounds_s[0], float(self._frame.rows(0, 1).wall_times[0])
        self._start_s, self._start_wall_s = start
        self._rows_from_s, self._rows_from_wall_s = first_row or (last_s, last_wall_s)

    def wall_s(self, query: str, time_s: float) -> float:
        """At a simulation time; before the recording that of its start."""
        if time_s >= self._rows_from_s and self._frame is not None and len(self._frame):
            from_s = time_s if query == _FROM else math.nextafter(time_s, math.inf)
            place = int(self._frame.places([from_s])[0]) - (query != _FROM)
            place = min(place, len(self._frame) - 1)
            return float(self._frame.rows(place, place + 1).wall_times[0])
        if time_s >= self._rows_from_s:
            row = self._connection.execute(query, (self._run_id, time_s)).fetchone()
            return float(row[0]) if row else self._rows_from_wall_s
        if time_s <= self._start_s:
            return self._start_wall_s
        share = (time_s - self._start_s) / (self._rows_from_s - self._start_s)
        return self._start_wall_s + share * (self._rows_from_wall_s - self._start_wall_s)


def _turning_point(
    before_s: float, after_s: float, has_turned: Callable[[float], bool]
) -> tuple[float, float]:
    """The last time before and the first after something turned from false to true."""
    for _ in range(_BISECTIONS):
        middle_s = (before_s + after_s) / 2
        if has_turned(middle_s):
            after_s = middle_s
        else:
            before_s = middle_s
    return before_s, after_s
