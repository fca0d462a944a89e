"""Numeric signals as curves: a mean line and a min-max band, broken where nothing was recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from webots_mcp.store.analysis.arrays import rhythm_of
from webots_mcp.store.questions.series import NumberColumns, RunHistory

Point = tuple[float, float, float, float]  # time, mean, minimum, maximum
_BREAK: Point = (math.nan, math.nan, math.nan, math.nan)


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

    @property
    def lone_points(self) -> list[Point]:
        """Those between two breaks: a line would not show them."""
        framed = [_BREAK, *self.points, _BREAK]
        return [
            point
            for before, point, after in zip(framed, framed[1:], framed[2:], strict=False)
            if math.isnan(before[0]) and math.isnan(after[0]) and not math.isnan(point[0])
        ]


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
