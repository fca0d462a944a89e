"""Text and boolean signals as the points at which they change, and the time in each value."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.kept import kept_parts
from webots_mcp.store.reading.ranges import Segment, just_after
from webots_mcp.store.reading.rollups import rows_after
from webots_mcp.store.reading.rows import read_columns
from webots_mcp.store.rollup.rolling import watermark
from webots_mcp.store.signals.registry import Signal

MOST_VALUES: Final = 20

_CHANGES: Final = (
    "SELECT sim_time_s, value FROM change WHERE run_id = ? AND signal_id = ? AND sim_time_s < ? "
    "ORDER BY state_id"
)
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
) -> dict[str, list[Point]]:
    """The change points of text and boolean signals in a segment, at any length of it.

    The first point is the value in force when the segment begins; its time may lie before. They
    come from the change table, and from the rows after the watermark until the deadline.
    """
    points = {signal.name: _stored(connection, segment, signal, deadline) for signal in signals}
    mark = watermark(connection, segment.run_id)
    before_end = Segment(segment.run_id, float("-inf"), segment.end_s)
    late = rows_after(connection, before_end, mark)
    if late is not None and signals:
        columns = read_columns(connection, late, signals, deadline, after_id=mark)
        for signal in signals:
            new = zip(columns.times, columns.values[signal.name], strict=True)
            _append_changes(points[signal.name], new)
    if signals:
        _splice_kept(connection, segment, signals, deadline, points)
    return {name: _from(found, segment.start_s) for name, found in points.items()}


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
    connection: sqlite3.Connection, segment: Segment, signal: Signal, deadline: Deadline
) -> list[Point]:
    if signal.id is None:
        return []
    rows = connection.execute(_CHANGES, (segment.run_id, signal.id, segment.end_s))
    if signal.kind == "bool":
        return [Point(time_s, None if value is None else value == "true") for time_s, value in rows]
    points = [Point(time_s, value) for time_s, value in rows]
    return [*_earlier(connection, segment, signal, points, deadline), *points]


def _earlier(
    connection: sqlite3.Connection,
    segment: Segment,
    signal: Signal,
    points: list[Point],
    deadline: Deadline,
) -> list[Point]:
    """The points from before the first stored one: then it was a number, which has none stored."""
    values = {"run": segment.run_id, "signal": signal.id}
    first = connection.execute(_FIRST_VALUE, values).fetchone()
    end_s = min(points[0].sim_time_s if points else math.inf, segment.end_s)
    if first is None or first[0] is None or first[0] >= end_s:
        return []
    found: list[Point] = []
    rows = read_columns(connection, Segment(segment.run_id, first[0], end_s), [signal], deadline)
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
