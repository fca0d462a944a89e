"""Text and boolean signals as the points at which they change, and the time in each value."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile
from typing import Final, NamedTuple

from webots_mcp.naming import Value
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.intervals import NO_VALUE, OneValue, joined, spans_in_pieces
from webots_mcp.store.reading.kept import kept_parts
from webots_mcp.store.reading.ranges import Segment, just_after, recorded_bounds
from webots_mcp.store.reading.rollups import read_pieces, rows_after
from webots_mcp.store.reading.rows import Columns, exceeds, read_columns
from webots_mcp.store.reading.sampling import newest_part
from webots_mcp.store.rollup.tables import watermark
from webots_mcp.store.signals.registry import Signal

MOST_VALUES: Final = 20
_FIRST_ROWS_BACK: Final = 500  # that are read before a row, then each time more of the rows before
_MORE_BACK: Final = 4

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
    """

    segment: Segment
    points: Mapping[str, list[Point]]
    since_before: frozenset[str] = frozenset()
    unread_from_s: float | None = None

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
    since: bool = True,
) -> Changes:
    """The change points of signals in a segment, at any length of it.

    They come from the change table, and from the rows after the watermark until the deadline: at
    first those of the segment, then, backwards from it, those before.

    Args:
        connection: Any.
        segment: Which stretch.
        signals: Text and flags; of numbers, each counts as its text, and of a long segment only the
            rows of buckets in which they changed are read.
        deadline: For all reading.
        since: Whether it matters when the value in force at the begin began. Without it no rows
            before the segment are read, and that point may lie at any time before.
    """
    look = _Look(connection, segment, deadline, _in_force_s(connection, segment))
    numbers = [each for each in signals if each.is_number]
    states = [each for each in signals if not each.is_number]
    points = look.of_numbers(numbers) if numbers else {}
    points |= look.of_states(states, since=since) if states else {}
    found = {name: _from(each, segment.start_s) for name, each in points.items()}
    if look.cuts_s:
        unread_s = max(segment.start_s, min(look.cuts_s))
        found = {name: _until(each, unread_s) for name, each in found.items()}
        return Changes(segment, found, frozenset(look.since_before), unread_s)
    return Changes(segment, found, frozenset(look.since_before))


class _Look:
    """What was read for one question about changes.

    Attributes:
        cuts_s: Where the deadline stopped each reading that it stopped.
        since_before: As of `Changes`.
    """

    def __init__(
        self,
        connection: sqlite3.Connection,
        segment: Segment,
        deadline: Deadline,
        in_force_s: float,
    ) -> None:
        self._connection = connection
        self._segment = segment
        self._deadline = deadline
        self._in_force_s = in_force_s  # the time of the row in force when the segment begins
        self.cuts_s: list[float] = []
        self.since_before: set[str] = set()

    def of_numbers(self, signals: Sequence[Signal]) -> dict[str, list[Point]]:
        """Of numbers no change is stored; the one in force at the begin stands in the row before.

        When it began is not looked for.
        """
        whole = replace(self._segment, start_s=self._in_force_s)
        bounds = recorded_bounds(self._connection, whole.run_id)
        if bounds is not None and bounds[0] < whole.start_s:
            self.since_before.update(each.name for each in signals)
        if exceeds(self._connection, whole):
            return self._of_long(whole, signals)
        columns = self._read(whole, signals)
        points: dict[str, list[Point]] = {each.name: [] for each in signals}
        for name, found in points.items():
            texts = OneValue().of_rows(columns.values[name])
            _append_changes(found, _points(zip(columns.times, texts, strict=True)))
        return points

    def _of_long(self, segment: Segment, signals: Sequence[Signal]) -> dict[str, list[Point]]:
        """Of numbers in a segment that is too long to be read row by row."""
        pieces = read_pieces(self._connection, segment, signals, self._deadline)
        self.cuts_s += [] if pieces.cut_at_s is None else [pieces.cut_at_s]

        def read(part: Segment) -> Columns:
            return self._read(part, signals)

        found: dict[str, list[Point]] = {}
        for signal in signals:
            spans = joined(spans_in_pieces(segment, signal, pieces, OneValue(), read))
            values = ((span.start_s, span.key) for span in spans)
            _append_changes(found.setdefault(signal.name, []), _points(values))
        return found

    def of_states(self, signals: Sequence[Signal], *, since: bool) -> dict[str, list[Point]]:
        """Of text and flags those that are stored, and those in the rows after the watermark."""
        points = {each.name: self._stored(each, since=since) for each in signals}
        run_id, end_s = self._segment.run_id, self._segment.end_s
        mark = watermark(self._connection, run_id)
        late = rows_after(self._connection, Segment(run_id, -math.inf, end_s), mark)
        if late is not None:
            rows = replace(late, start_s=max(late.start_s, self._in_force_s))
            columns = self._read(rows, signals, after=mark)
            if late.start_s < self._in_force_s:  # what is stored was over, or may have been
                before = replace(late, end_s=self._in_force_s)
                heads = {each: columns.values[each.name][:1] for each in signals}
                found = self._in_force(before, heads, points, mark) if since else {}
                points = {each.name: found.get(each.name, []) for each in signals}
            for signal in signals:
                new = zip(columns.times, columns.values[signal.name], strict=True)
                _append_changes(points[signal.name], new)
        self._splice_kept(signals, points)
        return points

    def _in_force(
        self,
        before: Segment,
        heads: Mapping[Signal, Sequence[Value]],
        stored: Mapping[str, list[Point]],
        mark: int = 0,
    ) -> dict[str, list[Point]]:
        """The point of the value in force, given what stands in that row, if it was read.

        Backwards from it the rows are read, up to the begin of `before`; what was in force when
        that began is stored.
        """
        begins_s = {signal.name: self._in_force_s for signal, head in heads.items() if head}
        left = [signal for signal in heads if signal.name in begins_s]
        rows, part = _FIRST_ROWS_BACK, before
        while left and before.start_s < before.end_s:
            part = newest_part(self._connection, before, rows)
            columns = read_columns(self._connection, part, left, self._deadline, after=mark)
            if columns.cut:
                self.since_before.update(each.name for each in left)
                break
            for signal in tuple(left):
                values = columns.values[signal.name]
                count = _alike_at_end(values, heads[signal][0])
                if count:
                    begins_s[signal.name] = columns.times[-count]
                if count < len(values):
                    left.remove(signal)
            before, rows = replace(before, end_s=part.start_s), rows * _MORE_BACK
        found: dict[str, list[Point]] = {}
        for signal, head in heads.items():
            if head:
                whole = signal in left and signal.name not in self.since_before
                points = found[signal.name] = stored[signal.name][-1:] if whole else []
                _append_changes(points, [(begins_s[signal.name], head[0])])
        return {name: each[-1:] for name, each in found.items()}

    def _splice_kept(self, signals: Sequence[Signal], points: dict[str, list[Point]]) -> None:
        """In kept stretches the points are those of each call: to the very step, none missed."""
        segment = self._segment
        for each in kept_parts(self._connection, segment.run_id, segment.start_s, segment.end_s):
            end_s = min(just_after(each.end_s), segment.end_s)
            stretch = Segment(segment.run_id, each.start_s, end_s, full_rate=True)
            columns = self._read(stretch, signals)
            if columns.cut:
                return
            for signal in signals:
                before = [point for point in points[signal.name] if point.sim_time_s < each.start_s]
                after = [point for point in points[signal.name] if point.sim_time_s >= end_s]
                new = zip(columns.times, columns.values[signal.name], strict=True)
                _append_changes(before, new)
                _append_changes(before, after)
                points[signal.name] = before

    def _stored(self, signal: Signal, *, since: bool) -> list[Point]:
        """The points from the change table; numbers, which are not in it, from rows."""
        points = _stored(self._connection, self._segment, signal)
        first_s = _first_number_s(self._connection, self._segment, signal, points)
        if first_s is None:
            return points
        end_s = min(points[0].sim_time_s if points else math.inf, self._segment.end_s)
        from_s = max(first_s, self._in_force_s)
        columns = self._read(Segment(self._segment.run_id, from_s, end_s), [signal])
        values, found = columns.values[signal.name], list[Point]()
        if since and first_s < from_s:
            before = Segment(self._segment.run_id, first_s, from_s)
            known = self._in_force(before, {signal: values[:1]}, {signal.name: []})
            found = known.get(signal.name, [])
        _append_changes(found, zip(columns.times, values, strict=True))
        return [*found, *points]

    def _read(self, segment: Segment, signals: Sequence[Signal], *, after: int = 0) -> Columns:
        """Rows; where they were cut is noted."""
        columns = read_columns(self._connection, segment, signals, self._deadline, after=after)
        self.cuts_s += [] if columns.cut_at_s is None else [columns.cut_at_s]
        return columns


def _points(texts: Iterable[tuple[float, Value]]) -> Iterable[tuple[float, Value]]:
    """What `OneValue` says of no value is none."""
    return ((time_s, None if text == NO_VALUE else text) for time_s, text in texts)


def value_ended_s(
    connection: sqlite3.Connection, segment: Segment, signal: Signal, deadline: Deadline
) -> tuple[float | None, float | None]:
    """When the value in force at the begin of a segment ended in it; None where it did not.

    And from where on the rows were not read, where it did not end before; None where all were.
    """
    stored: list[Point] = []
    if not signal.is_number:  # of numbers no change is stored
        found = _stored(connection, segment, signal, most=2)
        stored = _from(found, segment.start_s)
    end_s = just_after(stored[1].sim_time_s) if len(stored) > 1 else segment.end_s
    first = Segment(segment.run_id, segment.start_s, end_s)
    changes = change_points(connection, first, [signal], deadline, since=False)
    points = changes.points[signal.name]
    return (points[1].sim_time_s, None) if len(points) > 1 else (None, changes.unread_from_s)


def _in_force_s(connection: sqlite3.Connection, segment: Segment) -> float:
    """The time of the row whose values are in force when the segment begins."""
    asked = (segment.run_id, segment.start_s)
    (row_s,) = connection.execute(_ROW_IN_FORCE, asked).fetchone()
    return segment.start_s if row_s is None else row_s


def _stored(
    connection: sqlite3.Connection, segment: Segment, signal: Signal, most: int = -1
) -> list[Point]:
    """The points from the change table."""
    if signal.id is None:
        return []
    asked = {"run": segment.run_id, "signal": signal.id, "most": most}
    asked |= {"start": segment.start_s, "end": segment.end_s}
    rows = connection.execute(_CHANGES, asked)
    if signal.kind == "bool":
        return [Point(time_s, None if value is None else value == "true") for time_s, value in rows]
    return [Point(time_s, value) for time_s, value in rows]


def _first_number_s(
    connection: sqlite3.Connection, segment: Segment, signal: Signal, points: list[Point]
) -> float | None:
    """When the signal was a number before the first stored point; None where it was none.

    Of numbers no change is stored.
    """
    is_known = bool(points) and points[0].sim_time_s <= segment.start_s
    if signal.id is None or signal.kind == "bool" or is_known:
        return None
    values = {"run": segment.run_id, "signal": signal.id}
    first = connection.execute(_FIRST_VALUE, values).fetchone()
    end_s = min(points[0].sim_time_s if points else math.inf, segment.end_s)
    return None if first is None or first[0] is None or first[0] >= end_s else first[0]


def _append_changes(points: list[Point], rows: Iterable[tuple[float, object]]) -> None:
    for time_s, value in rows:
        assert value is None or isinstance(value, (str, bool))
        if not points or points[-1].value != value:
            points.append(Point(time_s, value))


def _from(points: list[Point], start_s: float) -> list[Point]:
    """Without the points that were over when the segment began."""
    started = sum(point.sim_time_s <= start_s for point in points)
    return points[max(0, started - 1) :]


def _alike_at_end(values: Sequence[Value], value: Value) -> int:
    """How many of the last are this one."""
    return sum(1 for _ in takewhile(lambda each: each == value, reversed(values)))


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
