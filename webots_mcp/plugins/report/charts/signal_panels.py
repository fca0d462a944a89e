"""Signals over time as figures: panels of curves over modes, rows of intervals below."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
from bokeh.core.properties import field as of_column
from bokeh.core.properties import value as the_text
from bokeh.layouts import gridplot
from bokeh.models import (
    ColumnDataSource,
    CrosshairTool,
    FixedTicker,
    LegendItem,
    Range,
    Range1d,
    Span,
    WheelZoomTool,
)
from bokeh.plotting import figure

from webots_mcp.plotting.canvas import Room, short
from webots_mcp.plotting.curves import Curve, Panel, Point
from webots_mcp.plotting.intervals import Interval, Lane
from webots_mcp.plotting.palette import FAINT, INK, LINES, Area, area_styles
from webots_mcp.plotting.question import changed_most
from webots_mcp.plotting.signal_axes import SignalAxes
from webots_mcp.plotting.signals import compose_signals
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
from webots_mcp.store.questions.series import MOST_POINTS
from webots_mcp.store.reading.ranges import TimeRange

ROOM: Final = Room(points=MOST_POINTS, panels=8, lanes=8, rows=16)
DASHES: Final = ("solid", "dashed", "dotted", "dotdash")
_PANEL_PX: Final = 120
_ROW_PX: Final = 24
_AXIS_PX: Final = 70  # below the last figure, and the legend of modes above the first
_HEADING_PX: Final = 30  # the title of a panel, or its legend
_LETTER_PX: Final = 7
_TOOLS: Final = "xpan,xbox_zoom,xzoom_in,xzoom_out,reset,save"
_FLAGS: Final = {"true": Area(INK, dotted=False), "false": Area("#EFEFEF", dotted=False)}
_WITH_NAMES: Final = 0.012  # of the range, for each letter: shorter intervals are not labelled


Key: TypeAlias = "tuple[str, str, int]"  # what it is, its name, its run


@dataclass(frozen=True)
class SignalsChart(Chart):
    """Signals over time.

    Attributes:
        plot: What is drawn.
        x_range: That of all figures.
        sources: The data of what is drawn. A curve, `("curve", name, run)`, has time_s, mean, low
            and high; the mode, `("ground", name, 0)`, start_s, end_s, value, colour and hatch.
    """

    plot: SignalAxes
    x_range: Range
    time_axis: Any
    sources: dict[Key, ColumnDataSource]

    def refresh(self, plot: SignalAxes) -> bool:
        """Show other data in the same figures; False where those would have to be others."""
        data = data_of(plot)
        if _form(plot) != _form(self.plot):
            return False
        for key, source in self.sources.items():
            source.data = data[key]
        self.time_axis.axis_label = plot.x_label
        return True


def signals_chart(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    names: Sequence[str] = (),
    *,
    bands: str | None = None,
    events: bool = True,
    room: Room = ROOM,
) -> SignalsChart:
    """Signals as lines in a band of extremes, a mode as their ground, rows of events below.

    Args:
        connection: Any.
        ranges: From `find_range`; several runs are laid over each other, each beginning at 0.
        names: Signals, with `*`; none for the three that changed most.
        bands: The text signal behind the curves; None for the mode, where there is one; "" for
            none.
        events: Whether to mark what `find_events` finds; of several runs nothing is marked.
        room: How much is drawn.

    Raises:
        UnknownSignalError: A name meets nothing; the text offers near ones.
        InvalidInputError: `bands` is no text signal, or there are too many runs.
        NothingRecordedError: None of the signals has a value in the range.
    """
    names = names or changed_most(connection, ranges[-1])
    plot, notes = compose_signals(connection, ranges, names, bands=bands, events=events, room=room)
    return draw_signals(plot, notes)


def draw_signals(
    plot: SignalAxes,
    notes: Sequence[str] = (),
    *,
    x_range: Range | None = None,
    height_px: int | None = None,
) -> SignalsChart:
    """The figures of what `compose_signals` has gathered.

    Args:
        plot: That.
        notes: Its notes.
        x_range: Of all figures; None for that of the data.
        height_px: What they may fill; they are not made lower than is readable.
    """
    x_range = x_range or Range1d(start=plot.x_range[0], end=plot.x_range[1])
    sources = sources_of(data_of(plot))
    drawing = _Drawing(plot, x_range, sources, _panel_px(plot, height_px))
    figures = [drawing.panel(panel) for panel in plot.panels]
    if plot.lanes or plot.events:
        figures.append(drawing.lanes())
    axis = figures[-1].xaxis[0]
    axis.visible, axis.axis_label = True, plot.x_label
    layout = gridplot(
        [[each] for each in figures],
        merge_tools=True,
        sizing_mode="stretch_width",
        toolbar_location="right",
        toolbar_options={"logo": None},
    )
    return SignalsChart(layout, plot.title, tuple(notes), plot, x_range, axis, sources)


class _Drawing:
    """Draws figures that share a clock, a crosshair and a margin."""

    def __init__(
        self, plot: SignalAxes, x_range: Range, sources: dict[Key, ColumnDataSource], panel_px: int
    ) -> None:
        self._plot = plot
        self._x_range = x_range
        self._sources = sources
        self._panel_px = panel_px
        self._line = Span(dimension="height", line_color=FAINT, line_width=1, line_dash="dotted")
        named = [short(lane.name) for lane in (*plot.lanes, *plot.events)]
        self._left_px = max([58, *(14 + _LETTER_PX * len(name) for name in named)])

    def panel(self, panel: Panel) -> Any:
        """Curves on one axis, with what happened behind them."""
        fig = self._figure(self._panel_px)
        self._ground(fig)
        fig.xgrid.grid_line_color = None
        items = [self._curve(fig, panel, index) for index in range(len(panel.curves))]
        unit = f"[{panel.unit}]" if panel.unit else ""
        if len(panel.names) == 1:
            fig.title.text = plain(f"{panel.names[0]} {unit}".strip())
        else:
            fig.yaxis.axis_label = unit
        if len(items) > 1:
            fig.add_layout(legend(items), "above")
        if panel is self._plot.panels[0] and self._plot.bands:
            fig.add_layout(self._ground_legend(fig, self._plot.bands), "above")
        return fig

    def lanes(self) -> Any:
        """Rows of texts, flags and events."""
        states, events = self._plot.lanes, self._plot.events
        count = len(states) + len(events)
        fig = self._figure(count * _ROW_PX + 8, y_range=Range1d(start=count, end=0))
        fig.grid.grid_line_color = None
        for row, lane in enumerate(states):
            self._states(fig, row, lane)
        for row, lane in enumerate(events, len(states)):
            self._events(fig, row, lane)
        rows = [row + 0.5 for row in range(count)]
        named = [plain(short(lane.name)) for lane in (*states, *events)]
        fig.yaxis.ticker = FixedTicker(ticks=rows)
        fig.yaxis.major_label_overrides = dict(zip(rows, named, strict=True))
        fig.yaxis.major_tick_line_color = None
        fig.yaxis.axis_line_color = None
        self._hatch(fig)
        return fig

    def _figure(self, height: int, **options: Any) -> Any:
        fig: Any = figure(
            frame_height=height, x_range=self._x_range, tools=_TOOLS, min_border_left=self._left_px,
            min_border_right=16, min_border_top=0, min_border_bottom=4, **options,
        )  # fmt: skip
        style(fig)
        fig.add_tools(CrosshairTool(overlay=self._line, visible=False))
        fig.add_tools(WheelZoomTool(dimensions="width", modifiers="ctrl"))
        fig.xaxis.visible = False
        return fig

    def _ground(self, fig: Any) -> None:
        """Modes, gaps and the moments of events, over the whole height behind the curves."""
        if self._plot.bands:
            source = self._sources["ground", self._plot.bands.name, 0]
            fig.vstrip("start_s", "end_s", source=source, name="ground", **_GROUND)
        self._hatch(fig)
        line = {"line_color": FAINT, "line_dash": "dotted", "line_alpha": 0.6}
        fig.vspan("start_s", source=self._sources[_MOMENTS], **line)

    def _hatch(self, fig: Any) -> None:
        """Where nothing was recorded, and where not all was read."""
        fig.vstrip("start_s", "end_s", source=self._sources[_GAPS], **_GAP)
        fig.vstrip("start_s", "end_s", source=self._sources[_UNREAD], **(_GAP | _NOT_ALL))

    def _ground_legend(self, fig: Any, bands: Lane) -> Any:
        (ground,) = fig.select({"name": "ground"})
        name = LegendItem(label=the_text(plain(f"{short(bands.name)}:")))
        found = legend([name, LegendItem(label=of_column("value"), renderers=[ground])])
        found.click_policy = "none"
        return found

    def _curve(self, fig: Any, panel: Panel, index: int) -> LegendItem:
        curve = panel.curves[index]
        colour, dash = self._pen(curve, index)
        curve_of, band_of, lone_of = (
            self._sources[what, curve.name, curve.run_id] for what in ("curve", "band", "lone")
        )
        alpha = 0.28 / len(panel.curves) ** 0.5
        band = fig.patch("x", "y", source=band_of, color=colour, alpha=alpha, line_width=0)
        pen = {"color": colour, "line_dash": dash, "line_width": 1.6}
        line = fig.line("time_s", "mean", source=curve_of, **pen)
        lone = fig.scatter("time_s", "mean", source=lone_of, color=colour, size=5)
        name = self._name(curve)
        extremes = ("extremes", "@low{0.[0000]} to @high{0.[0000]}")
        told = [(name, "@mean{0.[0000]}"), extremes, ("at", "@time_s{0.000} s")]
        fig.add_tools(hover([line], told, mode="vline", line_policy="nearest"))
        return LegendItem(label=the_text(name), renderers=[band, line, lone])

    def _pen(self, curve: Curve, index: int) -> tuple[str, str]:
        """Colour and dashes: by run where several are overlaid, else by signal."""
        runs = list(self._plot.colour_by_run)
        index = runs.index(curve.run_id) if runs else index
        return LINES[index % len(LINES)], DASHES[index % len(DASHES)]

    def _name(self, curve: Curve) -> str:
        return plain(self._plot.colour_by_run.get(curve.run_id, curve.name))

    def _states(self, fig: Any, row: int, lane: Lane) -> None:
        bars = fig.hbar(
            y=row + 0.5, left="start_s", right="end_s", height=0.8, line_width=0,
            source=self._sources["lane", lane.name, 0], fill_color="colour",
            hatch_pattern="hatch", hatch_color=INK, hatch_alpha=0.5,
        )  # fmt: skip
        fig.add_tools(hover([bars], [(lane.name, "@value"), *_WHEN]))
        fig.text(
            "at_s", row + 0.5, text="value", source=self._sources["names", lane.name, 0],
            text_color="colour", text_align="center", text_baseline="middle",
            text_font_size="11px",
        )  # fmt: skip

    def _events(self, fig: Any, row: int, lane: Lane) -> None:
        source = self._sources["events", lane.name, 0]
        fig.hbar(
            y=row + 0.5, left="start_s", right="end_s", height=0.8, source=source, line_width=0,
            fill_color=LINES[1], fill_alpha=0.3,
        )  # fmt: skip
        marks = fig.scatter(
            "start_s", row + 0.5, source=source, marker="diamond", size=11, color=LINES[1],
            line_color="white",
        )  # fmt: skip
        fig.add_tools(hover([marks], [(lane.name, "@value"), *_WHEN]))


_GAPS: Final[Key] = ("gaps", "", 0)
_UNREAD: Final[Key] = ("unread", "", 0)
_MOMENTS: Final[Key] = ("moments", "", 0)
_WHEN: Final = (("from", "@start_s{0.000} s"), ("to", "@end_s{0.000} s"))
_GROUND: Final[dict[str, Any]] = {
    "fill_color": "colour", "fill_alpha": 0.35, "line_width": 0, "hatch_pattern": "hatch",
    "hatch_color": INK, "hatch_alpha": 0.25, "level": "underlay",
}  # fmt: skip
_GAP: Final[dict[str, Any]] = {
    "fill_color": "white", "line_width": 0, "hatch_pattern": "/", "hatch_color": "#AAAAAA",
    "hatch_weight": 0.5, "level": "underlay",
}  # fmt: skip


_NOT_ALL: Final[dict[str, Any]] = {
    "hatch_pattern": "x",
    "hatch_color": LINES[1],
    "hatch_alpha": 0.5,
}


def _panel_px(plot: SignalAxes, height_px: int | None) -> int:
    """How high a panel is, of what the rows below leave."""
    if height_px is None or not plot.panels:
        return _PANEL_PX
    rows = len(plot.lanes) + len(plot.events)
    left_px = height_px - rows * _ROW_PX - _AXIS_PX
    return max(_PANEL_PX, left_px // len(plot.panels) - _HEADING_PX)


def _form(plot: SignalAxes) -> Any:
    """What the figures are made for: the same form, the same figures."""
    return (
        [
            (panel.unit, [(curve.name, curve.run_id) for curve in panel.curves])
            for panel in plot.panels
        ],
        [lane.name for lane in plot.lanes],
        [lane.name for lane in plot.events],
        plot.bands.name if plot.bands else None,
        plot.colour_by_run,
    )


def data_of(plot: SignalAxes) -> dict[Key, dict[str, Any]]:
    """All that the figures show, by what it is."""
    styles = _styles_of(plot)
    events = [interval for lane in plot.events for interval in lane.intervals]
    found: dict[Key, dict[str, Any]] = {
        _GAPS: _columns(plot.gaps), _UNREAD: _columns(plot.unread), _MOMENTS: _columns(events),
    }  # fmt: skip
    for curve in (curve for panel in plot.panels for curve in panel.curves):
        found["curve", curve.name, curve.run_id] = _points(curve.points)
        found["band", curve.name, curve.run_id] = _outline(curve.points)
        found["lone", curve.name, curve.run_id] = _points(curve.lone_points)
    if plot.bands:
        found["ground", plot.bands.name, 0] = _areas(plot.bands, styles)
    for lane in plot.lanes:
        found["lane", lane.name, 0] = _areas(lane, styles)
        found["names", lane.name, 0] = _names(lane, plot.x_range, styles)
    for lane in plot.events:
        found["events", lane.name, 0] = _columns(lane.intervals)
    return found


def _styles_of(plot: SignalAxes) -> dict[str, Area]:
    """The same value has the same style in every row, and behind the panels."""
    lanes = [*plot.lanes, *([plot.bands] if plot.bands else [])]
    values = [value for lane in lanes for value in lane.values if value not in _FLAGS]
    return area_styles(values) | _FLAGS


def _points(points: Sequence[Point]) -> dict[str, Any]:
    return dict(zip(("time_s", "mean", "low", "high"), _by_column(points), strict=True))


def _by_column(points: Sequence[Point]) -> Any:
    """The points, a row for each of their four columns."""
    rows: Any = np.array(points, dtype=np.float64)
    return np.transpose(rows.reshape((-1, 4)))


def _outline(points: Sequence[Point]) -> dict[str, Any]:
    """The band of extremes: along the least values and back along the largest, piece by piece."""
    columns = _by_column(points)
    x: list[Any] = []
    y: list[Any] = []
    for piece in np.split(columns, np.flatnonzero(np.isnan(columns[0])), axis=1):
        times, _, lows, highs = piece[:, ~np.isnan(piece[0])]
        x += [times, times[::-1], [np.nan]]
        y += [lows, highs[::-1], [np.nan]]
    return {"x": np.concatenate(x), "y": np.concatenate(y)}


def _columns(intervals: Sequence[Interval]) -> dict[str, Any]:
    return {
        "start_s": numbers([each.start_s for each in intervals]),
        "end_s": numbers([each.end_s for each in intervals]),
        "value": texts([each.value for each in intervals]),
    }


def _areas(lane: Lane, styles: dict[str, Area]) -> dict[str, Any]:
    """The columns of coloured stretches."""
    areas = [styles[each.value] for each in lane.intervals]
    return {
        **_columns(lane.intervals),
        "colour": [area.colour for area in areas],
        "hatch": ["dot" if area.dotted else " " for area in areas],
    }


def _names(lane: Lane, x_range: tuple[float, float], styles: dict[str, Area]) -> dict[str, Any]:
    """The values that have room in their stretches."""
    length_s = x_range[1] - x_range[0]
    shown = [
        each
        for each in lane.intervals
        if each.end_s - each.start_s > _WITH_NAMES * len(short(each.value)) * length_s
    ]
    return {
        "at_s": numbers([(each.start_s + each.end_s) / 2 for each in shown]),
        "value": [plain(short(each.value)) for each in shown],
        "colour": ["white" if styles[each.value].colour == INK else INK for each in shown],
    }
