"""Text and boolean signals as the points at which they change, and the time in each value."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final, NamedTuple

from webots_mcp.naming import Value
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.intervals import NO_VALUE, OneValue, joined, spans_in_pieces
from webots_mcp.store.reading.kept import kept_parts
from webots_mcp.store.reading.ranges import Segment, just_after
from webots_mcp.store.reading.rollups import read_pieces, rows_after
from webots_mcp.store.reading.rows import Columns, exceeds, read_columns
from webots_mcp.store.rollup.tables import watermark
from webots_mcp.store.signals.registry import Signal

MOST_VALUES: Final = 20

# Of all changes of a signal only those of the segment are looked at, and the one in force before.
_CHANGES: Final = (
    "SELECT sim_time_s, value FROM change WHERE run_id = :run AND signal_id = :signal "
    "AND sim_time_s < :end AND state_id >= coalesce((SELECT max(state_id) FROM change "
    "WHERE run_id = :run AND signal_id = :signal AND state_id <= ("
    "SELECT id FROM state WHERE run_id = :run AND sim_time_s <= :start "
    "ORDER BY sim_time_s DESC, id DESC LIMIT 1)), 0) AND state_id < coalesce(("
    "SELECT id FROM state WHERE run_id = :run AND sim_time_s >= :end "
    "ORDER BY sim_time_s, id LIMIT 1), 1e18) ORDER BY state_id LIMIT :most"
)
_ROW_IN_FORCE: Final = "SELECT max(sim_time_s) FROM state WHERE run_id = ? AND sim_time_s <= ?"
# Of each table the first bucket: in `all_rollup` SQLite would sort all of them.
_FIRST_VALUE: Final = "SELECT min(first_sim_time_s) FROM ({})".format(
    " UNION ALL ".join(
        f"SELECT * FROM (SELECT first_sim_time_s FROM {table} WHERE run_id = :run "
        "AND signal_id = :signal AND first_sim_time_s IS NOT NULL ORDER BY bucket LIMIT 1)"
        for table in ("rollup", "recent_rollup")
    )
)


class Point(NamedTuple):
    """From `sim_time_s` on the signal had this value."""

    sim_time_s: float
    value: str | bool | None


def change_points(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    deadline: Deadline,
    *,
    since: bool = True,
) -> dict[str, list[Point]]:
    """The change points of signals in a segment, at any length of it.

    The first point is the value in force when the segment begins; its time may lie before. They
    come from the change table, and from the rows after the watermark until the deadline.

    Args:
        connection: Any.
        segment: Which stretch.
        signals: Text and flags; of numbers, each counts as its text, and of a long segment only the
            rows of buckets in which they changed are read.
        deadline: For all reading.
        since: Whether it matters when the value in force at the begin began. Without it no rows
            before the segment are read, and that point may lie at any time before.
    """
    from_s = -math.inf if since else _in_force_s(connection, segment)
    numbers = [each for each in signals if each.is_number]
    points = _of_numbers(connection, segment, numbers, deadline) if numbers else {}
    signals = [each for each in signals if not each.is_number]
    points |= {each.name: _stored(connection, segment, each, deadline, from_s) for each in signals}
    mark = watermark(connection, segment.run_id)
    late = rows_after(connection, Segment(segment.run_id, from_s, segment.end_s), mark)
    if late is not None and signals:
        columns = read_columns(connection, late, signals, deadline, after=mark)
        for signal in signals:
            new = zip(columns.times, columns.values[signal.name], strict=True)
            _append_changes(points[signal.name], new)
    if signals:
        _splice_kept(connection, segment, signals, deadline, points)
    return {name: _from(found, segment.start_s) for name, found in points.items()}


def _of_numbers(
    connection: sqlite3.Connection, segment: Segment, signals: Sequence[Signal], deadline: Deadline
) -> dict[str, list[Point]]:
    """Of numbers no change is stored; the one in force at the begin stands in the row before."""
    whole = replace(segment, start_s=_in_force_s(connection, segment))
    if exceeds(connection, whole):
        return _of_long(connection, whole, signals, deadline)
    columns = read_columns(connection, whole, signals, deadline)
    points: dict[str, list[Point]] = {each.name: [] for each in signals}
    for name, found in points.items():
        texts = OneValue().of_rows(columns.values[name])
        _append_changes(found, _points(zip(columns.times, texts, strict=True)))
    return points


def _of_long(
    connection: sqlite3.Connection, segment: Segment, signals: Sequence[Signal], deadline: Deadline
) -> dict[str, list[Point]]:
    """Of numbers in a segment that is too long to be read row by row."""
    pieces = read_pieces(connection, segment, signals, deadline)

    def read(part: Segment) -> Columns:
        return read_columns(connection, part, signals, deadline)

    found: dict[str, list[Point]] = {}
    for signal in signals:
        spans = joined(spans_in_pieces(segment, signal, pieces, OneValue(), read))
        values = ((span.start_s, span.key) for span in spans)
        _append_changes(found.setdefault(signal.name, []), _points(values))
    return found


def _points(texts: Iterable[tuple[float, Value]]) -> Iterable[tuple[float, Value]]:
    """What `OneValue` says of no value is none."""
    return ((time_s, None if text == NO_VALUE else text) for time_s, text in texts)


def value_ended_s(
    connection: sqlite3.Connection, segment: Segment, signal: Signal, deadline: Deadline
) -> float | None:
    """When the value in force at the begin of a segment ended in it; None where it did not."""
    stored: list[Point] = []
    if not signal.is_number:  # of numbers no change is stored
        found = _stored(connection, segment, signal, deadline, segment.start_s, most=2)
        stored = _from(found, segment.start_s)
    end_s = just_after(stored[1].sim_time_s) if len(stored) > 1 else segment.end_s
    first = Segment(segment.run_id, segment.start_s, end_s)
    points = change_points(connection, first, [signal], deadline, since=False)[signal.name]
    return points[1].sim_time_s if len(points) > 1 else None


def _in_force_s(connection: sqlite3.Connection, segment: Segment) -> float:
    """The time of the row whose values are in force when the segment begins."""
    asked = (segment.run_id, segment.start_s)
    (row_s,) = connection.execute(_ROW_IN_FORCE, asked).fetchone()
    return segment.start_s if row_s is None else row_s


def _splice_kept(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    deadline: Deadline,
    points: dict[str, list[Point]],
) -> None:
    """In kept stretches the points are those of each call: to the very step, and none missed."""
    for each in kept_parts(connection, segment.run_id, segment.start_s, segment.end_s):
        end_s = min(just_after(each.end_s), segment.end_s)
        stretch = Segment(segment.run_id, each.start_s, end_s, full_rate=True)
        columns = read_columns(connection, stretch, signals, deadline)
        if columns.cut:
            return
        for signal in signals:
            before = [point for point in points[signal.name] if point.sim_time_s < each.start_s]
            after = [point for point in points[signal.name] if point.sim_time_s >= end_s]
            _append_changes(before, zip(columns.times, columns.values[signal.name], strict=True))
            _append_changes(before, after)
            points[signal.name] = before


def _stored(
    connection: sqlite3.Connection,
    segment: Segment,
    signal: Signal,
    deadline: Deadline,
    from_s: float,
    most: int = -1,
) -> list[Point]:
    """The points from the change table; numbers, which are not in it, from rows since `from_s`."""
    if signal.id is None:
        return []
    asked = {"run": segment.run_id, "signal": signal.id, "most": most}
    asked |= {"start": segment.start_s, "end": segment.end_s}
    rows = connection.execute(_CHANGES, asked)
    if signal.kind == "bool":
        return [Point(time_s, None if value is None else value == "true") for time_s, value in rows]
    points = [Point(time_s, value) for time_s, value in rows]
    return [*_earlier(connection, segment, signal, points, deadline, from_s), *points]


def _earlier(
    connection: sqlite3.Connection,
    segment: Segment,
    signal: Signal,
    points: list[Point],
    deadline: Deadline,
    from_s: float,
) -> list[Point]:
    """The points from before the first stored one: then it was a number, which has none stored."""
    if points and points[0].sim_time_s <= segment.start_s:
        return []
    values = {"run": segment.run_id, "signal": signal.id}
    first = connection.execute(_FIRST_VALUE, values).fetchone()
    end_s = min(points[0].sim_time_s if points else math.inf, segment.end_s)
    if first is None or first[0] is None or first[0] >= end_s:
        return []
    found: list[Point] = []
    before = Segment(segment.run_id, max(first[0], from_s), end_s)
    rows = read_columns(connection, before, [signal], deadline)
    _append_changes(found, zip(rows.times, rows.values[signal.name], strict=True))
    return found


def _append_changes(points: list[Point], rows: Iterable[tuple[float, object]]) -> None:
    for time_s, value in rows:
        assert value is None or isinstance(value, (str, bool))
        if not points or points[-1].value != value:
            points.append(Point(time_s, value))


def _from(points: list[Point], start_s: float) -> list[Point]:
    """Without the points that were over when the segment began."""
    started = sum(point.sim_time_s <= start_s for point in points)
    return points[max(0, started - 1) :]


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
