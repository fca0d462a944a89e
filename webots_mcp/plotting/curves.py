"""Numeric signals as curves, broken where nothing was recorded, and which of them share a panel."""

from __future__ import annotations

import math
import sqlite3
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import np, rhythm_of
from webots_mcp.analysis.summary import LARGEST
from webots_mcp.plotting.parts import Part
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.segment import Deadline
from webots_mcp.store.series import NumberColumns, RunHistory
from webots_mcp.store.signals import RegisteredSignal

Point = tuple[float, float, float, float]  # time, mean, minimum, maximum
_BREAK: Point = (math.nan, math.nan, math.nan, math.nan)
MOST_CURVES: Final = 5  # more bands on top of each other are mud
_LEAST_SHARE: Final = 0.07  # of the axis; a curve that moves less would look flat
MOST_PLACES: Final = 20_000  # of a way; a picture has a thousandth as many pixels
_LEAP: Final = 10.0  # times the speed that 95 % of the steps keep to
_FINENESS: Final = 1 / 2000  # of the larger side: what lies nearer is the same pixel


@dataclass(frozen=True)
class Curve:
    """One signal of one run.

    Attributes:
        points: In order of time; NaN where the line is broken.
        low: The smallest value of the range; `high` the largest.
    """

    name: str
    unit: str | None
    run_id: int
    points: Sequence[Point]
    low: float
    high: float


def curve_of(columns: NumberColumns, run: RunHistory, origin_s: float = 0.0) -> Curve | None:
    """The curve of a signal; None where it has no value.

    Args:
        columns: The signal, in buckets.
        run: What the buckets are.
        origin_s: The simulation time that is drawn as 0.
    """
    points = _present(columns, run)
    if not points or columns.whole.min is None or columns.whole.max is None:
        return None
    broken = _with_breaks(points, run, angle=columns.kind == "angle")
    moved = [(time - origin_s, mean, low, high) for time, mean, low, high in broken]
    extremes = (columns.whole.min, columns.whole.max)
    return Curve(columns.name, columns.unit, run.run_id, moved, *extremes)


def _present(columns: NumberColumns, run: RunHistory) -> list[Point]:
    """The buckets that hold a value, each at its middle."""
    half_s = (run.step_s or 0.0) / 2
    cells = zip(run.sim_time_s, columns.mean, columns.min, columns.max, strict=True)
    return [
        (start_s + half_s, math.nan if mean is None else mean, low, high)
        for start_s, mean, low, high in cells
        if low is not None and high is not None
    ]


def _with_breaks(points: Sequence[Point], run: RunHistory, *, angle: bool) -> list[Point]:
    """Breaks where values are missing for longer than usual, and where an angle goes round."""
    pauses = {gap.start_s for gap in rhythm_of([point[0] for point in points]).gaps}
    step_s = run.step_s or 0.0
    broken = [points[0]]
    for before, after in pairwise(points):
        silent = before[0] in pauses or any(
            before[0] - step_s <= gap.start_s and gap.end_s <= after[0] + step_s for gap in run.gaps
        )
        if silent or (angle and abs(after[1] - before[1]) > math.pi):
            broken.append(_BREAK)
        broken.append(after)
    return broken


@dataclass
class Panel:
    """Curves on one axis."""

    curves: list[Curve] = field(default_factory=list[Curve])

    @property
    def unit(self) -> str | None:
        """The unit of all of them; None where they have none, or several."""
        units = {curve.unit for curve in self.curves}
        return units.pop() if len(units) == 1 else None

    @property
    def names(self) -> list[str]:
        """The signals, each once."""
        return list(dict.fromkeys(curve.name for curve in self.curves))

    @property
    def is_full(self) -> bool:
        """Whether another curve would be one too many."""
        return len(self.curves) == MOST_CURVES

    def suits(self, curve: Curve) -> bool:
        """Whether it has the unit and the scale of the others."""
        if curve.unit != self.curves[0].unit:
            return False
        together = [*self.curves, curve]
        height = max(each.high for each in together) - min(each.low for each in together)
        return all(_is_visible(each, height) for each in together)


def _is_visible(curve: Curve, height: float) -> bool:
    interval = curve.high - curve.low
    return interval == 0 or interval >= _LEAST_SHARE * height


def by_scale(curves: Iterable[Curve], most_panels: int) -> tuple[list[Panel], list[str]]:
    """The curves of one run in at most so many panels, and the names of those left out.

    A unit or a scale that has no panel yet comes before a second panel for one that has.
    """
    panels: list[Panel] = []
    left_out: list[Curve] = []
    for curve in curves:
        suitable = [panel for panel in panels if panel.suits(curve)]
        place = next((panel for panel in suitable if not panel.is_full), None)
        if place is not None:
            place.curves.append(curve)
        elif suitable or len(panels) == most_panels:
            left_out.append(curve)
        else:
            panels.append(Panel([curve]))
    for _ in range(len(panels), most_panels):
        if left_out:
            panels.append(Panel(left_out[:1]))
            del left_out[0]
            _fill(panels[-1], left_out)
    return panels, [curve.name for curve in left_out]


def _fill(panel: Panel, waiting: list[Curve]) -> None:
    """Take from those that wait what suits."""
    for curve in tuple(waiting):
        if not panel.is_full and panel.suits(curve):
            panel.curves.append(curve)
            waiting.remove(curve)


def by_signal(curves: Sequence[Curve], most_panels: int) -> tuple[list[Panel], list[str]]:
    """The curves of several runs, one panel per signal, and the names of those left out."""
    names = list(dict.fromkeys(curve.name for curve in curves))
    panels = [
        Panel([curve for curve in curves if curve.name == name]) for name in names[:most_panels]
    ]
    return panels, names[most_panels:]


def by_choice(
    curves: Sequence[Curve], grouped: Sequence[Sequence[str]], most_panels: int
) -> tuple[list[Panel], list[str]]:
    """The curves of one run in the panels that are named; others by scale in what room is left."""
    panels = [Panel([curve for curve in curves if curve.name in names]) for names in grouped]
    panels = [panel for panel in panels if panel.curves][:most_panels]
    drawn = {name for panel in panels for name in panel.names}
    others, left_out = by_scale(
        [curve for curve in curves if curve.name not in drawn], most_panels - len(panels)
    )
    return [*panels, *others], left_out


# Where a robot went: the rows of a run as points in the plane, and where they stand out.


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
    connection: sqlite3.Connection,
    part: Part,
    x: RegisteredSignal,
    y: RegisteredSignal,
    deadline_s: float,
) -> Path:
    """The places of one run: of every row, or of every so many if the rows are many."""
    (segment,) = part.range.segments
    frame = read_frame(connection, segment, Deadline(deadline_s))
    xs, ys = frame.numbers(x.name), frame.numbers(y.name)
    rows = np.flatnonzero(np.maximum(np.abs(xs), np.abs(ys)) <= LARGEST)
    every = max(1, math.ceil(len(rows) / MOST_PLACES))
    shown = np.union1d(rows[::every], rows[-1:])
    times = frame.times
    places = [
        Place(*place)
        for place in zip(times[shown].tolist(), xs[shown].tolist(), ys[shown].tolist(), strict=True)
    ]
    step_s = None
    if every > 1:
        step_s = float(f"{float(np.median(np.diff(times[shown]))):.3g}")
    return Path(places, step_s, frozenset(_breaks(places)), is_whole=frame.cut_at_s is None)


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
