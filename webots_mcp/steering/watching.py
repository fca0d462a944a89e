"""A window of wall time: the rows that were recorded in it, and the distance travelled."""

from __future__ import annotations

import math
import sqlite3
from dataclasses import dataclass, replace
from typing import Any, Final

from webots_mcp.questions.bounds import newest_runs
from webots_mcp.questions.budget import figure, seconds
from webots_mcp.store.detection.kinds import EventOptions
from webots_mcp.store.detection.motion import (
    doubt_of_length,
    doubt_of_unit,
    motion_in,
)
from webots_mcp.store.questions.outcomes import Way, way_in
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range, row_before
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S, Deadline, Segment
from webots_mcp.store.recording import View

_NAMING: Final = ("position", "unit")  # said once where it is the same of all runs


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

    Each run has its own position: its controller may have had other names for it.

    Several runs are reported one by one: the jump to the start at a reset was not travelled. Where
    reading took longer than the deadline, the answer has the time since which rows are missing.
    """
    known = known_signals(view.connection, found)
    deadline = Deadline(deadline_s)
    ways: dict[int, dict[str, Any]] = {}
    for segment in found.segments:
        frame = read_frame(view.connection, segment, deadline)
        position = motion_in(frame, known, EventOptions()).position
        if position is None:
            continue
        way = way_in(frame, position)
        facts = _distances(way) or {}
        if way.cut_at_s is not None:
            facts["rows_missing_from_s"] = seconds(max(way.cut_at_s, segment.start_s))
        if not facts:
            continue
        took_s = float(way.times[-1] - way.times[0]) if len(way.times) else 0.0
        speed_m_s = (facts.get("distance_m") or 0.0) / took_s if took_s else 0.0
        names: dict[str, Any] = {"position": [signal.name for signal in position]}
        if doubt := doubt_of_unit(position, speed_m_s):
            names["unit"] = doubt
        ways[segment.run_id] = names | facts
    if len(ways) < 2:
        return next(iter(ways.values()), None)
    shared = {
        key: value
        for key, value in next(iter(ways.values())).items()
        if key in _NAMING and all(way.get(key) == value for way in ways.values())
    }
    own = {
        run_id: {key: value for key, value in way.items() if key not in shared}
        for run_id, way in ways.items()
    }
    return shared | {"runs": [{"run_id": run_id, **way} for run_id, way in own.items()]}


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
