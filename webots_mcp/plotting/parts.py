"""What a picture is about: the runs in its ranges, what was recorded in each, and its events."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple, TypeAlias

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.events import Events, Found, drawn_kinds, find_events
from webots_mcp.judging.detection.kinds import Event, EventOptions, Verdicts
from webots_mcp.judging.detection.search import find_motion
from webots_mcp.plotting.canvas import (
    TEXT_PX,
    Area,
    Canvas,
    Frame,
    scaled,
    short,
    ticks,
    width_of,
    wrapped,
)
from webots_mcp.plotting.intervals import Interval, Lane
from webots_mcp.store.parameters import differing, parameters_of
from webots_mcp.store.reading.catalogue import one_signal, signals_of
from webots_mcp.store.reading.ranges import TimeRange, recorded_bounds
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.store.series import MOST_POINTS, History, RunHistory, query_history
from webots_mcp.store.signals import RegisteredSignal

Known = dict[str, RegisteredSignal]

MOST_CHANGES: Final = 5000  # of one text or flag; more would be a grey haze
MOST_RUNS: Final = 10  # each with a colour and dashes of its own
_SHOWN_PARAMETERS: Final = 3
MOST_EVENTS: Final = 500
MOST_LANES: Final = 5  # in one picture
TITLE_PX: Final = 13.0
LINE_PX: Final = 16.0  # from line to line
_SWATCH_PX: Final = 26.0
_GAP_PX: Final = 14.0
_MOST_HEIGHT: Final = 0.25  # of the picture
_BAR_PX: Final = 12.0
_BAR_STEPS: Final = 64
SCALE_PX: Final = 78.0  # what a scale of colours takes
_STAR: Final = "M" + "L".join(
    f"{r * math.sin(i * math.pi / 5):.2f} {-r * math.cos(i * math.pi / 5):.2f}"
    for i, r in enumerate([1.2, 0.5] * 5)
) + "Z"  # fmt: skip
SHAPES: Final = {
    "circle": "M-1 0A1 1 0 1 1 1 0A1 1 0 1 1-1 0Z",
    "square": "M-.9-.9H.9V.9H-.9Z",
    "diamond": "M0-1.2L.7 0 0 1.2-.7 0Z",
    "cross": "M-1-.6L-.6-1 0-.4.6-1 1-.6.4 0 1 .6 .6 1 0 .4-.6 1-1 .6-.4 0Z",
    "plus": "M-.35-1H.35V-.35H1V.35H.35V1H-.35V.35H-1V-.35H-.35Z",
    "triangle": "M0-1.1L1 .8H-1Z",
    "star": _STAR,
    "arrow": "M1 0L-.9.9V-.9Z",
}


@dataclass(frozen=True)
class Part:
    """One run of a picture.

    Attributes:
        range: The run's part of what was asked for.
        name: "run 3", with its label where it has one, and the parameters in which the runs differ.
        start_s: The first moment that was recorded and asked for; `end_s` the last one.
        origin_s: The simulation time that is drawn as 0.
    """

    range: TimeRange
    name: str
    run: RunHistory
    start_s: float
    end_s: float
    origin_s: float

    @property
    def has_rows(self) -> bool:
        """Whether anything was recorded; where there was no time to read it, something may be."""
        is_empty = self.run.rows == 0 and self.run.cut_at_s is None
        return not is_empty and self.start_s <= self.end_s

    @property
    def unread(self) -> Interval | None:
        """The stretch of which not all was read; None where all was."""
        cut_s = self.run.cut_at_s
        if cut_s is None:
            return None
        return Interval("", min(max(cut_s, self.start_s), self.end_s), self.end_s)

    @property
    def robot(self) -> str:
        """Whose run it is."""
        return self.range.robot

    @property
    def notes(self) -> tuple[str, ...]:
        """Where the range reaches outside the recording, and what of it could not be read."""
        unread = (f"run {self.run.run_id}: {each}" for each in self.run.unread)
        return (*self.range.notes, *unread)


def parts_of(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    names: Sequence[str],
    points: int = MOST_POINTS,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> list[Part]:
    """Read the signals of each run in the ranges; several runs begin at 0 each.

    Args:
        connection: Any.
        ranges: Those of the picture.
        names: Signals, with `*`.
        points: The most buckets of a run; the buckets of all runs have one length.
        deadline_s: After it nothing more is read of a range, and the part says from where on.

    Raises:
        UnknownSignalError: A name meets nothing.
        InvalidInputError: No name is given, or there are more than ten runs.
        NothingRecordedError: There is no row in the ranges.
    """
    count = sum(len(each.segments) for each in ranges)
    if count > MOST_RUNS:
        raise InvalidInputError(
            f"the range holds {count} runs, and at most {MOST_RUNS} can be laid over each other: "
            "name them by their ids"
        )
    parts: list[Part] = []
    histories = _histories(connection, ranges, names, points, deadline_s)
    for each, history in zip(ranges, histories, strict=True):
        for segment, run in zip(each.segments, history.runs, strict=True):
            alone = replace(each, segments=(segment,))
            parts.append(_part(connection, alone, run, count > 1))
    if not any(part.has_rows for part in parts):
        notes = [note for history in histories for note in history.notes]
        raise NothingRecordedError("; ".join(["there are no values in the range", *notes]))
    return _named_by_parameters(connection, [part for part in parts if part.has_rows])


def _named_by_parameters(connection: sqlite3.Connection, parts: list[Part]) -> list[Part]:
    """Runs that differ in parameters are told apart by them: run 3 (kp 2)."""
    had = parameters_of(connection, [part.run.run_id for part in parts])
    unlike = differing(list(had.values()))[:_SHOWN_PARAMETERS]
    named: list[Part] = []
    for part in parts:
        own = had[part.run.run_id]
        values = [f"{name} {short(str(own[name].described))}" for name in unlike if name in own]
        name = f"{part.name} ({', '.join(values)})" if values else part.name
        named.append(replace(part, name=name))
    return named


def _histories(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    names: Sequence[str],
    points: int,
    deadline_s: float,
) -> list[History]:
    """The same data must look the same: the longest run decides how long a bucket is."""
    least_step_s = 0.0
    while True:
        histories = [
            query_history(
                connection, each, names, max_points=points, max_changes=MOST_CHANGES,
                least_step_s=least_step_s, deadline_s=deadline_s,
            )
            for each in ranges
        ]  # fmt: skip
        runs = [run for history in histories for run in history.runs if run.sim_time_s]
        steps_s = {run.step_s or 0.0 for run in runs}
        if len(steps_s) <= 1 or max(steps_s) == least_step_s:
            return histories
        least_step_s = max(steps_s)


def _part(
    connection: sqlite3.Connection, time_range: TimeRange, run: RunHistory, overlaid: bool
) -> Part:
    first_s, newest_s = recorded_bounds(connection, run.run_id) or (run.start_s, run.end_s)
    label = fetch_run(connection, run.run_id).label
    name = f"run {run.run_id}" + (f" “{short(label)}”" if label else "")
    start_s, end_s = max(run.start_s, first_s), min(run.end_s, newest_s)
    origin_s = first_s if overlaid else 0.0
    return Part(time_range, name, run, start_s, end_s, origin_s)


def title_of(parts: Sequence[Part]) -> str:
    """Robots, runs and the stretch of time."""
    robots = " and ".join(dict.fromkeys(part.robot for part in parts))
    if len(parts) > 1:
        return f"{robots}: {', '.join(part.name for part in parts)}"
    (part,) = parts
    return f"{robots}, {part.name}, {_seconds(part.start_s)} to {_seconds(part.end_s)} s"


def _seconds(time_s: float) -> str:
    return f"{time_s:.2f}".rstrip("0").rstrip(".")


def range_notes(parts: Sequence[Part]) -> list[str]:
    """Where a range reaches outside the recording, and what of it is not drawn."""
    notes = [note for part in parts for note in part.notes]
    notes += [f"{unread}: it took too long" for unread in unread_parts(parts)]
    return notes + [
        f"of {columns.total} changes of {columns.name} in {part.name} only the newest "
        f"{len(columns.points)} are shown"
        for part in parts
        for columns in part.run.changes
        if columns.total > len(columns.points)
    ]


def unread_parts(parts: Sequence[Part]) -> list[str]:
    """From where on not all of each run was read, of those of which not all was."""
    return [
        f"not all of {part.name} was read from {_seconds(unread.start_s)} s on"
        for part in parts
        if (unread := part.unread) is not None
    ]


def known_signals(connection: sqlite3.Connection, ranges: Sequence[TimeRange]) -> Known:
    """All signals of the robot of the last range, by name.

    Raises:
        NothingRecordedError: No range is given.
        UnknownSignalError: No signal has been recorded.
    """
    if not ranges:
        raise NothingRecordedError("no run is given: there is nothing to draw")
    return {signal.name: signal for signal in signals_of(connection, ranges[-1], ["*"])}


def mode_signal(known: Known, wanted: str | None) -> str | None:
    """The text signal that colours a picture: the one wanted, else one that is named like a mode.

    Raises:
        UnknownSignalError: No signal has the wanted name.
        InvalidInputError: The wanted signal holds numbers.
    """
    if wanted == "":
        return None
    if wanted is None:
        mode = find_motion(known, EventOptions()).mode
        return mode.name if mode else None
    signal = one_signal(known, wanted)
    if signal.is_number and not signal.is_choice:
        raise InvalidInputError(f"{wanted!r} holds numbers: a text or a flag colours a picture")
    return signal.name


def event_lanes(
    connection: sqlite3.Connection,
    part: Part,
    names: Sequence[str],
    rows: int = MOST_LANES,
    known: Mapping[int, Found] | None = None,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> tuple[list[Lane], list[str]]:
    """One lane per kind of event, and notes: of the drawn signals, and of the robot as a whole.

    Args:
        connection: Any.
        part: The run.
        names: The drawn signals.
        rows: How many lanes have room.
        known: By run, what was searched before in all of it, and told by whoever did.
        deadline_s: For the search; a note says which kinds were not looked for.
    """
    most = min(rows, MOST_LANES)
    drawn = tuple(kind.name for kind in drawn_kinds())
    options = EventOptions(kinds=drawn, signals=tuple(names))
    found = _found(connection, part, options, known or {}, deadline_s)
    kinds = [kind for kind in drawn if any(event.kind == kind for event in found.events)]
    lanes = [_lane(kind, found, part) for kind in kinds[:most]]
    notes = list[str]()
    if not known:
        notes = [note for note in found.notes if note not in part.notes]
        notes += _not_looked_for(found.verdicts)
    if found.left_out:
        kind, rest = max(found.left_out.items(), key=lambda item: item[1].count)
        notes.append(
            f"{rest.count} events of kind {kind} up to {rest.last.start_s:.3f} s are not drawn"
        )
    if left_out := kinds[most:]:
        notes.append(f"events left out: {', '.join(left_out)}")
    return lanes, notes


def _not_looked_for(verdicts: Verdicts) -> list[str]:
    """Where a picture shows no number, there is none to be judged: that is no news."""
    of_numbers = [kind.name for kind in drawn_kinds() if kind.of_numbers]
    told = {
        kind: reasons
        for kind, reasons in verdicts.reasons.items()
        if kind not in of_numbers or verdicts.unlooked(kind) is None
    }
    gaps = replace(verdicts, reasons=told).gaps
    return [f"not looked for: {kinds}: {why}" for kinds, why in gaps.items()]


def _lane(kind: str, found: Events, part: Part) -> Lane:
    events = sorted((e for e in found.events if e.kind == kind), key=lambda event: event.start_s)
    intervals = [_interval(event, part).moved(part.origin_s) for event in events]
    return Lane(kind, intervals, ())


def _interval(event: Event, part: Part) -> Interval:
    """Named by what it is about: the signal, the action, the level, or what the bridge noticed."""
    what = event.details.get("what") if event.kind == "bridge_event" else event.name
    return _within(Interval(str(what or ""), event.start_s, event.end_s), part)


def _within(interval: Interval, part: Part) -> Interval:
    """What of an event is in the picture: it may have begun before, and gone on."""
    start_s = max(interval.start_s, min(part.start_s, interval.end_s))
    return Interval(interval.value, start_s, min(interval.end_s, max(part.end_s, start_s)))


def _found(
    connection: sqlite3.Connection,
    part: Part,
    options: EventOptions,
    known: Mapping[int, Found],
    deadline_s: float = QUESTION_DEADLINE_S,
) -> Events:
    """What is drawn of a run: searched for, or out of what was searched before."""
    if (before := known.get(part.run.run_id)) is None:
        return find_events(
            connection, part.range, options, limit=MOST_EVENTS, around=(), group=False,
            deadline_s=deadline_s,
        )  # fmt: skip
    of_numbers = {kind.name for kind in drawn_kinds() if kind.of_numbers}
    undrawn = known_signals(connection, [part.range]).keys() - set(options.signals)
    drawn = [
        event
        for event in before.events
        if event.kind in options.kinds
        if event.kind not in of_numbers or event.name not in undrawn
    ]
    return replace(before.only(drawn), context=()).told(connection, MOST_EVENTS)


def stuck_mark(
    connection: sqlite3.Connection,
    part: Part,
    position: tuple[str, str],
    deadline_s: float,
    known: Mapping[int, Found] | None = None,
) -> tuple[Lane, list[str]]:
    """When the robot was stuck, and where that was not looked for."""
    options = EventOptions(kinds=("stuck",), signals=position, position=position)
    found = _found(connection, part, options, known or {}, deadline_s)
    intervals = [_within(Interval("stuck", e.start_s, e.end_s), part) for e in found.events]
    lane = Lane(f"stuck over {options.stuck_s:g} s", intervals, ())
    return lane, [] if known else _not_looked_for(found.verdicts)


# What surrounds axes: titles, ticks, marks, and a legend in as many rows as it needs.


Sample: TypeAlias = "Callable[[Canvas, float, float], None]"


class Entry(NamedTuple):
    """A line of a legend.

    Attributes:
        draw: Draws its sample around a place; None without one.
        hides: The name of the elements that a click on it hides in a page.
    """

    text: str
    draw: Sample | None = None
    hides: str = ""

    @property
    def width_px(self) -> float:
        """With its sample."""
        return width_of(self.text) + (_SWATCH_PX if self.draw else 0.0) + _GAP_PX


def line_sample(colour: str, dash: str = "none", width: float = 1.6) -> Sample:
    """Draws a stretch of a line."""

    def draw(canvas: Canvas, x: float, y: float) -> None:
        canvas.add("path", d=f"M{x - 10:g} {y:g}h20", stroke=colour, stroke_width=width,
                   stroke_dasharray=dash)  # fmt: skip

    return draw


def area_sample(area: Area, opacity: float = 1.0) -> Sample:
    """Draws an area."""

    def draw(canvas: Canvas, x: float, y: float) -> None:
        paint_area(canvas, area, (x - 10, y - 5, 20.0, 10.0), opacity)

    return draw


def paint_area(
    canvas: Canvas, area: Area, box: tuple[float, float, float, float], opacity: float = 1.0
) -> None:
    """A rectangle (left, top, width, height) in the style of an area."""
    left, top, width, height = box
    place = {"x": left, "y": top, "width": width, "height": height}
    opaque = {} if opacity == 1.0 else {"fill_opacity": opacity}
    canvas.add("rect", **place, fill=area.colour, **opaque)
    if area.dotted:
        canvas.add("rect", **place, fill="url(#hatch-dots)", fill_opacity=opacity / 2)


def hatch_sample(pattern: str) -> Sample:
    """Draws a hatched area."""

    def draw(canvas: Canvas, x: float, y: float) -> None:
        canvas.add("rect", x=x - 10, y=y - 5, width=20, height=10, fill=f"url(#{pattern})")

    return draw


def rows_of(entries: Sequence[Entry], width_px: float, height_px: float) -> list[list[Entry]]:
    """The entries in rows of that width, up to a quarter of the height; the rest are counted."""
    most = max(1, int(_MOST_HEIGHT * height_px / LINE_PX))
    rows: list[list[Entry]] = []
    for index, entry in enumerate(entries):
        if rows and sum(each.width_px for each in rows[-1]) + entry.width_px <= width_px:
            rows[-1].append(entry)
        elif len(rows) < most:
            rows.append([entry])
        else:
            rows[-1][-1] = Entry(f"and {len(entries) - index + 1} more")
            break
    return rows


def paint_rows(
    canvas: Canvas, rows: Sequence[Sequence[Entry]], top: float, left: float | None = None
) -> None:
    """Rows of a legend from a height downwards: centred, or from the left."""
    for row, entries in enumerate(rows):
        width = sum(each.width_px for each in entries) - _GAP_PX
        x = max(4.0, (canvas.width_px - width) / 2) if left is None else left
        y = top + (row + 0.5) * LINE_PX
        for entry in entries:
            hides = {"data_hides": entry.hides} if entry.hides else {}
            canvas.open(class_="entry", **hides)
            if entry.draw:
                entry.draw(canvas, x + 10, y)
            canvas.text(x + (_SWATCH_PX if entry.draw else 0.0), y + 4, entry.text)
            canvas.close()
            x += entry.width_px


def paint_title(canvas: Canvas, title: str) -> float:
    """At the top left, in as many lines as it needs; returns how high it is."""
    lines = wrapped(title, canvas.width_px - 16, TITLE_PX * 1.1)
    for row, line in enumerate(lines):
        canvas.text(8, TITLE_PX + 4 + row * LINE_PX, line, size=TITLE_PX, font_weight="bold")
    return 10 + LINE_PX * len(lines)


def paint_x_axis(
    canvas: Canvas, frame: Frame, marks: Sequence[tuple[float, str]], label: Sequence[str] = ()
) -> None:
    """A line below the frame, with ticks, their labels, and what the axis is."""
    canvas.open(class_="x-axis")
    pen = {"stroke": canvas.look.faint, "stroke_width": 0.8}
    canvas.add("path", d=f"M{frame.left:.1f} {frame.bottom:.1f}H{frame.right:.1f}", **pen)
    canvas.open(class_="ticks")
    for value, text in marks:
        x = float(frame.px(value))
        canvas.add("path", d=f"M{x:.1f} {frame.bottom:.1f}v4", **pen)
        half = width_of(text) / 2
        inside = min(max(x, half), canvas.width_px - half)
        canvas.text(inside, frame.bottom + 16, text, anchor="middle")
    canvas.close()
    for row, line in enumerate(label):
        y = frame.bottom + 33 + row * LINE_PX
        canvas.text(frame.left + frame.width / 2, y, line, anchor="middle")
    canvas.close()


def paint_y_axis(canvas: Canvas, frame: Frame, marks: Sequence[tuple[float, str]]) -> None:
    """A line at the left of the frame, with ticks, their labels, and lines through the frame."""
    canvas.open(class_="y-axis")
    faint = {"stroke": canvas.look.faint, "stroke_width": 0.8}
    canvas.add("path", d=f"M{frame.left:.1f} {frame.top:.1f}V{frame.bottom:.1f}", **faint)
    canvas.open(class_="ticks")
    for value, text in marks:
        y = float(frame.py(value))
        canvas.add("path", d=f"M{frame.left:.1f} {y:.1f}h-4", **faint)
        canvas.text(frame.left - 7, y + 4, text, anchor="end")
    canvas.close()
    canvas.close()


def paint_grid(
    canvas: Canvas, frame: Frame, x: Sequence[tuple[float, str]], y: Sequence[tuple[float, str]]
) -> None:
    """Light lines at the ticks."""
    lines = [f"M{frame.px(value):.1f} {frame.top:.1f}V{frame.bottom:.1f}" for value, _ in x]
    lines += [f"M{frame.left:.1f} {frame.py(value):.1f}H{frame.right:.1f}" for value, _ in y]
    canvas.add("path", class_="grid", d="".join(lines), stroke=canvas.look.grid, stroke_width=0.7)


def paint_y_label(canvas: Canvas, frame: Frame, label: str) -> None:
    """What the vertical axis is, along it."""
    x, y = TEXT_PX + 2, frame.top + frame.height / 2
    canvas.text(0, 0, label, anchor="middle", transform=f"translate({x:g} {y:.1f}) rotate(-90)")


def paint_scale(
    canvas: Canvas, frame: Frame, scale: str, bounds: tuple[float, float], label: str
) -> None:
    """A scale of colours at the right of the frame, and what it means."""
    left, height = frame.right + 12, frame.height / _BAR_STEPS
    for step in range(_BAR_STEPS):
        colour = scaled(step / (_BAR_STEPS - 1), scale)
        y = frame.bottom - (step + 1) * height
        canvas.add("rect", x=left, y=y, width=_BAR_PX, height=height + 0.5, fill=colour)
    bar = Frame(left, frame.top, _BAR_PX, frame.height, (0, 1), bounds)
    for value, text in ticks(*bounds, frame.height / 40):
        canvas.text(left + _BAR_PX + 4, float(bar.py(value)) + 4, text)
    x, y = canvas.width_px - 6, frame.top + frame.height / 2
    canvas.text(0, 0, label, anchor="middle", transform=f"translate({x:g} {y:.1f}) rotate(-90)")


# Marks --------------------------------------------------------------------------------------------


def paint_mark(
    canvas: Canvas, shape: str, place: tuple[float, float], size: float, *, degrees: float = 0.0,
    **style: Any,
) -> None:  # fmt: skip
    """A mark at a place in pixels, so large from its middle; in a page it keeps its size."""
    x, y = place
    canvas.open(class_="at", data_x=x, data_y=y, transform=f"translate({x:.2f} {y:.2f})")
    turned = f" rotate({degrees:.1f})" if degrees else ""
    scaled_by = {"transform": f"scale({size:g}){turned}"}
    width = style.pop("stroke_width", 0.0) / size
    canvas.add("path", d=SHAPES[shape], stroke_width=f"{width:.3f}", **scaled_by, **style)
    canvas.close()


def mark_sample(shape: str, size: float, **style: Any) -> Sample:
    """Draws a mark."""

    def draw(canvas: Canvas, x: float, y: float) -> None:
        paint_mark(canvas, shape, (x, y), size, **style)

    return draw
