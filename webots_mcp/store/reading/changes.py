"""Texts, flags and modes as the points at which they change, and the time in each value."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple

from webots_mcp.naming import Value
from webots_mcp.store.analysis.arrays import Indexes, np
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.frame import Frame, Unread, read_frame
from webots_mcp.store.reading.kept import kept_parts
from webots_mcp.store.reading.ranges import Segment, just_after
from webots_mcp.store.signals.flatten import shown
from webots_mcp.store.signals.registry import Signal

MOST_VALUES: Final = 20
_FIRST_ROWS_BACK: Final = 1024  # that are looked at before a row, then each time more before those
_MORE_BACK: Final = 4


class Point(NamedTuple):
    """From `sim_time_s` on the signal had this value."""

    sim_time_s: float
    value: str | bool | None


@dataclass(frozen=True)
class Changes:
    """The change points of signals in a segment.

    Attributes:
        points: By signal, in order; the first is the value in force when the segment begins, its
            time may lie before. Of a signal whose value then is not known there are only later
            ones, or none.
        since_before: Those whose first value was in force before the time of its point:
            since when was not found.
        unread_from_s: The deadline passed: no point lies behind this, and the last of each signal
            need not be its last. None where all was read.
        unread: Parts of the segment that could not be read, and why; no point lies in them.
    """

    segment: Segment
    points: Mapping[str, list[Point]]
    since_before: frozenset[str] = frozenset()
    unread_from_s: float | None = None
    unread: tuple[Unread, ...] = ()

    def read_to_s(self, end_s: float) -> float:
        """How far before `end_s` the values are known."""
        return end_s if self.unread_from_s is None else min(end_s, self.unread_from_s)

    def cut(self, unread_from_s: float | None) -> Changes:
        """Those of them that were read up to there, for an answer that ends there."""
        if unread_from_s is None or self.read_to_s(unread_from_s) < unread_from_s:
            return self
        points = {name: _until(each, unread_from_s) for name, each in self.points.items()}
        return replace(self, points=points, unread_from_s=unread_from_s)

    def longest_values(self, name: str, end_s: float) -> dict[str, float]:
        """Seconds in each value up to `end_s`, of what was read; see `longest_values`."""
        return longest_values(self.points[name], self.segment.start_s, self.read_to_s(end_s))


def change_points(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    deadline: Deadline,
    *,
    frame: Frame | None = None,
    since: bool = True,
) -> Changes:
    """The change points of signals in a segment, at any length of it.

    Args:
        connection: Any.
        segment: Which stretch.
        signals: Texts, flags and numbers; of a number each value counts as its text.
        deadline: For all reading; that since when is found out last.
        frame: The rows of the segment, where they were read already.
        since: Whether it matters when the value in force at the begin began; without it the time of
            that point may be any before.
    """
    frame = frame or read_frame(connection, segment, deadline)
    before: Frame | None = None  # it is read only where it is looked at
    points: dict[str, list[Point]] = {}
    since_before = set[str]()
    for signal in signals:
        found = _points_in(frame, signal)
        first = found[0] if found and found[0].sim_time_s <= segment.start_s else None
        known = first is not None
        if since or not known:
            if before is None:
                whole = Segment(segment.run_id, -math.inf, segment.start_s)
                before = read_frame(connection, whole, deadline)
            late = since and deadline.passed and len(before) > 0
            first = None if late else _in_force(before, signal, first, since=since)
            if first is not None and since and _is_hidden(before, signal, first.sim_time_s):
                since_before.add(signal.name)
        if first is None:
            since_before.update([signal.name] * (known and since))
        else:
            found[: int(found[:1] == [] or known or found[0].value == first.value)] = [first]
        points[signal.name] = found
    if not segment.full_rate:
        _splice_kept(connection, segment, signals, deadline, points)
    if frame.cut_at_s is None:
        return Changes(segment, points, frozenset(since_before), unread=frame.unread)
    unread_s = max(segment.start_s, frame.cut_at_s)
    found = {name: _until(each, unread_s) for name, each in points.items()}
    return Changes(segment, found, frozenset(since_before), unread_s, frame.unread)


def _in_force(
    before: Frame, signal: Signal, at_begin: Point | None, *, since: bool
) -> Point | None:
    """The point of the value in force when a segment begins; None where it is not found.

    Args:
        before: The rows before the segment.
        signal: Of which.
        at_begin: What the row at the begin says; None without such a row.
        since: Whether to look for the time at which that value began.
    """
    rows = len(before)
    if before.cut_at_s is not None or not rows:
        return at_begin if before.cut_at_s is None else None
    if at_begin is None:
        at_begin = next(iter(_points_in(before.rows(rows - 1, rows), signal)), None)
    if at_begin is None:
        return None
    row = _first_alike(before, signal, at_begin.value) if since else rows
    return at_begin if row == rows else Point(float(before.times[row]), at_begin.value)


def _is_hidden(before: Frame, signal: Signal, time_s: float) -> bool:
    """Whether the row before a time is one whose value could not be read."""
    row = int(before.places([time_s])[0])
    return row > 0 and not before.rows(row - 1, row).was_read(signal.name).all()


def _first_alike(frame: Frame, signal: Signal, value: str | bool | None) -> int:
    """The first of the last rows that all have this value; the number of rows if none has it."""
    stop, rows = len(frame), _FIRST_ROWS_BACK
    while stop > 0:
        start = max(0, stop - rows)
        values, codes = _valued(frame.rows(start, stop), signal)
        unlike = np.flatnonzero(codes != (values.index(value) if value in values else -1))
        if len(unlike):
            return start + int(unlike[-1]) + 1
        stop, rows = start, rows * _MORE_BACK
    return 0


def _points_in(frame: Frame, signal: Signal) -> list[Point]:
    """The first value of a frame, and each that is unlike the one before."""
    values, codes = _valued(frame, signal)
    read = frame.was_read(signal.name)
    times, codes = frame.times[read], codes[read]
    rows = np.flatnonzero(np.diff(codes, prepend=-1))
    at = zip(times[rows].tolist(), codes[rows].tolist(), strict=True)
    return [Point(time_s, values[code]) for time_s, code in at]


def _valued(frame: Frame, signal: Signal) -> tuple[list[str | bool | None], Indexes]:
    """The values of a signal as its kind has them, and of each row which one it has."""
    codes, labels = frame.coded(signal.name)
    of_label = [_value(signal, label) for label in labels]
    values = list(dict.fromkeys(of_label))
    places = {value: place for place, value in enumerate(values)}
    return values, np.array([places[value] for value in of_label], np.intp)[codes]


def _value(signal: Signal, label: Value) -> str | bool | None:
    if signal.kind == "bool":
        return None if label is None else label in (1, True)
    if signal.is_number and isinstance(label, str):
        return None
    return shown(label)


def _splice_kept(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    deadline: Deadline,
    points: dict[str, list[Point]],
) -> None:
    """In kept stretches the points are those of each call: to the very step, none missed."""
    for each in kept_parts(connection, segment.run_id, segment.start_s, segment.end_s):
        start_s = max(each.start_s, segment.start_s)
        end_s = min(just_after(each.end_s), segment.end_s)
        stretch = Segment(segment.run_id, start_s, end_s, full_rate=True)
        frame = read_frame(connection, stretch, deadline)
        if frame.cut_at_s is not None:
            return
        for signal in signals:
            outside = points[signal.name]
            before = [point for point in outside if point.sim_time_s < start_s]
            after = [point for point in outside if point.sim_time_s >= end_s]
            whole = [*before, *_points_in(frame, signal), *after]
            alike = [False, *(was.value == now.value for was, now in pairwise(whole))]
            points[signal.name] = [
                point for point, same in zip(whole, alike, strict=True) if not same
            ]


def _until(points: list[Point], end_s: float) -> list[Point]:
    """Those that lie not behind a time."""
    return [point for point in points if point.sim_time_s <= end_s]


def time_by_value(points: Sequence[Point], start_s: float, end_s: float) -> dict[str, float]:
    """Simulated seconds in each value within [start_s, end_s), the longest first.

    Between two rows the value of the earlier one is in force; null counts as "null".
    """
    seconds: dict[str, float] = {}
    for point, after in pairwise([*points, Point(end_s, None)]):
        begin_s, stop_s = max(point.sim_time_s, start_s), min(after.sim_time_s, end_s)
        if stop_s > begin_s:
            key = spelled(point.value)
            seconds[key] = seconds.get(key, 0.0) + stop_s - begin_s
    return dict(sorted(seconds.items(), key=lambda item: -item[1]))


def longest_values(points: Sequence[Point], start_s: float, end_s: float) -> dict[str, float]:
    """The same for at most 20 values: a text that is no mode has too many."""
    return dict(list(time_by_value(points, start_s, end_s).items())[:MOST_VALUES])


def spelled(value: str | bool | None) -> str:
    """A value as a name: true, false, null, or the text."""
    return value if isinstance(value, str) else {True: "true", False: "false", None: "null"}[value]
