"""Where robots went as a picture: of one run, or of several laid over each other."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import Final

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.naming import listed
from webots_mcp.plotting.canvas import Picture, Sheet
from webots_mcp.plotting.intervals import Lane, lane_of, merged_notes
from webots_mcp.plotting.parts import (
    Known,
    Part,
    known_signals,
    mode_signal,
    parts_of,
    range_notes,
    stuck_mark,
    title_of,
)
from webots_mcp.plotting.path import read_path
from webots_mcp.plotting.trajectory_axes import Track, TrajectoryAxes, paint_trajectory
from webots_mcp.store.detection.kinds import EventOptions
from webots_mcp.store.detection.motion import motion_in
from webots_mcp.store.reading.catalogue import one_signal
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.signals import Signal

_FLAGS: Final = ("bumper", "collision", "collided", "contact", "touching", "stuck")


def plot_trajectory(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    position: tuple[str, str] | None = None,
    *,
    bands: str | None = None,
    events: bool = True,
    sheet: Sheet | None = None,
) -> Picture:
    """The way of the robot in the plane, with start, end, direction, and where it got into trouble.

    Args:
        connection: Any.
        ranges: From `find_range`; each run in them counts, ten at most.
        position: The signals to the right and upwards; None finds them by their names.
        bands: The text signal that colours the way; None for the mode, where there is one; ""
            for the time. Of several runs each has its own colour.
        events: Whether to mark where it was stuck and where a bumper or the like was true.
        sheet: Size and format; None for a PNG of 900 x 500 pixels.

    Raises:
        UnknownSignalError: A name meets nothing; the text offers near ones.
        InvalidInputError: A signal of the position is no number, or there are too many runs.
        NothingRecordedError: No position was recorded in the range.
    """
    sheet = sheet or Sheet()
    plot, notes = compose_trajectory(connection, ranges, position, bands=bands, events=events)
    canvas, _ = paint_trajectory(plot, sheet.width_px, sheet.height_px)
    caption = "; ".join([f"{plot.title}: {plot.y_label} over {plot.x_label}", *_cut(plot.tracks)])
    return canvas.picture(sheet.image_format, caption, notes)


def compose_trajectory(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    position: tuple[str, str] | None = None,
    *,
    bands: str | None = None,
    events: bool = True,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> tuple[TrajectoryAxes, tuple[str, ...]]:
    """What `plot_trajectory` paints, and its notes; arguments and errors as there.

    `deadline_s` is for each thing that is read; where a way was cut by it, it has no end.
    """
    known = known_signals(connection, ranges)
    x, y = position_of(connection, known, ranges[-1], position)
    mode = mode_signal(known, bands)
    flags = _flags(known) if events else []
    names = [x.name, y.name, *([mode] if mode else []), *flags]
    parts = parts_of(connection, ranges, names, deadline_s=deadline_s)
    tracks: list[Track] = []
    unlooked: list[str] = []
    for part in parts:
        modes = _lane(part, mode) if len(parts) == 1 else None
        marks = [_flagged(part, flag) for flag in flags]
        if events:
            stuck, notes = stuck_mark(connection, part, (x.name, y.name), deadline_s)
            marks.insert(0, stuck)
            unlooked += notes
        path = read_path(connection, part, x, y, deadline_s)
        tracks.append(Track(part.name, path, modes, marks))
    if not any(track.path.places for track in tracks):
        if not all(track.path.is_whole for track in tracks):
            raise NothingRecordedError(
                f"no position was read in time in {title_of(parts)}: ask for less time"
            )
        none = f"{x.name} and {y.name} have no values in {title_of(parts)}"
        raise NothingRecordedError(
            "; ".join([none, *(note for part in parts for note in part.notes)])
        )
    metres = None if position else "m"
    labels = (_label(x, metres), _label(y, metres))
    axes = TrajectoryAxes(title_of(parts), *labels, tracks, mode)
    return axes, tuple(dict.fromkeys((*_notes(parts, tracks), *unlooked)))


def position_of(
    connection: sqlite3.Connection,
    known: Known,
    newest: TimeRange,
    named: tuple[str, str] | None = None,
) -> tuple[Signal, Signal]:
    """The position that is drawn: the one named, else the one of the newest run.

    Raises:
        UnknownSignalError: No signal has such a name.
        InvalidInputError: A name holds no numbers; none is named, and there is no position.
    """
    if named is not None:
        return _number(known, named[0]), _number(known, named[1])
    frame = read_frame(connection, newest.segments[-1], Deadline())
    position = motion_in(frame, known, EventOptions()).position
    if position is None:
        numbers = [name for name, signal in known.items() if signal.is_number]
        raise InvalidInputError(
            f"no position was found among the {len(known)} signals: name its two, x and y; "
            f"numbers are {listed(numbers) or 'none of them'}"
        )
    return position


def _number(known: Known, name: str) -> Signal:
    signal = one_signal(known, name)
    if not signal.is_number:
        raise InvalidInputError(f"{name!r} holds no numbers: it cannot be a position")
    return signal


def _flags(known: Known) -> list[str]:
    flags = [name for name in known if known[name].kind == "bool"]
    return [name for name in flags if any(flag in name.lower() for flag in _FLAGS)]


def _lane(part: Part, name: str | None) -> Lane | None:
    found = (columns for columns in part.run.changes if columns.name == name)
    lanes = (lane_of(columns, part.run, part.end_s) for columns in found)
    return next(lanes, None)


def _flagged(part: Part, flag: str) -> Lane:
    lane = _lane(part, flag)
    intervals = lane.intervals if lane else ()
    return Lane(flag, [each for each in intervals if each.value == "true"], ())


def _label(signal: Signal, usual_unit: str | None) -> str:
    """Webots measures in metres: a position whose name has no unit is taken to be one in metres."""
    unit = signal.unit or usual_unit
    return f"{signal.name} [{unit}]" if unit else signal.name


def _notes(parts: Sequence[Part], tracks: Sequence[Track]) -> tuple[str, ...]:
    notes = range_notes(parts)
    notes += merged_notes([track.modes for track in tracks if track.modes])
    notes += [
        f"{track.name}: one position every {track.path.step_s:g} s (too many rows to draw each)"
        for track in tracks
        if track.path.step_s is not None
    ]
    return (*notes, *_cut(tracks))


def _cut(tracks: Sequence[Track]) -> list[str]:
    """Up to when a way was read that goes on."""
    return [
        f"the path of {track.name} is not read after {track.path.places[-1].time_s:g} s"
        for track in tracks
        if track.path.places and not track.path.is_whole
    ]
