"""Rows that have just come, at the end of what is drawn already."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any, Final

import numpy as np

from webots_mcp.naming import Value, spelled_out
from webots_mcp.plotting.palette import FAINT, area_styles
from webots_mcp.plugins.page.tab_data import NewRows
from webots_mcp.plugins.report.charts import SignalsChart, WayChart
from webots_mcp.store.reading.frame_summary import spelled

MOST_POINTS: Final = 20_000  # of a curve in the browser; the oldest go first
_PALE: Final = "#EEEEEE"
_STRETCH: Final = ("start_s", "end_s", "value", "colour", "hatch")


def grow_signals(chart: SignalsChart, columns: NewRows, angles: Collection[str] = ()) -> None:
    """Add rows to the curves, and let the modes and rows of states go on.

    Args:
        chart: What is drawn.
        columns: The rows.
        angles: Names of signals whose curves are broken where they go round.
    """
    sources: dict[Any, Any] = dict(chart.sources)
    for (what, name, _), source in sources.items():
        values = columns.values.get(name, [])
        if what == "curve" and values:
            points = _points(columns.times, values)
            if name in angles:
                points = _broken(source.data, points)
            source.stream(points, MOST_POINTS)
        elif what in ("ground", "lane") and values:
            _go_on(source, columns.times, values)


def _points(times: Sequence[float], values: Sequence[Value]) -> dict[str, Any]:
    numbers = np.array(
        [value if isinstance(value, (int, float)) else math.nan for value in values], np.float64
    )
    return {"time_s": np.array(times), "mean": numbers, "low": numbers, "high": numbers}


def _broken(drawn: Any, points: dict[str, Any]) -> dict[str, Any]:
    """The points of an angle with a break before each that is half a turn away or more."""
    before = list(drawn["mean"][-1:]) or [math.nan]
    leaps = np.flatnonzero(np.abs(np.diff(points["mean"], prepend=before)) > math.pi)
    return {name: np.insert(column, leaps, math.nan) for name, column in points.items()}


def _go_on(source: Any, times: Sequence[float], values: Sequence[Value]) -> None:
    """The last stretch goes on until the first row that has another value, which begins one."""
    pieces = groupby(zip(times, map(_spelled, values), strict=True), key=itemgetter(1))
    starts, shown = zip(*((next(rows)[0], value) for value, rows in pieces), strict=True)
    stretches = list(zip(starts, [*starts[1:], times[-1]], shown, strict=True))
    before = list(source.data["value"])
    if before:
        start_s, end_s, value = stretches[0]
        goes_on = value == before[-1]
        source.patch({"end_s": [(len(before) - 1, end_s if goes_on else start_s)]})
        del stretches[: int(goes_on)]
    if stretches:
        starts, ends, shown = zip(*stretches, strict=True)
        known = dict(zip(before, source.data["colour"], strict=True))
        colours = [known.get(value) or _colour(value, known) for value in shown]
        hatches = [" "] * len(shown)
        columns = (starts, ends, shown, colours, hatches)
        source.stream(dict(zip(_STRETCH, map(list, columns), strict=True)), MOST_POINTS)


def _spelled(value: Value) -> str:
    """As the rows and the legend name it."""
    if value is None or isinstance(value, (str, bool)):
        return spelled_out(spelled(value))
    return f"{value:g}"


def _colour(value: str, known: dict[str, str]) -> str:
    """The one that it will have in the next drawing, mostly."""
    return area_styles([*known, value])[value].colour if value != "null" else _PALE


def grow_way(chart: WayChart, position: tuple[str, str], columns: NewRows) -> None:
    """Add steps to the way, up to where the robot is now."""
    source: Any = chart.sources["way", 0]
    end: Any = chart.sources["end", 0]
    data = source.data
    mode = chart.plot.mode
    modes = columns.values.get(mode or "", [None] * len(columns.times))
    colours = dict(zip(data["value"], data["colour"], strict=True))
    x0, y0 = float(end.data["x"][0]), float(end.data["y"][0])
    steps: dict[str, list[Any]] = {name: [] for name in data}
    places = zip(columns.times, *(columns.values[name] for name in position), modes, strict=True)
    for time_s, x, y, value in places:
        if not isinstance(x, (int, float)) or not isinstance(y, (int, float)):
            continue
        held = _spelled(value) if mode else "-"
        colour = colours.get(held) or (_colour(held, colours) if mode else FAINT)
        row = {"x0": x0, "y0": y0, "x1": x, "y1": y, "time_s": time_s}
        for name, item in {**row, "value": held, "colour": colour}.items():
            steps[name].append(item)
        x0, y0 = x, y
    if steps["x0"]:
        source.stream(steps, MOST_POINTS)
        end.data = {"x": [x0], "y": [y0]}
