"""Read the values of a frame part by part, before a range and an order are applied.

A row group is one part, and so are 1,024 rows that are in no chunk. A chunk that cannot be read
costs its part of the range, which is noted under the name of the signal.
"""

from __future__ import annotations

import copy
import sqlite3
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, TypeVar, cast

from webots_mcp.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.signals.naming import REDUCTIONS, array_item
from webots_mcp.store import chunk_making
from webots_mcp.store.chunks import (
    ABSENT,
    SIM_TIMES,
    STATE_IDS,
    WALL_TIMES,
    DamagedChunkError,
    Decoded,
    EncodedChunk,
    StateColumns,
    Statistics,
    chunks_by_signal,
    decoded_of,
    decoded_or_why,
    fill_numbers,
    statistics_by_signal,
    statistics_in,
    statistics_of,
    values_in,
)
from webots_mcp.store.reading.observed_pose import Derived
from webots_mcp.store.reading.unread import Unread

_OF_ITEMS: Final = (
    "SELECT id, json_extract(data, ?), json_array_length(data, ?) FROM {} "
    "WHERE run_id = ? AND id BETWEEN ? AND ? AND json_valid(data)"
)
_ITEMS: Final = _OF_ITEMS.format("state")
_KEPT_ITEMS: Final = _OF_ITEMS.format("kept_state")
_NAMES: Final[dict[Column, str]] = {
    SIM_TIMES: "simulation times",
    WALL_TIMES: "wall times",
    STATE_IDS: "row ids",
}

Column = str | int  # the name of a signal, or a number for other chunks (SIM_TIMES, ...)
T = TypeVar("T")


@dataclass(frozen=True)
class SourceLimits:
    """Limits of reading the values of a frame.

    Attributes:
        cached_bytes: Size of the arrays that one frame caches.
        many_groups: Groups from which on numbers are decoded right into one array.
        few_columns: Columns of a short run that are read one by one.
        group_rows: Rows of a group; far more than any process puts into one.
    """

    cached_bytes: int = 160_000_000
    many_groups: int = 4
    few_columns: int = 4
    group_rows: int = 2**20


_SOURCE: Final = SourceLimits()


class FrameSource:
    """Rows of groups, followed by rows that are in no group.

    Attributes:
        columns: The rows that are in no group.
        first_rows: The first row of each part, followed by the number of rows; `edges` is the same
            as a list.
        starts_s: Simulation time of the first row of each part; `ends_s` of the last one.
        order: The rows ordered by time; None if they already are.
        unread: What could not be read so far, each with its column; None stands for all columns.
        derived: Values at given times of signals that no row holds, by name.
        bounds: The requested rows [start, stop).
        frames: The bounds of all frames that share the arrays of this source.
    """

    def __init__(
        self,
        connection: sqlite3.Connection,
        run_id: int,
        groups: Array,
        columns: StateColumns,
        ids: Mapping[str, int],
    ) -> None:
        self.connection = connection
        self.run_id = run_id
        self.columns = columns
        self.ids = ids
        self.unread: dict[Unread, Column | None] = {}
        self.derived: Derived = {}
        self.order: Indexes | None = None
        self.bounds: tuple[int, int] = (0, 0)
        self.frames: dict[tuple[int, int], None] = {}
        self._cache = _ArrayCache()
        self._columns_read = 0
        self._noting: list[dict[Unread, Column | None]] = []
        groups = self._sound(groups)
        self._group_ids: Indexes = groups[:, 0].astype(np.intp)
        self._ids_of_groups: list[int] = self._group_ids.tolist()
        new = np.arange(0, len(columns), chunk_making.GROUP_ROWS)
        ends = np.minimum(new + chunk_making.GROUP_ROWS, len(columns))
        rows = np.concatenate(([0.0], groups[:, 3], ends - new))
        self.first_rows: Indexes = np.cumsum(rows.astype(np.intp))
        self.edges: list[int] = self.first_rows.tolist()
        times: Array = np.array(columns.times, np.float64)
        self.starts_s: Array = np.append(groups[:, 1], times[new])
        self.ends_s: Array = np.append(groups[:, 2], times[ends - 1])
        steps = np.diff(times)
        # ids of rows from full-rate segments descend
        rising = (steps == 0) & (np.diff(np.array(columns.ids)) > 0)
        self.is_in_order = bool(
            (self.starts_s[1:] >= self.ends_s[:-1]).all()
            and ((steps > 0) | rising).all()
            and not (  # rows that arrived late have greater ids than those before them
                (groups[1:, 1] == groups[:-1, 2]) & (groups[1:, 4] < groups[:-1, 4])
            ).any()
        )

    def _sound(self, groups: Array) -> Array:
        """Return the groups whose row says something possible; the others are noted as unread."""
        counts, starts_s, ends_s = groups[:, 3], groups[:, 1], groups[:, 2]
        sound = (counts >= 1) & (counts <= _SOURCE.group_rows) & (starts_s <= ends_s)
        for _, start_s, end_s, *_ in groups[~sound].tolist():
            self.note(Unread(start_s, end_s, "its row group is damaged"), None)
        return groups[sound]

    @property
    def rows(self) -> int:
        """The number of rows."""
        return self.edges[-1]

    def parts(self, start: int, stop: int) -> slice:
        """Return the parts that have rows in [start, stop)."""
        first = bisect_right(self.edges, start) - 1
        return slice(first, bisect_left(self.edges, stop) if start < stop else first)

    def fill(self, column: Column, start: int, numbers: Array) -> tuple[list[int], Indexes]:
        """Write the numbers of whole groups into an array, where each of their rows holds one.

        Args:
            column: Which values.
            start: The first row.
            numbers: An item for each row from there on.

        Returns:
            The parts that are written, and the others, which `values` reads.
        """
        parts = self.parts(start, start + len(numbers))
        edges, ids = self.edges, self._ids_of_groups
        others: Indexes = np.arange(int(parts.start), int(parts.stop))
        signal_id = self._signal_id(column)
        if signal_id is None or column in self.derived or self.is_item(column):
            return [], others
        into: dict[int, Array] = {}
        places: dict[int, int] = {}
        for place in range(parts.start, min(parts.stop, len(ids))):
            first, behind = edges[place] - start, edges[place + 1] - start
            if first >= 0 and behind <= len(numbers):
                into[ids[place]] = numbers[first:behind]
                places[ids[place]] = place
        if len(into) < _SOURCE.many_groups:
            return [], others
        filled = fill_numbers(self.connection, self.run_id, signal_id, into)
        written = [places[group_id] for group_id in filled]
        return written, others[~np.isin(others, np.array(written, np.intp))]

    def values(
        self,
        column: Column,
        start: int,
        stop: int,
        wanted: Indexes | None = None,
        into: Array | None = None,
    ) -> Iterator[tuple[int, Decoded]]:
        """Yield the values in rows [start, stop), a part at a time, each with its first row.

        Args:
            column: The values to read.
            start: The first row, from which indexes are counted.
            stop: The row after the last.
            wanted: The parts to read; None for all. Parts without values are left out.
            into: Receives the numbers of the rows if they can be decoded directly; the yielded
                arrays are then parts of it.
        """
        parts = self.parts(start, stop)
        places = range(parts.start, parts.stop)
        edges = self.edges
        targets: dict[int, Array] = {}
        if into is not None:
            targets = {
                place: into[edges[place] - start : edges[place + 1] - start]
                for place in places
                if start <= edges[place] and edges[place + 1] <= stop
            }
        asked = places if wanted is None else wanted.tolist()
        for place, values in self._of_parts(column, asked, targets):
            first, behind = edges[place], edges[place + 1]
            if start <= first and behind <= stop:
                yield first - start, values
                continue
            inside = slice(max(0, start - first), stop - first)
            codes = None if values.codes is None else values.codes[inside]
            part = Decoded(values.numbers[inside], codes, values.labels, values.is_whole)
            yield max(0, first - start), part

    def _of_parts(
        self, column: Column, places: Sequence[int], into: Mapping[int, Array] | None = None
    ) -> Iterator[tuple[int, Decoded]]:
        if isinstance(column, str) and column in self.derived:
            for place, times in self._of_parts(SIM_TIMES, places):
                yield place, self.derived[column](times.numbers)
            return
        if isinstance(column, str) and self.is_item(column):
            for place in places:
                yield place, self._item(column, place)
            return
        groups = len(self._group_ids)
        yield from self._of_groups(column, [place for place in places if place < groups], into)
        rows = _of_rows(self.columns, column) or ()
        for place in (each for each in places if each >= groups and len(rows)):
            first = (place - groups) * chunk_making.GROUP_ROWS
            yield place, decoded_of(rows[first : first + chunk_making.GROUP_ROWS])

    def is_item(self, column: Column) -> bool:
        """Return whether a name means one item of a long array, of which no chunk has values."""
        if not isinstance(column, str) or column in self.ids or column in self.columns.values:
            return False
        item = array_item(column)
        count = f"{item[0]}.{REDUCTIONS[0]}" if item else ""
        return bool(count) and (count in self.ids or count in self.columns.values)

    def _item(self, column: str, place: int) -> Decoded:
        """Return one item of an array in the rows of a part, from the states that are kept."""
        return self.cached(("item", column, place), lambda: self._read_item(column, place))

    def _read_item(self, column: str, place: int) -> Decoded:
        array, at = cast("tuple[str, int]", array_item(column))
        ((_, ids),) = self._of_parts(STATE_IDS, [place])
        wanted = ids.numbers.astype(np.intp).tolist()
        span = (float(self.starts_s[place]), float(self.ends_s[place]))
        paths = self.connection.execute(
            "SELECT path FROM signal WHERE robot_id = (SELECT robot_id FROM run WHERE id = ?) "
            "AND name = ?",
            (self.run_id, f"{array}.{REDUCTIONS[0]}"),
        ).fetchone()
        path = f"{paths[0] if paths else _path_of(array)}[{at}]"
        found: dict[int, tuple[Any, Any]] = {}
        for query, sign in ((_ITEMS, 1), (_KEPT_ITEMS, -1)):
            some = [sign * row_id for row_id in wanted if sign * row_id > 0]
            if some:
                asked = (path, path[: path.rindex("[")], self.run_id, min(some), max(some))
                rows = self.connection.execute(query, asked)
                found |= {sign * row_id: (value, count) for row_id, value, count in rows}
        values = [found[row_id][0] if row_id in found else ABSENT for row_id in wanted]
        if gone := sum(row_id not in found for row_id in wanted):
            why = f"{gone} rows were deleted by retention, and single items of {array} with them"
            self.note(Unread(*span, f"{column}: {why}"), column)
        longest = max((count for _, count in found.values() if count is not None), default=None)
        if found and (longest is None or longest <= at):
            why = (
                f"there {array} is no array" if longest is None else f"{array} has {longest} items"
            )
            self.note(Unread(*span, f"{column}: {why}"), column)
        return decoded_of(values)

    def _of_groups(
        self, column: Column, places: Sequence[int], into: Mapping[int, Array] | None
    ) -> Iterator[tuple[int, Decoded]]:
        """Yield the values that the chunks of some groups hold; `into` has arrays for some."""
        signal_id = self._signal_id(column)
        if signal_id is None or not places:
            return
        edges, every_id = self.edges, self._ids_of_groups
        ids = [every_id[place] for place in places]
        of_group = dict(zip(ids, places, strict=True))
        wanted = {every_id[place]: edges[place + 1] - edges[place] for place in places}
        missing = dict(of_group) if signal_id <= SIM_TIMES else {}  # each group has times and ids
        targets: dict[int, Array] = {}
        if into:
            targets = {ids[n]: into[place] for n, place in enumerate(places) if place in into}
        found = self._stored(signal_id, wanted, targets)
        for group_id, values in found:
            missing.pop(group_id, None)
            place = of_group[group_id]
            if isinstance(values, Decoded):
                yield place, values
            elif (instead := self._without_chunk(place, column, values)) is not None:
                yield place, instead
        for place in missing.values():
            instead = self._without_chunk(place, column, DamagedChunkError("missing"))
            if instead is not None:
                yield place, instead

    def _stored(
        self, signal_id: int, wanted: Mapping[int, int], targets: Mapping[int, Array]
    ) -> Iterator[tuple[int, Decoded | DamagedChunkError]]:
        """Yield what `values_in` does; of a short run all chunks are read once many are wanted."""
        self._columns_read += 1
        if len(self._ids_of_groups) > 1 or self._columns_read <= _SOURCE.few_columns:
            yield from values_in(self.connection, self.run_id, signal_id, wanted, targets)
            return
        chunk = self._chunks_of_one_group.get(signal_id)
        if chunk is None:
            return
        for group_id, rows in wanted.items():
            yield group_id, decoded_or_why(chunk, rows, targets.get(group_id))

    @cached_property
    def _chunks_of_one_group(self) -> dict[int, EncodedChunk]:
        """Return the chunks of all signals of a short run, read at once."""
        return chunks_by_signal(self.connection, self.run_id, self._ids_of_groups[0])

    def _signal_id(self, column: Column) -> int | None:
        return self.ids.get(column) if isinstance(column, str) else column

    def _without_chunk(
        self, place: int, column: Column, error: DamagedChunkError
    ) -> Decoded | None:
        """Note a chunk that cannot be read.

        For times and ids return values that keep rows in order.
        """
        span = (float(self.starts_s[place]), float(self.ends_s[place]))
        why = f"the chunk of {_NAMES.get(column, column)} is {error}"
        self.note(Unread(*span, why), column)
        chunk_making.report_damaged_group(self.connection, int(self._group_ids[place]))
        rows = int(self.first_rows[place + 1] - self.first_rows[place])
        evenly: Array = np.linspace(*span, rows)
        if column == SIM_TIMES:
            return Decoded(evenly, None, ())
        if column == WALL_TIMES:
            return Decoded(np.interp(evenly, *self._known_walls()), None, ())
        return Decoded(np.zeros(rows), None, ()) if column == STATE_IDS else None

    def _known_walls(self) -> tuple[Array, Array]:
        """Return simulation and wall times of the ends of parts, as far as statistics have them."""
        table = self.statistics(WALL_TIMES)
        first, last = (Statistics._fields.index(end) for end in ("first", "last"))
        walls: Array = np.append(table[:, first], table[:, last])
        times: Array = np.append(self.starts_s, self.ends_s)
        order = np.argsort(times[~np.isnan(walls)], kind="stable")
        if not len(order):
            return np.zeros(1), np.zeros(1)
        return times[~np.isnan(walls)][order], walls[~np.isnan(walls)][order]

    def statistics(self, column: Column) -> Array:
        """Return the statistics of a signal: a row per part, a column per field of `Statistics`."""
        return self.cached(("statistics", column), lambda: self._statistics(column))

    def _statistics(self, column: Column) -> Array:
        table = no_statistics(len(self.starts_s))
        if column in self.derived or self.is_item(column):
            for place, part in self._of_parts(column, range(len(table))):
                table[place] = statistics_of(part)
            return table
        signal_id = self._signal_id(column)
        if signal_id is not None and signal_id > SIM_TIMES and len(self._group_ids) == 1:
            if signal_id in self._of_one_group:
                table[0] = np.array(self._of_one_group[signal_id], np.float64)
        elif signal_id is not None and len(self._group_ids):
            stored = statistics_in(self.connection, self.run_id, signal_id, self._between)
            at, known = self._places_of(stored[:, 0])
            table[at] = stored[known, 1:]
        values = _of_rows(self.columns, column) or ()
        for at, first in enumerate(range(0, len(values), chunk_making.GROUP_ROWS)):
            part = decoded_of(values[first : first + chunk_making.GROUP_ROWS])
            table[len(self._group_ids) + at] = statistics_of(part)
        return table

    def whole_statistics(self) -> dict[str, Statistics] | None:
        """Return the statistics of all signals where one group has all rows; None elsewhere."""
        if len(self._group_ids) != 1 or len(self.columns) or self.unread or self.derived:
            return None
        found = self._of_one_group
        return {name: found[each] for name, each in self.ids.items() if each in found}

    @cached_property
    def _of_one_group(self) -> dict[int, Statistics]:
        """Return the statistics of all signals of a short run, read at once."""
        return statistics_by_signal(self.connection, self.run_id, int(self._group_ids[0]))

    @property
    def _between(self) -> tuple[int, int]:
        return int(self._group_ids.min()), int(self._group_ids.max())

    def _places_of(self, group_ids: Array) -> tuple[Indexes, Flags]:
        """Return the indexes of groups, and which of the groups have one."""
        order = np.argsort(self._group_ids, kind="stable")
        ids = self._group_ids[order]
        at = np.searchsorted(ids, group_ids)
        known = ids[at] == group_ids
        return order[at[known]], known

    def forget(self) -> None:
        """Drop the arrays that were made so far."""
        self._cache = _ArrayCache()

    def cached(self, key: object, make: Callable[[], T]) -> T:
        """Return what was made under this key before, or make it now.

        What could not be read for it is noted in both cases.
        """
        if (known := self._cache.find(key)) is None:
            self._noting.append({})
            try:
                made = make()
            finally:
                notes = self._noting.pop()
            self._cache.put(key, made, notes)
        else:
            made, notes = known
        for part, column in notes.items():
            self.note(part, column)
        return made

    def known(self, key: object) -> Any:
        """Return what was made under this key before, or None."""
        found = self._cache.find(key)
        if found is None:
            return None
        for part, column in found[1].items():
            self.note(part, column)
        return found[0]

    def known_whole(self, key: object) -> Any:
        """Return what was made under this key before and could be read whole, or None."""
        found = self._cache.find(key)
        return None if found is None or found[1] else found[0]

    def note(self, part: Unread, column: Column | None) -> None:
        """Note what could not be read, of which column; None for all of them."""
        self.unread[part] = column
        for notes in self._noting[-1:]:
            notes[part] = column

    def may_serve(self, start_s: float, end_s: float) -> bool:
        """Return whether a source of [start_s, end_s) alone would read the same, at the same cost.

        This source covers a longer time. Rows in no chunk are divided into parts from the first one
        on, so all of them must be requested. The statistics of a signal are read for all groups, so
        at least half of them must be requested.
        """
        if self.unread or self.derived or self.order is not None or not self.is_in_order:
            return False
        times = self.columns.times
        if len(times) and not (start_s <= times[0] and times[-1] < end_s):
            return False
        touched = np.count_nonzero((self.ends_s >= start_s) & (self.starts_s < end_s))
        return 2 * int(touched) >= len(self.starts_s)

    def twin(self) -> FrameSource:
        """Return a source that shares all arrays but only reports what itself could not read."""
        other = copy.copy(self)
        other.unread = {part: of for part, of in self.unread.items() if of is None}
        other._noting = []
        return other


class _ArrayCache:
    """Arrays by key, up to `_SOURCE.cached_bytes`; the least recently used are dropped.

    Each is stored with what could not be read for it.
    """

    def __init__(self) -> None:
        self._made: OrderedDict[object, tuple[Any, dict[Unread, Column | None], int]] = (
            OrderedDict()
        )
        self._bytes = 0

    def find(self, key: object) -> tuple[Any, dict[Unread, Column | None]] | None:
        """Return what is cached under a key, or None."""
        if key not in self._made:
            return None
        self._made.move_to_end(key)
        return self._made[key][:2]

    def put(self, key: object, made: object, notes: dict[Unread, Column | None]) -> None:
        """Cache what was made."""
        size = _bytes_of(made)
        self._made[key] = made, notes, size
        self._bytes += size
        while self._bytes > _SOURCE.cached_bytes and len(self._made) > 1:
            _, (_, _, freed) = self._made.popitem(last=False)
            self._bytes -= freed


def _bytes_of(made: object) -> int:
    """Return the size of an array, or of the arrays that make up a tuple or an object."""
    if isinstance(made, np.ndarray):
        return int(made.nbytes)
    parts = cast("Sequence[object]", made) if isinstance(made, tuple) else vars(made).values()
    return sum(int(getattr(part, "nbytes", 0)) for part in parts)


def _path_of(name: str) -> str:
    """Return the JSON path of a dotted name that is not registered yet."""
    return "$" + "".join(f'."{part}"' for part in name.split("."))


def no_statistics(parts: int) -> Array:
    """Return the statistics of a signal that none of these parts has."""
    table: Array = np.full((parts, len(Statistics._fields)), np.nan)
    table[:] = np.array(Statistics(0, 0), np.float64)
    return table


def _of_rows(columns: StateColumns, column: Column) -> Sequence[Any] | None:
    """Return the values of rows that are in no chunk; None if none of them has one."""
    if isinstance(column, str):
        return columns.values.get(column)
    of_row = {SIM_TIMES: columns.times, WALL_TIMES: columns.wall_times, STATE_IDS: columns.ids}
    return of_row[column] if len(columns) else None
