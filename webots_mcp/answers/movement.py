"""How far a robot moved in a range, as an answer shows it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from webots_mcp.answers.budget import (
    figure,
    seconds,
)
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import doubt_of_length, doubt_of_unit, motion_in
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.recording import RobotView

if TYPE_CHECKING:
    from webots_mcp.judging.run_measures import Way


def movement(
    view: RobotView, found: TimeRange, deadline_s: float = QUESTION_DEADLINE_S
) -> dict[str, Any] | None:
    """Distance along the path and displacement, in metres; None without a position.

    Each run has its own position: its controller may have had other names for it.

    Several runs are reported one by one: the jump to the start at a reset was not travelled. Where
    reading took longer than the deadline, the answer has the time since which rows are missing.
    """
    from webots_mcp.judging.run_measures import way_in

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
    # A value that all runs share is shown once.
    shared = {
        key: value
        for key, value in next(iter(ways.values())).items()
        if key in ("position", "unit") and all(way.get(key) == value for way in ways.values())
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
