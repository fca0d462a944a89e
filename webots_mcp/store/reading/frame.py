"""The one reader of the past: rows of a run over a stretch, as arrays, and what was not read.

A frame has the times of its rows, and gives the values of each signal that is asked for: from
chunks, which are decompressed then, and from the newest rows, which are in no chunk yet. What a
chunk comes to (`Frame.zones`) is known without opening it.
"""

from __future__ import annotations

import math
import sqlite3
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

from webots_mcp.naming import Value
from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.store.chunks.codec import (
    IS_ABSENT,
    IS_NUMBER,
    Decoded,
    Replaced,
)
from webots_mcp.store.chunks.columns import STATE_COLUMNS, StateColumns
from webots_mcp.store.chunks.making import GROUP_ROWS
from webots_mcp.store.chunks.statistics import Statistics, statistics_of
from webots_mcp.store.chunks.stored import (
    SIM_TIMES,
    STATE_IDS,
    WALL_TIMES,
    groups_in,
    reached,
)
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.frame_source import FrameSource, Part, Unread
from webots_mcp.store.reading.kept import MOST_ROWS, kept_parts
from webots_mcp.store.reading.newest_rows import read_rows, rows_in_no_chunk
from webots_mcp.store.reading.ranges import Segment

_FEW: Final = 4  # times that few chunks are opened one by one; else all of them at once
_OTHER: Final = 0  # code of null and of a key that is not there
_FIRST_LABEL: Final = 2  # of the codes of a chunk

_IN: Final = "run_id = ? AND sim_time_s >= ? AND sim_time_s < ?"
_STATES: Final = f"SELECT {STATE_COLUMNS} FROM state WHERE {_IN} ORDER BY sim_time_s, id"
_KEPT: Final = (
    "SELECT -id, sim_time_s, wall_time_s, data, replaced FROM kept_state "
    f"WHERE {_IN} ORDER BY sim_time_s, id LIMIT ?"
)
# Rows that were deleted, and of which no chunk is left. What is oldest goes first.
_LOST: Final = (
    "SELECT started_sim_time_s, (SELECT min(start_sim_time_s) FROM row_group WHERE run_id = r.id "
    "AND is_complete = 1), (SELECT min(sim_time_s) FROM state WHERE run_id = r.id) FROM run r "
    "WHERE id = ? AND purged_rows > coalesce((SELECT sum(row_count - stored_row_count) "
    "FROM row_group WHERE run_id = r.id AND is_complete = 1), 0)"
)
_SIGNALS: Final = (
    "SELECT s.name, s.id FROM run r JOIN signal s ON s.robot_id = r.robot_id WHERE r.id = ? "
    "AND typeof(s.name) = 'text'"
)


class Coded(NamedTuple):
    """The values of any signal as codes.

    Attributes:
        codes: One for each row: the place of its value among the labels.
        labels: The values; the first is None, for null and for a key that is not there.
    """

    codes: Indexes
    labels: list[Value]


@dataclass(frozen=True)
class Zones:
    """What the chunks of a signal come to, those of the newest rows included, in order.

    All are arrays with an item for each chunk; NaN where a chunk has no usable number.

    Attributes:
        first_row: Place of its first row in the frame.
        row_count: Its rows, also those that lack the signal.
        held_count: Of them, those whose state has the signal, be it null.
        value_count: Of them, those with a usable number; of a text with a text.
        start_s: Simulation time of its first row; `end_s` of its last one.
    """

    first_row: Indexes
    row_count: Indexes
    held_count: Indexes
    value_count: Indexes
    change_count: Indexes
    start_s: Array
    end_s: Array
    first: Array
    last: Array
    min: Array
    max: Array
    sum: Array
    squared_deviations: Array
    largest_step: Array

    def __len__(self) -> int:
        return len(self.first_row)

    def spans(self, wanted: Flags) -> list[tuple[int, int]]:
        """Rows [start, stop) of the chunks that are wanted; those side by side are one span."""
        edges = np.flatnonzero(np.diff(wanted, prepend=False, append=False)).tolist()
        stops = np.append(self.first_row, self.first_row[-1:] + self.row_count[-1:])
        return [
            (int(stops[start]), int(stops[stop]))
            for start, stop in zip(edges[::2], edges[1::2], strict=True)
        ]


class Frame:
    """Rows of one run in order of simulation time; equal times in the order of their ids.

    Attributes:
        run_id: Of which run.
        cut_at_s: The deadline passed after this row, or before any where it is the begin of what
            was to be read; None where all was read.
    """

    def __init__(
        self, source: FrameSource, start: int, stop: int, cut_at_s: float | None = None
    ) -> None:
        self._source = source
        self._start = start
        self._stop = stop
        self.cut_at_s = cut_at_s
        self.run_id = source.run_id

    @classmethod
    def of(
        cls,
        times: Sequence[float] | Array,
        columns: Mapping[str, Sequence[Any] | Array],
        *,
        wall_times: Sequence[float] | Array | None = None,
        run_id: int = 0,
    ) -> Frame:
        """A frame of values that are in no recording.

        Args:
            times: Simulation time of each row in s, never falling.
            columns: Of each signal one value for each row; None or NaN where it has none.
            wall_times: Unix time of each row in s; None for the simulation times.
            run_id: Of which run it says to be.
        """
        listed = [float(each) for each in times]
        walls = listed if wall_times is None else [float(each) for each in wall_times]
        values = {name: _plain(column) for name, column in columns.items()}
        ids = list(range(1, len(listed) + 1))
        rows = StateColumns(ids, listed, walls, [""] * len(listed), values)
        return cls(FrameSource(None, run_id, _rows_in_parts(rows, 0), {}), 0, len(listed))

    def __len__(self) -> int:
        return self._stop - self._start

    def __contains__(self, name: str) -> bool:
        """Whether a row may have a value of that signal."""
        if name in self._source.ids:
            return True
        columns = (part.columns for part in self._source.parts)
        return any(each is not None and name in each.values for each in columns)

    @property
    def new_rows(self) -> list[StateColumns]:
        """The rows that are in no chunk yet, a part at a time."""
        return [part.columns for part in self._source.parts if part.columns is not None]

    @property
    def unread(self) -> tuple[Unread, ...]:
        """What is not in it, as far as its values were asked for."""
        return tuple(self._source.unread)

    @cached_property
    def times(self) -> Array:
        """Simulation time of each row, in s."""
        return self._of_rows(SIM_TIMES, "times")

    @cached_property
    def wall_times(self) -> Array:
        """Unix time of each row, in s."""
        return self._of_rows(WALL_TIMES, "wall_times")

    @cached_property
    def ids(self) -> Indexes:
        """The id of each state row; negative of those that only a kept stretch has."""
        return self._of_rows(STATE_IDS, "ids").astype(np.intp)

    def numbers(self, name: str) -> Array:
        """The number of a signal in each row: NaN where it has none; flags are 0 and 1."""
        return self._source.kept(
            ("numbers", name, self._start, self._stop), lambda: self._numbers(name), 8 * len(self)
        )

    def usable(self, name: str) -> tuple[Array, Array]:
        """Times and numbers of the rows that have a usable one: not NaN, not beyond 1e100."""
        from webots_mcp.store.analysis.summary import usable_part

        return usable_part(self.times, self.numbers(name))

    def coded(self, name: str) -> Coded:
        """The values of a signal, whatever they are, as codes."""
        return self._source.kept(
            ("coded", name, self._start, self._stop), lambda: self._coded(name), 8 * len(self)
        )

    def texts(self, name: str) -> Coded:
        """As `coded`, of texts alone: numbers and flags have the code of None."""
        return self._source.kept(
            ("texts", name, self._start, self._stop),
            lambda: self._coded(name, numbers=False),
            8 * len(self),
        )

    def held(self, name: str) -> Flags:
        """In which rows the state has the signal, be it null."""
        start, stop = self._bounds()
        whole = np.zeros(stop - start, np.bool_)
        for part, values, inside in self._parts(name):
            if values is not None:
                codes = np.zeros(1) if values.codes is None else values.codes[inside]
                first, rows = max(0, part.start - start), len(values.numbers[inside])
                whole[first : first + rows] = codes != IS_ABSENT
        return self._within(whole)

    def values(self, name: str) -> list[Value]:
        """The values as Python has them; slow, for a few rows. What was replaced is None."""
        codes, labels = self.coded(name)
        return [labels[code] for code in codes.tolist()]

    def values_at(self, name: str, rows: Indexes) -> list[Value]:
        """The values in some rows, in order, of which each chunk is opened once."""
        zones = self.zones(name)
        chunks = np.searchsorted(zones.first_row, rows, "right") - 1
        found: list[Value] = []
        for chunk in np.unique(chunks).tolist():
            first = int(zones.first_row[chunk])
            codes, labels = self.rows(first, first + int(zones.row_count[chunk])).coded(name)
            found += [labels[code] for code in codes[rows[chunks == chunk] - first].tolist()]
        return found

    def replaced(self, name: str) -> Counter[str]:
        """How often each value that JSON cannot hold (nan, inf, ...) stood there."""
        if self._source.order is not None:
            return self._replaced(name)
        zones, found = self.zones(name), Counter[str]()
        for start, stop in zones.spans(zones.held_count > zones.value_count):
            found += self.rows(start, stop)._replaced(name)
        return found

    def _replaced(self, name: str) -> Counter[str]:
        found = Counter[str]()
        for _, values, inside in self._parts(name):
            if values is None or values.codes is None:
                continue
            for code, label in enumerate(values.labels, _FIRST_LABEL):
                if isinstance(label, Replaced):
                    found[label.why] += int(np.count_nonzero(values.codes[inside] == code))
        return +found

    def zones(self, name: str) -> Zones:
        """What the chunks of a signal come to; those that the frame cuts come to what is in it."""
        size = 8 * len(Zones.__annotations__) * len(self._source.parts)
        key = ("zones", name, self._start, self._stop)
        return self._source.kept(key, lambda: self._made_zones(name), size)

    def _made_zones(self, name: str) -> Zones:
        if self._source.order is not None:
            return _zones(self._cut_zones(self._in_order(name)))
        stored = self._source.zones(
            self._source.ids.get(name), lambda columns: columns.values.get(name)
        )
        return self._zones_within(
            stored, lambda start, stop: _slice_of(self._source, name, start, stop)
        )

    def time_zones(self) -> Zones:
        """The same of the simulation times: the largest step shows whether rows are missing."""
        if self._source.order is not None:
            return _zones(self._cut_zones(Decoded(self.times, None, ())))
        stored = self._source.zones(SIM_TIMES, lambda columns: columns.times)
        return self._zones_within(stored, lambda start, stop: Decoded(
            self._source.of_rows(SIM_TIMES, "times", start, stop), None, ()
        ))  # fmt: skip

    def _zones_within(
        self,
        stored: Sequence[tuple[Part, Statistics | None]],
        values_in: Callable[[int, int], Decoded],
    ) -> Zones:
        found: list[_Zone] = []
        for part, statistics in stored:
            start, stop = max(part.start, self._start), min(part.start + part.rows, self._stop)
            if start >= stop:
                continue
            bounds_s = part.bounds_s
            if stop - start < part.rows:
                statistics = statistics_of(values_in(start, stop))
                times = self._source.of_rows(SIM_TIMES, "times", start, stop)
                bounds_s = float(times[0]), float(times[-1])
            found.append(_Zone(start - self._start, stop - start, statistics, *bounds_s))
        return _zones(found)

    @property
    def bounds_s(self) -> tuple[float, float]:
        """Simulation time of its first and last row; only of a frame that has rows."""
        first, last = self.rows(0, 1), self.rows(len(self) - 1, len(self))
        return float(first.times[0]), float(last.times[0])

    def places(self, times_s: Array | Sequence[float]) -> Indexes:
        """The places of the first rows at or after some times; few chunks of times are opened."""
        wanted: Array = np.asarray(times_s, np.float64)
        source = self._source
        starts_s, ends_s = source.bounds_s
        if source.order is None and "times" not in self.__dict__ and len(starts_s):
            parts = np.searchsorted(ends_s, wanted)
            inside = (parts < len(starts_s)) & (
                starts_s[np.minimum(parts, len(ends_s) - 1)] < wanted
            )
            opened: list[int] = np.unique(parts[inside]).tolist()
            if len(opened) * _FEW < len(starts_s):
                first_rows = np.array(
                    [part.start for part in source.parts] + [source.rows], np.intp
                )
                found = first_rows[parts]
                for at in opened:
                    part = source.parts[at]
                    times = source.of_rows(SIM_TIMES, "times", part.start, part.start + part.rows)
                    here = inside & (parts == at)
                    found[here] += np.searchsorted(times, wanted[here])
                return np.maximum(0, np.minimum(found - self._start, len(self)))
        return np.searchsorted(self.times, wanted)

    def rows(self, start: int, stop: int) -> Frame:
        """Some of its rows by their places; only the chunks that they touch are opened."""
        start, stop = max(0, start), min(len(self), stop)
        part = Frame(self._source, self._start + start, self._start + max(start, stop))
        if "times" in self.__dict__:
            part.__dict__["times"] = self.times[start : max(start, stop)]
        return part

    def between(self, start_s: float, end_s: float) -> Frame:
        """Its rows in [start_s, end_s) of simulation time."""
        start, stop = self.places([start_s, end_s]).tolist()
        return self.rows(start, stop)

    def _cut_zones(self, values: Decoded) -> list[_Zone]:
        """Of rows that lie among each other in several chunks, in parts of their own."""
        found: list[_Zone] = []
        for first in range(0, len(self), GROUP_ROWS):
            stop = min(first + GROUP_ROWS, len(self))
            bounds_s = float(self.times[first]), float(self.times[stop - 1])
            statistics = statistics_of(_cut(values, first, stop))
            found.append(_Zone(first, stop - first, statistics, *bounds_s))
        return found

    def _in_order(self, name: str) -> Decoded:
        numbers, (codes, labels) = self.numbers(name), self.coded(name)
        if not any(isinstance(label, str) for label in labels):
            return Decoded(numbers, None, ())
        other = np.where(codes == _OTHER, IS_ABSENT, codes + _FIRST_LABEL)
        return Decoded(numbers, other, [None, *labels])

    def _of_rows(self, signal_id: int, attribute: str) -> Array:
        bounds = self._bounds()
        return self._source.kept(
            (signal_id, self._start, self._stop),
            lambda: self._within(self._source.of_rows(signal_id, attribute, *bounds)),
            8 * len(self),
        )

    def _parts(self, name: str) -> list[tuple[Part, Decoded | None, slice]]:
        """The parts that the frame touches, and which of their rows are in it."""
        start, stop = self._bounds()
        return [
            (part, values, slice(max(0, start - part.start), max(0, stop - part.start)))
            for part, values in self._source.decoded(name, start, stop)
        ]

    def _bounds(self) -> tuple[int, int]:
        """The rows that have to be decoded; all, where they have to be put in order."""
        if self._source.order is None:
            return self._start, self._stop
        return 0, self._source.rows

    def _within(self, whole: Any) -> Any:
        """The rows of the frame among those that were decoded."""
        order = self._source.order
        return whole if order is None else whole[order[self._start : self._stop]]

    def _numbers(self, name: str) -> Array:
        start, stop = self._bounds()
        whole = np.full(stop - start, np.nan)
        for part, values, inside in self._parts(name):
            if values is not None:
                numbers = values.numbers[inside]
                first = max(0, part.start - start)
                whole[first : first + len(numbers)] = numbers
        return self._within(whole)

    def _coded(self, name: str, *, numbers: bool = True) -> Coded:
        start, stop = self._bounds()
        whole = np.full(stop - start, _OTHER, np.intp)
        known: dict[object, int] = {}
        labels: list[Value] = [None]
        for part, values, inside in self._parts(name):
            if values is not None:
                codes = _relabelled(values, known, labels, numbers=numbers)[inside]
                first = max(0, part.start - start)
                whole[first : first + len(codes)] = codes
        return Coded(self._within(whole), labels)


def read_frame(
    connection: sqlite3.Connection,
    segment: Segment,
    deadline: Deadline,
    *,
    full_rate: bool = True,
    every_call: bool = False,
) -> Frame:
    """Read a segment of a run; values are read when they are asked for.

    Args:
        connection: Any; it is used as long as the frame is.
        segment: Which rows.
        deadline: Rows that are in no chunk yet are read until then; the frame says what is left.
        full_rate: Of a segment that is kept at full rate, each call of `publish` is a row.
        every_call: Of any segment each call is a row that is in a kept stretch.
    """
    run_id, span = segment.run_id, (segment.start_s, segment.end_s)
    parts: list[Part] = []
    if full_rate and segment.full_rate:
        columns = StateColumns()
        cut_at_s = read_rows(connection, _STATES, (run_id, *span), columns, deadline)
        if cut_at_s is None:
            cut_at_s = read_rows(connection, _KEPT, (run_id, *span, -1), columns, deadline)
    else:
        at = reached(connection, run_id)
        columns, cut_at_s = rows_in_no_chunk(connection, run_id, span, at, deadline)
        for group in groups_in(connection, run_id, *span):
            start = parts[-1].start + parts[-1].rows if parts else 0
            parts.append(Part(start, group.row_count, group, None))
        if every_call and cut_at_s is None:
            cut_at_s = read_rows(connection, _KEPT, (run_id, *span, -1), columns, deadline)
    parts += _rows_in_parts(columns, parts[-1].start + parts[-1].rows if parts else 0)
    names = dict(connection.execute(_SIGNALS, (run_id,)).fetchall())
    source = FrameSource(connection, run_id, parts, names)
    if lost := deleted_part(connection, segment):
        source.unread[lost] = None
    return _framed(source, segment, _said(source, segment, cut_at_s))


def _said(source: FrameSource, segment: Segment, cut_at_s: float | None) -> float | None:
    """Where the deadline cut a segment, if it did; the frame names what is not in it."""
    if cut_at_s is None or cut_at_s >= segment.end_s:
        return None
    reached_s = max(cut_at_s, segment.start_s)
    source.unread[Unread(reached_s, segment.end_s, "time limit reached")] = None
    return reached_s


def deleted_part(connection: sqlite3.Connection, segment: Segment) -> Unread | None:
    """The part of a segment whose rows and chunks retention has deleted."""
    row = connection.execute(_LOST, (segment.run_id,)).fetchone()
    if row is None:
        return None
    start_s, *left = (time_s for time_s in row if isinstance(time_s, int | float))
    start_s, end_s = max(start_s, segment.start_s), min([*left, segment.end_s])
    return Unread(start_s, end_s, "deleted by retention") if start_s < end_s else None


def read_kept(connection: sqlite3.Connection, segment: Segment, deadline: Deadline) -> Frame | None:
    """The rows of a segment that only kept stretches have; None where there are none.

    Of a segment that is at full rate itself none: `read_frame` has them among the others.
    """
    if segment.full_rate:
        return None
    bounds = (segment.run_id, segment.start_s, segment.end_s)
    if not kept_parts(connection, *bounds):
        return None
    columns = StateColumns()
    cut_at_s = read_rows(connection, _KEPT, (*bounds, MOST_ROWS), columns, deadline)
    source = FrameSource(connection, segment.run_id, _rows_in_parts(columns, 0), {})
    cut_at_s = _said(source, segment, cut_at_s)
    return _framed(source, segment, cut_at_s) if len(columns) else None


def _framed(source: FrameSource, segment: Segment, cut_at_s: float | None) -> Frame:
    """The rows of a source that lie in a segment, in order."""
    whole = Frame(source, 0, source.rows, cut_at_s)
    if not source.is_in_order:
        ids = whole.ids
        order = np.lexsort((np.abs(ids), whole.wall_times if (ids < 0).any() else ids, whole.times))
        source.order = order
        source.forget()
        whole = Frame(source, 0, source.rows, cut_at_s)
    start, stop = whole.places([segment.start_s, segment.end_s]).tolist()
    if math.isfinite(segment.wall_start_s) or math.isfinite(segment.wall_end_s):
        walls = whole.wall_times[start:stop]
        inside = np.flatnonzero((walls >= segment.wall_start_s) & (walls < segment.wall_end_s))
        stop = start + int(inside[-1]) + 1 if len(inside) else start
        start += int(inside[0]) if len(inside) else 0
    return Frame(source, start, stop, cut_at_s)


def _rows_in_parts(columns: StateColumns, start: int) -> list[Part]:
    """Rows that are in no chunk, as if they were."""
    rows = len(columns)
    if rows <= GROUP_ROWS:
        return [Part(start, rows, None, columns)] if rows else []
    return [
        Part(start + first, min(GROUP_ROWS, rows - first), None, columns.part(first, GROUP_ROWS))
        for first in range(0, rows, GROUP_ROWS)
    ]


def _plain(column: Sequence[Any] | Array) -> list[Any]:
    listed: list[Any] = column.tolist() if isinstance(column, np.ndarray) else list(column)
    return [None if value != value else value for value in listed]


def _cut(values: Decoded, start: int, stop: int) -> Decoded:
    codes = None if values.codes is None else values.codes[start:stop]
    return Decoded(values.numbers[start:stop], codes, values.labels)


def _slice_of(source: FrameSource, name: str, start: int, stop: int) -> Decoded:
    """The values of a signal in some rows of one part."""
    ((part, values),) = source.decoded(name, start, stop)
    if values is None:
        return Decoded(np.full(stop - start, np.nan), np.full(stop - start, IS_ABSENT), ())
    return _cut(values, start - part.start, stop - part.start)


def _relabelled(
    values: Decoded, known: dict[object, int], labels: list[Value], *, numbers: bool
) -> Indexes:
    """Codes that several chunks share; numbers get labels as well, where they are wanted."""

    def code_of(value: Value) -> int:
        key = (type(value), value)
        if key not in known:
            known[key] = len(labels)
            labels.append(value)
        return known[key]

    codes = np.full(len(values.numbers), _OTHER, np.intp)
    if numbers:
        held = np.ones(len(codes), np.bool_) if values.codes is None else values.codes == IS_NUMBER
        held &= ~np.isnan(values.numbers)
        unique, places = np.unique(values.numbers[held], return_inverse=True)
        found = [code_of(_number(each)) for each in unique.tolist()]
        codes[held] = np.array(found, np.intp)[places] if found else _OTHER
    if values.codes is not None:
        for code, label in enumerate(values.labels, _FIRST_LABEL):
            wanted = numbers or isinstance(label, str)
            if wanted and label is not None and not isinstance(label, Replaced):
                codes[values.codes == code] = code_of(label)
    return codes


def _number(value: float) -> float:
    return int(value) if value.is_integer() and abs(value) < 2**53 else value


class _Zone(NamedTuple):
    """What rows of a frame come to that are in one chunk."""

    first_row: int
    row_count: int
    statistics: Statistics | None
    start_s: float
    end_s: float


def _zones(parts: Sequence[_Zone]) -> Zones:
    nothing = Statistics(0, 0)
    table: Array = np.reshape(
        np.array([tuple(part.statistics or nothing) for part in parts], np.float64),
        (len(parts), len(Statistics._fields)),
    )
    figures: dict[str, Array] = dict(zip(Statistics._fields, np.transpose(table), strict=True))
    places: Array = np.reshape(np.array([(*part[:2], *part[3:]) for part in parts]), (-1, 4))
    first, rows, starts_s, ends_s = np.transpose(places)
    held: Indexes = figures.pop("row_count").astype(np.intp)
    present: Indexes = figures.pop("value_count").astype(np.intp)
    changed: Indexes = figures.pop("change_count").astype(np.intp)
    where = first.astype(np.intp), rows.astype(np.intp)
    return Zones(*where, held, present, changed, starts_s, ends_s, **figures)
