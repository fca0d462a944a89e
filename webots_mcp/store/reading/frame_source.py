"""Where the values of a frame come from: the chunks of some groups, and rows that are in none."""

from __future__ import annotations

import math
import sqlite3
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple, TypeVar, cast

from webots_mcp.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.store import chunk_making
from webots_mcp.store.chunks import (
    SIM_TIMES,
    STATE_COLUMNS,
    STATE_IDS,
    WALL_TIMES,
    ChunkProgress,
    DamagedChunkError,
    Decoded,
    StateColumns,
    Statistics,
    decoded_of,
    groups_with_steps,
    statistics_in,
    statistics_of,
    values_in,
)
from webots_mcp.store.reading.observed_pose import Derived
from webots_mcp.store.reading.segment import Deadline
from webots_mcp.store.run_rows import reading_texts

_MOST_ROWS: Final = 2**20  # of a group: no maker puts more than 1,024 into one
NOT_READ: Final = "not read from"  # how what says that a part is not in a frame begins
MOST_CACHED_BYTES: Final = 80_000_000  # of values that a frame caches
Column = str | int  # the name of a signal, or what has a chunk of its own (SIM_TIMES, ...)
T = TypeVar("T")

_NAMES: Final[dict[Column, str]] = {
    SIM_TIMES: "simulation times",
    WALL_TIMES: "wall times",
    STATE_IDS: "row ids",
}
_ROWS_OF: Final = (
    f"SELECT {STATE_COLUMNS} FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s <= ? "
    "ORDER BY sim_time_s, id"
)
ROWS_AT_ONCE: Final = 1024  # between two looks at the deadline
MOST_ROWS_CACHED: Final = 4096  # of one run; more are there only where nobody makes chunks
MOST_RUNS_CACHED: Final = 16
_IN: Final = "sim_time_s >= ? AND sim_time_s < ?"
_NEWEST: Final = (
    f"SELECT {STATE_COLUMNS} FROM state WHERE run_id = ? AND (sim_time_s, id) > (?, ?) "
    "ORDER BY sim_time_s, id"
)
_NEWEST_IN: Final = (
    f"SELECT {STATE_COLUMNS} FROM state WHERE run_id = ? AND {_IN} AND (sim_time_s, id) > (?, ?) "
    "ORDER BY sim_time_s, id"
)
_LATE: Final = (
    f"SELECT {STATE_COLUMNS} FROM state WHERE +run_id = ? AND id > ? AND {_IN} "
    "AND (sim_time_s, id) <= (?, ?) ORDER BY sim_time_s, id"
)
_FEWER_THAN: Final = (
    "SELECT count(*) FROM (SELECT 1 FROM state WHERE run_id = ? AND (sim_time_s, id) > (?, ?) "
    "LIMIT ?)"
)
_ONE_BETWEEN: Final = (  # came late into what was parsed before
    "SELECT EXISTS (SELECT 1 FROM state WHERE run_id = ? AND (sim_time_s, id) > (?, ?) "
    "AND (sim_time_s, id) < (?, ?) AND id > ?)"
)
_RUN: Final = "SELECT uuid FROM run WHERE id = ?"
_FILE: Final = "SELECT file FROM pragma_database_list WHERE name = 'main'"
_SHADOWED: Final = "SELECT EXISTS (SELECT 1 FROM temp.sqlite_master WHERE name = 'state')"


class Unread(NamedTuple):
    """A part of what was asked for that is not in a frame: [start_s, end_s], and why."""

    start_s: float
    end_s: float
    why: str

    def __str__(self) -> str:
        return f"{NOT_READ} {self.start_s:.3f} to {self.end_s:.3f} s: {self.why}"


class FrameSource:
    """Rows of groups, then rows that are in none, before a range and an order are laid over them.

    They are in parts: each group is one, and so are 1,024 of the others.

    Attributes:
        columns: The rows that are in no group.
        first_rows: Of each part, and how many rows there are in all.
        starts_s: Simulation time of the first row of each part; `ends_s` of the last one.
        order: The rows in order of time; None where they are.
        unread: What could not be read so far, each of which column: None of all.
        derived: Signals that no row holds, by name: their values at some times.
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
        sound = (groups[:, 3] >= 1) & (groups[:, 3] <= _MOST_ROWS) & (groups[:, 1] <= groups[:, 2])
        for _, start_s, end_s, *_ in groups[~sound].tolist():
            self.unread[Unread(start_s, end_s, "its row group is damaged")] = None
        groups = groups[sound]
        self._group_ids: Indexes = groups[:, 0].astype(np.intp)
        new = np.arange(0, len(columns), chunk_making.GROUP_ROWS)
        ends = np.minimum(new + chunk_making.GROUP_ROWS, len(columns))
        rows = np.concatenate(([0.0], groups[:, 3], ends - new))
        self.first_rows: Indexes = np.cumsum(rows.astype(np.intp))
        times: Array = np.array(columns.times, np.float64)
        self.starts_s: Array = np.append(groups[:, 1], times[new])
        self.ends_s: Array = np.append(groups[:, 2], times[ends - 1])
        steps = np.diff(times)
        rising = (steps == 0) & (np.diff(np.array(columns.ids)) > 0)  # those of kept rows fall
        self.is_in_order = bool(
            (self.starts_s[1:] >= self.ends_s[:-1]).all()
            and ((steps > 0) | rising).all()
            and not (  # what came late has greater ids than what stood there before
                (groups[1:, 1] == groups[:-1, 2]) & (groups[1:, 4] < groups[:-1, 4])
            ).any()
        )
        self._cache: OrderedDict[object, Any] = OrderedDict()
        self._cached_bytes = 0

    @property
    def rows(self) -> int:
        """How many there are."""
        return int(self.first_rows[-1])

    def parts(self, start: int, stop: int) -> slice:
        """The parts that have rows in [start, stop)."""
        first = int(np.searchsorted(self.first_rows, start, "right")) - 1
        return slice(first, int(np.searchsorted(self.first_rows, stop)) if start < stop else first)

    def values(
        self, column: Column, start: int, stop: int, wanted: Indexes | None = None
    ) -> Iterator[tuple[int, Decoded]]:
        """The values in rows [start, stop), a part at a time, each with its place from start on.

        Args:
            column: What values.
            start: The first row.
            stop: The row behind the last.
            wanted: Which of the parts; None for all. Those that have no values are left out.
        """
        parts = self.parts(start, stop)
        places = range(parts.start, parts.stop)
        for place, values in self._of_parts(column, places if wanted is None else wanted.tolist()):
            first, behind = self.first_rows[place : place + 2].tolist()
            if start <= first and behind <= stop:
                yield first - start, values
            else:
                yield max(0, first - start), _cut(values, max(0, start - first), stop - first)

    def _of_parts(self, column: Column, places: Sequence[int]) -> Iterator[tuple[int, Decoded]]:
        if isinstance(column, str) and column in self.derived:
            for place, times in self._of_parts(SIM_TIMES, places):
                yield place, self.derived[column](times.numbers)
            return
        groups = len(self._group_ids)
        of_group = {int(self._group_ids[place]): place for place in places if place < groups}
        signal_id, connection = self._signal_id(column), self.connection
        if signal_id is not None and of_group:
            sizes = np.diff(self.first_rows)
            wanted = {group_id: int(sizes[place]) for group_id, place in of_group.items()}
            found = values_in(connection, self.run_id, signal_id, wanted)
            if signal_id <= SIM_TIMES:  # each group has times and ids
                found = _with_missing(found, wanted)
            for group_id, values in found:
                place = of_group[group_id]
                if isinstance(values, DamagedChunkError):
                    values = self._from_rows(connection, place, column, values)
                if values is not None:
                    yield place, values
        rows = _of_rows(self.columns, column) or ()
        for place in (each for each in places if each >= groups and len(rows)):
            first = (place - groups) * chunk_making.GROUP_ROWS
            yield place, decoded_of(rows[first : first + chunk_making.GROUP_ROWS])

    def _signal_id(self, column: Column) -> int | None:
        return self.ids.get(column) if isinstance(column, str) else column

    def _from_rows(
        self, connection: sqlite3.Connection, place: int, column: Column, error: DamagedChunkError
    ) -> Decoded | None:
        """What the rows of a damaged chunk say, where they are all there; else it is not read."""
        columns, span = StateColumns(), (float(self.starts_s[place]), float(self.ends_s[place]))
        columns.add(connection.execute(_ROWS_OF, (self.run_id, *span)).fetchall())
        rows = int(self.first_rows[place + 1] - self.first_rows[place])
        if len(columns) == rows:
            values = _of_rows(columns, column)
            if values is not None:
                return decoded_of(values)
        said = _NAMES.get(column, column)
        self.unread[Unread(*span, f"the chunk of {said} is {error}")] = column
        evenly: Array = np.linspace(*span, rows)
        if column == SIM_TIMES:  # so they keep the rows in order
            return Decoded(evenly, None, ())
        if column == WALL_TIMES:
            return Decoded(np.interp(evenly, *self._known_walls()), None, ())
        return Decoded(np.zeros(rows), None, ()) if column == STATE_IDS else None

    def _known_walls(self) -> tuple[Array, Array]:
        """Simulation and wall times of the first and last rows of parts, by their statistics."""
        table = self.statistics(WALL_TIMES)
        first, last = (Statistics._fields.index(end) for end in ("first", "last"))
        walls: Array = np.append(table[:, first], table[:, last])
        times: Array = np.append(self.starts_s, self.ends_s)
        order = np.argsort(times[~np.isnan(walls)], kind="stable")
        if not len(order):
            return np.zeros(1), np.zeros(1)
        return times[~np.isnan(walls)][order], walls[~np.isnan(walls)][order]

    def statistics(self, column: Column) -> Array:
        """What a signal comes to: a row for each part, a column for each field of `Statistics`."""
        return self.cached(("statistics", column), lambda: self._statistics(column))

    def _statistics(self, column: Column) -> Array:
        table = nothing(len(self.starts_s))
        if column in self.derived:
            for place, part in self._of_parts(column, range(len(table))):
                table[place] = statistics_of(part)
            return table
        signal_id = self._signal_id(column)
        if signal_id is not None and len(self._group_ids):
            stored = statistics_in(self.connection, self.run_id, signal_id, self._between)
            at, known = self._places_of(stored[:, 0])
            table[at] = stored[known, 1:]
        values = _of_rows(self.columns, column) or ()
        for at, first in enumerate(range(0, len(values), chunk_making.GROUP_ROWS)):
            part = decoded_of(values[first : first + chunk_making.GROUP_ROWS])
            table[len(self._group_ids) + at] = statistics_of(part)
        return table

    def with_long_steps(self, longer_s: float) -> Flags:
        """In which parts two rows that follow each other are further apart in simulation time."""
        between = self.starts_s[1:] - self.ends_s[:-1] > longer_s
        found = np.append(between, False) | np.append(False, between)
        found[len(self._group_ids) :] = True
        if len(self._group_ids):
            asked = (self.run_id, SIM_TIMES, self._between, longer_s)
            ids = groups_with_steps(self.connection, *asked)
            found[self._places_of(np.array(ids, np.float64))[0]] = True
        return found

    @property
    def _between(self) -> tuple[int, int]:
        return int(self._group_ids.min()), int(self._group_ids.max())

    def _places_of(self, group_ids: Array) -> tuple[Indexes, Flags]:
        """The places of groups, and which of the groups have one."""
        order = np.argsort(self._group_ids, kind="stable")
        ids = self._group_ids[order]
        at = np.searchsorted(ids, group_ids)
        known = ids[at] == group_ids
        return order[at[known]], known

    def forget(self) -> None:
        """Forget what was made."""
        self._cache.clear()
        self._cached_bytes = 0

    def cached(self, key: object, make: Callable[[], T]) -> T:
        """What was made before, or is made now; what was used longest ago makes room for it."""
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key][0]
        made = make()
        self._cache[key] = made, (size := _bytes_of(made))
        self._cached_bytes += size
        while self._cached_bytes > MOST_CACHED_BYTES and len(self._cache) > 1:
            _, (_, freed) = self._cache.popitem(last=False)
            self._cached_bytes -= freed
        return made


def _bytes_of(made: object) -> int:
    """Of an array, or of those that make it up."""
    if isinstance(made, np.ndarray):
        return int(made.nbytes)
    parts = cast("Sequence[object]", made) if isinstance(made, tuple) else vars(made).values()
    return sum(int(getattr(part, "nbytes", 0)) for part in parts)


def nothing(parts: int) -> Array:
    """The statistics of a signal that is in none of so many parts."""
    table: Array = np.full((parts, len(Statistics._fields)), np.nan)
    table[:] = np.array(Statistics(0, 0), np.float64)
    return table


def _with_missing(
    found: Iterator[tuple[int, Decoded | DamagedChunkError]], wanted: Mapping[int, int]
) -> Iterator[tuple[int, Decoded | DamagedChunkError]]:
    """What was found in some groups, and an error of each in which nothing was."""
    missing = dict.fromkeys(wanted)
    for group_id, values in found:
        missing.pop(group_id, None)
        yield group_id, values
    for group_id in missing:
        yield group_id, DamagedChunkError("missing")


def _of_rows(columns: StateColumns, column: Column) -> Sequence[Any] | None:
    """The values of rows that are in no chunk; None where none of them has one."""
    if isinstance(column, str):
        return columns.values.get(column)
    of_row = {SIM_TIMES: columns.times, WALL_TIMES: columns.wall_times, STATE_IDS: columns.ids}
    return of_row[column] if len(columns) else None


def _cut(values: Decoded, start: int, stop: int) -> Decoded:
    codes = None if values.codes is None else values.codes[start:stop]
    return Decoded(values.numbers[start:stop], codes, values.labels, values.is_whole)


# -- rows in no chunk: the newest ones, and those that came late -----------------------------------
#
# Parsing them is what a question about a running robot costs, so that the newest are cached
# between questions, and only what has come since is read.


Read = tuple[StateColumns, "float | None"]


class _Cached(NamedTuple):
    place: tuple[float, int]  # after which the rows begin
    columns: StateColumns


_cache: OrderedDict[tuple[str, str], _Cached] = OrderedDict()
_lock = threading.Lock()


def rows_in_no_chunk(
    connection: sqlite3.Connection,
    run_id: int,
    span: tuple[float, float],
    at: ChunkProgress,
    deadline: Deadline,
) -> Read:
    """Rows of a run that are in no chunk, in order: all in [start, end), and maybe newer ones.

    Args:
        connection: Any.
        run_id: The run.
        span: Start and end, simulation times in s.
        at: Up to where the run is in chunks.
        deadline: For all reading.

    Returns:
        The rows, and the time of the last one where the deadline passed before all were read.
    """
    place = (at.end_s, at.last_state_id)
    columns, cut_s = StateColumns(), None
    if at.end_s != -math.inf:  # else nothing came late, and all rows of the file would be read
        late = (run_id, at.max_state_id, *span, *place)
        cut_s = read_rows(connection, _LATE, late, columns, deadline)
    if cut_s is not None or span[1] < at.end_s:
        return columns, cut_s
    key = _key(connection, run_id) if has_few_new_rows(connection, run_id, at) else None
    if key is None or len(columns):
        # SQLite would go through all rows from the start of the range rather than from the place.
        after = (max(span[0], at.end_s), span[1])
        cut_s = read_rows(connection, _NEWEST_IN, (run_id, *after, *place), columns, deadline)
        return columns, cut_s
    with _lock:
        return _cached_rows(connection, run_id, key, place, deadline)


def has_few_new_rows(connection: sqlite3.Connection, run_id: int, at: ChunkProgress) -> bool:
    """Whether a run has so few rows after those in chunks that they are cached."""
    asked = (run_id, at.end_s, at.last_state_id, MOST_ROWS_CACHED + 1)
    return bool(connection.execute(_FEWER_THAN, asked).fetchone()[0] <= MOST_ROWS_CACHED)


def _cached_rows(
    connection: sqlite3.Connection,
    run_id: int,
    key: tuple[str, str],
    place: tuple[float, int],
    deadline: Deadline,
) -> Read:
    """The newest rows: those that were parsed before, and those that have come since."""
    cached = _cache.pop(key, None)
    columns = StateColumns()
    if cached is not None and cached.place == place and len(cached.columns):
        last = (cached.columns.times[-1], cached.columns.ids[-1])
        asked = (run_id, *place, *last, max(cached.columns.ids))
        if not connection.execute(_ONE_BETWEEN, asked).fetchone()[0]:
            columns = cached.columns
    after = (columns.times[-1], columns.ids[-1]) if len(columns) else place
    cut_s = read_rows(connection, _NEWEST, (run_id, *after), columns, deadline)
    _cache[key] = _Cached(place, columns)
    while len(_cache) > MOST_RUNS_CACHED:
        _cache.popitem(last=False)
    return columns.part(0, len(columns)), cut_s


def read_rows(
    connection: sqlite3.Connection,
    query: str,
    values: tuple[object, ...],
    columns: StateColumns,
    deadline: Deadline,
) -> float | None:
    """Add the rows of a query; the time of the last one where the deadline passed before its end.

    Without a row it is minus infinity. The first of the values is the run.
    """
    with reading_texts(connection):
        cursor = connection.execute(query, values)
        while rows := cursor.fetchmany(ROWS_AT_ONCE):
            if deadline.passed:
                return columns.times[-1] if len(columns) else float("-inf")
            columns.add(rows, f"run {values[0]}: ")
    return None


def _key(connection: sqlite3.Connection, run_id: int) -> tuple[str, str] | None:
    """Which run of which file it is; None where what is read now is not what others will read."""
    file, run = connection.execute(_FILE).fetchone(), connection.execute(_RUN, (run_id,)).fetchone()
    if not file or not file[0] or not run or not isinstance(run[0], str):
        return None
    return None if connection.execute(_SHADOWED).fetchone()[0] else (file[0], run[0])
