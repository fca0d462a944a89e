"""The positions from which the way of a run is summed: all rows, or samples of a long stretch."""

from __future__ import annotations

import sqlite3
from typing import TYPE_CHECKING, Final, NamedTuple

from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.motion import find_motion, path_length, position_noise
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment, TimeRange, whole_run
from webots_mcp.store.reading.rows import Columns, exceeds, read_columns
from webots_mcp.store.reading.sampling import MOST_SAMPLES, newest_part, read_sampled
from webots_mcp.store.reading.subject import Subject
from webots_mcp.store.signals.catalogue import known_signals
from webots_mcp.store.signals.registry import Signal

if TYPE_CHECKING:
    from webots_mcp.store.analysis.track import PathLength

NOISE_ROWS: Final = 2000  # of a long stretch, that tell the noise of its position
SAMPLE_S: Final = 0.5  # between the positions from which a long stretch's distance is summed


class Way(NamedTuple):
    """Where a robot was in a stretch of one run.

    Attributes:
        columns: x and y of all rows or, of a long stretch, of samples and the newest row.
        position: The two signals.
        noise_m: Of samples what neighbouring rows tell; None where the columns tell it.
        sampled_s: Simulated seconds between samples; None where all rows are read.
    """

    columns: Columns
    position: tuple[Signal, Signal]
    noise_m: float | None = None
    sampled_s: float | None = None

    @property
    def length(self) -> PathLength:
        """How long it is; samples cut corners a little."""
        return path_length(self.columns, self.position, self.noise_m)


def read_way(
    connection: sqlite3.Connection,
    segment: Segment,
    position: tuple[Signal, Signal],
    deadline: Deadline,
) -> Way:
    """The way of a robot in a segment, as far as it is read before the deadline."""
    every_s = sampling_interval_s(connection, segment, position)
    if every_s is None:
        return Way(read_columns(connection, segment, position, deadline), position)
    columns = read_sampled(connection, segment, position, every_s, deadline)
    newest = read_columns(connection, newest_part(connection, segment, 0), position, deadline)
    if not columns.cut and newest.ids > columns.ids[-1:]:
        columns.add(newest)
    part = newest_part(connection, segment, NOISE_ROWS)
    noise_m = position_noise(read_columns(connection, part, position, deadline), position)
    return Way(columns, position, noise_m, every_s)


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
    return None if way.columns.cut or len(way.columns.times) < 2 else way.length


def sampling_interval_s(
    connection: sqlite3.Connection, segment: Segment, position: tuple[Signal, Signal]
) -> float | None:
    """Simulated seconds between the positions that are read; None where all are."""
    if not exceeds(connection, segment) or not all(each.is_plain for each in position):
        return None
    return max(SAMPLE_S, (segment.end_s - segment.start_s) / MOST_SAMPLES)
