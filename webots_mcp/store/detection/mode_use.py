"""In which modes a robot moves and stands: seen in this run and in earlier ones."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Indexes, median, np
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.motion import Motion, RunNoise, places_in
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import Segment, just_after, recorded_bounds
from webots_mcp.store.signals.flatten import shown

ROLLS_OUT_S: Final = 1.5  # after a mode began, the motion of the mode before may go on
LEAST_MOVED_M: Final = 0.3  # within so long: who drifts about a place does not move
AWAY_S: Final = 20.0
LEAST_NOISE: Final = 8.0  # deviations of what is left of the noise
USUALLY_STANDS: Final = 4  # times as many visits as it moves in, of at least so many visits
LEAST_VISITS: Final = 3
EARLIER_RUNS: Final = 3
MOST_ROWS: Final = 2_000_000  # of a run: its first ones
_STANDS_SHARE: Final = 0.8  # of a visit
_MOVES_SHARE: Final = 0.1  # of the samples of a visit, or of so many
_ENOUGH: Final = 200
_SAMPLE_S: Final = 0.5
_FAST: Final = 0.9  # of the speeds while it moves are below what is called fast
_PACE_S: Final = 1.0  # over so long a speed is measured; longer, by so much for each metre of noise
_PACE_S_PER_M: Final = 100.0

_EARLIER: Final = (
    "SELECT id FROM run WHERE robot_id = (SELECT robot_id FROM run WHERE id = ?) AND id < ? "
    "ORDER BY id DESC LIMIT ?"
)


@dataclass(frozen=True)
class ModeUse:
    """What a robot did in a mode.

    Attributes:
        moving: Visits of it in which it moved; `standing` those in which it mostly stood.
        speed_m_s: How fast it usually was while it moved; `run_id` says in which run.
    """

    moving: int = 0
    standing: int = 0
    speed_m_s: float = 0.0
    run_id: int = 0

    @property
    def usually_stands(self) -> bool:
        """Whether it moved in few of many visits."""
        return self.standing >= max(LEAST_VISITS, USUALLY_STANDS * self.moving)

    def with_more(self, other: ModeUse) -> ModeUse:
        """Together with another; the speed is the first that is known."""
        moving, standing = self.moving + other.moving, self.standing + other.standing
        return replace(self if self.moving else other, moving=moving, standing=standing)


class ModeUses:
    """What a robot does in its modes, from as many of its runs as that takes.

    Attributes:
        run_id: The run that is searched.
        is_cut: There was no time to read all of these runs.
    """

    def __init__(
        self,
        connection: sqlite3.Connection,
        run: Frame,
        motion: Motion,
        options: EventOptions,
        deadline: Deadline,
    ) -> None:
        self.run_id = run.run_id
        self.is_cut = False
        self._motion = motion
        self._options = options
        self._frames = self._runs(connection, run, deadline)
        self._known: dict[str, ModeUse] = {}

    def of(self, mode: str) -> ModeUse:
        """What it did in a mode; runs are read until one of them shows that it moved."""
        while not self._known.get(mode, ModeUse()).moving:
            if (frame := next(self._frames, None)) is None:
                break
            self.is_cut |= frame.cut_at_s is not None
            for name, use in uses_in(frame, self._motion, self._options):
                self._known[name] = self._known.get(name, ModeUse()).with_more(use)
        return self._known.get(mode, ModeUse())

    def _runs(
        self, connection: sqlite3.Connection, run: Frame, deadline: Deadline
    ) -> Iterator[Frame]:
        """The run and a few of the same robot before it, as far as there is time."""
        earlier = connection.execute(_EARLIER, (run.run_id, run.run_id, EARLIER_RUNS)).fetchall()
        for run_id in (run.run_id, *(run_id for (run_id,) in earlier)):
            if deadline.passed:
                self.is_cut = True
                return
            bounds = recorded_bounds(connection, run_id)
            if run_id == run.run_id:
                yield run.rows(0, MOST_ROWS)
            elif bounds is not None:
                whole = Segment(run_id, bounds[0], just_after(bounds[1]))
                yield read_frame(connection, whole, deadline).rows(0, MOST_ROWS)


def uses_in(frame: Frame, motion: Motion, options: EventOptions) -> Iterator[tuple[str, ModeUse]]:
    """What a robot did in the modes of a frame, by its mean places in half a second each."""
    if motion.mode is None or motion.position is None:
        return
    codes, labels = frame.coded(motion.mode.name)
    rows, x, y = places_in(frame, motion.position)
    if not len(rows):
        return
    is_all = len(rows) == len(frame)
    times, codes = (frame.times, codes) if is_all else (frame.times[rows], codes[rows])
    same = (np.diff(times // _SAMPLE_S) == 0) & (np.diff(codes) == 0)
    starts = np.flatnonzero(np.append(True, ~same))
    counts = np.diff(starts, append=len(rows))
    times, x, y = (np.add.reduceat(each, starts) / counts for each in (times, x, y))
    left_m = RunNoise(frame, motion).position_m / median(counts) ** 0.5
    codes: Indexes = codes[starts]
    changes = np.flatnonzero(np.diff(codes)) + 1
    visits = np.searchsorted(changes, np.arange(len(codes)), "right")
    begins_s = np.append(times[0] - ROLLS_OUT_S, times[changes])[visits]
    there = np.flatnonzero(times >= begins_s + ROLLS_OUT_S)
    times, x, y = times[there], x[there], y[there]
    codes, visits = codes[there], visits[there]
    firsts = np.flatnonzero(np.diff(visits, prepend=-1))
    lengths = np.diff(firsts, append=len(visits))
    last = np.repeat(firsts + lengths - 1, lengths)

    def way_m(over_s: float) -> tuple[Array, Array]:
        later = np.minimum(np.searchsorted(times, times + over_s), last)
        return np.hypot(x[later] - x, y[later] - y), times[later] - times

    noise_m = LEAST_NOISE * left_m
    got_away = way_m(AWAY_S)[0] >= max(LEAST_MOVED_M, noise_m)
    moved = np.add.reduceat(got_away * 1.0, firsts) >= _MOVES_SHARE * np.minimum(lengths, _ENOUGH)
    slow = way_m(options.stuck_s)[0] <= max(options.stuck_m, noise_m)
    stood = np.add.reduceat(slow * 1.0, firsts) >= _STANDS_SHARE * lengths
    stood &= times[firsts + lengths - 1] - times[firsts] >= options.stuck_s
    paced_m, took_s = way_m(pace_s := max(_PACE_S, _PACE_S_PER_M * left_m))
    speeds = paced_m / np.maximum(took_s, pace_s / 2)
    for code in np.unique(codes).tolist():
        own, mode = codes[firsts] == code, shown(labels[int(code)])
        some = speeds[np.repeat(own & moved, lengths)]
        # Not beside the greatest one: where it was put elsewhere it seems to be very fast.
        fast = float(np.quantile(some, _FAST)) if len(some) else 0.0
        speed_m_s = median(some[some >= fast / 2]) if len(some) else 0.0
        counted = int((own & moved).sum()), int((own & stood).sum())
        if mode is not None:
            yield mode, ModeUse(*counted, speed_m_s, frame.run_id)
