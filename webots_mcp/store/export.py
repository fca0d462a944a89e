"""Export in constant memory: states or trials as flat tables, a whole range for viewers."""

from __future__ import annotations

import csv
import heapq
import io
import json
import math
import re
import sqlite3
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Final, Literal, NamedTuple, cast

from webots_mcp.analysis.arrays import Array, Indexes, np
from webots_mcp.analysis.summary import Ranked
from webots_mcp.database.files import placed
from webots_mcp.errors import InvalidInputError
from webots_mcp.extras.plugin_registry import ExportFormat, export_formats, load
from webots_mcp.signals.naming import LONGEST_SPREAD_ARRAY, flatten
from webots_mcp.store.chunk_table import ColumnCells, Kind, RunColumns, chunk_table
from webots_mcp.store.chunks import (
    ABSENT,
    IS_NUMBER,
    SIM_TIMES,
    STATE_IDS,
    WALL_TIMES,
    ChunkGroup,
    Decoded,
    Replaced,
    groups_in,
    parse,
    signals_in,
    values_in,
)
from webots_mcp.store.reading.frame import deleted_part
from webots_mcp.store.reading.ranges import Segment, TimeRange
from webots_mcp.store.reading.segment import full_rate_parts
from webots_mcp.store.reading.unread import Unread
from webots_mcp.store.registered_signals import RegisteredSignal, registered
from webots_mcp.store.run_rows import put_back
from webots_mcp.store.trial_sets import TrialRecord, best_of, fetch_trial_set, ranking_of, trials_of

# Rows of a range or trials to export, flattened to one value per dotted name. State rows that
# retention has deleted are restored from their chunks as JSON, as they were recorded. They miss
# what chunks do not hold ('webots-mcp help database'); `notes` reports how much.


_STEP: Final = re.compile(r'\."((?:[^"\\]|\\.)*)"|\.([^.\[]+)|\[(\d+)\]')
_VALUE: Final = None  # key in a tree for the value at the node itself

_encode: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode

StoredRow = tuple[int, float, float, str, "str | None"]
_Tree = dict[Any, Any]
# read in one short transaction each, so that no checkpoint waits for an export
CHUNK_ROWS: Final = 2000
_IN_SEGMENT: Final = (
    "run_id = :run_id AND sim_time_s >= :start_s AND sim_time_s < :end_s "
    "AND wall_time_s >= :wall_start_s AND wall_time_s < :wall_end_s"
)
# Includes full-rate segments, with negative ids for rows that only they have. Several calls in one
# step are ordered by wall time.
_AFTER_WALL: Final = "(sim_time_s > :start_s OR wall_time_s > :after_wall_s)"
_COUNT: Final = (
    "SELECT count(*) FROM {table} WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ?"
)
_LAST_ID: Final = "SELECT coalesce(max(id), 0) FROM {table}"
_NOT_FINITE: Final = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
_LARGEST_INT: Final = 2**63 - 1
_PLAIN_KINDS: Final[dict[type[object], ColumnKind]] = {
    float: "num", str: "text", bool: "bool", type(None): "null",
}  # fmt: skip
_OWN: Final = (
    ExportFormat("csv", ("csv",), "webots_mcp.store.export:write_csv", passes=2, is_text=True),
    ExportFormat(
        "jsonl",
        ("jsonl", "json", "ndjson"),
        "webots_mcp.store.export:write_json_lines",
        is_text=True,
    ),
)
_ALL: Final = (*_OWN, *export_formats())
FORMATS: Final = {each.name: each for each in _ALL if not each.for_viewers}  # of tables
FOR_VIEWERS: Final = {each.name: each for each in _ALL if each.for_viewers}
BUNDLE: Final = "zip"
_OF_TRIAL: Final = (
    "trial_set_id", "number", "run_id", "status", "score", "ended_by", "ended_sim_time_s", "error",
    "started_wall_time_s", "finished_wall_time_s",
)  # fmt: skip
_OF_PARAMETERS: Final = ("rank", "mean", "least", "greatest", "scores", "pruned", "failed")


class _WhyNone(NamedTuple):
    """A value that JSON could not hold, by its name and the reason; stored as null."""

    name: str
    why: str


class PurgedRows:
    """The rows of a part of a run that are in chunks and no longer in `state`.

    Attributes:
        unread: What could not be restored, once the rows were read.
        notes: The number of values that chunks do not hold exactly.
    """

    def __init__(self, connection: sqlite3.Connection, segment: Segment) -> None:
        self._connection = connection
        self._segment = segment
        found = connection.execute(
            "SELECT id, row_count - stored_row_count, lost_value_count FROM row_group "
            "WHERE run_id = ? AND is_complete = 1 AND stored_row_count < row_count",
            (segment.run_id,),
        ).fetchall()
        self._purged = {group_id: rows for group_id, rows, _ in found}
        inside = groups_in(connection, segment.run_id, segment.start_s, segment.end_s)
        self._groups = [group for group in inside if group.id in self._purged]
        lost_counts = {group_id: lost for group_id, _, lost in found}
        lost = sum(lost_counts[group.id] for group in self._groups)
        deleted = deleted_part(connection, segment)
        self.unread: dict[Unread, None] = {deleted: None} if deleted else {}
        self.notes = [
            f"{lost} values of run {segment.run_id} are incomplete: their rows were deleted, and "
            "chunks hold no long arrays and texts, and no integers beyond 2^53 "
            "('webots-mcp help database')"
        ] * (lost > 0)  # fmt: skip

    def __len__(self) -> int:
        return sum(len(self._places(group)) for group in self._groups)

    def __iter__(self) -> Iterator[StoredRow]:
        """Yield the rows in order of simulation time."""
        waiting = list[StoredRow]()
        for group in self._groups:
            ready = [row for row in waiting if row[1] < group.start_s]  # groups may overlap
            yield from ready
            waiting = sorted([*waiting[len(ready) :], *self._rows(group)], key=lambda row: row[1])
        yield from waiting

    def _places(self, group: ChunkGroup) -> Indexes:
        """Return which rows of a group are meant, in order; the lowest ids are deleted first."""
        times, walls, ids = (
            self._numbers(each, group) for each in (SIM_TIMES, WALL_TIMES, STATE_IDS)
        )
        if not len(times) == len(walls) == len(ids):  # one of the chunks is damaged
            return np.zeros(0, np.intp)
        part = self._segment
        wanted = np.zeros(len(ids), np.bool_)
        wanted[np.argsort(ids)[: self._purged[group.id]]] = True
        wanted &= (times >= part.start_s) & (times < part.end_s)
        wanted &= (walls >= part.wall_start_s) & (walls < part.wall_end_s)
        bounds = (part.run_id, group.start_s, group.end_s)
        # Rows that were purged from the states are available if a full-rate segment kept them.
        for time_s, wall_s in self._connection.execute(
            "SELECT sim_time_s, wall_time_s FROM kept_state WHERE run_id = ? AND call IS NULL "
            "AND sim_time_s BETWEEN ? AND ?",
            bounds,
        ):
            wanted &= (times != time_s) | (walls != wall_s)
        return np.flatnonzero(wanted)

    def _rows(self, group: ChunkGroup) -> list[StoredRow]:
        places = self._places(group)
        tree, columns = _Tree(), list[list[Any]]()
        for name, signal in self._signals.items():
            if (values := self._values(signal.id or 0, name, group)) is not None:
                _put(tree, signal, len(columns))
                columns.append(_listed(name, values, places))
        ids, *times = (
            self._numbers(each, group)[places].tolist()
            for each in (STATE_IDS, SIM_TIMES, WALL_TIMES)
        )
        by_row = zip(*columns, strict=True) if columns else ((),) * len(ids)
        return [
            (int(row_id), time_s, wall_s, *_stored(_built(tree, values), values))
            for row_id, time_s, wall_s, values in zip(ids, *times, by_row, strict=True)
        ]

    @cached_property
    def _signals(self) -> dict[str, RegisteredSignal]:
        run_id = self._segment.run_id
        (robot_id,) = self._connection.execute(
            "SELECT robot_id FROM run WHERE id = ?", (run_id,)
        ).fetchone()
        here = signals_in(self._connection, run_id)
        known = registered(self._connection, robot_id)
        return {name: signal for name, signal in known.items() if signal.id in here}

    def _numbers(self, signal_id: int, group: ChunkGroup) -> Array:
        values = self._values(signal_id, "times", group)
        return np.zeros(0) if values is None else values.numbers

    def _values(self, signal_id: int, name: str, group: ChunkGroup) -> Decoded | None:
        wanted = {group.id: group.row_count}
        for _, values in values_in(self._connection, self._segment.run_id, signal_id, wanted):
            if isinstance(values, Decoded):
                return values
            self.unread[Unread(group.start_s, group.end_s, f"the chunk of {name} is {values}")] = (
                None
            )
        return None


def _put(tree: _Tree, signal: RegisteredSignal, column: int) -> None:
    """Note the place of a signal in a state."""
    steps = [int(index) if index else key or json.loads(f'"{quoted}"')
             for quoted, key, index in _STEP.findall(signal.path)]  # fmt: skip
    for step in (*steps, *([signal.reduction] if signal.reduction else [])):
        tree = tree.setdefault(step, _Tree())
    tree[_VALUE] = column


def _built(tree: _Tree, row: Sequence[Any]) -> Any:
    """Return the part of a state at a place, or ABSENT."""
    if _VALUE in tree and (value := row[tree[_VALUE]]) is not ABSENT:
        return None if type(value) is _WhyNone else value
    found = {
        step: value
        for step, inner in tree.items()
        if step is not _VALUE and (value := _built(inner, row)) is not ABSENT
    }
    if found and all(type(step) is int for step in found):
        return [found.get(index) for index in range(max(found) + 1)]
    return found or ABSENT


def _stored(state: Any, row: Sequence[Any]) -> tuple[str, str | None]:
    """Return a state as stored in the table, and what was replaced in it."""
    replaced = {each.name: each.why for each in row if type(each) is _WhyNone}
    text = _encode({} if state is ABSENT else state)
    return text, _encode(replaced) if replaced else None


def _listed(name: str, values: Decoded, places: Indexes) -> list[Any]:
    """Return the values in some rows as JSON holds them."""
    numbers: list[Any] = values.numbers[places].tolist()
    if values.is_whole:
        numbers = [int(number) if number == number else number for number in numbers]
    elif math.inf in map(abs, numbers):  # an integer beyond the range of floats
        numbers = [_WhyNone(name, "int") if abs(each) == math.inf else each for each in numbers]
    if values.codes is None:
        return numbers
    labels = [_WhyNone(name, each.why) if isinstance(each, Replaced) else each
              for each in values.labels]  # fmt: skip
    other = [None, ABSENT, *labels]
    codes = values.codes[places].tolist()
    return [
        number if code == IS_NUMBER else other[code]
        for number, code in zip(numbers, codes, strict=True)
    ]


# Rows to export and rows of a range, flattened to one value per dotted name.


Progress = Callable[[int, int], object]
ColumnKind = Literal["null", "bool", "int", "num", "text", "numbers"]


class Recorded(NamedTuple):
    """A stored state row; the id is negative if only a full-rate segment has the row."""

    run_id: int
    state_id: int
    sim_time_s: float
    wall_time_s: float
    data: str
    replaced: str | None


class FlatRow(NamedTuple):
    """A row of a table.

    Attributes:
        head: One value per column of `ExportTable.head`. The id is negative for a state that only a
            full-rate segment has.
        values: Values by dotted name. Values that were not finite are restored; an array of more
            than 16 items is one value.
        replaced: The path of every value that JSON could not hold, and what it was.
    """

    head: tuple[Any, ...]
    values: dict[str, Any]
    replaced: dict[str, str]


class Column(NamedTuple):
    """A dotted name and the kind of its values; "text" also for mixed kinds."""

    name: str
    kind: ColumnKind


_HEAD: Final = (
    Column("run_id", "int"),
    Column("state_id", "int"),
    Column("sim_time_s", "num"),
    Column("wall_time_s", "num"),
)
_RESERVED: Final = frozenset((*(column.name for column in _HEAD), "replaced"))


class ExportTable(ABC):
    """Rows that can be read more than once.

    Attributes:
        head: The columns that every row has.
    """

    head: ClassVar[tuple[Column, ...]]

    @abstractmethod
    def rows(self, pass_number: int = 1) -> Iterator[FlatRow]:
        """Yield all rows; the second pass reports its own progress."""

    def columns(self) -> list[Column]:
        """Return the columns of the rows in order of first appearance; this reads all rows."""
        kinds: dict[str, ColumnKind] = {}
        for row in self.rows():
            for name, value in row.values.items():
                seen = kind_of(value)
                if kinds.get(name) != seen:
                    kinds[name] = _widened(kinds.get(name, seen), seen)
        return [Column(name, kind) for name, kind in kinds.items()]


@dataclass(frozen=True)
class ByColumn:
    """The rows of a source by columns, for formats that have columns.

    Attributes:
        columns: As `ExportTable.columns`, each after the name of its signal.
    """

    parts: Sequence[RunColumns]
    columns: Sequence[tuple[str, Column]]
    total: int
    progress: Progress | None = None

    def slices(self, rows: int) -> Iterator[tuple[list[Any], list[ColumnCells]]]:
        """Yield N rows at a time: the values of `StateTable.head` and the cells of each column."""
        done = 0
        for part in self.parts:
            for frame in part.slices(rows):
                runs = np.full(len(frame), part.run_id)
                head: list[Any] = [runs, frame.ids, frame.times, frame.wall_times]
                yield head, [ColumnCells(frame, name, column.kind) for name, column in self.columns]
                done += len(frame)
                if self.progress is not None:
                    self.progress(done, self.total)


@dataclass(frozen=True)
class StateTable(ExportTable):
    """The state rows that existed when the export began; they can be read more than once.

    Attributes:
        passes: How often they will be read, for progress reports.
        purged: The rows of each segment that only its chunks have.
        counts: The number of rows of each segment in the table `state`.
    """

    head: ClassVar[tuple[Column, ...]] = _HEAD
    connection: sqlite3.Connection
    segments: Sequence[Segment]
    last_id: int
    last_kept_id: int
    total: int
    passes: int
    purged: Sequence[PurgedRows]
    progress: Progress | None = None
    counts: Sequence[int] = ()

    @classmethod
    def of(
        cls,
        connection: sqlite3.Connection,
        segments: Sequence[Segment],
        passes: int,
        progress: Progress | None,
    ) -> StateTable:
        """Return the rows that these segments have now; ids ascend in the order of writing."""
        bounds = [(part.run_id, part.start_s, part.end_s) for part in segments]
        last_ids, counts = dict[str, int](), dict[str, list[int]]()
        for table in ("state", "kept_state"):
            last_ids[table] = connection.execute(_LAST_ID.format(table=table)).fetchone()[0]
            count = _COUNT.format(table=table)
            counts[table] = [connection.execute(count, each).fetchone()[0] for each in bounds]
        total = sum(map(sum, counts.values()))
        purged = [PurgedRows(connection, segment) for segment in segments]
        total += sum(map(len, purged))
        newest = (last_ids["state"], last_ids["kept_state"])
        each = counts["state"]
        return cls(connection, segments, *newest, total, passes, purged, progress, each)

    @property
    def notes(self) -> list[str]:
        """Return what could not be restored of deleted rows, once they were read."""
        notes = [note for each in self.purged for note in (*each.notes, *map(str, each.unread))]
        unread = (each for part in self.__dict__.get("_parts") or () for each in part.frame.unread)
        return [*notes, *map(str, unread)]

    @cached_property
    def _parts(self) -> list[RunColumns] | None:
        return chunk_table(self.connection, self.segments, self.counts, self.last_id)

    def by_column(self) -> ByColumn | None:
        """Return the rows by columns from chunks; None if chunks do not hold all values exactly."""
        if self._parts is None:
            return None
        kinds: dict[str, set[Kind]] = {}
        for part in self._parts:
            for name, found in part.kinds.items():
                kinds.setdefault(name, set()).update(found)
        columns: dict[str, tuple[str, Column]] = {}
        own = {f"state.{name}" if name in _RESERVED else name: name for name in kinds}
        if len(own) < len(kinds):
            return None
        for part in self._parts:
            for state_id in sorted(set(part.first_rows.values()), key=self._place_of):
                row = self._state(part.run_id, state_id)
                for name in row.values if row else ():
                    if name not in own:
                        return None
                    columns.setdefault(name, (own[name], Column(name, _kind_of(kinds[own[name]]))))
        if len(columns) < len(kinds) or not all(
            column.kind != "text" or kinds[name] <= {"text", "null"}
            for name, column in columns.values()
        ):
            return None
        return ByColumn(self._parts, list(columns.values()), self.total, self.progress)

    def _place_of(self, state_id: int) -> tuple[float, int]:
        (time_s,) = self.connection.execute(
            "SELECT sim_time_s FROM state WHERE id = ?", (state_id,)
        ).fetchone() or (math.inf,)
        return time_s, state_id

    def _state(self, run_id: int, state_id: int) -> FlatRow | None:
        row = self.connection.execute(
            "SELECT id, sim_time_s, wall_time_s, data, replaced FROM state WHERE id = ?",
            (state_id,),
        ).fetchone()
        return flat_row(Recorded(run_id, *row)) if row else None

    def rows(self, pass_number: int = 1) -> Iterator[FlatRow]:
        """Return all of them, run by run, in the order of simulation time."""
        return (flat_row(recorded) for recorded in self.recorded(pass_number))

    def recorded(self, pass_number: int = 1) -> Iterator[Recorded]:
        """Yield the same rows as they are stored."""
        done = (pass_number - 1) * self.total
        for segment, purged in zip(self.segments, self.purged, strict=True):
            stored = (row for chunk in self._chunks(segment) for row in chunk)
            # Ids descend where only a full-rate segment has a row.
            for row in heapq.merge(purged, stored, key=lambda row: (row[1], row[2])):
                yield Recorded(segment.run_id, *row)
                done += 1
                if self.progress is not None and done % CHUNK_ROWS == 0:
                    self.progress(done, self.total * self.passes)
        if self.progress is not None:
            self.progress(done, self.total * self.passes)

    def _chunks(self, segment: Segment) -> Iterator[list[Any]]:
        values: dict[str, Any] = {
            "run_id": segment.run_id, "start_s": segment.start_s, "end_s": segment.end_s,
            "wall_start_s": segment.wall_start_s, "wall_end_s": segment.wall_end_s,
            "last_id": self.last_id, "last_kept_id": self.last_kept_id,
            "after_id": 0, "after_wall_s": -math.inf, "limit": CHUNK_ROWS,
        }  # fmt: skip
        query = (
            "SELECT id, sim_time_s, wall_time_s, data, replaced FROM state "
            f"WHERE {_IN_SEGMENT} AND id <= :last_id AND (sim_time_s > :start_s "
            "OR id > :after_id) ORDER BY sim_time_s, id LIMIT :limit"
        )
        if full_rate_parts(self.connection, segment.run_id, segment.start_s, segment.end_s):
            query = (
                "SELECT id, sim_time_s, wall_time_s, data, replaced FROM state "
                f"WHERE {_IN_SEGMENT} AND id <= :last_id AND {_AFTER_WALL} UNION ALL "
                "SELECT -id, sim_time_s, wall_time_s, data, replaced FROM kept_state "
                f"WHERE {_IN_SEGMENT} AND id <= :last_kept_id AND {_AFTER_WALL} "
                "ORDER BY sim_time_s, wall_time_s LIMIT :limit"
            )
        while chunk := self.connection.execute(query, values).fetchall():
            yield chunk
            values["after_id"], values["start_s"], values["after_wall_s"] = chunk[-1][:3]


def flat_row(recorded: Recorded) -> FlatRow:
    """Return a stored row as one value per dotted name."""
    *head, data, replaced_text = recorded
    state = state_of(data, replaced_text)
    replaced = cast("dict[str, str]", json.loads(replaced_text)) if replaced_text else {}
    values: dict[str, Any] = {}
    _spread("", state.items(), values)
    for name in _RESERVED.intersection(values):
        values[f"state.{name}"] = values.pop(name)
    return FlatRow(tuple(head), values, replaced)


def state_of(data: str, replaced: str | None) -> dict[str, Any]:
    """Return a stored state with its numbers that are not finite, for which JSON has null.

    Args:
        data: Its JSON.
        replaced: What was replaced in it, as JSON; None if nothing was.
    """
    state = parse(data)
    for path, kind in cast("dict[str, str]", json.loads(replaced or "{}")).items():
        if kind in _NOT_FINITE:
            put_back(state, path.split("."), _NOT_FINITE[kind])
    return state


def value_at(state: dict[str, Any], name: str) -> Any:
    """Return the value at a dotted name in a state, or None."""
    inner: Any = state
    try:
        for step in name.split("."):
            inner = cast("Any", inner[int(step)] if isinstance(inner, list) else inner[step])
    except (KeyError, IndexError, TypeError, ValueError):
        return flatten(state).get(name)  # a key may hold a dot
    return inner


def _spread(prefix: str, items: Iterable[tuple[str, Any]], values: dict[str, Any]) -> None:
    """Flatten like `naming.flatten`, with the same names, but leave long arrays whole."""
    for key, value in items:
        name = prefix + key
        kind = cast("type[object]", type(value))
        if kind is dict:
            _spread(f"{name}.", value.items(), values)
        elif kind is list and len(value) <= LONGEST_SPREAD_ARRAY:
            _spread(f"{name}.", ((str(i), item) for i, item in enumerate(value)), values)
        else:
            values[name] = value


def kind_of(value: object) -> ColumnKind:
    """Return the kind of a flattened value; "text" also for values without their own column."""
    plain = _PLAIN_KINDS.get(type(value))
    if plain is not None:
        return plain
    if isinstance(value, int):
        return "int" if abs(value) <= _LARGEST_INT else "text"
    return "numbers" if _is_numbers(cast("list[Any]", value)) else "text"


def _is_numbers(items: list[Any]) -> bool:
    return all(
        type(item) is float or (type(item) is int and abs(item) <= _LARGEST_INT) for item in items
    )


def _widened(known: ColumnKind, seen: ColumnKind) -> ColumnKind:
    """Return the new kind of a column after such a value."""
    if known == seen:
        return known
    if "null" in (known, seen):
        return seen if known == "null" else known
    return "num" if {known, seen} == {"int", "num"} else "text"


def _kind_of(seen: Iterable[Kind]) -> Kind:
    """Return the kind of a column that has values of these kinds."""
    kind: ColumnKind = "null"
    for each in seen:
        kind = _widened(kind, each)
    return cast("Kind", kind)


def as_text(value: object) -> str | None:
    """Return the text of a cell; numbers in the shortest form that reads back unchanged."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, (int, float)) else _compact(value)


_compact: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode


class Exported(NamedTuple):
    """What was written for viewers.

    Attributes:
        counts: The number of states, log lines, events, commands and pictures.
        beside: The other file that was written and its purpose; empty if there is none.
        notes: What could not be restored of deleted rows.
    """

    counts: Counter[str]
    beside: str = ""
    notes: Sequence[str] = ()


def export(
    connection: sqlite3.Connection,
    wanted: TimeRange | TrialTable,
    form: str,
    sink: BinaryIO,
    progress: Progress | None = None,
    *,
    safe_cells: bool = False,
    notes: list[str] | None = None,
) -> int:
    """Write the state rows of a range, as many as exist now, flattened.

    Rows that retention has deleted are restored from their chunks. Columns are run, state id,
    simulation and wall time, then the dotted names in order of first appearance. A signal called
    like one of these or `replaced` becomes `state.NAME`.

    Args:
        connection: An open database; it is never kept busy for more than an instant.
        wanted: A range from `find_range`, or trials, which already are a table.
        form: One of `FORMATS`.
        sink: Receives bytes; need not be seekable.
        progress: Called now and then with the number of rows read and the total.
        safe_cells: See `write_csv`; the other formats have no cells that could be formulas.
        notes: Receives what could not be restored of deleted rows.

    Returns:
        The number of rows.

    Raises:
        InvalidInputError: The format does not exist, or needs a library that is not installed.
        OSError: The sink cannot be written.
    """
    chosen = FORMATS.get(form)
    if chosen is None:
        raise InvalidInputError(f"Unknown format {form!r}. Choose one of {', '.join(FORMATS)}.")
    if isinstance(wanted, TrialTable):
        source = wanted
    else:
        source = StateTable.of(connection, wanted.segments, chosen.passes, progress)
    if safe_cells and form == "csv":
        write_csv(source, sink, safe_cells=True)
    else:
        load(chosen.write)(source, sink)
    if notes is not None and isinstance(source, StateTable):
        notes += source.notes
    return source.total


def export_file(
    connection: sqlite3.Connection,
    wanted: TimeRange | TrialTable,
    form: str,
    file: Path,
    progress: Progress | None = None,
    *,
    safe_cells: bool = False,
    notes: list[str] | None = None,
) -> int:
    """Export like `export`, into a private file that appears only when it is complete.

    Raises:
        InvalidInputError: As for `export`, or the file cannot be written.
    """
    with placed(file) as aside, aside.open("wb") as sink:
        return export(connection, wanted, form, sink, progress, safe_cells=safe_cells, notes=notes)


def export_for_viewers(
    connection: sqlite3.Connection,
    data_dir: Path,
    wanted: TimeRange,
    form: str,
    file: Path,
    progress: Progress | None = None,
) -> Exported:
    """Write all of a range in a format for viewers.

    The files are private to their owner and appear only when they are complete.

    Args:
        connection: An open database; it is never kept busy for more than an instant.
        data_dir: The folder of the pictures.
        wanted: A range from `find_range`.
        form: One of `FOR_VIEWERS`.
        file: The file to write.
        progress: Called now and then with the number of rows read and the total.

    Raises:
        InvalidInputError: The library is not installed, or a file cannot be written.
    """
    exported: Exported = load(FOR_VIEWERS[form].write)(connection, data_dir, wanted, file, progress)
    return exported


def format_of(file: Path) -> str:
    """Return the format that the name of a file stands for.

    Raises:
        InvalidInputError: No format has this suffix.
    """
    ending = file.suffix.lower().lstrip(".")
    if ending == BUNDLE:
        return BUNDLE
    for each in _ALL:
        if ending in each.suffixes:
            return each.name
    endings = ", ".join(f".{each.name}" for each in _ALL)
    raise InvalidInputError(
        f"The name {file.name} does not show the format. End it in {endings} or "
        f".{BUNDLE}, "
        "or give --format."
    )


# Rows as CSV and as JSON lines.


_encode_export: Final = json.JSONEncoder(
    ensure_ascii=False, allow_nan=False, separators=(",", ":")
).encode


def write_csv(source: ExportTable, sink: BinaryIO, *, safe_cells: bool = False) -> None:
    r"""Write one line per row under a line of column names; UTF-8, line ends as in RFC 4180.

    Missing and null values are empty; flags are `true` and `false`; values that were not finite are
    `nan`, `inf` or `-inf`; a long array is its JSON text; a NUL character is written as `\0`,
    because many CSV readers stop there.

    A spreadsheet runs a text that begins with =, +, - or @ as a formula. With `safe_cells` such a
    text (also a name) gets an apostrophe before it; numbers do not change.
    """
    spell = _harmless if safe_cells else _without_nul
    columns = source.columns()
    names = [column.name for column in columns]
    # The csv writer itself turns numbers into text and null into nothing.
    spelled = [
        i
        for i, column in enumerate(columns, len(source.head))
        if column.kind in ("bool", "text", "numbers")
    ]
    text = io.TextIOWrapper(sink, "utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow(map(spell, (*(column.name for column in source.head), *names)))
    for row in source.rows(pass_number=2):
        cells: list[object] = [*row.head, *map(row.values.get, names)]
        for i in spelled:
            value = cells[i]
            cells[i] = (spell if isinstance(value, str) else _without_nul)(as_text(value))
        writer.writerow(cells)
    text.detach()


def _without_nul(text: str | None) -> str | None:
    return text.replace("\0", "\\0") if text else text


def _harmless(text: str | None) -> str | None:
    plain = _without_nul(text)
    return f"'{plain}" if plain and plain.startswith(("=", "+", "-", "@", "\t", "\r")) else plain


def write_json_lines(source: ExportTable, sink: BinaryIO) -> None:
    """Write one JSON object per row and line: values by dotted name, null if not finite.

    `replaced`, if a row has it, names the path of every value that JSON cannot hold, and what it
    was.
    """
    head = [column.name for column in source.head]
    for row in source.rows():
        line: dict[str, Any] = dict(zip(head, row.head, strict=True)) | row.values
        if row.replaced:
            line["replaced"] = row.replaced
        sink.write(_line(line))


def json_text(value: dict[str, Any]) -> str:
    """Return strict JSON: null for numbers that are not finite."""
    try:
        return _encode_export(value)
    except ValueError:
        return _encode_export(_finite(value))


def _line(line: dict[str, Any]) -> bytes:
    return f"{json_text(line)}\n".encode()


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType]
    return [_finite(item) for item in value] if isinstance(value, list) else value  # pyright: ignore[reportUnknownVariableType]


# The trials of a set as a flat table: one row per trial, with statistics of its parameters.


@dataclass(frozen=True)
class TrialTable(ExportTable):
    """The trials of a set, in order.

    Columns are those of the table `trial`, the parameters by name, and the results of all trials
    with the same parameters: rank (1 is the best), mean, minimum and maximum score, and how many
    gave a score, were pruned, and failed. A parameter called like one of those is `parameter NAME`.
    """

    head: ClassVar[tuple[Column, ...]] = ()
    trials: Sequence[TrialRecord]
    figures: dict[str, tuple[Any, ...]]
    notes: Sequence[str] = ()

    @classmethod
    def of(cls, connection: sqlite3.Connection, set_id: int) -> TrialTable:
        """Return the trials as they are now.

        Raises:
            InvalidInputError: The set does not exist.
        """
        trials = trials_of(connection, set_id)
        plan = json.loads(fetch_trial_set(connection, set_id).plan)
        sets = ranking_of(trials, best_of(plan)).sets
        return cls(
            trials, {_key(each.parameters): _figures(i, each) for i, each in enumerate(sets, 1)}
        )

    @property
    def total(self) -> int:
        """How many there are."""
        return len(self.trials)

    def rows(self, pass_number: int = 1) -> Iterator[FlatRow]:
        """Yield all rows; `pass_number` makes no difference."""
        for each in self.trials:
            values: dict[str, Any] = {name: getattr(each, name) for name in _OF_TRIAL}
            for name, value in each.values.items():
                values[_column(name)] = value
            figures = self.figures.get(_key(each.values), (None,) * len(_OF_PARAMETERS))
            yield FlatRow((), values | dict(zip(_OF_PARAMETERS, figures, strict=True)), {})


def _figures(rank: int, ranked: Ranked) -> tuple[Any, ...]:
    spread = ranked.score or (None, None, None)
    return (rank, *spread, len(ranked.scores), ranked.pruned, len(ranked.failures))


def _key(parameters: dict[str, Any]) -> str:
    return json.dumps(parameters, sort_keys=True)


def _column(parameter: str) -> str:
    taken = parameter in (*_OF_TRIAL, *_OF_PARAMETERS)
    return f"parameter {parameter}" if taken else parameter
