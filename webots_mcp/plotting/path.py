"""Where a robot went: the rows of a run as points in the plane, and where they stand out."""

from __future__ import annotations

import math
import sqlite3
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Final, NamedTuple, TypeGuard

from webots_mcp.naming import Value
from webots_mcp.plotting.parts import Part
from webots_mcp.store.analysis.rhythm import rhythm_of
from webots_mcp.store.analysis.summary import LARGEST
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.rows import exceeds, read_columns
from webots_mcp.store.signals.registry import Signal

_LEAP: Final = 10.0  # times the speed that 95 % of the steps keep to
_FINENESS: Final = 1 / 2000  # of the larger side: what lies nearer is the same pixel


class Place(NamedTuple):
    """Where the robot was at a simulation time."""

    time_s: float
    x: float
    y: float


@dataclass(frozen=True)
class Path:
    """The places of one run, in order.

    Attributes:
        step_s: Simulated time between the places where not every row was read; else None.
        breaks: Indexes of the places before which nothing was recorded, or to which it leapt.
        is_whole: Whether it was read up to its end: the last place of one that was not is none.
    """

    places: Sequence[Place]
    step_s: float | None
    breaks: frozenset[int]
    is_whole: bool = True

    def pieces(self) -> Iterator[Sequence[Place]]:
        """The parts between the breaks."""
        edges = [0, *sorted(self.breaks), len(self.places)]
        return (self.places[start:end] for start, end in pairwise(edges) if end > start)

    def steps(self) -> list[tuple[Place, Place]]:
        """From each place that can be seen to the next, within the pieces."""
        return [step for piece in self.pieces() for step in pairwise(thinned(piece))]

    def at(self, time_s: float) -> Place:
        """The place at that time, or the first one."""
        index = bisect_right(self.places, time_s, key=lambda place: place.time_s)
        return self.places[max(0, index - 1)]

    def between(self, start_s: float, end_s: float) -> Sequence[Place]:
        """The places in [start_s, end_s), and the next one, so that pieces touch."""
        start = bisect_right(self.places, start_s, key=lambda place: place.time_s)
        end = bisect_right(self.places, end_s, key=lambda place: place.time_s)
        return self.places[max(0, start - 1) : end + 1]


def read_path(
    connection: sqlite3.Connection, part: Part, x: Signal, y: Signal, deadline_s: float
) -> Path:
    """The places of one run: of every row, or of the part's buckets if the rows are many."""
    (segment,) = part.range.segments
    cut_s = part.run.cut_at_s
    if exceeds(connection, segment):
        run = part.run
        by_name = {columns.name: columns.last for columns in run.numbers}
        path = _path(run.sim_time_s, by_name[x.name], by_name[y.name], run.step_s)
    else:
        columns = read_columns(connection, segment, [x, y], Deadline(deadline_s))
        path = _path(columns.times, columns.values[x.name], columns.values[y.name], None)
        cut_s = columns.cut_at_s
    return replace(path, is_whole=cut_s is None)


def _path(
    times: Sequence[float], xs: Sequence[Value], ys: Sequence[Value], step_s: float | None
) -> Path:
    places = [
        Place(time, x, y)
        for time, x, y in zip(times, xs, ys, strict=True)
        if _is_usable(x) and _is_usable(y)
    ]
    return Path(places, step_s, frozenset(_breaks(places)))


def _is_usable(value: Value) -> TypeGuard[float]:
    """Whether a distance to it can be told."""
    return isinstance(value, (int, float)) and abs(value) <= LARGEST


def _breaks(places: Sequence[Place]) -> Iterator[int]:
    pauses = {gap.start_s for gap in rhythm_of([place.time_s for place in places]).gaps}
    speeds = [_speed(before, after) for before, after in pairwise(places)]
    usual = sorted(speeds)[int(0.95 * len(speeds))] if speeds else 0.0
    for index, speed in enumerate(speeds):
        if places[index].time_s in pauses or speed > _LEAP * usual > 0:
            yield index + 1


def _speed(before: Place, after: Place) -> float:
    passed_s = after.time_s - before.time_s
    return math.dist(before[1:], after[1:]) / passed_s if passed_s > 0 else 0.0


def extent(places: Sequence[Place]) -> float:
    """The larger side of the box around the places."""
    xs, ys = [place.x for place in places], [place.y for place in places]
    return max(max(xs) - min(xs), max(ys) - min(ys)) if places else 0.0


def thinned(places: Sequence[Place]) -> list[Place]:
    """The places without those that would be painted on the same pixel as the one before."""
    least = _FINENESS * extent(places)
    kept = list(places[:1])
    for place in places:
        if math.dist(place[1:], kept[-1][1:]) > least:
            kept.append(place)
    return [*kept, places[-1]] if kept[-1:] != list(places[-1:]) else kept


class Heading(NamedTuple):
    """A place on the path, and the direction in which it goes on from there."""

    x: float
    y: float
    degrees: float


def headings(path: Path, count: int) -> list[Heading]:
    """The direction at `count` places that are evenly spread over the length of the path."""
    steps = path.steps()
    reached = list(accumulate(math.dist(before[1:], after[1:]) for before, after in steps))
    if not reached or reached[-1] == 0:
        return []
    found: list[Heading] = []
    for number in range(count):
        before, after = steps[bisect_right(reached, reached[-1] * (number + 0.5) / count)]
        degrees = math.degrees(math.atan2(after.y - before.y, after.x - before.x))
        found.append(Heading((before.x + after.x) / 2, (before.y + after.y) / 2, degrees))
    return found
