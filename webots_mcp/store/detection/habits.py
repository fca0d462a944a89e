"""In which modes a robot has been seen moving, in this run and in earlier ones."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np

from webots_mcp.naming import Value
from webots_mcp.store.analysis.track import Track, path_length_m
from webots_mcp.store.detection.motion import Motion, position_noise, tracks_in
from webots_mcp.store.reading.changes import Changes, Point, change_points
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment, just_after, recorded_bounds
from webots_mcp.store.reading.rows import read_columns
from webots_mcp.store.reading.sampling import newest_part
from webots_mcp.store.signals.registry import Signal

ROLLS_OUT_S: Final = 1.5  # after a mode began, the motion of the mode before may go on
WINDOW_S: Final = 20.0  # at once is read
MOST_WINDOWS: Final = 12  # of each mode are read
LEAST_MOVED_M: Final = 0.1
LEAST_NOISE: Final = 4.0  # deviations of the position
OVER_NOISE: Final = 20.0  # deviations of what is left of it: so far it goes while speed is measured
EARLIER_RUNS: Final = 3
NOISE_ROWS: Final = 100  # fewer tell the noise of their positions badly, under 12 not at all
NEWEST_ROWS: Final = 1000  # of a run, which tell it then

_EARLIER: Final = (
    "SELECT id FROM run WHERE robot_id = (SELECT robot_id FROM run WHERE id = ?) AND id < ? "
    "ORDER BY id DESC LIMIT ?"
)


@dataclass(frozen=True)
class Seen:
    """How fast it moved in a mode, and in which run that was seen."""

    speed_m_s: float
    run_id: int


class MovedIn:
    """Looks for a mode's visits until one of them shows that the robot moved in it.

    Attributes:
        cut: Modes whose visits were not all looked at before the time was over.
    """

    def __init__(
        self, connection: sqlite3.Connection, run_id: int, motion: Motion, deadline: Deadline
    ) -> None:
        self._connection = connection
        self.run_id = run_id
        self._motion = motion
        self._deadline = deadline
        self.cut: set[Value] = set()
        self._changes: dict[int, Changes] = {}
        self._noises_m: dict[int, float | None] = {}
        self._seen: dict[Value, Seen | None] = {}

    def seen(self, mode: Value) -> Seen | None:
        """None where none of the looked at visits shows that it moved."""
        if mode not in self._seen or (mode in self.cut and not self._deadline.passed):
            self._seen[mode] = self._look(mode) if isinstance(mode, str) else None
        return self._seen[mode]

    def _look(self, mode: str) -> Seen | None:
        self.cut.discard(mode)
        runs = self._connection.execute(_EARLIER, (self.run_id, self.run_id, EARLIER_RUNS))
        for run_id in (self.run_id, *(run_id for (run_id,) in runs.fetchall())):
            for window in self._windows(run_id, mode):
                if self._deadline.passed:
                    break
                if speed_m_s := self._speed_in(window):
                    return Seen(speed_m_s, run_id)
        if self._deadline.passed:
            self.cut.add(mode)
        return None

    def _windows(self, run_id: int, mode: str) -> list[Segment]:
        """Stretches of the mode's visits, spread over the run."""
        windows = [
            Segment(run_id, start_s, min(start_s + WINDOW_S, end_s))
            for begin_s, end_s in self._visits(run_id, mode)
            for start_s in _steps(begin_s, end_s)
        ]
        every = max(1, -(-len(windows) // MOST_WINDOWS))
        return windows[::every]

    def _visits(self, run_id: int, mode: str) -> Iterator[tuple[float, float]]:
        """When the mode was in force, without the moment in which the one before rolls out."""
        bounds = recorded_bounds(self._connection, run_id)
        signal = self._motion.mode
        if bounds is None or signal is None:
            return
        whole = Segment(run_id, bounds[0], just_after(bounds[1]))
        found = self._changes.get(run_id)
        if found is None:
            found = change_points(self._connection, whole, [signal], self._deadline)
            if found.unread_from_s is None:
                self._changes[run_id] = found
        end = Point(found.read_to_s(whole.end_s), None)
        for at, (point, after) in enumerate(pairwise([*found.points[signal.name], end])):
            if point.value == mode:
                yield point.sim_time_s + (ROLLS_OUT_S if at else 0.0), after.sim_time_s

    def _speed_in(self, window: Segment) -> float | None:
        """How fast it usually was while it moved; None where it did not."""
        position = self._motion.position
        if position is None:
            return None
        columns = read_columns(self._connection, window, position, self._deadline)
        few = len(columns.times) < NOISE_ROWS
        tracks = tracks_in(columns, position, self._noise_m(window, position) if few else None)
        way_m = sum(map(path_length_m, tracks))
        if way_m < max([LEAST_MOVED_M, *(LEAST_NOISE * track.noise_m for track in tracks)]):
            return None
        return max(map(_usual_m_s, tracks)) or None

    def _noise_m(self, window: Segment, position: tuple[Signal, Signal]) -> float | None:
        """That of the position in a run, whatever the mode; None where its rows do not tell it."""
        if window.run_id not in self._noises_m:
            run = replace(window, start_s=-math.inf, end_s=math.inf)
            newest = newest_part(self._connection, run, NEWEST_ROWS)
            columns = read_columns(self._connection, newest, position, self._deadline)
            self._noises_m[window.run_id] = position_noise(columns, position)
        return self._noises_m[window.run_id]


def _steps(begin_s: float, end_s: float) -> Iterator[float]:
    while begin_s < end_s:
        yield begin_s
        begin_s += WINDOW_S


def _usual_m_s(track: Track) -> float:
    """The median speed over a second, where it is at least half of the highest.

    Over more seconds where the noise of a position would pass for speed.
    """
    lasted_s = float(track.times[-1] - track.times[0])
    way_m = path_length_m(track)
    if not way_m:
        return 0.0
    over_s = min(OVER_NOISE * track.left_m * lasted_s / way_m, lasted_s / 2)
    later = np.searchsorted(track.times, track.times + max(1.0, over_s))
    later = np.minimum(later, len(track.times) - 1)
    way_m = np.hypot(track.x[later] - track.x, track.y[later] - track.y)
    took_s = np.maximum(track.times[later] - track.times, max(0.5, over_s))
    speeds = way_m / took_s
    return float(np.median(speeds[speeds >= speeds.max() / 2]))
