"""The way of a robot in the plane as a figure, with equal scales."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
from bokeh.core.properties import field as of_column
from bokeh.core.properties import value as the_text
from bokeh.models import (
    BoxZoomTool,
    ColorBar,
    ColumnDataSource,
    LegendItem,
    LinearColorMapper,
    WheelZoomTool,
)
from bokeh.plotting import figure

from webots_mcp.plotting.canvas import short
from webots_mcp.plotting.intervals import Lane
from webots_mcp.plotting.palette import FAINT, INK, LINES, area_styles
from webots_mcp.plotting.path import Path, Place, headings
from webots_mcp.plotting.trajectory import compose_trajectory
from webots_mcp.plotting.trajectory_axes import Track, TrajectoryAxes
from webots_mcp.plugins.report.charts.chart import (
    Chart,
    hover,
    legend,
    numbers,
    plain,
    sources_of,
    style,
    texts,
)
from webots_mcp.plugins.report.charts.obstacles import Obstacle, obstacles_of
from webots_mcp.store.reading.ranges import TimeRange

HEIGHT_PX: Final = 460
_TOOLS: Final = "pan,zoom_in,zoom_out,reset,save"
_ARROWS: Final = 9
_LEAST_M: Final = 0.02  # of the figure: a robot that stands still is not blown up
_SHAPES: Final = ("circle", "x", "cross", "triangle", "star")
_AT: Final = ("at", "@time_s{0.000} s")
_WHERE: Final = (_AT, ("x, y", "@x1{0.000}, @y1{0.000}"))


Key: TypeAlias = "tuple[str, int]"  # what it is, of which track


@dataclass(frozen=True)
class WayChart(Chart):
    """Ways in the plane.

    Attributes:
        plot: What is drawn.
        sources: The data of what is drawn. The steps of a track, `("way", number)`, have x0, y0,
            x1, y1, time_s, value and colour; where it ends, `("end", number)`, x and y.
    """

    plot: TrajectoryAxes
    sources: dict[Key, ColumnDataSource]

    def refresh(self, plot: TrajectoryAxes) -> bool:
        """Show other data in the same figure; False where that would have to be another."""
        data = data_of(plot)
        if data.keys() != self.sources.keys() or _legend_of(plot) != _legend_of(self.plot):
            return False
        for key, source in self.sources.items():
            source.data = data[key]
        return True


def way_chart(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    position: tuple[str, str] | None = None,
    *,
    bands: str | None = None,
    events: bool = True,
) -> WayChart:
    """Where robots went: start, end, direction, what stands in their world, where it went wrong.

    Args:
        connection: Any.
        ranges: From `find_range`; each run in them counts, four at most.
        position: The signals to the right and upwards; None finds them by their names.
        bands: The text signal that colours the way; None for the mode, where there is one; ""
            for the time. Of several runs each has its own colour.
        events: Whether to mark where it was stuck and where a bumper or the like was true.

    Raises:
        UnknownSignalError: A name meets nothing; the text offers near ones.
        InvalidInputError: A signal of the position is no number, or there are too many runs.
        NothingRecordedError: No position was recorded in the range.
    """
    plot, notes = compose_trajectory(connection, ranges, position, bands=bands, events=events)
    return draw_way(plot, notes, obstacles_of(connection, ranges))


def draw_way(
    plot: TrajectoryAxes,
    notes: Sequence[str] = (),
    obstacles: Sequence[Obstacle] = (),
    *,
    legend_columns: int | None = None,
) -> WayChart:
    """The figure of what `compose_trajectory` has gathered, and of what stands there.

    Args:
        plot: That.
        notes: Its notes.
        obstacles: What stands there.
        legend_columns: Of a narrow figure; None for a legend in one row.
    """
    fig: Any = figure(
        height=HEIGHT_PX, sizing_mode="stretch_width", match_aspect=True, tools=_TOOLS
    )
    style(fig)
    fig.add_tools(BoxZoomTool(match_aspect=True), WheelZoomTool(modifiers="ctrl"))
    fig.xaxis.axis_label, fig.yaxis.axis_label = plain(plot.x_label), plain(plot.y_label)
    _obstacles(fig, obstacles)
    sources = sources_of(data_of(plot))
    items: list[LegendItem] = []
    for index, track in enumerate(plot.tracks):
        if track.path.places:
            items += _track(fig, track, index, sources, alone=len(plot.tracks) == 1)
    _least_size(fig, [place for track in plot.tracks for place in track.path.places])
    shown = legend(items)
    if legend_columns is not None:
        shown.ncols = legend_columns
    fig.add_layout(shown, "above")
    return WayChart(fig, plot.title, tuple(notes), plot, sources)


def data_of(plot: TrajectoryAxes) -> dict[Key, dict[str, Any]]:
    """All that the figure shows of the tracks, by what it is."""
    found: dict[Key, dict[str, Any]] = {}
    for index, track in enumerate(plot.tracks):
        if not track.path.places:
            continue
        first, last = track.path.places[0], track.path.places[-1]
        found["way", index] = _steps(track, LINES[index % len(LINES)])
        found["start", index] = {"x": [first.x], "y": [first.y]}
        end = [last] if track.path.is_whole else []
        found["end", index] = {"x": [each.x for each in end], "y": [each.y for each in end]}
        found["headings", index] = _headings(track.path)
        for mark in track.marks:
            if mark.intervals:
                found[f"mark {mark.name}", index] = _marked(mark, track.path)
    return found


def _legend_of(plot: TrajectoryAxes) -> Any:
    """What the legend tells, which stays as it is as long as the figure."""
    marks = [[(mark.name, len(mark.intervals)) for mark in track.marks] for track in plot.tracks]
    tracks = [(track.name, track.path.is_whole) for track in plot.tracks]
    return marks, tracks, plot.mode, plot.x_label, plot.y_label


def _obstacles(fig: Any, obstacles: Sequence[Obstacle]) -> None:
    """Outlines where sizes are known, marks elsewhere; what stands there is told by its name."""
    outlined = [each for each in obstacles if each.outline]
    shapes = ColumnDataSource({
        "xs": [[x for x, _ in each.outline] for each in outlined],
        "ys": [[y for _, y in each.outline] for each in outlined],
        "name": texts([each.name for each in outlined]),
    })  # fmt: skip
    areas = fig.patches("xs", "ys", source=shapes, fill_color="#D0D0D0", line_color=FAINT)
    points = [each for each in obstacles if not each.outline]
    marks = ColumnDataSource({
        "x": [each.x for each in points],
        "y": [each.y for each in points],
        "name": texts([each.name for each in points]),
    })  # fmt: skip
    dots = fig.scatter(
        "x", "y", source=marks, marker="square", size=9, color="#BBBBBB", line_color=FAINT
    )
    fig.add_tools(hover([areas, dots], [("stands here", "@name")]))


def _track(
    fig: Any, track: Track, index: int, sources: dict[Key, ColumnDataSource], *, alone: bool
) -> list[LegendItem]:
    colour = LINES[index % len(LINES)]
    steps: dict[str, Any] = {name: name for name in ("x0", "y0", "x1", "y1")}
    steps |= {"source": sources["way", index], "line_cap": "round"}
    fig.segment(**steps, line_width=5, line_color=INK, line_alpha=0.5)
    by_time = alone and track.modes is None
    mapper = LinearColorMapper(palette="Viridis256")
    paint: Any = {"field": "time_s", "transform": mapper} if by_time else "colour"
    way = fig.segment(**steps, line_width=3.4, line_color=paint)
    if by_time:
        fig.add_layout(ColorBar(color_mapper=mapper, title="time [s]", width=10), "right")
    told = [(track.name, "@value" if track.modes else ""), *_WHERE]
    fig.add_tools(hover([way], told, line_policy="next"))
    items: list[LegendItem] = []
    if track.modes is not None:
        items.append(LegendItem(label=of_column("value"), renderers=[way]))
    elif not alone:
        items.append(LegendItem(label=the_text(plain(track.name)), renderers=[way]))
    fig.scatter(
        "x", "y", angle="angle", source=sources["headings", index], marker="triangle", size=10,
        color=INK if alone else colour, line_color="white",
    )  # fmt: skip
    items += _ends(fig, index, colour, sources, is_whole=track.path.is_whole)
    return [*items, *_marks(fig, track, index, sources, alone=alone)]


def _steps(track: Track, colour: str) -> dict[str, Any]:
    """The columns of a way: each step with what it is coloured by."""
    steps = track.path.steps() or [(place, place) for place in track.path.places[:1]]
    values = _values([after.time_s for _, after in steps], track.modes)
    styles = area_styles(track.modes.values) if track.modes else {}
    return {
        "x0": numbers([before.x for before, _ in steps]),
        "y0": numbers([before.y for before, _ in steps]),
        "x1": numbers([after.x for _, after in steps]),
        "y1": numbers([after.y for _, after in steps]),
        "time_s": numbers([after.time_s for _, after in steps]),
        "value": texts(values),
        "colour": [styles[value].colour if value in styles else colour for value in values],
    }


def _values(times: Sequence[float], modes: Lane | None) -> list[str]:
    """What held at each time; where nothing is known "-"."""
    if modes is None or not modes.intervals:
        return ["-"] * len(times)
    starts = np.array([each.start_s for each in modes.intervals])
    found: list[str] = []
    for time_s, place in zip(times, np.searchsorted(starts, times, side="right"), strict=True):
        interval = modes.intervals[max(0, int(place) - 1)]
        is_inside = interval.start_s <= time_s <= interval.end_s
        found.append(interval.value if is_inside else "-")
    return found


def _headings(path: Path) -> dict[str, Any]:
    """Where a triangle points along the way, and by how much it is turned."""
    found = headings(path, _ARROWS)
    return {
        "x": numbers([each.x for each in found]),
        "y": numbers([each.y for each in found]),
        "angle": numbers([math.radians(each.degrees - 90) for each in found]),
    }


def _marked(mark: Lane, path: Path) -> dict[str, Any]:
    places = [path.at(each.start_s) for each in mark.intervals]
    return {
        "x1": numbers([place.x for place in places]),
        "y1": numbers([place.y for place in places]),
        "time_s": numbers([each.start_s for each in mark.intervals]),
        "until_s": numbers([each.end_s for each in mark.intervals]),
    }


def _ends(
    fig: Any, index: int, colour: str, sources: dict[Key, ColumnDataSource], *, is_whole: bool
) -> list[LegendItem]:
    start = fig.scatter(
        "x", "y", source=sources["start", index], size=11, fill_color="white", line_color=INK,
        line_width=2,
    )  # fmt: skip
    end = fig.scatter(
        "x", "y", source=sources["end", index], marker="square", size=11, color=colour,
        line_color="white",
    )  # fmt: skip
    told = [] if index else [("start", start), ("end", end)][: 1 + is_whole]
    return [LegendItem(label=name, renderers=[renderer]) for name, renderer in told]


def _marks(
    fig: Any, track: Track, index: int, sources: dict[Key, ColumnDataSource], *, alone: bool
) -> list[LegendItem]:
    items: list[LegendItem] = []
    for mark, shape in zip(track.marks, _SHAPES, strict=False):
        if not mark.intervals:
            continue
        colour = LINES[1] if alone else LINES[index % len(LINES)]
        hollow = {"fill_alpha": 0.0} if shape == "circle" else {}
        dots = fig.scatter(
            "x1", "y1", source=sources[f"mark {mark.name}", index], marker=shape, size=14,
            color=colour, line_width=2, **hollow,
        )  # fmt: skip
        name = f"{short(mark.name)}{'' if alone else f', {track.name}'}"
        fig.add_tools(hover([dots], [(name, "@time_s{0.000} to @until_s{0.000} s")]))
        items.append(
            LegendItem(label=the_text(plain(f"{name} ({len(mark.intervals)})")), renderers=[dots])
        )
    return items


def _least_size(fig: Any, places: Sequence[Place]) -> None:
    """Unseen points around the middle, which the axes reach at least."""
    if places:
        middle = places[len(places) // 2]
        sides = (-_LEAST_M / 2, _LEAST_M / 2)
        fig.scatter(
            [middle.x + side for side in sides], [middle.y + side for side in sides], alpha=0
        )
