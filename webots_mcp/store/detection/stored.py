"""Events that were stored when they happened: runs, commands, logs, pictures, what was noticed."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, Final

from webots_mcp.store.detection.event import LEVELS, Event, EventOptions
from webots_mcp.store.reading.changes import change_points
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.gaps import rhythm_in, rhythm_of, with_rows_around
from webots_mcp.store.reading.ranges import Segment, just_after
from webots_mcp.store.reading.rows import exceeds, read_columns
from webots_mcp.store.signals.registry import Signal

MOST_OF_A_KIND: Final = 2000  # newest rows of a table that are looked at, per run
MOST_CHANGES: Final = 500  # newest change points of one signal that become events

_IN_SEGMENT: Final = (
    "WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ? AND wall_time_s >= ? "
    "AND wall_time_s < ? "
)
_NEWEST: Final = "ORDER BY sim_time_s DESC, id DESC LIMIT ?"
_LOGS: Final = f"SELECT sim_time_s, wall_time_s, level, source, message FROM log {_IN_SEGMENT}"
_NOTICED: Final = (  # changes are in the change table, of all signals and without a limit
    f"SELECT sim_time_s, wall_time_s, kind, name, data FROM event {_IN_SEGMENT} "
    "AND kind NOT IN ('change', 'start', 'reset', 'reload') "
)
_IMAGES: Final = f"SELECT sim_time_s, wall_time_s, kind, device, path, id FROM image {_IN_SEGMENT}"
_RUN: Final = (
    "SELECT started_sim_time_s, started_wall_time_s, start_reason, last_sim_time_s, "
    "ended_wall_time_s, end_reason FROM run WHERE id = ?"
)
# A command belongs to the run of its robot that went on when it was claimed, else created.
_COMMANDS: Final = (
    "SELECT id, action, params, status, created_wall_time_s, claimed_wall_time_s, "
    "claimed_sim_time_s, finished_wall_time_s, finished_sim_time_s, result, error FROM command "
    "WHERE robot_id = (SELECT robot_id FROM run WHERE id = :run) "
    "AND coalesce(claimed_wall_time_s, created_wall_time_s) >= :start_wall "
    "AND coalesce(claimed_wall_time_s, created_wall_time_s) < :end_wall "
    "ORDER BY id DESC LIMIT :limit"
)
_RUN_WALLS: Final = (
    "SELECT started_wall_time_s, coalesce((SELECT min(n.started_wall_time_s) FROM run n "
    "WHERE n.robot_id = r.robot_id AND n.id > r.id), 9e99) FROM run r WHERE id = ?"
)
_SIM_AT_WALL: Final = (
    "SELECT sim_time_s FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ? "
    "AND wall_time_s <= ? ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)
_WALL_AT: Final = (
    "SELECT wall_time_s FROM state WHERE run_id = ? AND sim_time_s <= ? "
    "ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)


def wall_time_at(connection: sqlite3.Connection, run_id: int, sim_time_s: float) -> float:
    """Wall time of the run's last row at or before a simulation time; else of the run's start."""
    row = connection.execute(_WALL_AT, (run_id, sim_time_s)).fetchone()
    return float(row[0] if row else connection.execute(_RUN, (run_id,)).fetchone()[1])


def run_events(connection: sqlite3.Connection, segment: Segment) -> Iterator[Event]:
    """Begin and end of the run, where the segment holds them."""
    start_s, start_wall_s, start, end_s, end_wall_s, end = connection.execute(
        _RUN, (segment.run_id,)
    ).fetchone()
    if segment.holds_from_s <= start_s and segment.wall_start_s <= start_wall_s:
        details = {"what": "began", "reason": start}
        yield Event("run", segment.run_id, start_s, start_s, start_wall_s, None, details)
    if end_wall_s is not None and end_s < segment.holds_to_s and end_wall_s < segment.wall_end_s:
        details = {"what": "ended", "reason": end}
        yield Event("run", segment.run_id, end_s, end_s, end_wall_s, None, details)


def gap_events(connection: sqlite3.Connection, segment: Segment, deadline: Deadline) -> list[Event]:
    """Where rows are missing: gaps that the segment touches, also all around it."""
    around = with_rows_around(connection, segment)
    if exceeds(connection, around):
        rhythm = rhythm_in(connection, around)
    else:
        rhythm = rhythm_of(read_columns(connection, around, (), deadline).times)
    details = {"usual_interval_s": rhythm.interval_s}
    return [
        Event("gap", segment.run_id, gap.start_s, gap.end_s, wall_s, None, details)
        for gap in rhythm.gaps
        if gap.end_s > segment.start_s and gap.start_s < segment.end_s
        for wall_s in [wall_time_at(connection, segment.run_id, gap.start_s)]
    ]


def change_events(
    connection: sqlite3.Connection,
    segment: Segment,
    newest_s: float,
    signals: Sequence[Signal],
    deadline: Deadline,
) -> Iterator[Event]:
    """Changes of text and flags, each as long as the new value lasted, up to the newest row."""
    states = [signal for signal in signals if not signal.is_number]
    # From just before on: what changed exactly at the start had another value until then.
    before_s = math.nextafter(segment.start_s, -math.inf)
    whole = Segment(segment.run_id, before_s, just_after(newest_s))
    for name, points in change_points(connection, whole, states, deadline).items():
        ends_s = [*(point.sim_time_s for point in points[2:]), None]
        changes = [
            (before, point, end_s)
            for (before, point), end_s in zip(pairwise(points), ends_s, strict=False)
            if segment.start_s <= point.sim_time_s < segment.end_s
        ]
        for before, point, end_s in changes[-MOST_CHANGES:]:
            place = (segment.run_id, point.sim_time_s, newest_s if end_s is None else end_s)
            wall_s = wall_time_at(connection, segment.run_id, point.sim_time_s)
            details = {"before": before.value, "after": point.value}
            yield Event("change", *place, wall_s, name, details, ongoing=end_s is None)


def log_events(
    connection: sqlite3.Connection, segment: Segment, options: EventOptions
) -> Iterator[Event]:
    """Log lines of the level and above."""
    levels = LEVELS[LEVELS.index(options.log_level) :]
    marks = ", ".join("?" * len(levels))
    query = f"{_LOGS} AND level IN ({marks}) {_NEWEST}"
    for time_s, wall_s, level, source, message in connection.execute(
        query, (*_bounds(segment), *levels, MOST_OF_A_KIND)
    ):
        details = {"source": source, "message": message}
        yield Event("log", segment.run_id, time_s, time_s, wall_s, level, details)


def noticed_events(connection: sqlite3.Connection, segment: Segment) -> Iterator[Event]:
    """What the bridge noticed and stored: pause, resume, dropped rows, trouble with storage."""
    rows = connection.execute(_NOTICED + _NEWEST, (*_bounds(segment), MOST_OF_A_KIND))
    for time_s, wall_s, kind, name, data in rows:
        details: dict[str, Any] = {"what": kind}
        if data:
            details["data"] = json.loads(data)
        yield Event("noticed", segment.run_id, time_s, time_s, wall_s, name, details)


def image_events(connection: sqlite3.Connection, segment: Segment) -> Iterator[Event]:
    """Camera frames and screenshots."""
    rows = connection.execute(_IMAGES + _NEWEST, (*_bounds(segment), MOST_OF_A_KIND))
    for time_s, wall_s, kind, device, path, image_id in rows:
        details = {"kind": kind, "path": path, "image_id": image_id}
        yield Event("image", segment.run_id, time_s, time_s, wall_s, device, details)


def command_events(connection: sqlite3.Connection, segment: Segment) -> Iterator[Event]:
    """Commands, from when they were claimed (or created, if never) to when they were finished."""
    start_wall_s, end_wall_s = connection.execute(_RUN_WALLS, (segment.run_id,)).fetchone()
    walls = {
        "start_wall": max(start_wall_s, segment.wall_start_s),
        "end_wall": min(end_wall_s, segment.wall_end_s),
    }
    rows = connection.execute(_COMMANDS, {"run": segment.run_id, "limit": MOST_OF_A_KIND, **walls})
    for row in rows.fetchall():
        event = _command(connection, segment, row)
        if event is not None:
            yield event


def _command(
    connection: sqlite3.Connection, segment: Segment, row: tuple[Any, ...]
) -> Event | None:
    """None if it was outside the segment in simulation time."""
    command_id, action, params, status, created_s, claimed_s, start_s, *finished = row
    finished_wall_s, end_s, result, error = finished
    wall_s = created_s if claimed_s is None else claimed_s
    if start_s is None:
        span = (segment.run_id, segment.holds_from_s, segment.holds_to_s, wall_s)
        at = connection.execute(_SIM_AT_WALL, span).fetchone()
        start_s = at[0] if at else None
    if start_s is None or not segment.holds_from_s <= start_s < segment.holds_to_s:
        return None
    details: dict[str, Any] = {"id": command_id, "status": status, "params": json.loads(params)}
    if finished_wall_s is not None:
        details["took_wall_s"] = finished_wall_s - wall_s
    details |= {"result": json.loads(result)} if result else {}
    details |= {"error": error} if error else {}
    end_s = start_s if end_s is None or end_s < start_s else end_s  # a reset finishes in a new run
    ongoing = status in ("pending", "claimed")
    place = (segment.run_id, start_s, end_s, wall_s)
    return Event("command", *place, action, details, ongoing=ongoing)


def _bounds(segment: Segment) -> tuple[float, ...]:
    walls = (segment.wall_start_s, segment.wall_end_s)
    return (segment.run_id, segment.holds_from_s, segment.holds_to_s, *walls)
