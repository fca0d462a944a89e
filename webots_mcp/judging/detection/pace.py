"""`slow_simulation`: a part of a run in which simulated time passed more slowly than real time.

The pace is measured over cells of simulated time, without waits. Parts are divided where it changes
by a test of ranks that divides 1 in 1,000 runs of one pace.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, median, np
from webots_mcp.analysis.level_changes import FEWEST_VALUES, level_changes
from webots_mcp.judging.detection.event import Alike, Event, NotSearchableError
from webots_mcp.judging.detection.search import EventKind, Search

SLOW: Final = 0.9  # of real time
DROPS: Final = 0.5  # of the pace at most times: a simulation that runs as fast as it can may drop
_CELL_S: Final = 1.0  # of simulation time, over which the pace is measured, or longer
_MOST_CELLS: Final = 500
_FALSE_ALARMS: Final = 1e-3  # that a run of one pace is divided
_LEAST_WALL_S: Final = 1.0
_NEARLY_SLOW: Final = 0.95  # of real time: worth a word


class PacePart(NamedTuple):
    """A part of a run of one pace: simulated and wall seconds without waits."""

    start_s: float
    end_s: float
    sim_s: float
    wall_s: float

    @property
    def factor(self) -> float:
        """The real-time factor."""
        return self.sim_s / max(self.wall_s, 1e-9)


class RunPace(NamedTuple):
    """The pace of a run.

    Attributes:
        parts: Between changes of the pace, in order; those that are slow are put together.
        usual: The real-time factor in most of the run.
        longest_wait_s: Between two rows.
    """

    parts: list[PacePart]
    usual: float
    longest_wait_s: float

    def is_slow(self, part: PacePart) -> bool:
        """Whether a part is slower than real time, or than most of the run by half."""
        return part.factor < SLOW or part.factor < DROPS * self.usual

    @property
    def slow(self) -> list[PacePart]:
        """Parts that are slow."""
        return [part for part in self.parts if self.is_slow(part)]


def pace_of(search: Search) -> RunPace:
    """Return the pace of the whole run of a search.

    A wait is over a second long and over 20 times as long as its step.

    Raises:
        NotSearchableError: It was too short.
    """
    if RunPace in search.shared:
        known: RunPace = search.shared[RunPace]
        return known
    frame = search.whole
    steps, waits = np.diff(frame.times), np.diff(frame.wall_times)
    moved = (steps > 0) & (waits >= 0)
    usual_s = float(np.median(waits[moved])) if moved.any() else 0.0  # of who is slow all the time
    goes_on = moved & (waits <= np.maximum(max(1.0, 3 * usual_s), 20 * steps))
    if float(waits[goes_on].sum()) < _LEAST_WALL_S:
        raise NotSearchableError("it lasted less than a second of wall time")
    parts = _parts_of(frame.times[1:][goes_on], steps[goes_on], waits[goes_on])
    usual = max(parts, key=lambda part: part.sim_s).factor
    pace = RunPace(parts, usual, float(waits[moved].max()))
    merged: list[PacePart] = []
    for part in parts:
        if merged and pace.is_slow(part) and pace.is_slow(merged[-1]):
            merged[-1] = together([merged[-1], part])
        else:
            merged.append(part)
    search.shared[RunPace] = pace._replace(parts=merged)
    return pace._replace(parts=merged)


def together(parts: Sequence[PacePart]) -> PacePart:
    """Return several parts as one."""
    sim_s, wall_s = sum(each.sim_s for each in parts), sum(each.wall_s for each in parts)
    return PacePart(parts[0].start_s, parts[-1].end_s, sim_s, wall_s)


def _parts_of(times: Array, steps: Array, waits: Array) -> list[PacePart]:
    """The parts of a run between changes of its pace."""
    cell_s = max(_CELL_S, float(times[-1] - times[0]) / _MOST_CELLS)
    cells = ((times - times[0]) // cell_s).astype(np.intp)
    firsts = np.flatnonzero(np.diff(cells, prepend=-1))
    sim_s, wall_s = np.add.reduceat(steps, firsts), np.add.reduceat(waits, firsts)
    changes = level_changes(sim_s / np.maximum(wall_s, 1e-9), _FALSE_ALARMS)
    edges = [0, *changes, len(firsts)]
    rows = [*firsts[edges[:-1]].tolist(), len(times)]
    shares = waits / np.maximum(steps, 1e-9)
    for at in range(1, len(rows) - 1):
        first, last = firsts[edges[at] - 1], [*firsts.tolist(), len(times)][edges[at] + 1]
        levels = [median(shares[a:b]) for a, b in (rows[at - 1 : at + 1], rows[at : at + 2])]
        rows[at] = int(first) + _border(shares[first:last], *levels)
    return [
        PacePart(
            float(times[a] - steps[a]), float(times[b - 1]), float(steps[a:b].sum()),
            float(waits[a:b].sum()),
        )
        for a, b in pairwise(rows)
        if b > a
    ]  # fmt: skip


def _border(values: Array, before: float, after: float) -> int:
    """The row from which values are nearer to the second of two levels than to the first."""
    nearer = np.abs(values - before) - np.abs(values - after)
    sums = np.append(0.0, np.cumsum(nearer))
    return int(sums.argmin())


def slow_simulation_events(search: Search) -> Iterator[Event]:
    """Where simulated time passed at less than 0.9 of real time, or at half the usual pace."""
    pace, segment = pace_of(search), search.segment
    for part in pace.slow:
        if part.start_s >= segment.end_s or part.end_s < segment.start_s:
            continue
        others = [each for each in pace.parts if not pace.is_slow(each)]
        details = {"real_time_factor": float(f"{part.factor:.3g}")}
        if others:
            details["otherwise"] = float(f"{together(others).factor:.3g}")
        yield search.event("slow_simulation", part.start_s, part.end_s, None, **details)
    slowest = min(pace.parts, key=lambda part: part.factor)
    if slowest.factor > _NEARLY_SLOW:
        return
    what = f"slowest part at {slowest.factor:.3g} times real time; under {SLOW:g} counts"
    search.note_nearest("slow_simulation", min(SLOW / slowest.factor, 1.0), what)


SLOW_SIMULATION: Final = EventKind(
    "slow_simulation",
    "simulated time passes slowly",
    slow_simulation_events,
    lasts=True,
    least_s=lambda options: FEWEST_VALUES * _CELL_S,
    ends_within_s=lambda event: _CELL_S,
    alike=Alike(lambda events, unit: "slow parts"),
    severity=15,
)
