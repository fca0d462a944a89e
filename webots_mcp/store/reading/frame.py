"""Read the past: rows of a run over an interval as arrays, and what was not read.

A frame has the times of its rows and returns the values of any signal on request. They come from
chunks, which are decompressed then, and from the newest rows, which are in no chunk yet. The
statistics of a chunk (`Frame.zone_map`) are known without opening it.
"""

from __future__ import annotations

import math
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple, TypeVar

from webots_mcp.analysis.arrays import Array, Flags, Indexes, np, time_weights, without_dropouts
from webots_mcp.analysis.summary import unwrap, usable_part
from webots_mcp.signals.naming import Value
from webots_mcp.store import chunk_making
from webots_mcp.store.chunks import (
    EXACT_INTEGERS,
    FIRST_LABEL,
    IS_ABSENT,
    IS_NUMBER,
    SIM_TIMES,
    STATE_COLUMNS,
    STATE_IDS,
    WALL_TIMES,
    Decoded,
    Replaced,
    StateColumns,
    Statistics,
    groups_as_array,
    reached,
    statistics_of,
)
from webots_mcp.store.reading.frame_source import Column, FrameSource, no_statistics
from webots_mcp.store.reading.observed_pose import MARGIN_S, Derived, find_observed, poses_of
from webots_mcp.store.reading.segment import (
    HAS_LOST_ROWS,
    MOST_ROWS,
    Deadline,
    Segment,
    full_rate_parts,
    read_so_far,
)
from webots_mcp.store.reading.unchunked_rows import read_rows, rows_in_no_chunk
from webots_mcp.store.reading.unread import Unread

# Up to this many chunks of times are opened one by one; otherwise all of them at once.
_FEW: Final = 4

_IN: Final = "run_id = ? AND sim_time_s >= ? AND sim_time_s < ?"
_KEPT: Final = (
    "SELECT -id, sim_time_s, wall_time_s, data, replaced FROM kept_state "
    f"WHERE {_IN} ORDER BY sim_time_s, id LIMIT ?"
)


T = TypeVar("T")


class Coded(NamedTuple):
    """The values of any signal as codes.

    Attributes:
        codes: One per row: the index of its value among the labels.
        labels: The values; the first is None, for null and for a missing key.
    """

    codes: Indexes
    labels: list[Value]


@dataclass(frozen=True)
class ZoneMap:
    """Statistics of the chunks of a signal in order, those of the newest rows included.

    All are arrays with one item per chunk; NaN if a chunk has no usable number.

    Attributes:
        first_row: Index of its first row in the frame.
        row_count: Number of its rows, with or without the signal.
        held_count: Number of rows whose state has the signal, even if null.
        value_count: Number of rows with a usable number, or with a text.
        start_s: Simulation time of its first row; `end_s` is that of its last one.
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
        """Return the rows [start, stop) of the wanted chunks; adjacent ones form one span."""
        if not wanted.any():
            return []
        return _spans(np.append(self.first_row, self.first_row[-1:] + self.row_count[-1:]), wanted)


class Frame:
    """Rows of one run in order of simulation time; equal times in the order of their ids.

    Attributes:
        run_id: The run.
        cut_at_s: The time of the last row before the deadline passed, or the start of the range if
            none was read; None if all was read.
    """

    def __init__(
        self, source: FrameSource, start: int, stop: int, cut_at_s: float | None = None
    ) -> None:
        self._source = source
        self._start = start
        self._stop = stop
        self.cut_at_s = cut_at_s
        self.run_id = source.run_id

    def __len__(self) -> int:
        return self._stop - self._start

    def __contains__(self, name: str) -> bool:
        """Return whether a row may have a value of that signal."""
        source = self._source
        is_held = name in source.ids or name in source.columns.values or name in source.derived
        return is_held or source.is_item(name)

    @property
    def new_rows(self) -> StateColumns:
        """Return the rows that are in no chunk yet."""
        return self._source.columns

    @property
    def derived(self) -> Derived:
        """The signals that no row holds, such as a pose by an observer."""
        return self._source.derived

    @property
    def unread(self) -> tuple[Unread, ...]:
        """What could not be read of the values requested so far."""
        return tuple(self._source.unread)

    def unread_of(self, name: str) -> tuple[Unread, ...]:
        """Return what could not be read, without parts that concern only other signals."""
        found = self._source.unread.items()
        return tuple(part for part, of in found if of == name or not isinstance(of, str))

    def was_read(self, name: str | None = None) -> Flags:
        """Return which rows are free of unreadable parts, for the values requested so far.

        Args:
            name: The signal, to ignore damage of other signals.
        """
        read = np.ones(len(self), np.bool_)
        for part in self.unread if name is None else self.unread_of(name):
            read[slice(*self.places([part.start_s, math.nextafter(part.end_s, math.inf)]))] = False
        return read

    @property
    def is_as_stored(self) -> bool:
        """Whether its rows are in the order of their chunks.

        None came late or only in full-rate segments.
        """
        return self._source.order is None

    @property
    def cuts_chunks(self) -> bool:
        """Whether its first or last chunk may have rows outside the frame."""
        return len(self) < self._source.rows

    def parts(self, column: Column) -> Iterator[tuple[int, Decoded]]:
        """Return the values of each chunk with the index of its first row, in no order.

        The frame must be as stored. Chunks without the signal are left out.
        """
        return self._source.values(column, self._start, self._stop)

    def shared(self, key: object, make: Callable[[], T]) -> T:
        """Return what another reader of these rows made of their values, or make it now.

        Args:
            key: Says what it is.
            make: Makes arrays, a tuple of them, or an object that has arrays as attributes.
        """
        return self._source.cached((key, self._start, self._stop), make)

    def forget(self) -> None:
        """Drop the values read so far, if they will not be requested again."""
        self._source.forget()

    @cached_property
    def times(self) -> Array:
        """Simulation time of each row in s."""
        return self._decoded(SIM_TIMES).numbers

    @cached_property
    def weights(self) -> Array | None:
        """Share of the time that each row stands for, with a mean of 1; None if all count equally.

        See `time_weights`.
        """
        return time_weights(self.times)

    def usable_weights(self, name: str) -> Array | None:
        """Return the weights of the rows that `usable` gives."""
        if self.weights is None:
            return None
        return usable_part(self.weights, self.numbers(name))[0]

    @cached_property
    def wall_times(self) -> Array:
        """Unix time of each row in s."""
        return self._decoded(WALL_TIMES).numbers

    @cached_property
    def ids(self) -> Indexes:
        """The id of each state row; negative for rows that only a full-rate segment has."""
        return self._decoded(STATE_IDS).numbers.astype(np.intp)

    def numbers(self, name: str) -> Array:
        """Return the number of a signal in each row: NaN where it has none; flags are 0 and 1."""
        return self._decoded(name).numbers

    def bridged(self, name: str, turn: float | None = None) -> Array:
        """Return numbers as `numbers` does, with straight lines in place of short dropouts.

        Args:
            name: The signal.
            turn: A whole turn of an angle, which is unwrapped; None for other signals.
        """

        def make() -> Array:
            numbers = self.numbers(name)
            return without_dropouts(unwrap(numbers, turn) if turn else numbers, self.times)

        return self.shared(("bridged", name, turn), make)

    def usable(self, name: str) -> tuple[Array, Array]:
        """Return times and numbers of the rows with a usable one: not NaN and not beyond 1e100."""
        return usable_part(self.times, self.numbers(name))

    def recorded(self, name: str) -> Decoded:
        """Return the values as recorded, with absent, null and replaced ones distinguished."""
        return self._decoded(name)

    def coded(self, name: str) -> Coded:
        """Return the values of any signal as codes."""
        return self._coded(name, numbers=True)

    def texts(self, name: str) -> Coded:
        """Return codes of texts alone, like `coded`: numbers and flags have the code of None."""
        return self._coded(name, numbers=False)

    def held(self, name: str) -> Flags:
        """Return the rows whose state has the signal, even if null."""
        codes = self._decoded(name).codes
        return np.ones(len(self), np.bool_) if codes is None else codes != IS_ABSENT

    def values(self, name: str) -> list[Value]:
        """Return the values as Python objects, slowly, for a few rows. Replaced values are None."""
        codes, labels = self.coded(name)
        return [labels[code] for code in codes.tolist()]

    def values_at(self, name: str, rows: Indexes) -> list[Value]:
        """Return the values in some rows, in order; each chunk is opened once."""
        edges = self._edges
        chunks = np.searchsorted(edges, rows, "right") - 1
        found: list[Value] = []
        for chunk in np.unique(chunks).tolist():
            codes, labels = self.rows(int(edges[chunk]), int(edges[chunk + 1])).coded(name)
            inside = rows[chunks == chunk] - edges[chunk]
            found += [labels[code] for code in codes[inside].tolist()]
        return found

    def replaced(self, name: str) -> Counter[str]:
        """Return how often each value that JSON cannot hold (nan, inf, ...) stood there."""
        zones, found = self.zone_map(name), Counter[str]()
        for span in zones.spans(zones.held_count > zones.value_count):
            values = self.rows(*span)._decoded(name)
            for code, label in enumerate(values.labels, FIRST_LABEL):
                if isinstance(label, Replaced) and values.codes is not None:
                    found[label.why] += int(np.count_nonzero(values.codes == code))
        return +found

    def zone_map(self, name: str) -> ZoneMap:
        """Return the statistics of a signal's chunks.

        Chunks that the frame cuts are recalculated.
        """
        key = ("zones", name, self._start, self._stop)
        return self._source.cached(key, lambda: self._make_zone_map(name))

    def whole_statistics(self) -> dict[str, Statistics] | None:
        """Return the statistics of all signals of a short run that one group of chunks holds.

        Return None for other frames and for those that do not hold the whole group.
        """
        return None if self.cuts_chunks else self._source.whole_statistics()

    def opened(self, name: str, wanted: Flags) -> Iterator[tuple[int, Array]]:
        """Yield the numbers of those chunks that have any, each with its first row."""
        if self._source.order is None and np.count_nonzero(wanted) * _FEW < len(wanted):
            first = self._source.parts(self._start, self._stop).start
            parts = first + np.flatnonzero(wanted)
            for at, values in self._source.values(name, self._start, self._stop, parts):
                yield at, values.numbers
            return
        for start, stop in _spans(self._edges, wanted):
            yield start, self.numbers(name)[start:stop]

    @property
    def bounds_s(self) -> tuple[float, float]:
        """Simulation time of its first and last row; the frame must have rows."""
        first, last = self.rows(0, 1), self.rows(len(self) - 1, len(self))
        return float(first.times[0]), float(last.times[0])

    def places(self, times_s: Array | Sequence[float]) -> Indexes:
        """Return the indexes of the first rows at or after some times, opening few chunks."""
        wanted: Array = np.asarray(times_s, np.float64)
        source = self._source
        parts = np.searchsorted(source.ends_s, wanted)
        inside = np.append(source.starts_s, math.inf)[parts] < wanted
        opened = np.unique(parts[inside])
        is_known = source.order is not None or "times" in self.__dict__
        if is_known or len(opened) * _FEW >= len(source.starts_s):
            return np.searchsorted(self.times, wanted)
        found = source.first_rows[parts]
        for first, times in source.values(SIM_TIMES, 0, source.rows, opened):
            here = inside & (source.first_rows[parts] == first)
            found[here] += np.searchsorted(times.numbers, wanted[here])
        return np.minimum(np.maximum(found - self._start, 0), len(self))

    def rows(self, start: int, stop: int) -> Frame:
        """Return some of its rows by index; only the chunks that they touch are opened."""
        start, stop = max(0, start), min(len(self), stop)
        part = Frame(self._source, self._start + start, self._start + max(start, stop))
        if "times" in self.__dict__:
            part.__dict__["times"] = self.times[start : max(start, stop)]
        return part

    def between(self, start_s: float, end_s: float) -> Frame:
        """Return its rows in [start_s, end_s) of simulation time."""
        start, stop = self.places([start_s, end_s]).tolist()
        return self.rows(start, stop)

    def bounds_of_wall_times(self) -> tuple[Indexes, Array, Array]:
        """Return the edges of its chunks, and the minimum and maximum wall time of each.

        A time that is unknown is NaN.
        """
        edges, source = self._edges, self._source
        if source.order is not None:
            unknown: Array = np.full(len(edges) - 1, np.nan)
            return edges, unknown, unknown
        table = source.statistics(WALL_TIMES)[source.parts(self._start, self._stop)]
        least, greatest = (Statistics._fields.index(end) for end in ("min", "max"))
        return edges, table[:, least], table[:, greatest]

    def _decoded(self, column: Column) -> Decoded:
        """Return all values; those of several chunks share their labels."""
        if (part := self._part_of_whole(column)) is not None:
            return part
        key = ("values", column, self._start, self._stop)
        return self._source.cached(key, lambda: self._decode(column))

    def _decode(self, column: Column) -> Decoded:
        source, order = self._source, self._source.order
        start, stop = (self._start, self._stop) if order is None else (0, source.rows)
        numbers, plain = np.empty(stop - start), list[slice]()
        coded: list[tuple[slice, Indexes]] = []
        known: dict[object, int] = {}  # a flag equals a number, so the key contains the type
        labels: list[Value | Replaced] = []
        edges = source.edges
        written, others = source.fill(column, start, numbers)
        plain += [slice(edges[part] - start, edges[part + 1] - start) for part in written]
        of_others = source.values(column, start, stop, others, numbers) if len(others) else ()
        for at, values in of_others:
            inside = slice(at, at + len(values.numbers))
            if values.numbers.base is not numbers:
                numbers[inside] = values.numbers
            if values.codes is None:
                plain.append(inside)
                continue
            for label in values.labels:
                if known.setdefault((type(label), label), len(labels)) == len(labels):
                    labels.append(label)
            shared = [known[type(each), each] + FIRST_LABEL for each in values.labels]
            codes_there = values.codes
            if shared != list(range(FIRST_LABEL, FIRST_LABEL + len(shared))):
                codes_there = np.array([IS_NUMBER, IS_ABSENT, *shared], np.intp)[codes_there]
            coded.append((inside, codes_there))
        codes: Indexes | None = None
        if coded or sum(each.stop - each.start for each in plain) < len(numbers):
            codes = np.full(len(numbers), IS_ABSENT, np.intp)
            for inside, found in [*((each, IS_NUMBER) for each in plain), *coded]:
                codes[inside] = found
            numbers[codes == IS_ABSENT] = np.nan
        if order is not None:
            rows = order[self._start : self._stop]
            numbers, codes = numbers[rows], None if codes is None else codes[rows]
        numbers.flags.writeable = False  # others may hold the same
        return Decoded(numbers, codes, labels)

    def _part_of_whole(self, column: Column) -> Decoded | None:
        """Return the numbers from those of all rows of the source, if they are known already.

        A frame with fewer rows may use them only if all rows were read without errors: otherwise
        what could not be read may lie in rows that only the other frame has.
        """
        source, own = self._source, (self._start, self._stop)
        for first, stop in source.frames:
            if (first, stop) == own or not first <= own[0] <= own[1] <= stop:
                continue
            key = ("values", column, first, stop)
            find = source.known if (first, stop) == source.bounds else source.known_whole
            whole: Decoded | None = find(key)
            if whole is not None and whole.codes is None:
                return Decoded(whole.numbers[own[0] - first : own[1] - first], None, ())
        return None

    def _coded(self, name: str, *, numbers: bool) -> Coded:
        """Return codes from 1 on; numbers get labels as well if they are wanted."""
        key = ("coded", name, numbers, self._start, self._stop)
        values = self._decoded(name)
        return self._source.cached(key, lambda: _coded(values, numbers=numbers))

    @property
    def _edges(self) -> Indexes:
        """Return the first row of each chunk that it touches and the end, or every 1,024th row."""
        if self._source.order is not None:
            return np.append(np.arange(0, len(self), chunk_making.GROUP_ROWS), len(self))
        parts = self._source.parts(self._start, self._stop)
        edges = self._source.first_rows[parts.start : parts.stop + 1]
        return np.minimum(np.maximum(edges, self._start), self._stop) - self._start

    @cached_property
    def _chunks(self) -> tuple[Indexes, Array, Array, list[int]]:
        """Return the edges of its chunks, their first and last times, and which of them it cuts."""
        source, edges = self._source, self._edges
        if source.order is not None:
            starts_s, ends_s = self.times[edges[:-1]], self.times[edges[1:] - 1]
            return edges, starts_s, ends_s, list(range(len(edges) - 1))
        parts = source.parts(self._start, self._stop)
        starts_s, ends_s = (np.array(each[parts]) for each in (source.starts_s, source.ends_s))
        whole = np.diff(source.first_rows[parts.start : parts.stop + 1])
        cut: list[int] = np.flatnonzero(np.diff(edges) < whole).tolist()
        for at in cut:
            rows = self.rows(int(edges[at]), int(edges[at + 1]))
            starts_s[at], ends_s[at] = rows.times[0], rows.times[-1]
        return edges, starts_s, ends_s, cut

    def _make_zone_map(self, name: str) -> ZoneMap:
        edges, starts_s, ends_s, cut = self._chunks
        if self._source.order is None:
            parts = self._source.parts(self._start, self._stop)
            table: Array = np.array(self._source.statistics(name)[parts])
        else:
            table = no_statistics(len(edges) - 1)
        for at in cut:
            rows = self.rows(int(edges[at]), int(edges[at + 1]))
            table[at] = statistics_of(rows._decoded(name))
        figures: dict[str, Array] = dict(zip(Statistics._fields, np.transpose(table), strict=True))
        held: Indexes = figures.pop("row_count").astype(np.intp)
        present: Indexes = figures.pop("value_count").astype(np.intp)
        changed: Indexes = figures.pop("change_count").astype(np.intp)
        return ZoneMap(
            edges[:-1], np.diff(edges), held, present, changed, starts_s, ends_s, **figures
        )


def read_frame(
    connection: sqlite3.Connection,
    segment: Segment,
    deadline: Deadline,
    *,
    full_rate: bool = True,
    every_call: bool = False,
) -> Frame:
    """Read a segment of a run; values are read on request.

    Args:
        connection: An open database, used for as long as the frame is.
        segment: The segment.
        deadline: Until when rows in no chunk are read; the frame reports what is left.
        full_rate: Whether each call of `publish` is a row, for a segment kept at full rate.
        every_call: Whether each call is a row in full-rate segments, for any segment.
    """
    asked = (segment.start_s, segment.end_s, segment.full_rate and full_rate)
    memo = read_so_far(connection).setdefault(("frames", segment.run_id), {})
    if (source := memo.get((*asked, every_call)) or _wider(memo, asked, every_call)) is not None:
        return _framed(source.twin(), segment, None)
    source, cut_at_s = _source_of(
        connection, segment, deadline, full_rate=full_rate, every_call=every_call
    )
    frame = _framed(source, segment, _note_cut(source, segment, cut_at_s))
    if cut_at_s is None:
        memo[(*asked, every_call)] = source.twin()
    return frame


def _wider(
    memo: Mapping[tuple[float, float, bool, bool], FrameSource],
    asked: tuple[float, float, bool],
    every_call: bool,
) -> FrameSource | None:
    """Return the source of a longer segment of the run, if it reads the same."""
    start_s, end_s, at_full_rate = asked
    if at_full_rate or every_call:
        return None
    for (first_s, last_s, *kinds), source in memo.items():
        is_longer = first_s <= start_s and last_s >= end_s
        if is_longer and not any(kinds) and source.may_serve(start_s, end_s):
            return source
    return None


def _source_of(
    connection: sqlite3.Connection,
    segment: Segment,
    deadline: Deadline,
    *,
    full_rate: bool,
    every_call: bool,
) -> tuple[FrameSource, float | None]:
    """Return the source of a segment, and where the deadline cut it."""
    run_id, span = segment.run_id, (segment.start_s, segment.end_s)
    groups: Array = np.zeros((0, 5))
    if full_rate and segment.full_rate:
        columns = StateColumns()
        cut_at_s = read_rows(
            connection,
            f"SELECT {STATE_COLUMNS} FROM state WHERE {_IN} ORDER BY sim_time_s, id",
            (run_id, *span),
            columns,
            deadline,
        )
        if cut_at_s is None:
            cut_at_s = read_rows(connection, _KEPT, (run_id, *span, -1), columns, deadline)
    else:
        at = reached(connection, run_id)
        columns, cut_at_s = rows_in_no_chunk(connection, run_id, span, at, deadline)
        groups = groups_as_array(connection, run_id, *span)
        if every_call and cut_at_s is None:
            columns = columns.part(0, len(columns))
            cut_at_s = read_rows(connection, _KEPT, (run_id, *span, -1), columns, deadline)
    query = (
        "SELECT s.name, s.id FROM run r JOIN signal s ON s.robot_id = r.robot_id WHERE r.id = ? "
        "AND typeof(s.name) = 'text'"
    )
    names = dict(connection.execute(query, (run_id,)).fetchall())
    source = FrameSource(connection, run_id, groups, columns, names)
    source.derived = _observed_pose(connection, segment, columns, deadline)
    if lost := deleted_part(connection, segment):
        source.note(lost, None)
    return source, cut_at_s


def _observed_pose(
    connection: sqlite3.Connection, segment: Segment, columns: StateColumns, deadline: Deadline
) -> Derived:
    """Return the pose of the robot by an observer, if its run has none of its own."""
    found = find_observed(connection, segment.run_id, columns)
    if found is None:
        return {}
    around = Segment(found.run_id, segment.start_s - MARGIN_S, segment.end_s + MARGIN_S)
    return poses_of(found.key, read_frame(connection, around, deadline).usable)


def _note_cut(source: FrameSource, segment: Segment, cut_at_s: float | None) -> float | None:
    """Return where the deadline cut a segment, and note the part after it as unread."""
    if cut_at_s is None or cut_at_s >= segment.end_s:
        return None
    reached_s = max(cut_at_s, segment.start_s)
    source.note(Unread(reached_s, segment.end_s, "time limit reached"), None)
    return reached_s


def deleted_part(connection: sqlite3.Connection, segment: Segment) -> Unread | None:
    """Return the part of a segment whose rows and chunks retention has deleted."""
    # The start of the run, and the start of what is left of it: the oldest rows are deleted first.
    row = connection.execute(
        "SELECT started_sim_time_s, (SELECT min(start_sim_time_s) FROM row_group "
        "WHERE run_id = r.id AND is_complete = 1), (SELECT min(sim_time_s) FROM state "
        f"WHERE run_id = r.id) FROM run r WHERE id = ? AND {HAS_LOST_ROWS}",
        (segment.run_id,),
    ).fetchone()
    if row is None:
        return None
    start_s, *left = (time_s for time_s in row if isinstance(time_s, int | float))
    start_s, end_s = max(start_s, segment.start_s), min([*left, segment.end_s])
    return Unread(start_s, end_s, "deleted by retention") if start_s < end_s else None


def read_kept(connection: sqlite3.Connection, segment: Segment, deadline: Deadline) -> Frame | None:
    """Return the rows of a segment that only full-rate segments have; None if there are none.

    Return None also for a segment that is at full rate itself: `read_frame` includes these rows.
    """
    if segment.full_rate:
        return None
    bounds = (segment.run_id, segment.start_s, segment.end_s)
    if not full_rate_parts(connection, *bounds):
        return None
    columns = StateColumns()
    cut_at_s = read_rows(connection, _KEPT, (*bounds, MOST_ROWS), columns, deadline)
    source = FrameSource(connection, segment.run_id, np.zeros((0, 5)), columns, {})
    source.derived = _observed_pose(connection, segment, columns, deadline)
    cut_at_s = _note_cut(source, segment, cut_at_s)
    return _framed(source, segment, cut_at_s) if len(columns) else None


def _framed(source: FrameSource, segment: Segment, cut_at_s: float | None) -> Frame:
    """Return the rows of a source that lie in a segment, in order."""
    source.bounds = 0, source.rows
    whole = Frame(source, 0, source.rows, cut_at_s)
    if not source.is_in_order and source.order is None:
        ids = whole.ids
        order = np.lexsort((np.abs(ids), whole.wall_times if (ids < 0).any() else ids, whole.times))
        source.order = order
        source.forget()
        whole = Frame(source, 0, source.rows, cut_at_s)
    start, stop = whole.places([segment.start_s, segment.end_s]).tolist()
    if math.isfinite(segment.wall_start_s) or math.isfinite(segment.wall_end_s):
        start, stop = _in_wall_time(whole.rows(start, stop), segment, start)
    source.bounds = start, stop
    source.frames[source.bounds] = None
    return Frame(source, start, stop, cut_at_s)


def _in_wall_time(rows: Frame, segment: Segment, at: int) -> tuple[int, int]:
    """Return the rows from the first to the last one in the wall time of a segment.

    Only the chunks at both ends are opened, if the statistics of the others suffice.

    Args:
        rows: The rows of its simulation time.
        segment: The segment, with its wall time.
        at: The index of their first row.
    """
    edges, first_s, last_s = rows.bounds_of_wall_times()
    # A chunk without known times may have such rows.
    possible = np.flatnonzero(~((last_s < segment.wall_start_s) | (first_s >= segment.wall_end_s)))

    def inside(part: int) -> Indexes:
        walls = rows.rows(int(edges[part]), int(edges[part + 1])).wall_times
        fits = (walls >= segment.wall_start_s) & (walls < segment.wall_end_s)
        return edges[part] + np.flatnonzero(fits)

    first = next((found for part in possible.tolist() if len(found := inside(part))), None)
    if first is None:
        return at, at
    last = next(found for part in reversed(possible.tolist()) if len(found := inside(part)))
    return at + int(first[0]), at + int(last[-1]) + 1


def _spans(edges: Indexes, wanted: Flags) -> list[tuple[int, int]]:
    """Return the rows [start, stop) between edges that are wanted; adjacent ones form one span."""
    if not wanted.any():
        return []
    if wanted.all():
        return [(int(edges[0]), int(edges[-1]))]
    ends = edges[np.flatnonzero(np.diff(wanted, prepend=False, append=False))].tolist()
    return list(zip(ends[::2], ends[1::2], strict=True))


def _coded(values: Decoded, *, numbers: bool) -> Coded:
    labels: list[Value] = [None]
    codes: Indexes | None = None
    is_number = None if values.codes is None else values.codes == IS_NUMBER
    if numbers and (is_number is None or is_number.any()):
        codes = np.zeros(len(values.numbers), np.intp)
        held = ~np.isnan(values.numbers)
        if is_number is not None:
            held &= is_number
        found = values.numbers[held]
        changes = np.append(True, found[1:] != found[:-1])[: len(found)]  # most stay as they are
        unique, places = np.unique(found[changes], return_inverse=True)
        codes[held] = (places + 1)[np.cumsum(changes) - 1]
        labels += map(_number, unique.tolist())
    if values.codes is not None:
        of_code = np.zeros(len(values.labels) + FIRST_LABEL, np.intp)
        for code, label in enumerate(values.labels, FIRST_LABEL):
            if isinstance(label, str) or (numbers and isinstance(label, bool)):
                of_code[code] = len(labels)
                labels.append(label)
        of_others: Indexes = of_code[values.codes]
        codes = of_others if codes is None else codes + of_others
    return Coded(np.zeros(len(values.numbers), np.intp) if codes is None else codes, labels)


def _number(value: float) -> float:
    return int(value) if value.is_integer() and abs(value) < EXACT_INTEGERS else value
