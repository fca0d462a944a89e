"""Stretches of time with a meaning: modes, recording gaps, events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from webots_mcp.analysis.arrays import Gap
from webots_mcp.plotting.colours import LINES, MOST_VALUES, OTHER_VALUES
from webots_mcp.signals.naming import listed
from webots_mcp.store.reading.frame_summary import Point, spelled
from webots_mcp.store.signal_history import ChangeColumns, RunHistory


@dataclass(frozen=True)
class Interval:
    """A value or a kind of event over an interval; an instant has no length."""

    value: str
    start_s: float
    end_s: float

    def moved(self, origin_s: float) -> Interval:
        """Return the same on a clock that begins at `origin_s`."""
        return Interval(self.value, self.start_s - origin_s, self.end_s - origin_s)


@dataclass(frozen=True)
class Lane:
    """A row of intervals under one name.

    Attributes:
        values: In the order of their colours.
        merged: Values that share the name "others", because there are too many to tell apart.
        colour: Of events; a kind has the same one in each picture.
    """

    name: str
    intervals: Sequence[Interval]
    values: Sequence[str]
    merged: Sequence[str] = ()
    colour: str = LINES[1]

    @property
    def counted(self) -> str:
        """The name with the number of intervals, such as `stuck (2)`."""
        return f"{self.name} ({len(self.intervals)})"

    def moved(self, origin_s: float, name: str) -> Lane:
        """Return the same under that name, on a clock that begins at `origin_s`."""
        return replace(self, name=name, intervals=[i.moved(origin_s) for i in self.intervals])


def lane_of(columns: ChangeColumns, run: RunHistory, end_s: float) -> Lane:
    """Return a text or boolean signal as intervals; values beyond the sixteenth share a name.

    Where nothing was recorded or read there is no interval: nobody knows the value.
    """
    end_s = end_s if columns.cut_at_s is None else min(columns.cut_at_s, end_s)
    values = list(columns.time_by_value_s)
    known = values if len(values) <= MOST_VALUES else values[: MOST_VALUES - 1]
    intervals = [
        Interval(value if value in known else OTHER_VALUES, *stretch)
        for start, until_s in _stretches(columns.points, end_s)
        for value in [spelled(start.value)]
        for stretch in _recorded(max(start.sim_time_s, run.start_s), until_s, run.gaps)
    ]
    present = {interval.value for interval in intervals}
    shown = [value for value in dict.fromkeys([*known, OTHER_VALUES]) if value in present]
    return Lane(columns.name, intervals, shown, values[len(known) :])


def at_resolution(intervals: Sequence[Interval], step_s: float) -> Sequence[Interval]:
    """Return the intervals as a picture with one pixel per `step_s` can show them.

    Of those that are shorter than a step and begin in the same one, the value that lasts longest
    there stands for the whole step.
    """
    wide = [each for each in intervals if each.end_s - each.start_s >= step_s]
    lasting: dict[int, dict[str, float]] = {}
    for each in intervals:
        if (lasts_s := each.end_s - each.start_s) < step_s:
            values = lasting.setdefault(math.floor(each.start_s / step_s), {})
            values[each.value] = values.get(each.value, 0.0) + lasts_s
    narrow = list[Interval]()
    for step, values in sorted(lasting.items()):
        value = max(values, key=values.__getitem__)
        start_s, end_s = step * step_s, (step + 1) * step_s
        if narrow and narrow[-1].value == value and narrow[-1].end_s == start_s:
            narrow[-1] = replace(narrow[-1], end_s=end_s)
        else:
            narrow.append(Interval(value, start_s, end_s))
    return [*narrow, *wide]


def merged_notes(lanes: Sequence[Lane]) -> list[str]:
    """Return which values of which signal cannot be distinguished in the picture."""
    return [
        f"{lane.name} has {len(lane.merged)} more values than colours, drawn as {OTHER_VALUES}: "
        f"{listed(dict.fromkeys(lane.merged))}"
        for lane in lanes
        if lane.merged
    ]


def _stretches(points: Sequence[Point], end_s: float) -> list[tuple[Point, float]]:
    ends = [after.sim_time_s for _, after in pairwise(points)]
    return list(zip(points, [*ends, end_s], strict=True)) if points else []


def _recorded(start_s: float, end_s: float, gaps: Sequence[Gap]) -> list[tuple[float, float]]:
    """Return the parts of an interval outside the gaps."""
    inside = [gap for gap in gaps if start_s <= gap.start_s and gap.end_s <= end_s]
    starts = [start_s, *(gap.end_s for gap in inside)]
    ends = [*(gap.start_s for gap in inside), end_s]
    return [(start, end) for start, end in zip(starts, ends, strict=True) if start < end]
