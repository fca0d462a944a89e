"""Signals over time as a picture: of one run, or of several laid over each other."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import replace

from webots_mcp.errors import NothingRecordedError
from webots_mcp.naming import listed
from webots_mcp.plotting.canvas import LEAST_HEIGHT_PX, Picture, Room, Sheet
from webots_mcp.plotting.curves import Curve, by_choice, by_scale, by_signal, curve_of
from webots_mcp.plotting.intervals import Interval, Lane, lane_of, merged_notes
from webots_mcp.plotting.parts import (
    Part,
    event_lanes,
    known_signals,
    mode_signal,
    parts_of,
    range_notes,
    title_of,
    unread_parts,
)
from webots_mcp.plotting.signal_axes import SignalAxes, paint_signals
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S


def plot_signals(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    names: Sequence[str],
    *,
    bands: str | None = None,
    events: bool = True,
    sheet: Sheet | None = None,
) -> Picture:
    """Numbers as a mean line in a min-max band, a mode behind them, flags and events below.

    Signals whose units or scales do not fit one axis get panels of their own, at most three.
    Where several runs are given they are laid over each other, each beginning at 0.

    Args:
        connection: Any.
        ranges: From `find_range`; each run in them counts, ten at most.
        names: Signals, with `*`.
        bands: The text signal behind the curves; None for the mode, where there is one; "" for
            none. Of several runs it is drawn below, once per run.
        events: Whether to mark what `find_events` finds; of several runs nothing is marked.
        sheet: Size and format; None for a PNG of 900 x 500 pixels.

    Raises:
        UnknownSignalError: A name meets nothing; the text offers near ones.
        InvalidInputError: `bands` is no text signal, or there are too many runs.
        NothingRecordedError: None of the signals has a value in the range.
    """
    sheet = sheet or Sheet()
    plot, notes = compose_signals(
        connection, ranges, names, bands=bands, events=events, room=sheet.room
    )
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
    room: Room | None = None,
    grouped: Sequence[Sequence[str]] | None = None,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> tuple[SignalAxes, tuple[str, ...]]:
    """What `plot_signals` paints, and its notes; arguments and errors as there.

    `room` is how much it may be; None for that of a PNG of 900 x 500 pixels. `grouped` are the
    signals of each panel; None puts those of one unit and scale together. `deadline_s` is for
    what is read of a range; what is not read in it is hatched, and a note says so.
    """
    room = room or Sheet().room
    mode = mode_signal(known_signals(connection, ranges), bands)
    parts = parts_of(
        connection, ranges, [*names, *([mode] if mode else [])], room.points, deadline_s
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
        marked, event_notes = event_lanes(connection, parts[0], drawn, room.rows - len(below))
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


def _curves(part: Part) -> list[Curve]:
    made = (curve_of(columns, part.run, part.origin_s) for columns in part.run.numbers)
    return [curve for curve in made if curve is not None]


def _behind_and_below(parts: Sequence[Part], mode: str | None) -> tuple[Lane | None, list[Lane]]:
    """The mode of a single run stands behind the curves, all else in rows below."""
    overlaid = len(parts) > 1
    lanes = [lane for part in parts for lane in _lanes(part, overlaid)]
    behind = next((lane for lane in lanes if lane.name == mode and not overlaid), None)
    return behind, [lane for lane in lanes if lane is not behind]


def _lanes(part: Part, overlaid: bool) -> list[Lane]:
    lanes = [lane_of(columns, part.run, part.end_s) for columns in part.run.changes]
    of_run = f", {part.name}" if overlaid else ""
    return [lane.moved(part.origin_s, lane.name + of_run) for lane in lanes if lane.intervals]


def _gaps(part: Part) -> list[Interval]:
    return [Interval("", gap.start_s, gap.end_s).moved(part.origin_s) for gap in part.run.gaps]


def _unread(part: Part) -> list[Interval]:
    return [] if part.unread is None else [part.unread.moved(part.origin_s)]


def _height_of_rows(rows: int, sheet: Sheet) -> int:
    """Rows of intervals alone need no more."""
    return min(sheet.height_px, max(LEAST_HEIGHT_PX, 130 + 50 * rows))


def _x_range(parts: Sequence[Part]) -> tuple[float, float]:
    start_s = min(part.start_s - part.origin_s for part in parts)
    end_s = max(part.end_s - part.origin_s for part in parts)
    return (start_s, end_s) if end_s > start_s else (start_s - 0.5, start_s + 0.5)


def _x_label(parts: Sequence[Part]) -> str:
    clock = "simulation time [s]" if len(parts) == 1 else "time since the start of the run [s]"
    steps = {part.run.step_s for part in parts if part.run.numbers}
    if len(steps) != 1 or None in steps:
        return clock
    return f"{clock}; line: mean, band: minimum to maximum of every {steps.pop():g} s"


def _caption(plot: SignalAxes) -> str:
    shown = [name for panel in plot.panels for name in panel.names]
    below = [lane.name for lane in plot.lanes]
    behind = f" over {plot.bands.name}" if plot.bands else ""
    unread = f", from {plot.unread[0].start_s:g} s on not all was read" if plot.unread else ""
    return f"{plot.title}: {', '.join([*shown, *below])}{behind}{unread}"


def _notes(parts: Sequence[Part], curves: Sequence[Curve]) -> list[str]:
    notes = range_notes(parts)
    drawn = {(curve.run_id, curve.name) for curve in curves}
    for part in parts:
        left = [c for c in part.run.numbers if (part.run.run_id, c.name) not in drawn]
        if too_large := [columns.name for columns in left if columns.too_large]:
            notes.append(f"beyond 1e100 in {part.name}: {listed(too_large)}")
        without_value = [
            each.name
            for each in left
            if not each.whole.present and not each.too_large and each.whole.rows
        ]
        if without_value and part.unread is None:
            notes.append(f"without a value in {part.name}: {listed(without_value)}")
        notes += [
            f"{columns.name} in {part.name} was {_counted(columns.replaced)}: not drawn"
            for columns in part.run.numbers
            if columns.replaced
        ]
    return list(dict.fromkeys(notes))


def _counted(replaced: dict[str, int]) -> str:
    return ", ".join(f"{value} {count} times" for value, count in replaced.items())


def _left_out(names: Sequence[str], room: Room) -> str:
    why = f"most that a picture of this size holds: panels {room.panels}, rows {room.lanes}"
    return f"left out: {listed(dict.fromkeys(names))} ({why}); ask for them alone"


def _nothing(parts: Sequence[Part]) -> str:
    notes = "; ".join(note for part in parts for note in part.notes)
    if unread := unread_parts(parts):
        return f"nothing to draw was read in time ({'; '.join(unread)}): ask for less time"
    return f"nothing to draw: none of the signals has a value in {title_of(parts)}" + (
        f" ({notes})" if notes else ""
    )
