"""Painting the ways of robots in the plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.plotting.canvas import paint_title, short
from webots_mcp.plotting.intervals import Lane
from webots_mcp.plotting.legend import Entry, paint_legend
from webots_mcp.plotting.palette import DASHES, FAINT, INK, LINES, area_styles
from webots_mcp.plotting.path import Path, Place, extent, headings, thinned

_ARROWS: Final = 9
_BREAK: Final = Place(math.nan, math.nan, math.nan)
_TICK_PX: Final = 45
_ON_THE_SPOT: Final = 0.03  # of the size of the whole way
_LEAST_SIZE: Final = 0.02  # of the picture, in the unit of the position
_START: Final[dict[str, Any]] = {
    "marker": "o", "markersize": 9, "markerfacecolor": "white", "markeredgewidth": 1.8,
}  # fmt: skip
_END: Final[dict[str, Any]] = {"marker": "s", "markersize": 9}
_DOTTED: Final[dict[str, Any]] = {
    "color": INK, "linewidth": 1.4, "linestyle": (0, (1, 2)), "dash_capstyle": "butt",
    "zorder": 3.2,
}  # fmt: skip
_MANY: Final = 10  # marks of a kind; more are drawn smaller
_SHAPES: Final[tuple[dict[str, Any], ...]] = (  # the first can be seen around the others
    {"marker": "o", "markersize": 16, "markerfacecolor": "none", "markeredgewidth": 2.2},
    {"marker": "X", "markersize": 10, "markeredgecolor": "white"},
    {"marker": "P", "markersize": 10, "markeredgecolor": "white"},
    {"marker": "^", "markersize": 10, "markeredgecolor": "white"},
    {"marker": "*", "markersize": 12, "markeredgecolor": "white"},
)


@dataclass(frozen=True)
class Track:
    """The way of one run.

    Attributes:
        modes: What colours it; None for the time, or for the run where there are several.
        marks: Events, one lane per kind, which may be empty; at most five.
    """

    name: str
    path: Path
    modes: Lane | None
    marks: Sequence[Lane]


@dataclass(frozen=True)
class TrajectoryAxes:
    """What is to be painted."""

    title: str
    x_label: str
    y_label: str
    tracks: Sequence[Track]
    mode: str | None


def paint_trajectory(figure: Any, plot: TrajectoryAxes) -> None:
    """Paint it on an empty figure."""
    paint_title(figure, plot.title)
    axes = figure.subplots()
    axes.set_xlabel(plot.x_label)
    axes.set_ylabel(plot.y_label)
    axes.grid(color="#E9E9E9", linewidth=0.6)
    entries: list[Entry] = []
    for index, track in enumerate(plot.tracks):
        if track.path.places:
            entries += _paint_track(figure, axes, track, index, plot)
    _frame(figure, axes, [place for track in plot.tracks for place in track.path.places])
    ends = [each.path.is_whole for each in plot.tracks if each.path.places]
    paint_legend(figure, [*_end_entries()[: 1 + any(ends)], *entries])


def _frame(figure: Any, axes: Any, places: Sequence[Place]) -> None:
    """The same scale and grid on both axes; a robot that stands still is not blown up."""
    middle = places[len(places) // 2]
    least = [(middle.x + side, middle.y + side) for side in (-_LEAST_SIZE / 2, _LEAST_SIZE / 2)]
    axes.update_datalim(least)
    axes.margins(0.06)
    axes.set_aspect("equal", adjustable="datalim")
    figure.draw_without_rendering()  # how far the axes reach is known only then
    _set_ticks(axes)


def _set_ticks(axes: Any) -> None:
    from matplotlib.ticker import MultipleLocator

    box, (start, end) = axes.get_window_extent(), axes.get_xlim()
    least = _TICK_PX * (end - start) / max(box.width, 1)
    unit = 10.0 ** math.floor(math.log10(least))
    step = next(unit * factor for factor in (1, 2, 5, 10) if unit * factor >= least)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(step))


def _paint_track(
    figure: Any, axes: Any, track: Track, index: int, plot: TrajectoryAxes
) -> list[Entry]:
    _paint_leaps(axes, track.path)
    if len(plot.tracks) > 1:
        entries = _paint_in_one_colour(axes, track, index)
        ink = LINES[index % len(LINES)]
    elif track.modes is not None and plot.mode is not None:
        entries, ink = _paint_modes(axes, track.path, track.modes), INK
    else:
        entries, ink = _paint_time(figure, axes, track.path), INK
    _paint_headings(axes, track.path, ink)
    _paint_ends(axes, track.path, ink)
    alone = len(plot.tracks) == 1
    return [*entries, *_paint_marks(axes, track, LINES[1] if alone else ink, alone)]


def _paint_leaps(axes: Any, path: Path) -> None:
    """Where nothing was recorded, or it leapt, a faint line shows what follows what."""
    for index in path.breaks:
        before, after = path.places[index - 1], path.places[index]
        axes.plot([before.x, after.x], [before.y, after.y], color=FAINT, linewidth=0.8,
                  linestyle=(0, (1, 2)), zorder=2)  # fmt: skip


def _paint_in_one_colour(axes: Any, track: Track, index: int) -> list[Entry]:
    from matplotlib.lines import Line2D

    pen: dict[str, Any] = {"color": LINES[index % len(LINES)], "linewidth": 1.6}
    pen["linestyle"] = DASHES[index % len(DASHES)]
    for piece in track.path.pieces():
        _line(axes, [piece], **pen)
    return [(Line2D([], [], **pen), track.name)]


def _paint_modes(axes: Any, path: Path, modes: Lane) -> list[Entry]:
    from matplotlib.lines import Line2D

    styles = area_styles(modes.values)
    stretches: dict[str, list[Sequence[Place]]] = {value: [] for value in modes.values}
    spot = _ON_THE_SPOT * extent(path.places)
    for piece in path.pieces():
        _line(axes, [piece], color=INK, linewidth=4.4)  # an edge, so that light colours are seen
        part = Path(piece, None, frozenset())
        for interval in modes.intervals:
            held = part.between(interval.start_s, interval.end_s)
            stretches[interval.value].append(held)
            if len(held) > 1 and extent(held) < spot:
                _dot(axes, held[-1], styles[interval.value].colour)
    for value, held in stretches.items():
        _line(axes, held, color=styles[value].colour, linewidth=3)
        if styles[value].dotted:
            _line(axes, held, **_DOTTED)
    shown: list[Entry] = []
    for value, style in ((value, styles[value]) for value in modes.values):
        line = Line2D([], [], color=style.colour, linewidth=4)
        dots = Line2D([], [], **_DOTTED)
        shown.append(((line, dots) if style.dotted else line, short(value)))
    return [(Line2D([], [], linestyle=""), f"{short(modes.name)}:"), *shown]


def _dot(axes: Any, place: Place, colour: str) -> None:
    """For what happened on the spot, where a line has no length."""
    axes.plot([place.x], [place.y], marker="o", markersize=6, color=colour, markeredgecolor=INK,
              markeredgewidth=0.6, zorder=3.5)  # fmt: skip


def _paint_time(figure: Any, axes: Any, path: Path) -> list[Entry]:
    from matplotlib.collections import LineCollection
    from matplotlib.colors import Normalize

    steps = path.steps()
    if not steps:  # it stood still: there is no line to colour
        return []
    scale = Normalize(path.places[0].time_s, path.places[-1].time_s)
    lines: Any = LineCollection([[(a.x, a.y), (b.x, b.y)] for a, b in steps], cmap="viridis")
    lines.set(array=[a.time_s for a, _ in steps], norm=scale, linewidth=2.2, zorder=3)
    lines.set_capstyle("round")
    axes.add_collection(lines)
    figure.colorbar(lines, ax=axes, label="simulation time [s]", pad=0.01)
    return []


def _line(axes: Any, stretches: Sequence[Sequence[Place]], **style: Any) -> None:
    """One line, broken between the stretches."""
    kept = [place for stretch in stretches for place in (*thinned(stretch), _BREAK)]
    style = {"solid_capstyle": "round", "zorder": 3} | style
    axes.plot([place.x for place in kept], [place.y for place in kept], **style)


def _paint_headings(axes: Any, path: Path, colour: str) -> None:
    from matplotlib.markers import MarkerStyle

    arrow = [(-1.0, 0.9), (1.0, 0.0), (-1.0, -0.9), (-1.0, 0.9)]
    for x, y, degrees in headings(path, _ARROWS):
        turned = MarkerStyle(arrow).rotated(deg=degrees)
        axes.plot([x], [y], marker=turned, markersize=10, color=colour, zorder=4,
                  markeredgecolor="white", markeredgewidth=0.6)  # fmt: skip


def _paint_ends(axes: Any, path: Path, colour: str) -> None:
    first, last = path.places[0], path.places[-1]
    axes.plot([first.x], [first.y], color=colour, zorder=5, **_START)
    if path.is_whole:
        axes.plot([last.x], [last.y], color=colour, zorder=5, **_END)


def _end_entries() -> list[Entry]:
    from matplotlib.lines import Line2D

    marks = [Line2D([], [], linestyle="", color=INK, **style) for style in (_START, _END)]
    return list(zip(marks, ("start", "end"), strict=True))


def _paint_marks(axes: Any, track: Track, colour: str, alone: bool) -> list[Entry]:
    entries: list[Entry] = []
    for mark, shape in zip(track.marks, _SHAPES, strict=False):
        if not mark.intervals:
            continue
        places = [track.path.at(interval.start_s) for interval in mark.intervals]
        xs, ys = [place.x for place in places], [place.y for place in places]
        size = shape["markersize"] * (0.6 if len(places) > _MANY else 1)
        style = shape | {"linestyle": "", "color": colour, "markersize": size}
        (handle,) = axes.plot(xs, ys, zorder=6, **style)
        whose = "" if alone else f", {track.name}"
        entries.append((handle, f"{short(mark.name)}{whose} ({len(places)})"))
    return entries
