"""Where robots went as a picture: of one run, or of several laid over each other."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

from webots_mcp.analysis.arrays import np
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Found
from webots_mcp.judging.detection.search import find_motion, motion_in
from webots_mcp.plotting.axes import AxesBox, axis_range, rounded_on, ticks
from webots_mcp.plotting.canvas import Canvas, PlotImage, Sheet, fitted, short, width_of
from webots_mcp.plotting.colours import INK, LINES, ON_PAPER, Theme, area_styles, scaled
from webots_mcp.plotting.intervals import Lane, lane_of, merged_notes
from webots_mcp.plotting.line_styles import line_style
from webots_mcp.plotting.painting import (
    LINE_PX,
    SCALE_PX,
    LegendEntry,
    line_sample,
    mark_sample,
    paint_grid,
    paint_mark,
    paint_rows,
    paint_scale,
    paint_title,
    paint_x_axis,
    paint_y_axis,
    paint_y_label,
    rows_of,
)
from webots_mcp.plotting.plotted_runs import (
    Known,
    PlottedRun,
    known_signals,
    mode_signal,
    plotted_runs,
    range_notes,
    stuck_mark,
    title_of,
)
from webots_mcp.plotting.robot_path import (
    PathPoint,
    RobotPath,
    extent,
    headings,
    read_path,
    thinned,
)
from webots_mcp.plotting.signal_plot import line_through
from webots_mcp.signals.naming import listed, nearest_first, spelled_out
from webots_mcp.store.reading.catalogue import one_signal
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.registered_signals import RegisteredSignal

_SHAPES: Final = ("circle", "cross", "plus", "triangle", "star")  # the first is around the others


@dataclass(frozen=True)
class TrajectoryLayout:
    """The layout of a path in the plane.

    Attributes:
        signals_share: Share of the reading time for signals; the rest is for the path and
            standstills.
        tick_px: Minimum distance between ticks.
        spot_share: Share of the size of the path within which a mode counts as held on the spot.
        min_size: Minimum side of the picture, in the unit of the position.
        margin: Margin on each side, as a share of the size.
        time_colours: Colours of a path that is coloured by time.
        many_marks: Marks of a kind beyond which they are drawn smaller.
        arrows: Arrows that show the direction.
    """

    signals_share: float = 0.5
    tick_px: float = 50.0
    spot_share: float = 0.03
    min_size: float = 0.02
    margin: float = 0.06
    time_colours: int = 64
    many_marks: int = 10
    arrows: int = 9


_LAYOUT: Final = TrajectoryLayout()


def plot_trajectory(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    position: tuple[str, str] | None = None,
    *,
    bands: str | None = None,
    sheet: Sheet | None = None,
) -> PlotImage:
    """Draw the path of the robot, with start, end, direction, and where it had trouble.

    Args:
        connection: Any.
        ranges: From `find_range`; each run in them counts, ten at most.
        position: The signals to the right and upwards; None finds them by their names.
        bands: The text signal that colours the way; None for the mode, where there is one; ""
            for the time. Of several runs each has its own colour.
        sheet: Size and format; None for a PNG of 900 x 500 pixels.

    Raises:
        UnknownSignalError: A name meets nothing; the text offers near ones.
        InvalidInputError: A signal of the position is no number, or there are too many runs.
        NothingRecordedError: No position was recorded in the range.
    """
    sheet = sheet or Sheet()
    plot, notes = compose_trajectory(connection, ranges, position, bands=bands)
    canvas, _ = paint_trajectory(plot, sheet.width_px, sheet.height_px)
    return canvas.picture(sheet.image_format, _caption(plot), notes)


def compose_trajectory(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    position: tuple[str, str] | None = None,
    *,
    bands: str | None = None,
    events: bool = True,
    found: Mapping[int, Found] | None = None,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> tuple[TrajectoryAxes, tuple[str, ...]]:
    """Return what `plot_trajectory` paints, and its notes; arguments and errors as there.

    `found` is as in `compose_signals`. `deadline_s` is for all that is read; where a way was cut by
    it, it has no end.
    """
    deadline = Deadline(deadline_s)
    known = known_signals(connection, ranges)
    x, y = position_of(connection, known, ranges[-1], position, deadline)
    heading = find_motion(known, EventOptions(position=(x.name, y.name))).heading
    mode = mode_signal(known, bands)
    flags = _flags(known) if events else []
    names = [x.name, y.name, *([mode] if mode else []), *flags]
    parts = plotted_runs(
        connection, ranges, names, deadline_s=_LAYOUT.signals_share * deadline.left_s
    )
    tracks: list[PlottedPath] = []
    unsearched: list[str] = []
    for part in parts:
        modes = _lane(part, mode) if len(parts) == 1 else None
        marks = [_flagged(part, flag) for flag in flags]
        path = read_path(connection, part, x, y, deadline.left_s, heading)
        if events:
            stuck, notes = stuck_mark(connection, part, (x.name, y.name), deadline.left_s, found)
            marks.insert(0, stuck)
            unsearched += notes
        tracks.append(PlottedPath(part.name, path, modes, marks))
    if not any(track.path.places for track in tracks):
        if not all(track.path.is_whole for track in tracks):
            raise NothingRecordedError(
                f"No position could be read in time in {title_of(parts)}. Ask for a shorter range."
            )
        none = f"{x.name} and {y.name} have no values in {title_of(parts)}"
        raise NothingRecordedError(
            "; ".join([none, *(note for part in parts for note in part.notes)])
        )
    metres = None if position else "m"
    labels = (_label(x, metres), _label(y, metres))
    axes = TrajectoryAxes(title_of(parts), *labels, tracks, mode)
    return axes, tuple(dict.fromkeys((*_notes(parts, tracks), *unsearched)))


def position_of(
    connection: sqlite3.Connection,
    known: Known,
    newest: TimeRange,
    named: tuple[str, str] | None = None,
    deadline: Deadline | None = None,
) -> tuple[RegisteredSignal, RegisteredSignal]:
    """Return the position that is drawn: the one named, else the one of the newest run.

    Raises:
        UnknownSignalError: No signal has such a name.
        InvalidInputError: A name holds no numbers; none is named, and there is no position.
    """
    if named is not None:
        return _number(known, named[0]), _number(known, named[1])
    frame = read_frame(connection, newest.segments[-1], deadline or Deadline())
    position = motion_in(frame, known, EventOptions()).position
    if position is None:
        numbers = [name for name, signal in known.items() if signal.is_number]
        raise InvalidInputError(
            f"No position was found among the {len(known)} signals. Name x and y in signals; "
            f"signals of numbers: {listed(numbers) or 'none'}"
        )
    return position


def _number(known: Known, name: str) -> RegisteredSignal:
    signal = one_signal(known, name)
    if not signal.is_number:
        numbers = nearest_first(name, [each for each in known if known[each].is_number])
        raise InvalidInputError(
            f"{name!r} holds no numbers, so it cannot be a position. "
            f"Signals of numbers: {listed(numbers) or 'none'}"
        )
    return signal


def _flags(known: Known) -> list[str]:
    flags = [name for name in known if known[name].kind == "bool"]
    words = ("bumper", "collision", "collided", "contact", "touching", "stuck")
    return [name for name in flags if any(word in name.lower() for word in words)]


def _caption(plot: TrajectoryAxes) -> str:
    drawn = [track for track in plot.tracks if track.path.places]
    sentences = [plot.title, f"Path from above: {plot.y_label} over {plot.x_label}"]
    for track in drawn:
        whose = f" of {track.name}" if len(plot.tracks) > 1 else ""
        start, end = (_place_text(track.path.places[at], plot) for at in (0, -1))
        end = f", end {end}" if track.path.is_whole else ""
        sentences.append(f"Start{whose} {start}{end}")
    if len(plot.tracks) == 1:
        sentences.append(f"Colour: {plot.mode if drawn[0].modes else 'simulation time'}")
    marks = [
        f"{mark.counted}{f' of {track.name}' if len(plot.tracks) > 1 else ''}"
        for track in drawn
        for mark in track.marks
        if mark.intervals
    ]
    sentences += [f"Marks: {', '.join(marks)}"] if marks else []
    return ". ".join([*sentences, *_cut(plot.tracks)])


def _place_text(place: PathPoint, plot: TrajectoryAxes) -> str:
    """Return a place as exactly as it can be read from the picture."""
    texts = list[str]()
    for at in (1, 2):
        values = [each[at] for each in plot.places]
        texts.append(rounded_on(place[at], axis_range(min(values), max(values))))
    return f"({', '.join(texts)})"


def _lane(part: PlottedRun, name: str | None) -> Lane | None:
    found = (columns for columns in part.run.changes if columns.name == name)
    lanes = (lane_of(columns, part.run, part.end_s) for columns in found)
    return next(lanes, None)


def _flagged(part: PlottedRun, flag: str) -> Lane:
    lane = _lane(part, flag)
    intervals = lane.intervals if lane else ()
    return Lane(flag, [each for each in intervals if each.value == "true"], ())


def _label(signal: RegisteredSignal, usual_unit: str | None) -> str:
    """Webots measures in metres: a position whose name has no unit is taken to be one in metres."""
    unit = signal.unit or usual_unit
    return f"{signal.name} [{unit}]" if unit else signal.name


def _notes(parts: Sequence[PlottedRun], tracks: Sequence[PlottedPath]) -> tuple[str, ...]:
    notes = range_notes(parts)
    notes += merged_notes([track.modes for track in tracks if track.modes])
    notes += [
        f"{track.name}: one position every {track.path.step_s:g} s (too many rows to draw each)"
        for track in tracks
        if track.path.step_s is not None
    ]
    return (*notes, *_cut(tracks))


def _cut(tracks: Sequence[PlottedPath]) -> list[str]:
    """Up to when a way was read that goes on."""
    return [
        f"The path of {track.name} was not read after {track.path.places[-1].time_s:g} s"
        for track in tracks
        if track.path.places and not track.path.is_whole
    ]


@dataclass(frozen=True)
class PlottedPath:
    """The way of one run.

    Attributes:
        modes: What colours it; None for the time, or for the run where there are several.
        marks: Events, one lane per kind, which may be empty; at most five.
        body: Outlines of the parts of the robot from above, in metres, in its own frame (x ahead,
            y to the left); empty where its size is not known.
    """

    name: str
    path: RobotPath
    modes: Lane | None
    marks: Sequence[Lane]
    body: Sequence[Outline] = ()


Outline: TypeAlias = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Obstacle:
    """Something that stands in a world.

    Attributes:
        outline: Its corners, seen from above, in metres; empty where its size is not known.
    """

    name: str
    x: float
    y: float
    outline: Outline = ()


@dataclass(frozen=True)
class TrajectoryAxes:
    """What is to be painted.

    Attributes:
        room_m: Room around the paths, for a robot that is drawn on them.
    """

    title: str
    x_label: str
    y_label: str
    tracks: Sequence[PlottedPath]
    mode: str | None
    room_m: float = 0.0

    @property
    def places(self) -> Sequence[PathPoint]:
        """Of all tracks."""
        return [place for track in self.tracks for place in track.path.places]


def paint_trajectory(
    plot: TrajectoryAxes, width_px: int, height_px: int, theme: Theme = ON_PAPER, *,
    obstacles: Sequence[Obstacle] = (), titled: bool = True,
) -> tuple[Canvas, AxesBox]:  # fmt: skip
    """Paint it, at the same scale on both axes."""
    return _TrajectoryPainter(plot, Canvas(width_px, height_px, theme), obstacles).paint(
        titled=titled
    )


class _TrajectoryPainter:
    def __init__(self, plot: TrajectoryAxes, canvas: Canvas, obstacles: Sequence[Obstacle]) -> None:
        self._plot, self._canvas, self._standing = plot, canvas, obstacles
        self._alone = len(plot.tracks) == 1
        modes = plot.tracks[0].modes if self._alone else None
        self._modes = modes if plot.mode is not None else None
        self._styles = area_styles(modes.values) if modes else {}

    def paint(self, *, titled: bool) -> tuple[Canvas, AxesBox]:
        plot, canvas = self._plot, self._canvas
        top = paint_title(canvas, plot.title) if titled else 6.0
        legend = rows_of(self._entries(), canvas.width_px - 20, canvas.height_px)
        by_time = self._alone and self._modes is None and bool(plot.tracks[0].path.steps())
        frame = self._frame(top, 44 + LINE_PX * len(legend), SCALE_PX if by_time else 16.0)
        marks = _marks_of(frame)
        paint_grid(canvas, frame, *marks)
        box = {"x": frame.left, "y": frame.top, "width": frame.width, "height": frame.height}
        view = f"{frame.left:.2f} {frame.top:.2f} {frame.width:.2f} {frame.height:.2f}"
        canvas.open("svg", **box, viewBox=view)
        canvas.open(class_="zoom")
        self._obstacles(frame)
        drawn = [(i, each) for i, each in enumerate(plot.tracks) if each.path.places]
        for index, track in drawn:
            self._way(frame, track, index)
            self._body(frame, track, index)
        canvas.close()
        canvas.close("svg")
        canvas.open(class_="marks")
        for index, track in drawn:
            self._marks(frame, track, index)
        canvas.close()
        paint_x_axis(canvas, frame, marks[0], [fitted(plot.x_label, frame.width)])
        paint_y_axis(canvas, frame, marks[1])
        paint_y_label(canvas, frame, fitted(plot.y_label, frame.height))
        if by_time:
            path = plot.tracks[0].path
            bounds = (path.places[0].time_s, path.places[-1].time_s)
            label = fitted("simulation time [s]", frame.height)
            paint_scale(canvas, frame, "time", bounds, label)
        paint_rows(canvas, legend, canvas.height_px - LINE_PX * len(legend) - 2)
        return canvas, frame

    def _frame(self, top: float, below: float, right: float) -> AxesBox:
        """Return the same scale on both axes; a robot that stands still is not blown up."""
        canvas, places = self._canvas, self._plot.places
        low, high = ([pick(p[i] for p in places) for i in (1, 2)] for pick in (min, max))
        sides = [max(b - a, _LAYOUT.min_size) * (1 + 2 * _LAYOUT.margin) + 2 * self._plot.room_m
                 for a, b in zip(low, high, strict=True)]  # fmt: skip
        middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
        labels = [text for _, text in ticks(*axis_range(low[1], high[1]), 8)]
        left = 30 + max(24.0, *map(width_of, labels))
        width = canvas.width_px - left - right
        height = max(20.0, canvas.height_px - top - below)
        per_px = max(sides[0] / width, sides[1] / height)
        x, y = ((m - n * per_px / 2, m + n * per_px / 2)
                for m, n in zip(middle, (width, height), strict=True))  # fmt: skip
        return AxesBox(left, top, width, height, x, y)

    def _ink(self, index: int) -> str:
        """Of several ways each has a colour of its own."""
        theme = self._canvas.theme
        return theme.ink if self._alone else line_style(index, theme).colour

    def _obstacles(self, frame: AxesBox) -> None:
        """Outlines where sizes are known, squares elsewhere; a page shows their names."""
        for each in self._standing:
            x, y = float(frame.px(each.x)), float(frame.py(each.y))
            d = f"M{x - 4:.1f} {y - 4:.1f}h8v8h-8Z"
            if each.outline:
                corners = np.array(each.outline)
                d = line_through(frame.px(corners[:, 0]), frame.py(corners[:, 1])) + "Z"
            named = {"stroke": self._canvas.theme.faint, "data_name": spelled_out(each.name)}
            style = {"fill": "#B8B8B8", "fill_opacity": 0.55, "stroke_width": 0.8}
            self._canvas.add("path", d=d, **named, **style)

    def _way(self, frame: AxesBox, track: PlottedPath, index: int) -> None:
        canvas, path = self._canvas, track.path
        canvas.open(data_part=f"track {index}")
        for at in path.breaks:  # where nothing was recorded, or it leapt: what follows what
            leap = [path.places[at - 1], path.places[at]]
            self._line(frame, [leap], canvas.theme.faint, 0.8, stroke_dasharray="1 2")
        if not self._alone:
            pen = {"stroke_dasharray": line_style(index, canvas.theme).dash}
            self._line(frame, path.pieces(), self._ink(index), 1.8, **pen)
        elif self._modes is not None:
            self._by_mode(frame, path, self._modes)
        else:
            self._by_time(frame, path)
        canvas.close()

    def _body(self, frame: AxesBox, track: PlottedPath, index: int) -> None:
        """Draw the robot at its true size where the path ends."""
        last = track.path.places[-1]
        if not track.path.is_whole or not math.isfinite(last.heading_rad):
            return
        self._canvas.open(data_part=f"track {index}", class_="body")
        for outline in track.body:
            corners = np.array(standing_at(last, outline))
            d = line_through(frame.px(corners[:, 0]), frame.py(corners[:, 1])) + "Z"
            self._canvas.add("path", d=d, fill=self._ink(index), fill_opacity=0.25,
                             stroke=self._ink(index), stroke_width=1.2)  # fmt: skip
        self._canvas.close()

    def _by_mode(self, frame: AxesBox, path: RobotPath, modes: Lane) -> None:
        stretches: dict[str, list[Sequence[PathPoint]]] = {value: [] for value in modes.values}
        spot = _LAYOUT.spot_share * extent(path.places)
        spots: list[tuple[PathPoint, str]] = []
        for piece in path.pieces():
            part = RobotPath(piece, None, frozenset())
            begin_s, end_s = piece[0].time_s, piece[-1].time_s
            for interval in modes.intervals:
                if interval.end_s < begin_s or end_s < interval.start_s:
                    continue
                held = part.between(interval.start_s, interval.end_s)
                stretches[interval.value].append(held)
                if len(held) > 1 and extent(held) < spot:
                    spots.append((held[-1], self._styles[interval.value].colour))
        # An edge, so that light colours are seen.
        self._line(frame, path.pieces(), self._canvas.theme.ink, 4.6)
        for value, held in stretches.items():
            self._line(frame, held, self._styles[value].colour, 3.2)
            if self._styles[value].dotted:
                self._line(frame, held, INK, 1.4, stroke_dasharray="1.4 2.8", stroke_linecap="butt")
        for place, colour in spots:  # what happened on the spot, where a line has no length
            self._line(frame, [[place, place]], self._canvas.theme.ink, 7.0)
            self._line(frame, [[place, place]], colour, 5.4)

    def _by_time(self, frame: AxesBox, path: RobotPath) -> None:
        start_s, end_s = path.places[0].time_s, path.places[-1].time_s
        length_s = (end_s - start_s) or 1.0
        stretches: list[list[Sequence[PathPoint]]] = [[] for _ in range(_LAYOUT.time_colours)]
        for before, after in path.steps():
            share = (before.time_s - start_s) / length_s
            stretches[min(_LAYOUT.time_colours - 1, int(share * _LAYOUT.time_colours))].append(
                (before, after)
            )
        for number, steps in enumerate(stretches):
            self._line(frame, steps, scaled(number / (_LAYOUT.time_colours - 1), "time"), 2.4)

    def _line(
        self, frame: AxesBox, stretches: Any, colour: str, width: float, **style: Any
    ) -> None:
        """One line, broken between the segments."""
        drawn = [np.array(thinned(each))[:, 1:3] for each in stretches if len(each) > 1]
        if drawn:
            d = "".join(line_through(frame.px(each[:, 0]), frame.py(each[:, 1])) for each in drawn)
            style = {"stroke_linecap": "round", "stroke_linejoin": "round"} | style
            self._canvas.add("path", d=d, fill="none", stroke=colour, stroke_width=width, **style)

    def _marks(self, frame: AxesBox, track: PlottedPath, index: int) -> None:
        canvas, path, ink = self._canvas, track.path, self._ink(index)
        canvas.open(data_part=f"track {index}")
        edge = {"stroke": canvas.theme.ground, "stroke_width": 0.6}
        for each in headings(path, _LAYOUT.arrows):
            at = (float(frame.px(each.x)), float(frame.py(each.y)))
            paint_mark(canvas, "arrow", at, 6.0, degrees=-each.degrees, fill=ink, **edge)
        first, last = path.places[0], path.places[-1]
        at = (float(frame.px(first.x)), float(frame.py(first.y)))
        paint_mark(
            canvas, "circle", at, 5.0, fill=canvas.theme.ground, stroke=ink, stroke_width=2.0
        )
        if path.is_whole:
            at = (float(frame.px(last.x)), float(frame.py(last.y)))
            paint_mark(canvas, "square", at, 6.5, fill=ink)
            if math.isfinite(last.heading_rad):
                degrees = -math.degrees(last.heading_rad)
                paint_mark(canvas, "nose", at, 6.5, degrees=degrees, fill=ink, **edge)
        for mark, shape in zip(track.marks, _SHAPES, strict=False):
            size = 0.6 if len(mark.intervals) > _LAYOUT.many_marks else 1.0
            for interval in mark.intervals:
                place = path.at(interval.start_s)
                at = (float(frame.px(place.x)), float(frame.py(place.y)))
                paint_mark(canvas, shape, at, size * _size(shape), **self._style(shape, index))
        canvas.close()

    def _style(self, shape: str, index: int) -> dict[str, Any]:
        colour = LINES[1] if self._alone else self._ink(index)
        if shape == "circle":
            return {"fill": "none", "stroke": colour, "stroke_width": 2.6}
        return {"fill": colour, "stroke": self._canvas.theme.ground, "stroke_width": 0.8}

    def _entries(self) -> list[LegendEntry]:
        plot, ink, ground = self._plot, self._canvas.theme.ink, self._canvas.theme.ground
        start = mark_sample("circle", 5.0, fill=ground, stroke=ink, stroke_width=2.0)
        path = plot.tracks[0].path
        at = [f" {_place_text(path.places[i], plot)}" if self._alone else "" for i in (0, -1)]
        entries = [LegendEntry(f"start{at[0]}", start)]
        if any(each.path.is_whole for each in plot.tracks if each.path.places):
            entries.append(LegendEntry(f"end{at[1]}", mark_sample("square", 6.5, fill=ink)))
        if self._modes is not None:
            entries.append(LegendEntry(f"{short(self._modes.name)}:"))
            for value in self._modes.values:
                style = self._styles[value]
                entries.append(LegendEntry(short(value), _mode_sample(style.colour, style.dotted)))
        for index, track in enumerate(plot.tracks):
            if not track.path.places:
                continue
            if not self._alone:
                sample = line_sample(*line_style(index, self._canvas.theme), 2.0)
                room = self._canvas.width_px - 80
                entries.append(LegendEntry(fitted(track.name, room), sample, f"track {index}"))
            whose = "" if self._alone else f", {track.name}"
            for mark, shape in zip(track.marks, _SHAPES, strict=False):
                if mark.intervals:
                    size = min(9.0, _size(shape))
                    sample = mark_sample(shape, size, **self._style(shape, index))
                    text = f"{short(mark.name)} ({len(mark.intervals)}){whose}"
                    entries.append(LegendEntry(fitted(text, self._canvas.width_px - 80), sample))
        return entries


def standing_at(place: PathPoint, outline: Outline) -> list[tuple[float, float]]:
    """Return an outline of a robot in the world, for a robot that stands at a place."""
    cos, sin = math.cos(place.heading_rad), math.sin(place.heading_rad)
    return [(place.x + cos * u - sin * v, place.y + sin * u + cos * v) for u, v in outline]


def _size(shape: str) -> float:
    return 11.0 if shape == "circle" else 6.0


def _mode_sample(colour: str, dotted: bool) -> Any:
    def draw(canvas: Canvas, x: float, y: float) -> None:
        line_sample(colour, width=4.5)(canvas, x, y)
        if dotted:
            line_sample(INK, "1.4 2.8", 1.4)(canvas, x, y)

    return draw


def _marks_of(frame: AxesBox) -> tuple[list[tuple[float, str]], list[tuple[float, str]]]:
    """Ticks of both axes, at the same distances."""
    widest = max(width_of(text) for _, text in ticks(*frame.x, frame.width / _LAYOUT.tick_px))
    room = max(_LAYOUT.tick_px, 1.4 * widest)
    return ticks(*frame.x, frame.width / room), ticks(*frame.y, frame.height / room)
