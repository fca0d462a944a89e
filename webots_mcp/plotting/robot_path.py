"""The path of a robot: the rows of a run as points in the plane.

Gaps in the recording and leaps break the path into pieces.
"""

from __future__ import annotations

import math
import sqlite3
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import np, rhythm_of
from webots_mcp.analysis.summary import LARGEST
from webots_mcp.plotting.plotted_runs import PlottedRun
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.segment import Deadline
from webots_mcp.store.registered_signals import RegisteredSignal


@dataclass(frozen=True)
class PathLimits:
    """How exactly a path is read and drawn.

    Attributes:
        places: Places that are read of a run: a thousand times as many as a picture has pixels
            across.
        leap_factor: A step at more than this many times the speed that 95 % of the steps keep to is
            a leap.
        pixel_share: Share of the larger side below which two places fall on the same pixel.
        agreement: Mean cosine between a heading and the direction of the path from which on the
            heading is taken to be measured counterclockwise from the x axis.
    """

    places: int = 20_000
    leap_factor: float = 10.0
    pixel_share: float = 1 / 2000
    agreement: float = 0.7


_LIMITS: Final = PathLimits()


class PathPoint(NamedTuple):
    """Where the robot was at a simulation time, and where it headed; NaN if that is not known."""

    time_s: float
    x: float
    y: float
    heading_rad: float = math.nan

    @property
    def place(self) -> tuple[float, float]:
        """Return x and y."""
        return self.x, self.y


@dataclass(frozen=True)
class RobotPath:
    """The places of one run, in order.

    Attributes:
        step_s: Simulated time between the places where not every row was read; else None.
        breaks: Indexes of the places before which nothing was recorded, or to which it leapt.
        is_whole: Whether it was read up to its end: the last place of one that was not is none.
    """

    places: Sequence[PathPoint]
    step_s: float | None
    breaks: frozenset[int]
    is_whole: bool = True

    def pieces(self) -> Iterator[Sequence[PathPoint]]:
        """Return the parts between the breaks."""
        edges = [0, *sorted(self.breaks), len(self.places)]
        return (self.places[start:end] for start, end in pairwise(edges) if end > start)

    def steps(self) -> list[tuple[PathPoint, PathPoint]]:
        """From each place that can be seen to the next, within the pieces."""
        return [step for piece in self.pieces() for step in pairwise(thinned(piece))]

    def at(self, time_s: float) -> PathPoint:
        """Return the place at that time, or the first one."""
        index = bisect_right(self.places, time_s, key=lambda place: place.time_s)
        return self.places[max(0, index - 1)]

    def between(self, start_s: float, end_s: float) -> Sequence[PathPoint]:
        """Return the places in [start_s, end_s), and the next one, so that pieces touch."""
        start = bisect_right(self.places, start_s, key=lambda place: place.time_s)
        end = bisect_right(self.places, end_s, key=lambda place: place.time_s)
        return self.places[max(0, start - 1) : end + 1]


def read_path(
    connection: sqlite3.Connection,
    part: PlottedRun,
    x: RegisteredSignal,
    y: RegisteredSignal,
    deadline_s: float,
    heading: RegisteredSignal | None = None,
) -> RobotPath:
    """Return the places of one run: of every row, or of every nth one if there are many.

    `heading` is an angle, if one is known. It is used if the robot moves along it.
    """
    (segment,) = part.range.segments
    frame = read_frame(connection, segment, Deadline(deadline_s))
    xs, ys = frame.numbers(x.name), frame.numbers(y.name)
    rows = np.flatnonzero(np.maximum(np.abs(xs), np.abs(ys)) <= LARGEST)
    every = max(1, math.ceil(len(rows) / _LIMITS.places))
    shown = np.union1d(rows[::every], rows[-1:])
    times = frame.times
    headings_rad = np.full(len(times), math.nan)
    if heading is not None and heading.turn:
        headings_rad = frame.numbers(heading.name) * (math.tau / heading.turn)
    places = _turned([
        PathPoint(*place)
        for place in zip(
            *(each[shown].tolist() for each in (times, xs, ys, headings_rad)), strict=True
        )
    ])  # fmt: skip
    step_s = None
    if every > 1:
        step_s = float(f"{float(np.median(np.diff(times[shown]))):.3g}")
    return RobotPath(places, step_s, frozenset(_breaks(places)), is_whole=frame.cut_at_s is None)


def _turned(places: Sequence[PathPoint]) -> list[PathPoint]:
    """Return the places with headings that agree with the path.

    A compass may count clockwise or from another direction, and a robot may drive backwards: then
    the direction of the path is the heading.
    """
    kept = thinned(places)
    steps = [(a, b) for a, b in pairwise(kept) if a.place != b.place]
    directions = [math.atan2(b.y - a.y, b.x - a.x) for a, b in steps]
    cosines = [
        math.cos(a.heading_rad - direction)
        for (a, _), direction in zip(steps, directions, strict=True)
        if math.isfinite(a.heading_rad)
    ]
    if any(math.isfinite(each.heading_rad) for each in places) and (
        not cosines or abs(sum(cosines)) >= _LIMITS.agreement * len(cosines)
    ):
        return list(places)
    times = [a.time_s for a, _ in steps]
    found = list[PathPoint]()
    for each in places:
        at = max(0, bisect_right(times, each.time_s) - 1)
        found.append(each._replace(heading_rad=directions[at] if directions else math.nan))
    return found


def _breaks(places: Sequence[PathPoint]) -> Iterator[int]:
    pauses = {gap.start_s for gap in rhythm_of([place.time_s for place in places]).gaps}
    speeds = [_speed(before, after) for before, after in pairwise(places)]
    usual = sorted(speeds)[int(0.95 * len(speeds))] if speeds else 0.0
    for index, speed in enumerate(speeds):
        if places[index].time_s in pauses or speed > _LIMITS.leap_factor * usual > 0:
            yield index + 1


def _speed(before: PathPoint, after: PathPoint) -> float:
    passed_s = after.time_s - before.time_s
    return math.dist(before.place, after.place) / passed_s if passed_s > 0 else 0.0


def extent(places: Sequence[PathPoint]) -> float:
    """Return the larger side of the box around the places."""
    xs, ys = [place.x for place in places], [place.y for place in places]
    return max(max(xs) - min(xs), max(ys) - min(ys)) if places else 0.0


def thinned(places: Sequence[PathPoint]) -> list[PathPoint]:
    """Return the places without those that would be painted on the same pixel as the one before."""
    least = _LIMITS.pixel_share * extent(places)
    kept = list(places[:1])
    for place in places:
        if math.dist(place.place, kept[-1].place) > least:
            kept.append(place)
    return [*kept, places[-1]] if kept[-1:] != list(places[-1:]) else kept


def thinned_with_headings(places: Sequence[PathPoint], turned_rad: float = 0.1) -> list[PathPoint]:
    """Return the thinned places, and those in between at which the robot has turned further."""
    seen = set(thinned(places))
    kept = list[PathPoint]()
    for place in places:
        is_turned = kept and abs(
            math.remainder(place.heading_rad - kept[-1].heading_rad, math.tau)
        ) > turned_rad  # fmt: skip
        if place in seen or is_turned:
            kept.append(place)
    return kept


class Heading(NamedTuple):
    """A place on the path, and the direction in which it goes on from there."""

    x: float
    y: float
    degrees: float


def headings(path: RobotPath, count: int) -> list[Heading]:
    """Return the direction at `count` places that are evenly spread over the length of the path."""
    steps = path.steps()
    reached = list(accumulate(math.dist(before.place, after.place) for before, after in steps))
    if not reached or reached[-1] == 0:
        return []
    found: list[Heading] = []
    for number in range(count):
        before, after = steps[bisect_right(reached, reached[-1] * (number + 0.5) / count)]
        degrees = math.degrees(math.atan2(after.y - before.y, after.x - before.x))
        found.append(Heading((before.x + after.x) / 2, (before.y + after.y) / 2, degrees))
    return found
