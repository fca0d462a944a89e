"""A window of wall time: the rows that were recorded in it, and the distance travelled."""

from __future__ import annotations

import math
import sqlite3
from dataclasses import dataclass, replace
from typing import Any

from webots_mcp.questions.bounds import newest_runs
from webots_mcp.questions.budget import figure, seconds
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.motion import (
    doubt_of_length,
    doubt_of_unit,
    find_motion,
)
from webots_mcp.store.questions.outcomes import Way, read_way
from webots_mcp.store.reading.deadline import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.reading.ranges import Scope, Segment, TimeRange, find_range, row_before
from webots_mcp.store.recording import View
from webots_mcp.store.signals.catalogue import known_signals


@dataclass(frozen=True)
class Window:
    """The recording since a moment.

    Attributes:
        rows: The time range of the rows; without segments if there are none.
        around: The same range, extended to the row before and to everything after the last row,
            since a pause or a log line lies between rows.
    """

    rows: TimeRange
    around: TimeRange


def window_from(view: View, wall_start_s: float) -> Window:
    """The window of a robot from that wall time (Unix) on."""
    found = find_range(view.connection, Scope(since_wall_time=wall_start_s), view.subject)
    found = newest_runs(found if found.segments else replace(found, notes=()))
    around = [
        replace(segment, start_s=_from_row_before(view.connection, segment))
        for segment in found.segments or [_standing(view, wall_start_s)]
    ]
    around[-1] = replace(around[-1], end_s=math.inf)
    return Window(found, replace(found, segments=tuple(around)))


def _from_row_before(connection: sqlite3.Connection, segment: Segment) -> float:
    before_s = row_before(connection, segment.run_id, segment.start_s)
    return segment.start_s if before_s is None else before_s


def _standing(view: View, wall_start_s: float) -> Segment:
    """The current run from its newest row on, limited to what was recorded in the window."""
    run = view.require_run()
    newest_s = view.state.sim_time_s if view.state else run.started_sim_time_s
    return Segment(run.id, newest_s, math.inf, wall_start_s)


def movement(
    view: View, found: TimeRange, deadline_s: float = QUESTION_DEADLINE_S
) -> dict[str, Any] | None:
    """Distance along the path and displacement, in metres; None without a position.

    Several runs are reported one by one: the jump to the start at a reset was not travelled. Where
    reading took longer than the deadline, the answer has the time since which rows are missing.
    """
    known = known_signals(view.connection, found)
    position = find_motion(known, EventOptions()).position
    if position is None:
        return None
    deadline = Deadline(deadline_s)
    names: dict[str, Any] = {"position": [signal.name for signal in position]}
    ways: dict[int, dict[str, Any]] = {}
    speeds_m_s: list[float] = []
    for segment in found.segments:
        way = read_way(view.connection, segment, position, deadline)
        missing = {}
        if way.cut_at_s is not None:
            missing = {"rows_missing_from_s": seconds(max(way.cut_at_s, segment.start_s))}
        if facts := (_distances(way) or {}) | missing:
            ways[segment.run_id] = facts
            took_s = float(way.times[-1] - way.times[0]) if len(way.times) else 0.0
            travelled_m: float = facts.get("distance_m") or 0.0
            speeds_m_s.append(travelled_m / took_s if took_s else 0.0)
    if doubt := doubt_of_unit(position, max(speeds_m_s, default=0.0)):
        names |= {"unit": doubt}
    if len(ways) > 1:
        return names | {"runs": [{"run_id": run_id, **way} for run_id, way in ways.items()]}
    return next((names | way for way in ways.values()), None)


def _distances(way: Way) -> dict[str, Any] | None:
    """Start, end, distance and displacement in one run, without invalid positions."""
    if len(way.times) < 2:
        return None
    length = way.length
    note = doubt_of_length(length)
    first, last = ((float(way.x_m[row]), float(way.y_m[row])) for row in (0, -1))
    return {
        "from_m": [figure(value) for value in first],
        "to_m": [figure(value) for value in last],
        "distance_m": figure(length.length_m),
        **({"distance_note": note} if note else {}),
        "displacement_m": figure(math.dist(first, last)),
    }
