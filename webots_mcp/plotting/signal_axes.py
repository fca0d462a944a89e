"""Painting signals over time: panels of curves, modes behind them, rows of intervals below."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.plotting.canvas import BESIDE_PX, ROW_PX, paint_title, short, wrapped
from webots_mcp.plotting.curves import Curve, Panel
from webots_mcp.plotting.intervals import Interval, Lane
from webots_mcp.plotting.legend import Entry, paint_legend
from webots_mcp.plotting.palette import DASHES, FAINT, INK, LINES, Area, area_styles

_LETTER_PX: Final = 6
_GAP: Final[dict[str, Any]] = {"facecolor": "none", "edgecolor": "#AAAAAA", "hatch": "////"}
_UNREAD: Final[dict[str, Any]] = {
    "facecolor": "none",
    "edgecolor": LINES[1],
    "hatch": "xx",
    "alpha": 0.5,
}
_DOT_HATCH: Final = "..."
_FLAGS: Final = {"true": Area(INK, dotted=False), "false": Area("#F0F0F0", dotted=False)}
_BAND_ALPHA: Final = 0.35
_LINES_THROUGH: Final = 30  # more instants would be a curtain


@dataclass(frozen=True)
class SignalAxes:
    """What is to be painted; all times are on the clock of the picture.

    Attributes:
        colour_by_run: Run to its name in the legend, where several are overlaid; else empty.
        bands: A text signal behind the curves.
        lanes: Text and boolean signals below.
        events: One lane per kind of event.
        gaps: Where nothing was recorded.
        unread: Where not all was read.
    """

    title: str
    x_label: str
    x_range: tuple[float, float]
    panels: Sequence[Panel]
    colour_by_run: Mapping[int, str]
    bands: Lane | None
    lanes: Sequence[Lane]
    events: Sequence[Lane]
    gaps: Sequence[Interval]
    unread: Sequence[Interval] = ()


def paint_signals(figure: Any, plot: SignalAxes) -> None:
    """Paint it on an empty figure."""
    width_px = figure.get_figwidth() * figure.dpi
    paint_title(figure, plot.title)
    rows = len(plot.lanes) + len(plot.events)
    heights = _heights(figure, len(plot.panels), rows)
    axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    axes[-1].set_xlim(*plot.x_range)
    panels = axes[: len(plot.panels)]
    for each, panel in zip(panels, plot.panels, strict=True):
        _paint_panel(each, panel, plot)
    if rows:
        _paint_lanes(axes[-1], plot)
    axes[-1].set_xlabel(wrapped(plot.x_label, width_px - 60))
    figure.align_ylabels(panels)
    paint_legend(figure, _entries(axes[-1], plot))


def _heights(figure: Any, panels: int, rows: int) -> list[float]:
    """Rows of intervals take the pixels that they need, the panels share the rest."""
    height_px = figure.get_figheight() * figure.dpi - 110
    rows_px = min(rows * ROW_PX, height_px / 2) if panels else height_px
    panel_px = (height_px - rows_px) / max(panels, 1)
    return [*[panel_px] * panels, *([rows_px] if rows else [])]


def _paint_panel(axes: Any, panel: Panel, plot: SignalAxes) -> None:
    _shade(axes, plot)
    for event in [interval for lane in plot.events for interval in lane.intervals][:_LINES_THROUGH]:
        axes.axvline(event.start_s, color=FAINT, linewidth=0.6, linestyle=(0, (1, 3)), zorder=1.5)
    handles = [
        _paint_curve(axes, curve, *_pen(panel, index, plot), len(panel.curves))
        for index, curve in enumerate(panel.curves)
    ]
    unit = f"[{panel.unit}]" if panel.unit else ""
    axes.grid(axis="y", color="#E3E3E3", linewidth=0.6)
    axes.margins(y=0.08)
    if len(panel.names) == 1:
        axes.set_title(f"{short(panel.names[0])} {unit}".strip(), loc="left", pad=3)
        return
    axes.set_ylabel(unit)
    labels = [short(curve.name) for curve in panel.curves]
    axes.legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)


def _pen(panel: Panel, index: int, plot: SignalAxes) -> tuple[str, Any]:
    """Colour and dashes: by run where several are overlaid, else by signal."""
    runs = list(plot.colour_by_run)
    if runs:
        index = runs.index(panel.curves[index].run_id)
    return LINES[index % len(LINES)], DASHES[index % len(DASHES)]


def _paint_curve(axes: Any, curve: Curve, colour: str, dashes: Any, neighbours: int) -> Any:
    """The band is the fainter the more of them lie on top of each other."""
    times, means, lows, highs = zip(*curve.points, strict=True)
    alpha = 0.28 / math.sqrt(neighbours)
    axes.fill_between(times, lows, highs, color=colour, alpha=alpha, linewidth=0, zorder=2)
    for time, mean, low, high in curve.lone_points:
        axes.plot([time, time], [low, high], color=colour, alpha=0.4, linewidth=2, zorder=2)
        axes.plot([time], [mean], color=colour, marker=".", markersize=4, zorder=3)
    (line,) = axes.plot(times, means, color=colour, linestyle=dashes, linewidth=1.3, zorder=3)
    return line


def _shade(axes: Any, plot: SignalAxes) -> None:
    """Modes and gaps, over the whole height behind the curves."""
    if plot.bands is not None:
        styles = _lane_styles(plot)
        for value in plot.bands.values:
            intervals = [interval for interval in plot.bands.intervals if interval.value == value]
            _bars(axes, intervals, **_fill(styles[value]), alpha=_BAND_ALPHA, zorder=0.5)
    _hatch(axes, plot, zorder=0.6)


def _hatch(axes: Any, plot: SignalAxes, zorder: float) -> None:
    """Whatever stands there in the last row's name, nothing was recorded, or read."""
    for stretches, style in ((plot.gaps, _GAP), (plot.unread, _UNREAD)):
        _bars(axes, stretches, color="white", zorder=zorder)
        _bars(axes, stretches, **style, zorder=zorder)


def _bars(axes: Any, intervals: Sequence[Interval], **style: Any) -> None:
    """Over the whole height of the axes."""
    if intervals:
        whole = {"transform": axes.get_xaxis_transform(), "linewidth": 0}
        axes.broken_barh(_lengths(intervals), (0, 1), **(whole | style))


def _lengths(intervals: Sequence[Interval]) -> list[tuple[float, float]]:
    return [(interval.start_s, interval.end_s - interval.start_s) for interval in intervals]


def _paint_lanes(axes: Any, plot: SignalAxes) -> None:
    lanes = [*plot.lanes, *plot.events]
    styles = _lane_styles(plot)
    for row, lane in enumerate(lanes):
        if row < len(plot.lanes):
            _paint_states(axes, row, lane, styles)
        else:
            _paint_events(axes, row, lane)
    _hatch(axes, plot, zorder=2)
    axes.set_ylim(len(lanes), 0)
    axes.set_yticks([row + 0.5 for row in range(len(lanes))], [short(lane.name) for lane in lanes])
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False)
    for edge in ("left", "top"):
        axes.spines[edge].set_visible(False)


def _lane_styles(plot: SignalAxes) -> dict[str, Area]:
    """The same value has the same style in every lane, and behind the panels."""
    behind = plot.bands.values if plot.bands else ()
    values = [value for lane in plot.lanes for value in lane.values]
    return area_styles([v for v in (*behind, *values) if v not in _FLAGS]) | _FLAGS


def _fill(style: Area) -> dict[str, Any]:
    hatch = _DOT_HATCH if style.dotted else None
    return {"facecolor": style.colour, "edgecolor": INK, "hatch": hatch, "linewidth": 0}


def _paint_states(axes: Any, row: int, lane: Lane, styles: Mapping[str, Area]) -> None:
    for value in lane.values:
        intervals = [interval for interval in lane.intervals if interval.value == value]
        axes.broken_barh(_lengths(intervals), (row + 0.1, 0.8), **_fill(styles[value]))
    for interval in lane.intervals:
        if _has_room(axes, interval):
            ink = "white" if styles[interval.value].colour == INK else INK
            middle = (interval.start_s + interval.end_s) / 2
            centred = {"ha": "center", "va": "center", "fontsize": 7, "clip_on": True}
            axes.text(middle, row + 0.52, short(interval.value), color=ink, **centred)


def _has_room(axes: Any, interval: Interval) -> bool:
    start_s, end_s = axes.get_xlim()
    share = (interval.end_s - interval.start_s) / (end_s - start_s)
    axis_px = axes.figure.get_figwidth() * axes.figure.dpi - BESIDE_PX
    return share * axis_px > 8 + _LETTER_PX * len(short(interval.value))


def _paint_events(axes: Any, row: int, lane: Lane) -> None:
    """A mark at the start of each, a bar for what lasted, its name where there is room."""
    bar = {"color": LINES[1], "alpha": 0.3, "linewidth": 0}
    axes.broken_barh(_lengths(lane.intervals), (row + 0.1, 0.8), **bar)
    starts = [interval.start_s for interval in lane.intervals]
    style = {"linestyle": "", "marker": "d", "markersize": 5, "color": LINES[1]}
    axes.plot(starts, [row + 0.5] * len(starts), clip_on=False, zorder=4, **style)
    ends = [*starts[1:], axes.get_xlim()[1]]
    for interval, end_s in zip(lane.intervals, ends, strict=True):
        if _has_room(axes, Interval(interval.value, interval.start_s, end_s)):
            axes.annotate(
                short(interval.value), (interval.start_s, row + 0.52), (5, 0), va="center",
                textcoords="offset points", fontsize=7, zorder=5,
            )  # fmt: skip


def _entries(axes: Any, plot: SignalAxes) -> list[Entry]:
    """What the legend has to tell."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: list[Entry] = []
    for index, name in enumerate(plot.colour_by_run.values()):
        pen: dict[str, Any] = {"color": LINES[index % len(LINES)], "linewidth": 1.5}
        entries.append((Line2D([], [], linestyle=DASHES[index % len(DASHES)], **pen), name))
    if plot.gaps:
        darker: dict[str, Any] = _GAP | {"edgecolor": "#999999"}
        entries.append((Patch(**darker, linewidth=0), "nothing recorded"))
    if plot.unread:
        entries.append((Patch(**_UNREAD, linewidth=0), "not all was read"))
    styles = _lane_styles(plot)
    if plot.bands is not None and plot.panels:
        entries.append((Patch(visible=False), f"{short(plot.bands.name)}:"))
        patches = [Patch(**_fill(styles[v]), alpha=_BAND_ALPHA) for v in plot.bands.values]
        entries += zip(patches, map(short, plot.bands.values), strict=True)
    entries += [(Patch(**_fill(styles[v])), short(v)) for v in _unlabelled(axes, plot)]
    return entries


def _unlabelled(axes: Any, plot: SignalAxes) -> list[str]:
    """Values in the rows below that no interval had room for."""
    intervals = [interval for lane in plot.lanes for interval in lane.intervals]
    labelled = {interval.value for interval in intervals if _has_room(axes, interval)}
    values = dict.fromkeys(interval.value for interval in intervals)
    return [value for value in values if value not in labelled]
