"""Numeric signals as curves, broken at gaps in the recording, and which of them share a panel.

Signals of one unit and a similar scale share an axis.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

from webots_mcp.analysis.arrays import rhythm_of
from webots_mcp.plotting.axes import axis_range
from webots_mcp.store.signal_history import NumberColumns, RunHistory

Point = tuple[float, float, float, float]  # time, mean, minimum, maximum
MOST_CURVES: Final = 5  # more bands on top of each other are mud


@dataclass(frozen=True)
class Curve:
    """One signal of one run.

    Attributes:
        points: In order of time; NaN where the line is broken.
        low: The smallest value of the range; `high` the largest.
        last: The value of the newest row that has one; None where not all was read.
    """

    name: str
    unit: str | None
    run_id: int
    points: Sequence[Point]
    low: float
    high: float
    last: float | None = None


def curve_of(columns: NumberColumns, run: RunHistory, origin_s: float = 0.0) -> Curve | None:
    """Return the curve of a signal; None where it has no value.

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
    newest = next((value for value in reversed(columns.last) if value is not None), None)
    last = newest if run.cut_at_s is None else None
    return Curve(columns.name, columns.unit, run.run_id, moved, *extremes, last)


def _present(columns: NumberColumns, run: RunHistory) -> list[Point]:
    """Return the buckets that hold a value, each at its middle."""
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
            broken.append((math.nan, math.nan, math.nan, math.nan))
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
    def scale(self) -> tuple[float, float]:
        """The range of the vertical axis."""
        return axis_range(min(c.low for c in self.curves), max(c.high for c in self.curves))

    @property
    def shared_name(self) -> str:
        """What the names of its signals share, as a pattern such as `arm.*.torque`, or nothing."""
        names = [name.split(".") for name in self.names]
        first, last = _shared_parts(names)
        if not first and not last:
            return ""
        return ".".join([*names[0][:first], "*", *names[0][len(names[0]) - last :]])

    @property
    def own_names(self) -> dict[str, str]:
        """Return what is left of each name without what all of them share."""
        names = [name.split(".") for name in self.names]
        first, last = _shared_parts(names)
        return {".".join(parts): ".".join(parts[first : len(parts) - last]) for parts in names}

    @property
    def is_full(self) -> bool:
        """Whether another curve would be one too many."""
        return len(self.curves) == MOST_CURVES

    def suits(self, curve: Curve) -> bool:
        """Return whether it has the unit and the scale of the others."""
        if curve.unit != self.curves[0].unit:
            return False
        together = [*self.curves, curve]
        height = max(each.high for each in together) - min(each.low for each in together)
        return all(_is_visible(each, height) for each in together)


def _shared_parts(names: Sequence[Sequence[str]]) -> tuple[int, int]:
    """Return how many parts all names begin with, and end with; something is left of each."""
    if len(names) < 2:
        return 0, 0
    most = min(len(parts) for parts in names) - 1
    first = next((i for i in range(most) if len({parts[i] for parts in names}) > 1), most)
    most -= first
    last = next((i for i in range(most) if len({parts[-1 - i] for parts in names}) > 1), most)
    return first, last


def _is_visible(curve: Curve, height: float) -> bool:
    interval = curve.high - curve.low
    # A curve that moves within less than 7 % of the axis would appear flat.
    return interval == 0 or interval >= 0.07 * height


def by_scale(curves: Iterable[Curve], most_panels: int) -> tuple[list[Panel], list[str]]:
    """Return the curves of one run in at most that many panels, and the names of those left out.

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
    """Return the curves of several runs, one panel per signal, and the names of those left out."""
    names = list(dict.fromkeys(curve.name for curve in curves))
    panels = [
        Panel([curve for curve in curves if curve.name == name]) for name in names[:most_panels]
    ]
    return panels, names[most_panels:]


def by_choice(
    curves: Sequence[Curve], grouped: Sequence[Sequence[str]], most_panels: int
) -> tuple[list[Panel], list[str]]:
    """Return the curves of one run in the given panels; others share the panels left."""
    panels = [Panel([curve for curve in curves if curve.name in names]) for names in grouped]
    panels = [panel for panel in panels if panel.curves][:most_panels]
    drawn = {name for panel in panels for name in panel.names}
    others, left_out = by_scale(
        [curve for curve in curves if curve.name not in drawn], most_panels - len(panels)
    )
    return [*panels, *others], left_out


# Where a robot went: the rows of a run as points in the plane, and where they stand out.
