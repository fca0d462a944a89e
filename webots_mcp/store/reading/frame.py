"""The one reader of the past: rows of a run over a stretch, as arrays, and what was not read.

A frame has the times of its rows, and gives the values of each signal that is asked for: from
chunks, which are decompressed then, and from the newest rows, which are in no chunk yet. What a
chunk comes to (`Frame.zones`) is known without opening it.
"""

from __future__ import annotations

import math
import sqlite3
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

from webots_mcp.naming import Value
from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.store.chunks.codec import (
    IS_ABSENT,
    IS_NUMBER,
    DamagedChunkError,
    Decoded,
    Replaced,
    decoded_of,
)
from webots_mcp.store.chunks.columns import STATE_COLUMNS, StateColumns
from webots_mcp.store.chunks.making import GROUP_ROWS
from webots_mcp.store.chunks.statistics import Statistics, statistics_of
from webots_mcp.store.chunks.stored import (
    SIM_TIMES,
    STATE_IDS,
    WALL_TIMES,
    Group,
    groups_in,
    reached,
    statistics_in,
    values_in,
)
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.kept import MOST_ROWS, kept_parts
from webots_mcp.store.reading.ranges import Segment

MOST_KEPT_BYTES: Final = 64_000_000  # of values that a frame keeps for who asks again
_ROWS_AT_ONCE: Final = 1024  # between two looks at the deadline
_FEW: Final = 4  # times that few chunks are opened one by one; else all of them at once
_OTHER: Final = 0  # code of null and of a key that is not there
_FIRST_LABEL: Final = 2  # of the codes of a chunk

_IN: Final = "sim_time_s >= ? AND sim_time_s < ?"
_TAIL: Final = (
    f"SELECT {STATE_COLUMNS} FROM state WHERE run_id = ? AND {_IN} AND (sim_time_s, id) > (?, ?) "
    "ORDER BY sim_time_s, id"
)
_LATE: Final = (
    f"SELECT {STATE_COLUMNS} FROM state WHERE id > ? AND +run_id = ? AND {_IN} "
    "AND (sim_time_s, id) <= (?, ?) ORDER BY sim_time_s, id"
)
_KEPT: Final = (
    "SELECT -id, sim_time_s, wall_time_s, data, odd FROM kept_state "
    f"WHERE run_id = ? AND {_IN} ORDER BY sim_time_s, id"
)
_ROWS_OF: Final = (
    f"SELECT {STATE_COLUMNS} FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s <= ? "
    "ORDER BY sim_time_s, id"
)
_SIGNALS: Final = (
    "SELECT s.name, s.id FROM run r JOIN signal s ON s.robot_id = r.robot_id WHERE r.id = ? "
    "AND typeof(s.name) = 'text'"
)


class Unread(NamedTuple):
    """A part of what was asked for that is not in a frame: [start_s, end_s], and why."""

    start_s: float
    end_s: float
    why: str

    def __str__(self) -> str:
        return f"not read from {self.start_s:.3f} to {self.end_s:.3f} s: {self.why}"


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


class _Part(NamedTuple):
    """Rows of a frame that are decoded together: a group, or rows that are in none."""

    start: int  # place of the first row
    rows: int
    group: Group | None
    columns: StateColumns | None

    @property
    def bounds_s(self) -> tuple[float, float]:
        """Simulation time of its first and last row."""
        if self.group is not None:
            return self.group.start_s, self.group.end_s
        assert self.columns is not None
        return self.columns.times[0], self.columns.times[-1]


class _Source:
    """Where the values come from, before a range and an order are laid over them."""

    def __init__(
        self,
        connection: sqlite3.Connection | None,
        run_id: int,
        parts: Sequence[_Part],
        ids: Mapping[str, int],
        deadline: Deadline | None,
    ) -> None:
        self.connection = connection
        self.run_id = run_id
        self.parts = parts
        self.ids = ids
        self.deadline = deadline
        self.rows = parts[-1].start + parts[-1].rows if parts else 0
        self.unread: dict[Unread, None] = {}
        self.order: Indexes | None = None
        self._groups = [part.group for part in parts if part.group is not None]
        self._of_group = {part.group.id: part for part in parts if part.group is not None}
        self._kept: OrderedDict[object, Any] = OrderedDict()
        self._kept_bytes = 0

    @cached_property
    def bounds_s(self) -> tuple[Array, Array]:
        """Simulation times of the first rows of all parts, and of the last ones."""
        bounds = [part.bounds_s for part in self.parts]
        return np.array([each[0] for each in bounds]), np.array([each[1] for each in bounds])

    @cached_property
    def is_in_order(self) -> bool:
        """Whether simulation time never falls from row to row."""
        starts_s, ends_s = self.bounds_s
        columns = [part.columns.times for part in self.parts if part.columns is not None]
        return bool((starts_s[1:] >= ends_s[:-1]).all()) and all(
            (np.diff(times) >= 0).all() for times in columns
        )

    def decoded(self, name: str, start: int, stop: int) -> list[tuple[_Part, Decoded | None]]:
        """The values of a signal in the parts that touch rows [start, stop); None: it has none."""
        wanted = [p for p in self.parts if p.start < stop and p.start + p.rows > start]
        stored = self._stored(self.ids.get(name), name, wanted)
        found: list[tuple[_Part, Decoded | None]] = []
        for part in wanted:
            if part.group is not None:
                found.append((part, stored.get(part.group.id)))
            else:
                assert part.columns is not None
                values = part.columns.values.get(name)
                found.append((part, None if values is None else decoded_of(values)))
        return found

    def of_rows(self, signal_id: int, attribute: str, start: int, stop: int) -> Array:
        """Times or ids of rows [start, stop)."""
        wanted = [p for p in self.parts if p.start < stop and p.start + p.rows > start]
        first = wanted[0].start if wanted else start
        stored = self._stored(signal_id, attribute, wanted)
        whole = np.full(max(stop, start) - first, np.nan)
        for part in wanted:
            inside = slice(part.start - first, part.start - first + part.rows)
            if part.columns is not None:
                values: Any = getattr(part.columns, attribute)
            elif part.group is not None and part.group.id in stored:
                values = stored[part.group.id].numbers
            else:
                continue
            whole[inside] = values[: len(whole) - inside.start]
        return whole[start - first :]

    def _stored(
        self, signal_id: int | None, name: str, parts: Sequence[_Part]
    ) -> dict[int, Decoded]:
        groups = [part.group for part in parts if part.group is not None]
        if signal_id is None or self.connection is None or not groups:
            return {}
        found: dict[int, Decoded] = {}
        for group_id, values in values_in(self.connection, self.run_id, signal_id, groups):
            if isinstance(values, DamagedChunkError):
                again = self._from_rows(self._of_group[group_id], name, signal_id, values)
                if again is None:
                    continue
                values = again
            found[group_id] = values
        return found

    def _from_rows(
        self, part: _Part, name: str, signal_id: int, error: DamagedChunkError
    ) -> Decoded | None:
        """What the rows of a damaged chunk say, where they are all there; else it is not read."""
        assert self.connection is not None and part.group is not None
        group = part.group
        columns = StateColumns()
        asked = (self.run_id, group.start_s, group.end_s)
        columns.add(self.connection.execute(_ROWS_OF, asked).fetchall())
        if len(columns) == group.row_count:
            values: Sequence[Any] | None = {
                SIM_TIMES: columns.times, WALL_TIMES: columns.wall_times, STATE_IDS: columns.ids
            }.get(signal_id, columns.values.get(name))  # fmt: skip
            if values is not None:
                return decoded_of(values)
        self.unread[Unread(group.start_s, group.end_s, f"the chunk of {name} is {error}")] = None
        return None

    def zones(
        self, signal_id: int | None, values_of: Callable[[StateColumns], Sequence[Any] | None]
    ) -> list[tuple[_Part, Statistics | None]]:
        """What a signal comes to in each part."""
        stored: dict[int, Statistics] = {}
        if signal_id is not None and self.connection is not None and self._groups:
            stored = statistics_in(self.connection, self.run_id, signal_id, self._groups)
        found: list[tuple[_Part, Statistics | None]] = []
        for part in self.parts:
            if part.group is not None:
                found.append((part, stored.get(part.group.id)))
            else:
                assert part.columns is not None
                values = values_of(part.columns)
                found.append((part, statistics_of(decoded_of(values)) if values else None))
        return found

    def forget(self) -> None:
        """Forget what was made."""
        self._kept.clear()
        self._kept_bytes = 0

    def kept(self, key: object, make: Any, size: int) -> Any:
        """What was made before, or is made now; the oldest makes room for it."""
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key][0]
        made = make()
        self._kept[key] = (made, size)
        self._kept_bytes += size
        while self._kept_bytes > MOST_KEPT_BYTES and len(self._kept) > 1:
            _, (_, freed) = self._kept.popitem(last=False)
            self._kept_bytes -= freed
        return made


class Frame:
    """Rows of one run in order of simulation time; equal times in the order of their ids.

    Attributes:
        run_id: Of which run.
        cut_at_s: The deadline passed after this row, or before any where it is the begin of what
            was to be read; None where all was read.
    """

    def __init__(
        self, source: _Source, start: int, stop: int, cut_at_s: float | None = None
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
        return cls(_Source(None, run_id, _rows_in_parts(rows, 0), {}, None), 0, len(listed))

    def __len__(self) -> int:
        return self._stop - self._start

    def __contains__(self, name: str) -> bool:
        """Whether a row may have a value of that signal."""
        if name in self._source.ids:
            return True
        columns = (part.columns for part in self._source.parts)
        return any(each is not None and name in each.values for each in columns)

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

    def values(self, name: str) -> list[Value]:
        """The values as Python has them; slow, for a few rows. What was replaced is None."""
        codes, labels = self.coded(name)
        return [labels[code] for code in codes.tolist()]

    def replaced(self, name: str) -> Counter[str]:
        """How often each value that JSON cannot hold (nan, inf, ...) stood there."""
        found = Counter[str]()
        for part, values, inside in self._parts(name):
            if values is None or values.codes is None:
                continue
            for code, label in enumerate(values.labels, _FIRST_LABEL):
                if isinstance(label, Replaced):
                    found[label.why] += int(np.count_nonzero(values.codes[inside] == code))
            assert part
        return Counter({why: count for why, count in found.items() if count})

    def zones(self, name: str) -> Zones:
        """What the chunks of a signal come to; those that the frame cuts come to what is in it."""
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
        stored: Sequence[tuple[_Part, Statistics | None]],
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

    def _parts(self, name: str) -> list[tuple[_Part, Decoded | None, slice]]:
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

    def _coded(self, name: str) -> Coded:
        start, stop = self._bounds()
        whole = np.full(stop - start, _OTHER, np.intp)
        known: dict[object, int] = {}
        labels: list[Value] = [None]
        for part, values, inside in self._parts(name):
            if values is not None:
                codes = _relabelled(values, known, labels)[inside]
                first = max(0, part.start - start)
                whole[first : first + len(codes)] = codes
        return Coded(self._within(whole), labels)


def read_frame(
    connection: sqlite3.Connection, segment: Segment, deadline: Deadline, *, full_rate: bool = True
) -> Frame:
    """Read a segment of a run; values are read when they are asked for.

    Args:
        connection: Any; it is used as long as the frame is.
        segment: Which rows.
        deadline: Rows that are in no chunk yet are read until then; the frame says what is left.
        full_rate: Of a segment that is kept at full rate, each call of `publish` is a row.
    """
    run_id, bounds = segment.run_id, (segment.start_s, segment.end_s)
    at = reached(connection, run_id)
    parts: list[_Part] = []
    if full_rate and segment.full_rate:
        whole = (run_id, *bounds, -math.inf, 0)
        rows = _read(connection, deadline, (_TAIL, whole), (_KEPT, (run_id, *bounds)))
    else:
        for group in groups_in(connection, run_id, *bounds):
            start = parts[-1].start + parts[-1].rows if parts else 0
            parts.append(_Part(start, group.row_count, group, None))
        here = (at.end_s, at.last_state_id)
        late = (at.max_state_id, run_id, *bounds, *here)
        rows = _read(connection, deadline, (_LATE, late), (_TAIL, (run_id, *bounds, *here)))
    columns, cut_at_s = rows
    parts += _rows_in_parts(columns, parts[-1].start + parts[-1].rows if parts else 0)
    names = dict(connection.execute(_SIGNALS, (run_id,)).fetchall())
    source = _Source(connection, run_id, parts, names, deadline)
    if cut_at_s is not None:
        reached_s = max(cut_at_s, segment.start_s)
        source.unread[Unread(reached_s, segment.end_s, "time limit reached")] = None
    return _framed(source, segment, cut_at_s)


def read_kept(connection: sqlite3.Connection, segment: Segment, deadline: Deadline) -> Frame | None:
    """The rows of a segment that only kept stretches have; None where there are none.

    Of a segment that is at full rate itself none: `read_frame` has them among the others.
    """
    if segment.full_rate:
        return None
    bounds = (segment.run_id, segment.start_s, segment.end_s)
    if not kept_parts(connection, *bounds):
        return None
    columns, cut_at_s = _read(connection, deadline, (f"{_KEPT} LIMIT {MOST_ROWS}", bounds))
    source = _Source(connection, segment.run_id, _rows_in_parts(columns, 0), {}, deadline)
    return _framed(source, segment, cut_at_s) if len(columns) else None


def _framed(source: _Source, segment: Segment, cut_at_s: float | None) -> Frame:
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


def _read(
    connection: sqlite3.Connection, deadline: Deadline, *queries: tuple[str, tuple[object, ...]]
) -> tuple[StateColumns, float | None]:
    """The rows of queries, and the time of the last one where the deadline passed."""
    columns = StateColumns()
    for query, values in queries:
        cursor = connection.execute(query, values)
        while rows := cursor.fetchmany(_ROWS_AT_ONCE):
            columns.add(rows)
            if deadline.passed and len(rows) == _ROWS_AT_ONCE:
                return columns, columns.times[-1]
    return columns, None


def _rows_in_parts(columns: StateColumns, start: int) -> list[_Part]:
    """Rows that are in no chunk, as if they were."""
    rows = len(columns)
    if rows <= GROUP_ROWS:
        return [_Part(start, rows, None, columns)] if rows else []
    return [
        _Part(start + first, min(GROUP_ROWS, rows - first), None, columns.part(first, GROUP_ROWS))
        for first in range(0, rows, GROUP_ROWS)
    ]


def _plain(column: Sequence[Any] | Array) -> list[Any]:
    listed: list[Any] = column.tolist() if isinstance(column, np.ndarray) else list(column)
    return [None if value != value else value for value in listed]


def _cut(values: Decoded, start: int, stop: int) -> Decoded:
    codes = None if values.codes is None else values.codes[start:stop]
    return Decoded(values.numbers[start:stop], codes, values.labels)


def _slice_of(source: _Source, name: str, start: int, stop: int) -> Decoded:
    """The values of a signal in some rows of one part."""
    ((part, values),) = source.decoded(name, start, stop)
    if values is None:
        return Decoded(np.full(stop - start, np.nan), np.full(stop - start, IS_ABSENT), ())
    return _cut(values, start - part.start, stop - part.start)


def _relabelled(values: Decoded, known: dict[object, int], labels: list[Value]) -> Indexes:
    """Codes that several chunks share; numbers get labels as well."""

    def code_of(value: Value) -> int:
        key = (type(value), value)
        if key not in known:
            known[key] = len(labels)
            labels.append(value)
        return known[key]

    codes = np.full(len(values.numbers), _OTHER, np.intp)
    held = np.ones(len(codes), np.bool_) if values.codes is None else values.codes == IS_NUMBER
    held &= ~np.isnan(values.numbers)
    unique, places = np.unique(values.numbers[held], return_inverse=True)
    numbers = [code_of(_number(each)) for each in unique.tolist()]
    codes[held] = np.array(numbers, np.intp)[places] if numbers else _OTHER
    if values.codes is not None:
        for code, label in enumerate(values.labels, _FIRST_LABEL):
            if label is not None and not isinstance(label, Replaced):
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
