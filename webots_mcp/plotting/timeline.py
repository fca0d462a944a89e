"""Painting signals over time: panels of curves, modes behind them, rows of spans below."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.plotting.canvas import short
from webots_mcp.plotting.curves import Curve
from webots_mcp.plotting.legend import Entry, paint_legend
from webots_mcp.plotting.palette import DASHES, FAINT, INK, LINES, area_colours
from webots_mcp.plotting.panels import Panel
from webots_mcp.plotting.spans import Lane, Span

_LANE_PX: Final = 17
_AXIS_PX: Final = 700  # about: how long the time axis becomes is known only after painting
_LETTER_PX: Final = 6
_GAP_HATCH: Final = "////"
_BAND_ALPHA: Final = 0.35
_LINES_THROUGH: Final = 30  # more instants would be a curtain


@dataclass(frozen=True)
class Timeline:
    """What is to be painted; all times are on the clock of the picture.

    Attributes:
        colour_by_run: Run to its name in the legend, where several are overlaid; else empty.
        bands: A text signal behind the curves.
        lanes: Text and boolean signals below.
        events: One lane per kind of event.
        gaps: Where nothing was recorded.
    """

    title: str
    x_label: str
    x_range: tuple[float, float]
    panels: Sequence[Panel]
    colour_by_run: Mapping[int, str]
    bands: Lane | None
    lanes: Sequence[Lane]
    events: Sequence[Lane]
    gaps: Sequence[Span]


def paint_timeline(figure: Any, timeline: Timeline) -> None:
    """Paint it on an empty figure."""
    figure.suptitle(timeline.title, x=0.01, ha="left", fontsize=10, fontweight="bold")
    rows = len(timeline.lanes) + len(timeline.events)
    heights = _heights(figure, len(timeline.panels), rows)
    axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    axes[-1].set_xlim(*timeline.x_range)
    panels = axes[: len(timeline.panels)]
    for each, panel in zip(panels, timeline.panels, strict=True):
        _paint_panel(each, panel, timeline)
    if rows:
        _paint_lanes(axes[-1], timeline)
    axes[-1].set_xlabel(timeline.x_label)
    figure.align_ylabels(panels)
    paint_legend(figure, _entries(axes[-1], timeline))


def _heights(figure: Any, panels: int, rows: int) -> list[float]:
    """Rows of spans take the pixels that they need, the panels share the rest."""
    height_px = figure.get_figheight() * figure.dpi - 110
    rows_px = min(rows * _LANE_PX, height_px / 2) if panels else height_px
    panel_px = (height_px - rows_px) / max(panels, 1)
    return [*[panel_px] * panels, *([rows_px] if rows else [])]


def _paint_panel(axes: Any, panel: Panel, timeline: Timeline) -> None:
    _shade(axes, timeline)
    for event in [span for lane in timeline.events for span in lane.spans][:_LINES_THROUGH]:
        axes.axvline(event.start_s, color=FAINT, linewidth=0.6, linestyle=(0, (1, 3)), zorder=1.5)
    handles = [
        _paint_curve(axes, curve, *_pen(panel, index, timeline), len(panel.curves))
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


def _pen(panel: Panel, index: int, timeline: Timeline) -> tuple[str, Any]:
    """Colour and dashes: by run where several are overlaid, else by signal."""
    runs = list(timeline.colour_by_run)
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


def _shade(axes: Any, timeline: Timeline) -> None:
    """Modes and gaps, over the whole height behind the curves."""
    if timeline.bands is not None:
        colours = _lane_colours(timeline)
        for value in timeline.bands.values:
            spans = [span for span in timeline.bands.spans if span.value == value]
            _bars(axes, spans, color=colours[value], alpha=_BAND_ALPHA, zorder=0.5)
    _hatch(axes, timeline.gaps, zorder=0.6)


def _hatch(axes: Any, gaps: Sequence[Span], zorder: float) -> None:
    """Whatever stands there in the last row's name, nothing was recorded."""
    _bars(axes, gaps, color="white", zorder=zorder)
    _bars(axes, gaps, facecolor="none", edgecolor="#AAAAAA", hatch=_GAP_HATCH, zorder=zorder)


def _bars(axes: Any, spans: Sequence[Span], **style: Any) -> None:
    """Over the whole height of the axes."""
    if spans:
        whole = {"transform": axes.get_xaxis_transform(), "linewidth": 0}
        axes.broken_barh(_lengths(spans), (0, 1), **whole, **style)


def _lengths(spans: Sequence[Span]) -> list[tuple[float, float]]:
    return [(span.start_s, span.end_s - span.start_s) for span in spans]


def _paint_lanes(axes: Any, timeline: Timeline) -> None:
    lanes = [*timeline.lanes, *timeline.events]
    colours = _lane_colours(timeline)
    for row, lane in enumerate(lanes):
        if row < len(timeline.lanes):
            _paint_states(axes, row, lane, colours)
        else:
            _paint_events(axes, row, lane)
    _hatch(axes, timeline.gaps, zorder=2)
    axes.set_ylim(len(lanes), 0)
    axes.set_yticks([row + 0.5 for row in range(len(lanes))], [short(lane.name) for lane in lanes])
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False)
    for edge in ("left", "top"):
        axes.spines[edge].set_visible(False)


def _lane_colours(timeline: Timeline) -> dict[str, str]:
    """The same value has the same colour in every lane, and behind the panels."""
    behind = timeline.bands.values if timeline.bands else ()
    values = [value for lane in timeline.lanes for value in lane.values]
    flags = {"true": INK, "false": "#F0F0F0"}
    return area_colours([v for v in (*behind, *values) if v not in flags]) | flags


def _paint_states(axes: Any, row: int, lane: Lane, colours: Mapping[str, str]) -> None:
    for value in lane.values:
        spans = [span for span in lane.spans if span.value == value]
        axes.broken_barh(_lengths(spans), (row + 0.1, 0.8), color=colours[value], linewidth=0)
    for span in lane.spans:
        if _has_room(axes, span):
            ink = "white" if colours[span.value] == INK else INK
            middle = (span.start_s + span.end_s) / 2
            axes.text(middle, row + 0.52, short(span.value), ha="center", va="center", fontsize=7,
                      color=ink, clip_on=True)  # fmt: skip


def _has_room(axes: Any, span: Span) -> bool:
    start_s, end_s = axes.get_xlim()
    share = (span.end_s - span.start_s) / (end_s - start_s)
    return share * _AXIS_PX > 8 + _LETTER_PX * len(short(span.value))


def _paint_events(axes: Any, row: int, lane: Lane) -> None:
    """A mark at the start of each, a bar for what lasted, its name where there is room."""
    axes.broken_barh(_lengths(lane.spans), (row + 0.1, 0.8), color=LINES[1], alpha=0.3, linewidth=0)
    starts = [span.start_s for span in lane.spans]
    style = {"linestyle": "", "marker": "d", "markersize": 5, "color": LINES[1]}
    axes.plot(starts, [row + 0.5] * len(starts), clip_on=False, zorder=4, **style)
    ends = [*starts[1:], axes.get_xlim()[1]]
    for span, end_s in zip(lane.spans, ends, strict=True):
        if _has_room(axes, Span(span.value, span.start_s, end_s)):
            axes.annotate(short(span.value), (span.start_s, row + 0.52), (5, 0), va="center",
                          textcoords="offset points", fontsize=7, zorder=5)  # fmt: skip


def _entries(axes: Any, timeline: Timeline) -> list[Entry]:
    """What the legend has to tell."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: list[Entry] = []
    for index, name in enumerate(timeline.colour_by_run.values()):
        pen: dict[str, Any] = {"color": LINES[index % len(LINES)], "linewidth": 1.5}
        entries.append((Line2D([], [], linestyle=DASHES[index % len(DASHES)], **pen), name))
    colours = _lane_colours(timeline)
    if timeline.bands is not None and timeline.panels:
        entries.append((Patch(visible=False), f"{short(timeline.bands.name)}:"))
        patches = [Patch(color=colours[v], alpha=_BAND_ALPHA) for v in timeline.bands.values]
        entries += zip(patches, map(short, timeline.bands.values), strict=True)
    entries += [(Patch(color=colours[v]), short(v)) for v in _unlabelled(axes, timeline)]
    if timeline.gaps:
        hatched = Patch(facecolor="none", edgecolor="#999999", hatch=_GAP_HATCH, linewidth=0)
        entries.append((hatched, "nothing recorded"))
    return entries


def _unlabelled(axes: Any, timeline: Timeline) -> list[str]:
    """Values in the rows below that no span had room for."""
    spans = [span for lane in timeline.lanes for span in lane.spans]
    labelled = {span.value for span in spans if _has_room(axes, span)}
    return [value for value in dict.fromkeys(span.value for span in spans) if value not in labelled]
