"""The way of a robot in a run: where it was, and how far it went."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from typing import TYPE_CHECKING

from webots_mcp.naming import FARTHEST_M
from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.motion import find_motion, in_metres
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import Segment, TimeRange, whole_run
from webots_mcp.store.reading.subject import Subject
from webots_mcp.store.signals.catalogue import known_signals
from webots_mcp.store.signals.registry import Signal

if TYPE_CHECKING:
    from webots_mcp.store.analysis.track import PathLength


@dataclass(frozen=True)
class Way:
    """Where a robot was in a stretch of one run.

    Attributes:
        times: Of the rows that have a position, in s.
        x_m: In metres, as `y_m`.
        cut_at_s: As of a frame: not all was read.
    """

    times: Array
    x_m: Array
    y_m: Array
    cut_at_s: float | None

    @property
    def length(self) -> PathLength:
        """How long it is, without what the noise of the position adds from row to row."""
        from webots_mcp.store.analysis.track import tracks_of, travelled

        return travelled(tracks_of(self.times, self.x_m, self.y_m))


def read_way(
    connection: sqlite3.Connection,
    segment: Segment,
    position: tuple[Signal, Signal],
    deadline: Deadline,
) -> Way:
    """The way of a robot in a segment, as far as it is read before the deadline."""
    frame = read_frame(connection, segment, deadline)
    x, y = (in_metres(each, frame.numbers(each.name)) for each in position)
    there = np.maximum(np.abs(x), np.abs(y)) <= FARTHEST_M
    return Way(frame.times[there], x[there], y[there], frame.cut_at_s)


def way_of_run(
    connection: sqlite3.Connection, subject: Subject, deadline: Deadline
) -> PathLength | None:
    """How far a robot went in a run; None where no position is recorded, or not all was read."""
    whole = whole_run(connection, subject.run_id)
    if whole is None:
        return None
    asked = TimeRange(subject.robot_id, subject.robot, (whole,), "simulation")
    position = find_motion(known_signals(connection, asked), EventOptions()).position
    if position is None:
        return None
    way = read_way(connection, whole, position, deadline)
    return None if way.cut_at_s is not None or len(way.times) < 2 else way.length
