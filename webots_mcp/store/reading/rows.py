"""Reading state rows as columns: one list of times, and one list of values per signal."""

from __future__ import annotations

import contextlib
import json
import math
import sqlite3
from array import array
from collections import Counter
from collections.abc import Collection, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

from webots_mcp.naming import Value, flatten
from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.analysis.summary import aligned_numbers, usable_part
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.kept import kept_parts
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.rollup.batch import is_replaced, replaced_names
from webots_mcp.store.run_rows import State
from webots_mcp.store.signals.flatten import parse, reductions, shown
from webots_mcp.store.signals.registry import Signal

orjson: Any
try:
    import orjson
except ImportError:
    orjson = None

RAW_ROWS: Final = 30_000  # 2 to 3 us each: what a question may read without rollups
MAX_EXTRACTED: Final = 99  # with the row 100, as many arguments as a function of SQLite has

_IN_SEGMENT: Final = (
    "WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ? "
    "AND wall_time_s >= ? AND wall_time_s < ? AND id > ?"  # of each table its own ids
)
# Of a kept stretch; each part comes in the order of its index, and the rows that only it has with
# negative ids.
_STATES: Final = (("id", "state"),)
_EVERY_STATE: Final = (*_STATES, ("-id", "kept_state"))
_PLACE: Final = "sim_time_s, wall_time_s, abs(row_id), row_id"  # among the rows of both
KEPT_STATES: Final = (("-id", "kept_state"),)
_FEWER_THAN: Final = (
    "SELECT count(*) FROM (SELECT 1 FROM state WHERE run_id = ? AND sim_time_s >= ? "
    "AND sim_time_s < ? LIMIT ?)"
)
_PURGED_IN: Final = (  # before the first row that is left
    "SELECT 1 FROM run WHERE id = ? AND purged_rows > 0 AND ? < coalesce("
    "(SELECT min(sim_time_s) FROM state WHERE run_id = run.id), last_sim_time_s)"
)
_CHUNK_ROWS: Final = 2000
_BRANCHES: Final = frozenset({list, dict})  # of a state: no values


@dataclass
class Columns:
    """State rows of one run, in order.

    Attributes:
        values: Per signal one value per row; None where the row has none.
        replaced: Per signal, how often each value that JSON cannot hold ("nan", "inf") stood there.
        cut_at_s: The deadline passed after this row, or before any where it is the begin of what
            was to be read; None where all was read.
    """

    run_id: int
    ids: list[int] = field(default_factory=list[int])
    times: list[float] = field(default_factory=list[float])
    walls: list[float] = field(default_factory=list[float])
    values: dict[str, list[Value]] = field(default_factory=dict[str, list[Value]])
    replaced: dict[str, Counter[str]] = field(default_factory=dict[str, Counter[str]])
    cut_at_s: float | None = None
    _aligned: dict[str, Array] = field(default_factory=dict[str, Array], repr=False)

    @property
    def cut(self) -> bool:
        """Whether not all rows were read."""
        return self.cut_at_s is not None

    @cached_property
    def moments(self) -> Array:
        """The times, of columns to which nothing is added any more."""
        return np.array(self.times, np.float64)

    def aligned(self, name: str) -> Array:
        """One number per row, NaN where it has none; made once, of columns that are whole."""
        if name not in self._aligned:
            self._aligned[name] = aligned_numbers(self.values[name])
        return self._aligned[name]

    def add(self, later: Columns) -> None:
        """Take in rows of the same signals that come after these."""
        self.ids += later.ids
        self.times += later.times
        self.walls += later.walls
        for name, values in self.values.items():
            values += later.values[name]

    def numbers(self, name: str) -> tuple[Array, Array]:
        """Times and numbers of a numeric signal, of the rows that have a usable one."""
        return usable_part(self.moments, self.aligned(name))


@dataclass(frozen=True)
class Numbers:
    """Numeric signals of rows, in order: a quarter of the memory that `Columns` take.

    Attributes:
        values: Per signal one number per row; NaN where the row has none.
        stretch_rows: How many rows the stretch has in which only these may hold a large step; None
            where these are all of it.
        cut_at_s: As of `Columns`.
    """

    times: Array
    values: dict[str, Array]
    stretch_rows: int | None = None
    cut_at_s: float | None = None

    def of(self, name: str) -> tuple[Array, Array]:
        """Times and numbers of a signal, of the rows that have a usable one."""
        return usable_part(self.times, self.values[name])


def numbers_of(columns: Columns, signals: Sequence[Signal]) -> Numbers:
    """The numbers of some signals."""
    values = {each.name: columns.aligned(each.name) for each in signals}
    return Numbers(columns.moments, values, cut_at_s=columns.cut_at_s)


def exceeds(connection: sqlite3.Connection, segment: Segment) -> bool:
    """Whether a segment has more than 30,000 rows, or rows of which only rollups are left.

    Looks at no more index entries than that.
    """
    if segment.full_rate:
        return False
    bounds = (segment.run_id, segment.start_s, segment.end_s, RAW_ROWS + 1)
    if connection.execute(_FEWER_THAN, bounds).fetchone()[0] > RAW_ROWS:
        return True
    return connection.execute(_PURGED_IN, (segment.run_id, segment.start_s)).fetchone() is not None


def read_columns(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    deadline: Deadline,
    *,
    after: int | State = 0,
    limit: int = -1,
    exact: bool = False,
    tables: Sequence[tuple[str, str]] | None = None,
) -> Columns:
    """Read the rows of a segment, in order, until the deadline.

    Args:
        connection: Any.
        segment: Which rows.
        signals: Which values of them; none for times only.
        deadline: After it no further rows are read, and the answer says that it was cut.
        after: Only rows with greater ids: those after the watermark, or after a page. Of a segment
            at full rate, whose ids do not rise with time, the row before.
        limit: At most so many rows; -1 for all.
        exact: Integers beyond 2^63 as they are, of which floats are made elsewhere.
        tables: `KEPT_STATES` for the rows that only kept stretches have; None for all rows of a
            segment at full rate, else for those that the throttle let through.
    """
    columns = Columns(segment.run_id, values={signal.name: [] for signal in signals})
    read = _read_decoded if exact or _are_decoded(signals) else _read_extracted
    with _until(deadline, connection, columns, segment.start_s):
        read(connection, signals, _rows_of(segment, after, limit, tables), columns, deadline)
    for signal in signals:
        columns.values[signal.name] = cleaned(signal, columns.values[signal.name])
    return columns


def read_numbers(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    deadline: Deadline,
) -> Numbers:
    """The numbers that `read_columns` reads of numeric signals, without their values as a list."""
    if not signals or _are_decoded(signals) or any(signal.reduction for signal in signals):
        return numbers_of(read_columns(connection, segment, signals, deadline), signals)
    columns = Columns(segment.run_id)
    parts: list[Array] = []
    paths = tuple(signal.path for signal in signals)
    with _until(deadline, connection, columns, segment.start_s):
        rows = _rows_of(segment)
        for _, texts in _chunks(connection, rows, extracted("data", paths), columns, deadline):
            parts.append(_numbers_at(signals, texts))
    numbers = np.concatenate(parts, axis=1) if parts else np.empty((len(signals), 0))
    values = {signal.name: row for signal, row in zip(signals, numbers, strict=True)}
    return Numbers(columns.moments, values, cut_at_s=columns.cut_at_s)


def _are_decoded(signals: Sequence[Signal]) -> bool:
    return len(signals) > MAX_EXTRACTED or any(signal.decoded for signal in signals)


@contextlib.contextmanager
def _until(
    deadline: Deadline, connection: sqlite3.Connection, columns: Columns, start_s: float
) -> Generator[None]:
    """What is read inside ends at the deadline, and the columns are cut then."""
    try:
        with deadline.interrupting(connection):
            yield
    except sqlite3.OperationalError:
        if not deadline.passed:
            raise
        columns.cut_at_s = columns.times[-1] if columns.times else start_s


def _rows_of(
    segment: Segment,
    after: int | State = 0,
    limit: int = -1,
    tables: Sequence[tuple[str, str]] | None = None,
) -> _Rows:
    """The rows that are asked of a segment, as `read_columns` explains them."""
    bounds = (segment.run_id, segment.start_s, segment.end_s)
    after_id, place = (after, None) if isinstance(after, int) else (0, after)
    if tables is None:
        tables = _EVERY_STATE if segment.full_rate and after_id == 0 else _STATES
    parameters = (*bounds, segment.wall_start_s, segment.wall_end_s, after_id)
    return _Rows(tables, parameters, limit, place)


def kept_columns(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    deadline: Deadline,
) -> Columns | None:
    """What only kept stretches have of a segment, up to 30,000 rows; None where that is nothing."""
    if not kept_parts(connection, segment.run_id, segment.start_s, segment.end_s):
        return None
    return read_columns(connection, segment, signals, deadline, limit=RAW_ROWS, tables=KEPT_STATES)


@dataclass(frozen=True)
class _Rows:
    """Which rows are read, from which tables: each with what its id is called there."""

    tables: Sequence[tuple[str, str]]
    bounds: tuple[object, ...]
    limit: int
    after: State | None

    def query(self, what: str, paths: Sequence[str] = ()) -> tuple[str, list[object]]:
        """A query for columns after the id, in order, and its values."""
        parts = [
            f"SELECT {key} AS row_id, {what} FROM {table} {_IN_SEGMENT}"
            for key, table in self.tables
        ]
        values = [value for _ in parts for value in (*paths, *self.bounds)]
        order = _PLACE if len(parts) > 1 else "sim_time_s, row_id"
        query = " UNION ALL ".join(parts)
        if self.after is not None:
            row = self.after
            query = f"SELECT * FROM ({query}) WHERE ({_PLACE}) > (?, ?, ?, ?)"
            values += [row.sim_time_s, row.wall_time_s, abs(row.id), row.id]
        elif len(parts) > 1:
            query = f"SELECT * FROM ({query})"  # a union is ordered by its columns only
        return f"{query} ORDER BY {order} LIMIT ?", [*values, self.limit]


def _read_extracted(
    connection: sqlite3.Connection,
    signals: Sequence[Signal],
    asked: _Rows,
    columns: Columns,
    deadline: Deadline,
) -> None:
    """Each path is extracted once, all of a row in one call."""
    paths = tuple(dict.fromkeys(signal.path for signal in signals))
    for replaced, texts in _chunks(connection, asked, extracted("data", paths), columns, deadline):
        by_path = values_at(paths, texts)
        reduced = {
            path: [reductions(array) for array in by_path[path]]
            for path in {signal.path for signal in signals if signal.reduction}
        }
        for signal in signals:
            if signal.reduction is None:
                columns.values[signal.name].extend(by_path[signal.path])
            else:
                rows = reduced[signal.path]
                columns.values[signal.name].extend([row.get(signal.reduction) for row in rows])
        _count_replaced(columns, signals, replaced)


def _numbers_at(signals: Sequence[Signal], texts: Sequence[str]) -> Array:
    """A row for each signal, given what `extracted` said of their paths in each state."""
    values = _all_values(texts)
    width = len(values) // len(texts)
    numbers = _as_numbers(values)
    if numbers is not None:
        table: Array = np.reshape(numbers, (len(texts), width))
        return np.transpose(table)[: len(signals)]
    columns = [cleaned(signal, values[at::width]) for at, signal in enumerate(signals)]
    return np.stack([aligned_numbers(column) for column in columns])


def _as_numbers(values: list[Any]) -> Array | None:
    """The numbers, NaN for null; None where there is anything else, or too large an integer."""
    for every in (lambda: values, lambda: [math.nan if v is None else v for v in values]):
        with contextlib.suppress(TypeError, OverflowError):
            return np.frombuffer(array("d", every()))
    return None


def extracted(data: str, paths: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """The SQL that gives what stands at some paths as one JSON array, and its parameters.

    Of several paths SQLite makes such an array, in which numbers stand as they were written; of
    one it would give the bare value, so that a single one is asked for twice.
    """
    asked = (*paths, *paths) if len(paths) == 1 else tuple(paths)
    return f"json_extract({data}{', ?' * len(asked)})", asked


def values_at(paths: Sequence[str], texts: Sequence[str]) -> dict[str, list[Any]]:
    """The values of each path, given what `extracted` said of each row; all are decoded at once."""
    if not paths or not texts:
        return {path: [] for path in paths}
    values = _all_values(texts)
    width = len(values) // len(texts)
    return {path: values[index::width] for index, path in enumerate(paths)}


def _all_values(texts: Sequence[str]) -> list[Any]:
    """The values of all rows one after the other."""
    return _decoded(f"[{','.join([text[1:-1] for text in texts])}]")


def _decoded(text: str) -> list[Any]:
    """A JSON array; orjson takes a fifth of the time, but not every number and text."""
    if orjson is not None:
        with contextlib.suppress(ValueError):
            return orjson.loads(text)
    return json.loads(text)


def _read_decoded(
    connection: sqlite3.Connection,
    signals: Sequence[Signal],
    asked: _Rows,
    columns: Columns,
    deadline: Deadline,
) -> None:
    for replaced, texts in _chunks(connection, asked, ("data", ()), columns, deadline):
        states = [flatten(parse(data)) for data in texts]
        for signal in signals:
            name = signal.name
            columns.values[name].extend([row.get(name) for row in states])
        _count_replaced(columns, signals, replaced)


def _chunks(
    connection: sqlite3.Connection,
    asked: _Rows,
    wanted: tuple[str, Sequence[str]],
    columns: Columns,
    deadline: Deadline,
) -> Iterator[tuple[Sequence[str | None], Sequence[str]]]:
    """Some rows each, which are added to the columns: what was replaced, and what is wanted.

    The row after them is fetched first: without one, all was read whatever the time is.
    """
    what, paths = wanted
    cursor = connection.execute(*asked.query(f"sim_time_s, wall_time_s, replaced, {what}", paths))
    ahead = cursor.fetchmany(1)
    while ahead:
        chunk = [*ahead, *cursor.fetchmany(_CHUNK_ROWS - 1)]
        ahead = cursor.fetchmany(1)
        ids, times, walls, replaced, texts = zip(*chunk, strict=True)
        columns.ids.extend(ids)
        columns.times.extend(times)
        columns.walls.extend(walls)
        yield replaced, texts
        if ahead and deadline.passed:
            columns.cut_at_s = columns.times[-1]
            return


def _count_replaced(
    columns: Columns, signals: Sequence[Signal], texts: Sequence[str | None]
) -> None:
    """Count what was replaced in the newest rows, whose values are there."""
    if not any(texts):
        return
    known = {text: replaced_names(text) for text in set(texts)}  # mostly the same in all rows
    named = {text: [each.name for each in signals if each.name in known[text]] for text in known}
    for row, text in enumerate(texts, len(columns.ids) - len(texts)):
        reasons = known[text]
        for name in named[text]:
            if is_replaced(reasons, name, columns.values[name][row]):
                columns.replaced.setdefault(name, Counter())[reasons[name]] += 1


def cleaned(signal: Signal, values: list[Any]) -> list[Value]:
    """Every value of the type that the signal's kind promises; the same from SQL and Python."""
    if signal.kind == "bool":
        return [None if value is None else value in (1, True) for value in values]
    types = set(map(type, values))
    if not types.isdisjoint(_BRANCHES):
        values = [None if type(value) in _BRANCHES else value for value in values]
    if signal.kind == "text":
        return _shown(values, types)
    return (
        [None if isinstance(value, str) else value for value in values] if str in types else values
    )


def _shown(values: list[Any], types: Collection[type]) -> list[Value]:
    """Each of the texts, of which there are mostly few, is looked at once."""
    if not {str, type(None)}.issuperset(types):
        return [shown(value) for value in values]
    by_text = {text: shown(text) for text in set(values)}
    return [by_text[text] for text in values]
