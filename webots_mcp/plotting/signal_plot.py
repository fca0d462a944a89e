"""Signals over time as a picture: of one run, or of several laid over each other."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

from webots_mcp.analysis.arrays import np
from webots_mcp.errors import NothingRecordedError
from webots_mcp.judging.detection.events import Found
from webots_mcp.plotting.axes import AxesBox, rounded_on, ticks
from webots_mcp.plotting.canvas import (
    LEAST_HEIGHT_PX,
    ROW_PX,
    Canvas,
    PlotImage,
    Room,
    Sheet,
    fitted,
    short,
    width_of,
    wrapped,
)
from webots_mcp.plotting.colours import INK, ON_PAPER, Area, Theme, area_styles
from webots_mcp.plotting.curves import Curve, Panel, by_choice, by_scale, by_signal, curve_of
from webots_mcp.plotting.intervals import Interval, Lane, at_resolution, lane_of, merged_notes
from webots_mcp.plotting.line_styles import LineStyle, line_style
from webots_mcp.plotting.painting import (
    LINE_PX,
    LegendEntry,
    area_sample,
    hatch_sample,
    line_sample,
    paint_area,
    paint_grid,
    paint_mark,
    paint_rows,
    paint_title,
    paint_x_axis,
    paint_y_axis,
    rows_of,
)
from webots_mcp.plotting.plotted_runs import (
    PlottedRun,
    event_lanes,
    known_signals,
    mode_signal,
    plotted_runs,
    range_notes,
    title_of,
    unread_parts,
)
from webots_mcp.signals.naming import counted, listed, spelled_out
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.segment import SEARCH_DEADLINE_S, Deadline

_FLAGS: Final = {"true": Area(INK, dotted=False), "false": Area("#EDEDED", dotted=False)}


@dataclass(frozen=True)
class SignalLayout:
    """The layout of signals over time.

    Attributes:
        small_text_px: Size of the letters in rows of intervals and at the ends of curves.
        leader_px: Length of the line from the end of a curve to its value.
        tick_px: Minimum distance between labels of the time axis.
        min_ticks: Labels of the time axis of a narrow figure, if their texts fit.
        level_px: Minimum distance between labels of the vertical axis.
        right_px: Margin on the right.
        time_labels_px: Height of the labels of the time axis.
        band_opacity: Opacity of modes behind curves.
        event_lines: Events that are marked by a line through the panels: more would be a curtain.
        events_share: Share of the reading time reserved for events, whatever the curves take.
    """

    small_text_px: float = 9.5
    leader_px: float = 9.0
    tick_px: float = 70.0
    min_ticks: float = 4.0
    level_px: float = 20.0
    right_px: float = 16.0
    time_labels_px: float = 24.0
    band_opacity: float = 0.35
    event_lines: int = 30
    events_share: float = 0.7


_LAYOUT: Final = SignalLayout()


def plot_signals(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    names: Sequence[str],
    *,
    bands: str | None = None,
    sheet: Sheet | None = None,
) -> PlotImage:
    """Numbers as a mean line in a min-max band, a mode behind them, flags and events below.

    Signals whose units or scales do not fit one axis get panels of their own, at most three.
    Where several runs are given they are laid over each other, each beginning at 0.

    Args:
        connection: Any.
        ranges: From `find_range`; each run in them counts, ten at most.
        names: Signals, with `*`.
        bands: The text signal behind the curves; None for the mode, where there is one; "" for
            none. Of several runs it is drawn below, once per run.
        sheet: Size and format; None for a PNG of 900 x 500 pixels.

    Raises:
        UnknownSignalError: A name meets nothing; the text offers near ones.
        InvalidInputError: `bands` is no text signal, or there are too many runs.
        NothingRecordedError: None of the signals has a value in the range.
    """
    sheet = sheet or Sheet()
    plot, notes = compose_signals(connection, ranges, names, bands=bands, room=sheet.room)
    if not plot.panels:
        rows = len(plot.lanes) + len(plot.events)
        sheet = replace(sheet, height_px=_height_of_rows(rows, sheet))
    canvas, _ = paint_signals(plot, sheet.width_px, sheet.height_px)
    return canvas.picture(sheet.image_format, _caption(plot), notes)


def compose_signals(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    names: Sequence[str],
    *,
    bands: str | None = None,
    events: bool = True,
    found: Mapping[int, Found] | None = None,
    room: Room | None = None,
    grouped: Sequence[Sequence[str]] | None = None,
    deadline_s: float = SEARCH_DEADLINE_S,
) -> tuple[SignalAxes, tuple[str, ...]]:
    """Return what `plot_signals` paints, and its notes; arguments and errors as there.

    `found` is what was searched before in the whole of these runs, each event by itself. `room` is
    how much it may be; None for that of a PNG of 900 x 500 pixels. `grouped` are the signals of
    each panel; None puts those of one unit and scale together. `deadline_s` is for all that is
    read, a share of it for events; what is not read in it is hatched, and a note says so.
    """
    room = room or Sheet().room
    deadline = Deadline(deadline_s)
    mode = mode_signal(known_signals(connection, ranges), bands)
    curves_s = deadline_s * (1 - _LAYOUT.events_share) if events else deadline_s
    parts = plotted_runs(
        connection, ranges, [*names, *([mode] if mode else [])], room.points, curves_s
    )
    overlaid = len(parts) > 1
    curves = [curve for part in parts for curve in _curves(part)]
    if grouped and not overlaid:
        panels, left_out = by_choice(curves, grouped, room.panels)
    else:
        panels, left_out = (by_signal if overlaid else by_scale)(curves, room.panels)
    behind, below = _behind_and_below(parts, mode if panels else None)
    if not panels and not below:
        raise NothingRecordedError(_nothing(parts))
    left_out += [lane.name for lane in below[room.lanes :]]
    below = below[: room.lanes]
    marked, event_notes = ([], [])
    if events and not overlaid:
        drawn = [name for panel in panels for name in panel.names] or names
        marked, event_notes = event_lanes(
            connection, parts[0], drawn, room.rows - len(below), found,
            max(deadline.left_s, _LAYOUT.events_share * deadline_s),
        )  # fmt: skip
    plot = SignalAxes(
        title=title_of(parts),
        x_label=_x_label(parts),
        x_range=_x_range(parts),
        panels=panels,
        colour_by_run={part.run.run_id: part.name for part in parts} if overlaid else {},
        bands=behind,
        lanes=below,
        events=marked,
        gaps=() if overlaid else _gaps(parts[0]),
        unread=() if overlaid else _unread(parts[0]),
    )
    notes = [*_notes(parts, curves), *merged_notes([*below, *([behind] if behind else [])])]
    if left_out:
        notes.append(_left_out(left_out, room))
    return plot, (*notes, *event_notes)


def _curves(part: PlottedRun) -> list[Curve]:
    made = (curve_of(columns, part.run, part.origin_s) for columns in part.run.numbers)
    return [curve for curve in made if curve is not None]


def _behind_and_below(
    parts: Sequence[PlottedRun], mode: str | None
) -> tuple[Lane | None, list[Lane]]:
    """Return the mode of a single run stands behind the curves, all else in rows below."""
    overlaid = len(parts) > 1
    lanes = [lane for part in parts for lane in _lanes(part, overlaid)]
    behind = next((lane for lane in lanes if lane.name == mode and not overlaid), None)
    return behind, [lane for lane in lanes if lane is not behind]


def _lanes(part: PlottedRun, overlaid: bool) -> list[Lane]:
    lanes = [lane_of(columns, part.run, part.end_s) for columns in part.run.changes]
    of_run = f", {part.name}" if overlaid else ""
    return [lane.moved(part.origin_s, lane.name + of_run) for lane in lanes if lane.intervals]


def _gaps(part: PlottedRun) -> list[Interval]:
    return [Interval("", gap.start_s, gap.end_s).moved(part.origin_s) for gap in part.run.gaps]


def _unread(part: PlottedRun) -> list[Interval]:
    return [] if part.unread is None else [part.unread.moved(part.origin_s)]


def _height_of_rows(rows: int, sheet: Sheet) -> int:
    """Rows of intervals alone need no more."""
    return min(sheet.height_px, max(LEAST_HEIGHT_PX, 130 + 50 * rows))


def _x_range(parts: Sequence[PlottedRun]) -> tuple[float, float]:
    start_s = min(part.start_s - part.origin_s for part in parts)
    end_s = max(part.end_s - part.origin_s for part in parts)
    return (start_s, end_s) if end_s > start_s else (start_s - 0.5, start_s + 0.5)


def _x_label(parts: Sequence[PlottedRun]) -> str:
    clock = "simulation time [s]" if len(parts) == 1 else "time since the start of the run [s]"
    steps = {part.run.step_s for part in parts if part.run.numbers}
    if len(steps) != 1 or None in steps:
        return clock
    return f"{clock}; line: mean by time, band: minimum to maximum of every {steps.pop():g} s"


def _caption(plot: SignalAxes) -> str:
    sentences = [plot.title]
    if plot.panels:
        panels = "; ".join(_panel_caption(panel, plot) for panel in plot.panels)
        sentences.append(f"Curves with their last values: {panels}")
    if plot.bands:
        sentences.append(f"Background: {plot.bands.name}")
    if plot.lanes:
        sentences.append(f"Rows: {'; '.join(lane.name for lane in plot.lanes)}")
    if plot.events:
        sentences.append(f"Events: {', '.join(lane.counted for lane in plot.events)}")
    if plot.unread:
        sentences.append(f"Not all was read from {plot.unread[0].start_s:g} s on")
    return ". ".join(sentences)


def _panel_caption(panel: Panel, plot: SignalAxes) -> str:
    """Return the signals of a panel with the values at the ends of their curves."""
    described = list[str]()
    for name in panel.names:
        values = [
            f"{rounded_on(curve.last, panel.scale)}{f' {curve.unit}' if curve.unit else ''}"
            + (f" (run {curve.run_id})" if plot.colour_by_run else "")
            for curve in panel.curves
            if curve.name == name and curve.last is not None
        ]
        described.append(" ".join([name, ", ".join(values)]).strip())
    return ", ".join(described)


def _notes(parts: Sequence[PlottedRun], curves: Sequence[Curve]) -> list[str]:
    notes = range_notes(parts)
    drawn = {(curve.run_id, curve.name) for curve in curves}
    for part in parts:
        left = [c for c in part.run.numbers if (part.run.run_id, c.name) not in drawn]
        if too_large := [columns.name for columns in left if columns.too_large]:
            notes.append(f"Too large to draw (beyond 1e100) in {part.name}: {listed(too_large)}")
        without_value = [
            each.name
            for each in left
            if not each.whole.present and not each.too_large and each.whole.rows
        ]
        if without_value and part.unread is None:
            notes.append(f"No value in {part.name}: {listed(without_value)}")
        notes += [
            f"Not drawn of {columns.name} in {part.name}: {_counted(columns.replaced)}"
            for columns in part.run.numbers
            if columns.replaced
        ]
    return list(dict.fromkeys(notes))


def _counted(replaced: dict[str, int]) -> str:
    return ", ".join(f"{counted(count, 'value')} {value}" for value, count in replaced.items())


def _left_out(names: Sequence[str], room: Room) -> str:
    holds = f"{counted(room.panels, 'panel')} and {counted(room.lanes, 'row')}"
    return (
        f"Left out: {listed(dict.fromkeys(names))}. A picture of this size has room for {holds}: "
        "draw them in a picture of their own"
    )


def _nothing(parts: Sequence[PlottedRun]) -> str:
    notes = "; ".join(note for part in parts for note in part.notes)
    if unread := unread_parts(parts):
        return f"nothing to draw was read in time ({'; '.join(unread)}): ask for less time"
    return f"nothing to draw: none of the signals has a value in {title_of(parts)}" + (
        f" ({notes})" if notes else ""
    )


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

    @property
    def rows(self) -> Sequence[Lane]:
        """All that stands in rows below the curves."""
        return [*self.lanes, *self.events]


def paint_signals(
    plot: SignalAxes, width_px: int, height_px: int, theme: Theme = ON_PAPER, *, titled: bool = True
) -> tuple[Canvas, list[AxesBox]]:
    """Paint it; the frames are those of the panels, and of the rows below them as the last."""
    return _SignalPainter(plot, width_px, height_px, theme).paint(titled=titled)


class _SignalPainter:
    """Paints what shares a clock and the margins."""

    def __init__(self, plot: SignalAxes, width_px: int, height_px: int, theme: Theme) -> None:
        self._plot = plot
        self._canvas = Canvas(width_px, height_px, theme)
        values_px = [
            width_of(rounded_on(curve.last, panel.scale), _LAYOUT.small_text_px)
            for panel in plot.panels
            for curve in panel.curves
            if curve.last is not None
        ]
        self._right_px = max([_LAYOUT.right_px, *(_LAYOUT.leader_px + 6 + px for px in values_px)])
        behind = plot.bands.values if plot.bands else ()
        values = [value for lane in plot.lanes for value in lane.values]
        # The same value has the same style in every row, and behind the panels.
        self._styles = area_styles([v for v in (*behind, *values) if v not in _FLAGS]) | _FLAGS

    def paint(self, *, titled: bool) -> tuple[Canvas, list[AxesBox]]:
        plot, canvas = self._plot, self._canvas
        top = paint_title(canvas, plot.title) if titled else 6.0
        heads = [
            rows_of(self._head(panel), canvas.width_px - 60, 4 * canvas.height_px)
            for panel in plot.panels
        ]
        label = wrapped(plot.x_label, canvas.width_px - 70)
        scales = [panel.scale for panel in plot.panels]
        left = self._left_px(scales)
        legend = rows_of(self._entries(left), canvas.width_px - 20, canvas.height_px)
        below = _LAYOUT.time_labels_px + LINE_PX * (len(label) + len(legend)) + 4
        heads_px = sum(LINE_PX * len(rows) + 8 for rows in heads)
        room = max(20.0, canvas.height_px - top - below - heads_px)
        rows_px = self._rows_px(room)
        panel_px = (room - rows_px) / max(1, len(plot.panels))
        frames: list[AxesBox] = []
        width = canvas.width_px - left - self._right_px
        for panel, rows, scale in zip(plot.panels, heads, scales, strict=True):
            paint_rows(canvas, rows, top, left)
            top += LINE_PX * len(rows) + 2
            frames.append(AxesBox(left, top, width, panel_px - 2, plot.x_range, scale))
            self._panel(panel, frames[-1])
            top += panel_px + 6
        if plot.rows:
            frames.append(AxesBox(left, top, width, rows_px, plot.x_range, (len(plot.rows), 0.0)))
            self._rows(frames[-1])
        marks = self._time_marks(frames[-1])
        for frame in frames[:-1]:
            paint_x_axis(canvas, frame, [(value, "") for value, _ in marks])
        paint_x_axis(canvas, frames[-1], marks, label)
        paint_rows(canvas, legend, canvas.height_px - LINE_PX * len(legend) - 2)
        return canvas, frames

    def _left_px(self, scales: Sequence[tuple[float, float]]) -> float:
        """Return what labels at the left take; of a long name of a row the end is shown."""
        most = 0.3 * self._canvas.width_px
        named = [width_of(self._row_name(lane)) for lane in self._plot.rows]
        labels = [width_of(text) for scale in scales for _, text in ticks(*scale, 5)]
        return 12 + min(most, max([24.0, *named, *labels]))

    def _row_name(self, lane: Lane) -> str:
        return lane.counted if lane in self._plot.events else short(lane.name)

    def _rows_px(self, room: float) -> float:
        """Rows take the pixels that they need, the panels share the rest."""
        if not self._plot.panels:
            return room
        return min(len(self._plot.rows) * float(ROW_PX), room / 2)

    def _time_marks(self, frame: AxesBox) -> list[tuple[float, str]]:
        low, high = self._plot.x_range
        tick_px = min(_LAYOUT.tick_px, frame.width / _LAYOUT.min_ticks)
        room = max(tick_px, 1.6 * max(width_of(text) for _, text in ticks(low, high, 8)))
        return ticks(low, high, frame.width / room)

    # Panels ---------------------------------------------------------------------------------------

    def _head(self, panel: Panel) -> list[LegendEntry]:
        """Return what stands above a panel: the name of its signal, or a legend of its lines.

        What the names of the lines share is a title, and the legend names what differs.
        """
        unit = [f"[{panel.unit}]"] if panel.unit else []
        room = self._canvas.width_px - 90
        if len(panel.names) == 1:
            part = "" if self._plot.colour_by_run else self._part(panel.curves[0])
            return [LegendEntry(fitted(" ".join([panel.names[0], *unit]), room), None, part)]
        named = _curve_names(panel, room)
        entries = [
            LegendEntry(named[curve.name], line_sample(*self._pen(panel, index)), self._part(curve))
            for index, curve in enumerate(panel.curves)
        ]
        if not panel.shared_name:
            return [*entries, *map(LegendEntry, unit)]
        return [LegendEntry(fitted(" ".join([panel.shared_name, *unit]), room)), *entries]

    def _part(self, curve: Curve) -> str:
        """By which a page finds it: of several runs all curves of one are hidden together."""
        run = self._plot.colour_by_run.get(curve.run_id)
        return f"run {curve.run_id}" if run is not None else f"curve {spelled_out(curve.name)}"

    def _pen(self, panel: Panel, index: int) -> LineStyle:
        """Return the style of a curve: by run where several are overlaid, else by signal."""
        runs = list(self._plot.colour_by_run)
        index = runs.index(panel.curves[index].run_id) if runs else index
        return line_style(index, self._canvas.theme)

    def _panel(self, panel: Panel, frame: AxesBox) -> None:
        canvas = self._canvas
        levels = ticks(*frame.y, max(2.0, frame.height / _LAYOUT.level_px))
        self._open(frame)
        self._ground(frame)
        paint_grid(canvas, frame, (), levels)
        starts = [each for lane in self._plot.events for each in lane.intervals]
        # Lines of the first ones only would look as if there were no others.
        for event in starts if len(starts) <= _LAYOUT.event_lines else ():
            x = float(frame.px(event.start_s))
            pen = {"stroke": canvas.theme.faint, "stroke_width": 0.6, "stroke_dasharray": "1 3"}
            canvas.add("path", d=f"M{x:.1f} {frame.top:.1f}V{frame.bottom:.1f}", **pen)
        for index, curve in enumerate(panel.curves):
            self._curve(frame, curve, *self._pen(panel, index), len(panel.curves))
        self._close()
        paint_y_axis(canvas, frame, levels)
        self._last_values(panel, frame)

    def _open(self, frame: AxesBox) -> None:
        """Begin what is cut off at the frame, and scaled in a page that is zoomed."""
        box = {"x": frame.left, "y": frame.top, "width": frame.width, "height": frame.height}
        view = f"{frame.left:.2f} {frame.top:.2f} {frame.width:.2f} {frame.height:.2f}"
        self._canvas.open("svg", **box, viewBox=view, preserveAspectRatio="none")
        self._canvas.open(class_="zoom")

    def _close(self) -> None:
        self._canvas.close()
        self._canvas.close("svg")

    def _curve(self, frame: AxesBox, curve: Curve, colour: str, dash: str, count: int) -> None:
        canvas = self._canvas
        canvas.open(data_part=self._part(curve))
        rows: Any = np.array(curve.points, np.float64)
        x = frame.px(rows[:, 0])
        mean, low, high = (frame.py(rows[:, column]) for column in (1, 2, 3))
        edges = [-1, *np.flatnonzero(np.isnan(rows[:, 0])).tolist(), len(rows)]
        pieces = [
            slice(start + 1, end) for start, end in pairwise(edges)
            if end > start + 1
        ]  # fmt: skip
        bands = "".join(
            f"{line_through(x[piece], high[piece])}L"
            f"{line_through(x[piece][::-1], low[piece][::-1])[1:]}Z"
            for piece in pieces
            if (np.abs(high[piece] - low[piece]) > 0.2).any()
        )
        if bands:
            canvas.add("path", d=bands, fill=colour, fill_opacity=0.28 / math.sqrt(count))
        line = "".join(line_through(x[piece], mean[piece]) for piece in pieces)
        canvas.add("path", d=line, fill="none", stroke=colour, stroke_width=1.4,
                   stroke_linejoin="round", stroke_dasharray=dash)  # fmt: skip
        for piece in pieces:
            if piece.stop - piece.start == 1:  # a line would not show it
                at = piece.start
                canvas.add("path", d=f"M{x[at]:.1f} {low[at]:.1f}V{high[at]:.1f}",
                           stroke=colour, stroke_width=2, stroke_opacity=0.4)  # fmt: skip
                canvas.add("path", d=f"M{x[at]:.1f} {mean[at]:.1f}h.01", stroke=colour,
                           stroke_width=4, stroke_linecap="round")  # fmt: skip
        canvas.close()

    def _last_values(self, panel: Panel, frame: AxesBox) -> None:
        """Write the last value at the end of each curve; a line leads to one that was moved."""
        canvas, size = self._canvas, _LAYOUT.small_text_px
        taken = list[tuple[float, float, float]]()  # left, right, middle
        ends = [
            (float(frame.px(time_s)), float(frame.py(mean)), index)
            for index, curve in enumerate(panel.curves)
            if curve.last is not None
            for time_s, mean, *_ in [curve.points[-1]]
        ]
        canvas.open(class_="marks ends")
        for x, y, index in sorted(ends):
            curve = panel.curves[index]
            text = rounded_on(curve.last or 0.0, panel.scale)
            left = x + _LAYOUT.leader_px
            right = left + width_of(text, size) + 3
            beside = [at for start, end, at in taken if start < right and left < end]
            middle = _free_place(y, beside, (frame.top + size / 2, frame.bottom - size / 2), size)
            if middle is None:
                continue  # the caption has it
            taken.append((left, right, middle))
            canvas.open(data_part=self._part(curve))
            canvas.open(class_="at", data_x=x, data_y=y, transform=f"translate({x:.1f} {y:.1f})")
            to = f"M1 0L{_LAYOUT.leader_px - 2:g} {middle - y:.1f}"
            pen = {"stroke": self._pen(panel, index).colour, "stroke_width": 1.4, "fill": "none"}
            canvas.add("path", d=to, **pen)
            halo: dict[str, Any] = {
                "stroke": canvas.theme.ground,
                "stroke_width": 2.5,
                "paint_order": "stroke",
            }
            canvas.text(_LAYOUT.leader_px, middle - y + 3.5, text, size=size, **halo)
            canvas.close()
            canvas.close()
        canvas.close()

    def _ground(self, frame: AxesBox) -> None:
        """Modes and gaps, over the whole height behind the curves."""
        bands = self._plot.bands
        # A thousand bands are drawn in half the time where their edges are those of pixels.
        self._canvas.open(shape_rendering="crispEdges")
        for each in _shown(bands.intervals, frame) if bands else ():
            box = (*self._stretch(frame, each), frame.height)
            paint_area(self._canvas, self._styles[each.value], box, _LAYOUT.band_opacity)
        self._canvas.close()
        self._hatch(frame)

    def _hatch(self, frame: AxesBox) -> None:
        """Where nothing was recorded, or read, whatever stands there in the last row's name."""
        canvas = self._canvas
        for stretches, name in ((self._plot.gaps, "gap"), (self._plot.unread, "unread")):
            for each in stretches:
                left, top, width = self._stretch(frame, each)
                for fill in (canvas.theme.ground, f"url(#hatch-{name})"):
                    canvas.add("rect", x=left, y=top, width=width, height=frame.height, fill=fill)

    def _stretch(self, frame: AxesBox, interval: Interval) -> tuple[float, float, float]:
        """Left, top and width."""
        left, right = float(frame.px(interval.start_s)), float(frame.px(interval.end_s))
        return left, frame.top, right - left

    # Rows -----------------------------------------------------------------------------------------

    def _rows(self, frame: AxesBox) -> None:
        canvas, plot = self._canvas, self._plot
        row_px = frame.height / len(plot.rows)
        self._open(frame)
        for row, lane in enumerate(plot.rows):
            top = frame.top + (row + 0.1) * row_px
            for each in _shown(lane.intervals, frame):
                left, _, width = self._stretch(frame, each)
                box = (left, top, width, 0.8 * row_px)
                if row < len(plot.lanes):
                    paint_area(canvas, self._styles[each.value], box)
                else:
                    paint_area(canvas, Area(lane.colour, dotted=False), box, 0.3)
        self._hatch(frame)
        self._close()
        for row, lane in enumerate(plot.rows):
            middle = frame.top + (row + 0.5) * row_px
            name = fitted(self._row_name(lane), frame.left - 10)
            canvas.text(frame.left - 7, middle + 4, name, anchor="end")
            canvas.open(class_="marks")
            if row < len(plot.lanes):
                self._name_states(frame, middle, lane)
            else:
                self._mark_events(frame, middle, lane)
            canvas.close()

    def _name_states(self, frame: AxesBox, middle: float, lane: Lane) -> None:
        for each in lane.intervals:
            if _has_room(frame, each):
                ink = "#FFFFFF" if self._styles[each.value].colour == INK else INK
                x = float(frame.px((each.start_s + each.end_s) / 2))
                self._name(short(each.value), x, middle, colour=ink, anchor="middle")

    def _mark_events(self, frame: AxesBox, middle: float, lane: Lane) -> None:
        """A mark at the start of each, its name after it or before it if it fits."""
        marked: dict[float, list[str]] = {}  # what begins at the same pixel shares a mark
        for each in lane.intervals:
            marked.setdefault(round(float(frame.px(each.start_s)), 0), []).append(each.value)
        free_from = frame.left
        ends = [*(x - 6 for x in list(marked)[1:]), frame.right]
        for (x, values), end in zip(marked.items(), ends, strict=True):
            paint_mark(self._canvas, "diamond", (x, middle), 4.0, fill=lane.colour)
            after = x + 6
            names = [value for value in dict.fromkeys(values) if value]
            more = f" and {len(names) - 1} more" if len(names) > 1 else ""
            texts = [", ".join(names), f"{short(names[0])}{more}"] if names else []
            for text in texts:
                width = width_of(text, _LAYOUT.small_text_px)
                if x + 7 + width < end:
                    self._name(text, x, middle, shift=7.0)
                    after = x + 7 + width
                    break
                if free_from < x - 7 - width:
                    self._name(text, x, middle, shift=-7.0, anchor="end")
                    break
            free_from = after

    def _name(self, text: str, x: float, y: float, *, shift: float = 0.0, **style: Any) -> None:
        canvas = self._canvas
        canvas.open(class_="at", data_x=x, data_y=y, transform=f"translate({x:.1f} {y:.1f})")
        canvas.text(shift, 3.5, text, size=_LAYOUT.small_text_px, **style)
        canvas.close()

    # Legend ---------------------------------------------------------------------------------------

    def _entries(self, left: float) -> list[LegendEntry]:
        """Return what the legend below the axes has to tell."""
        plot = self._plot
        entries: list[LegendEntry] = []
        for index, (run_id, name) in enumerate(plot.colour_by_run.items()):
            sample = line_sample(*line_style(index, self._canvas.theme))
            room = self._canvas.width_px - 80
            entries.append(LegendEntry(fitted(name, room), sample, f"run {run_id}"))
        if plot.gaps:
            entries.append(LegendEntry("nothing recorded", hatch_sample("hatch-gap")))
        if plot.unread:
            entries.append(LegendEntry("not all was read", hatch_sample("hatch-unread")))
        if plot.bands is not None and plot.panels:
            entries.append(LegendEntry(f"{short(plot.bands.name)}:"))
            entries += [
                LegendEntry(short(value), area_sample(self._styles[value], _LAYOUT.band_opacity))
                for value in plot.bands.values
            ]
        width = self._canvas.width_px - left - self._right_px
        frame = AxesBox(left, 0, width, 1, plot.x_range, (0, 1))
        return entries + [
            LegendEntry(short(value), area_sample(self._styles[value]))
            for value in _unnamed(plot.lanes, frame)
        ]


def _curve_names(panel: Panel, room_px: float) -> dict[str, str]:
    """Return how the legend names each signal, with its unit where the panel has several."""
    shortened = {name: short(own) for name, own in panel.own_names.items()}
    if len(set(shortened.values())) < len(shortened):  # the ends alone do not differ
        shortened = {name: fitted(own, room_px) for name, own in panel.own_names.items()}
    units = {curve.name: curve.unit for curve in panel.curves if not panel.unit}
    return {
        name: f"{text} [{units[name]}]" if units.get(name) else text
        for name, text in shortened.items()
    }


def _free_place(
    wanted: float, taken: Sequence[float], bounds: tuple[float, float], height: float
) -> float | None:
    """Return the nearest place within bounds that is a height away from those taken, if any."""
    low, high = bounds
    moved = (at + side * (height + 0.5) for at in taken for side in (-1, 1))
    places = [min(max(wanted, low), high), *moved]
    free = [
        place
        for place in places
        if low <= place <= high and all(abs(place - at) >= height for at in taken)
    ]
    return min(free, key=lambda place: abs(place - wanted), default=None)


def line_through(x: Any, y: Any) -> str:
    """Return the path through places in pixels."""
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))


def _shown(intervals: Sequence[Interval], frame: AxesBox) -> Sequence[Interval]:
    """Return the intervals to draw: at most about one for each pixel."""
    if len(intervals) <= 2 * frame.width:
        return intervals
    low, high = frame.x
    return at_resolution(intervals, (high - low) / frame.width)


def _has_room(frame: AxesBox, interval: Interval) -> bool:
    width = frame.width * (interval.end_s - interval.start_s) / (frame.x[1] - frame.x[0])
    return width > 10 + width_of(short(interval.value), _LAYOUT.small_text_px)


def _unnamed(lanes: Sequence[Lane], frame: AxesBox) -> list[str]:
    """Values in the rows below that fit into no interval."""
    intervals = [interval for lane in lanes for interval in lane.intervals]
    named = {interval.value for interval in intervals if _has_room(frame, interval)}
    return [v for v in dict.fromkeys(each.value for each in intervals) if v not in named]
