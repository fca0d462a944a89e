"""Rows to be exported: those of a range, flattened, and trials; one value per dotted name.

State rows that retention has deleted are given back from their chunks, as JSON, as they were
recorded. What chunks do not hold (docs/database.md) is missing in them; `notes` says how much that
is.
"""

from __future__ import annotations

import heapq
import json
import math
import re
import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final, Literal, NamedTuple, cast

from webots_mcp.naming import LONGEST_SPREAD_ARRAY, flatten
from webots_mcp.store.analysis.arrays import Array, Indexes, np
from webots_mcp.store.chunks import (
    ABSENT,
    IS_NUMBER,
    SIM_TIMES,
    STATE_IDS,
    WALL_TIMES,
    Decoded,
    Group,
    Replaced,
    groups_in,
    parse,
    signals_in,
    values_in,
)
from webots_mcp.store.reading.frame import deleted_part
from webots_mcp.store.reading.frame_source import Unread
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.reading.segment import kept_parts
from webots_mcp.store.run_rows import put_back
from webots_mcp.store.signals import Signal, registered

_PURGED: Final = (
    "SELECT id, row_count - stored_row_count, lost_value_count FROM row_group WHERE run_id = ? "
    "AND is_complete = 1 AND stored_row_count < row_count"
)
_ROBOT: Final = "SELECT robot_id FROM run WHERE id = ?"
# What went from the states and lies in a kept stretch stands there.
_MOVED: Final = (
    "SELECT sim_time_s, wall_time_s FROM kept_state WHERE run_id = ? AND call IS NULL "
    "AND sim_time_s BETWEEN ? AND ?"
)
_STEP: Final = re.compile(r'\."((?:[^"\\]|\\.)*)"|\.([^.\[]+)|\[(\d+)\]')
_VALUE: Final = None  # in a tree, the key of the value that stands at the place itself

_encode: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode

StoredRow = tuple[int, float, float, str, "str | None"]
_Tree = dict[Any, Any]


class _WhyNone(NamedTuple):
    """A value that JSON could not hold, by its name and why; null stands for it."""

    name: str
    why: str


class PurgedRows:
    """The rows of a part of a run that are in chunks and no longer in `state`.

    Attributes:
        unread: What could not be given back, once the rows were read.
        notes: How many values chunks do not hold as they were.
    """

    def __init__(self, connection: sqlite3.Connection, segment: Segment) -> None:
        self._connection = connection
        self._segment = segment
        found = connection.execute(_PURGED, (segment.run_id,)).fetchall()
        self._purged = {group_id: rows for group_id, rows, _ in found}
        inside = groups_in(connection, segment.run_id, segment.start_s, segment.end_s)
        self._groups = [group for group in inside if group.id in self._purged]
        lost_counts = {group_id: lost for group_id, _, lost in found}
        lost = sum(lost_counts[group.id] for group in self._groups)
        deleted = deleted_part(connection, segment)
        self.unread: dict[Unread, None] = {deleted: None} if deleted else {}
        self.notes = [
            f"{lost} values of run {segment.run_id} are incomplete: their rows were deleted, and "
            "chunks hold no long arrays and texts, and no integers beyond 2^53 (docs/database.md)"
        ] * (lost > 0)  # fmt: skip

    def __len__(self) -> int:
        return sum(len(self._places(group)) for group in self._groups)

    def __iter__(self) -> Iterator[StoredRow]:
        """The rows in order of simulation time."""
        waiting = list[StoredRow]()
        for group in self._groups:
            ready = [row for row in waiting if row[1] < group.start_s]  # groups may overlap
            yield from ready
            waiting = sorted([*waiting[len(ready) :], *self._rows(group)], key=lambda row: row[1])
        yield from waiting

    def _places(self, group: Group) -> Indexes:
        """Which rows of a group are meant, in order; of a group the lowest ids go first."""
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
        for time_s, wall_s in self._connection.execute(_MOVED, bounds):
            wanted &= (times != time_s) | (walls != wall_s)
        return np.flatnonzero(wanted)

    def _rows(self, group: Group) -> list[StoredRow]:
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
    def _signals(self) -> dict[str, Signal]:
        run_id = self._segment.run_id
        (robot_id,) = self._connection.execute(_ROBOT, (run_id,)).fetchone()
        here = signals_in(self._connection, run_id)
        known = registered(self._connection, robot_id)
        return {name: signal for name, signal in known.items() if signal.id in here}

    def _numbers(self, signal_id: int, group: Group) -> Array:
        values = self._values(signal_id, "times", group)
        return np.zeros(0) if values is None else values.numbers

    def _values(self, signal_id: int, name: str, group: Group) -> Decoded | None:
        wanted = {group.id: group.row_count}
        for _, values in values_in(self._connection, self._segment.run_id, signal_id, wanted):
            if isinstance(values, Decoded):
                return values
            self.unread[Unread(group.start_s, group.end_s, f"the chunk of {name} is {values}")] = (
                None
            )
        return None


def _put(tree: _Tree, signal: Signal, column: int) -> None:
    """Note at which place of a state a signal stands."""
    steps = [int(index) if index else key or json.loads(f'"{quoted}"')
             for quoted, key, index in _STEP.findall(signal.path)]  # fmt: skip
    for step in (*steps, *([signal.reduction] if signal.reduction else [])):
        tree = tree.setdefault(step, _Tree())
    tree[_VALUE] = column


def _built(tree: _Tree, row: Sequence[Any]) -> Any:
    """The part of a state that is at a place; ABSENT where nothing is."""
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
    """A state as the table has it, and what was replaced in it."""
    replaced = {each.name: each.why for each in row if type(each) is _WhyNone}
    text = _encode({} if state is ABSENT else state)
    return text, _encode(replaced) if replaced else None


def _listed(name: str, values: Decoded, places: Indexes) -> list[Any]:
    """The values in some rows as JSON holds them."""
    numbers: list[Any] = values.numbers[places].tolist()
    if values.is_whole:
        numbers = [int(number) if number == number else number for number in numbers]
    elif math.inf in map(abs, numbers):  # an integer that is beyond all floats
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


# Rows to be exported, and those of a range, flattened: one value per dotted name.


Progress = Callable[[int, int], object]
ColumnKind = Literal["null", "bool", "int", "num", "text", "numbers"]

CHUNK_ROWS: Final = 2000  # read in one short transaction each: no checkpoint waits for an export

_IN_SEGMENT: Final = (
    "run_id = :run_id AND sim_time_s >= :start_s AND sim_time_s < :end_s "
    "AND wall_time_s >= :wall_start_s AND wall_time_s < :wall_end_s"
)
_CHUNK: Final = (
    f"SELECT id, sim_time_s, wall_time_s, data, replaced FROM state WHERE {_IN_SEGMENT} "
    "AND id <= :last_id AND (sim_time_s > :start_s OR id > :after_id) "
    "ORDER BY sim_time_s, id LIMIT :limit"
)
# Where there are kept stretches, with negative ids for what only they have. Of several calls in one
# step wall time gives the order.
_AFTER_WALL: Final = "(sim_time_s > :start_s OR wall_time_s > :after_wall_s)"
_CHUNK_WITH_KEPT: Final = (
    f"SELECT id, sim_time_s, wall_time_s, data, replaced FROM state WHERE {_IN_SEGMENT} "
    f"AND id <= :last_id AND {_AFTER_WALL} UNION ALL "
    f"SELECT -id, sim_time_s, wall_time_s, data, replaced FROM kept_state WHERE {_IN_SEGMENT} "
    f"AND id <= :last_kept_id AND {_AFTER_WALL} ORDER BY sim_time_s, wall_time_s LIMIT :limit"
)
_COUNT: Final = (
    "SELECT count(*) FROM {table} WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ?"
)
_LAST_ID: Final = "SELECT coalesce(max(id), 0) FROM {table}"
_NOT_FINITE: Final = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
_LARGEST_INT: Final = 2**63 - 1
_PLAIN_KINDS: Final[dict[type[object], ColumnKind]] = {
    float: "num", str: "text", bool: "bool", type(None): "null",
}  # fmt: skip


class Recorded(NamedTuple):
    """A state row as it is stored; the id of one that only a kept stretch has is below 0."""

    run_id: int
    state_id: int
    sim_time_s: float
    wall_time_s: float
    data: str
    replaced: str | None


class Row(NamedTuple):
    """A row of a table.

    Attributes:
        head: What `Table.head` names. The id of a state that only a kept stretch has is below 0.
        values: By dotted name. What was not finite is so again; an array of more than 16 items
            is one value.
        replaced: Path of every value that JSON could not hold, and what it was.
    """

    head: tuple[Any, ...]
    values: dict[str, Any]
    replaced: dict[str, str]


class Column(NamedTuple):
    """A dotted name, and what its values are: "text" also where they are of several kinds."""

    name: str
    kind: ColumnKind


_HEAD: Final = (
    Column("run_id", "int"),
    Column("state_id", "int"),
    Column("sim_time_s", "num"),
    Column("wall_time_s", "num"),
)
_RESERVED: Final = frozenset((*(column.name for column in _HEAD), "replaced"))


class Table(ABC):
    """Rows that can be read more than once.

    Attributes:
        head: The columns that every row has.
    """

    head: ClassVar[tuple[Column, ...]]

    @abstractmethod
    def rows(self, pass_number: int = 1) -> Iterator[Row]:
        """All of them; the second pass reports its own progress."""

    def columns(self) -> list[Column]:
        """What the rows hold, in the order in which it first appears; this reads all of them."""
        kinds: dict[str, ColumnKind] = {}
        for row in self.rows():
            for name, value in row.values.items():
                seen = kind_of(value)
                if kinds.get(name) != seen:
                    kinds[name] = _widened(kinds.get(name, seen), seen)
        return [Column(name, kind) for name, kind in kinds.items()]


@dataclass(frozen=True)
class Source(Table):
    """The state rows that were there when the export began; they can be read more than once.

    Attributes:
        passes: How often they will be read, so that progress can be reported.
        purged: Of each segment the rows that only its chunks have.
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

    @classmethod
    def of(
        cls,
        connection: sqlite3.Connection,
        segments: Sequence[Segment],
        passes: int,
        progress: Progress | None,
    ) -> Source:
        """The rows that these segments have now; ids are given in the order of writing."""
        bounds = [(part.run_id, part.start_s, part.end_s) for part in segments]
        last_ids, total = dict[str, int](), 0
        for table in ("state", "kept_state"):
            last_ids[table] = connection.execute(_LAST_ID.format(table=table)).fetchone()[0]
            count = _COUNT.format(table=table)
            total += sum(connection.execute(count, bound).fetchone()[0] for bound in bounds)
        purged = [PurgedRows(connection, segment) for segment in segments]
        total += sum(map(len, purged))
        newest = (last_ids["state"], last_ids["kept_state"])
        return cls(connection, segments, *newest, total, passes, purged, progress)

    @property
    def notes(self) -> list[str]:
        """What could not be given back of rows that retention has deleted, once they were read."""
        return [note for each in self.purged for note in (*each.notes, *map(str, each.unread))]

    def rows(self, pass_number: int = 1) -> Iterator[Row]:
        """All of them, run by run, in the order of simulation time."""
        return (flat_row(recorded) for recorded in self.recorded(pass_number))

    def recorded(self, pass_number: int = 1) -> Iterator[Recorded]:
        """The same rows as they are stored."""
        done = (pass_number - 1) * self.total
        for segment, purged in zip(self.segments, self.purged, strict=True):
            stored = (row for chunk in self._chunks(segment) for row in chunk)
            # Ids fall where only a kept stretch has a row.
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
        query = _CHUNK
        if kept_parts(self.connection, segment.run_id, segment.start_s, segment.end_s):
            query = _CHUNK_WITH_KEPT
        while chunk := self.connection.execute(query, values).fetchall():
            yield chunk
            values["after_id"], values["start_s"], values["after_wall_s"] = chunk[-1][:3]


def flat_row(recorded: Recorded) -> Row:
    """A stored row as one value per dotted name."""
    *head, data, replaced_text = recorded
    state = parse(data)
    replaced = cast("dict[str, str]", json.loads(replaced_text)) if replaced_text else {}
    for path, kind in replaced.items():
        if kind in _NOT_FINITE:
            put_back(state, path.split("."), _NOT_FINITE[kind])
    values: dict[str, Any] = {}
    _spread("", state.items(), values)
    for name in _RESERVED.intersection(values):
        values[f"state.{name}"] = values.pop(name)
    return Row(tuple(head), values, replaced)


def value_at(state: dict[str, Any], name: str) -> Any:
    """The value of that dotted name in a state; None where there is none."""
    inner: Any = state
    try:
        for step in name.split("."):
            inner = cast("Any", inner[int(step)] if isinstance(inner, list) else inner[step])
    except (KeyError, IndexError, TypeError, ValueError):
        return flatten(state).get(name)  # a key may hold a dot
    return inner


def _spread(prefix: str, items: Iterable[tuple[str, Any]], values: dict[str, Any]) -> None:
    """As `leaves.flatten`, with which it shares the names; but a long array stays as it is."""
    for key, value in items:
        name = prefix + key
        kind = cast("type[object]", type(value))
        if kind is dict:
            _spread(f"{name}.", value.items(), values)
        elif kind is list and len(value) <= LONGEST_SPREAD_ARRAY:
            _spread(f"{name}.", ((str(i), item) for i, item in enumerate(value)), values)
        elif name not in values:
            values[name] = value


def kind_of(value: object) -> ColumnKind:
    """What a flattened value is; "text" also for what is none and has no column of its own."""
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
    """The kind of a column that was `known` when such a value comes."""
    if known == seen:
        return known
    if "null" in (known, seen):
        return seen if known == "null" else known
    return "num" if {known, seen} == {"int", "num"} else "text"


def as_text(value: object) -> str | None:
    """A value in a cell of text: numbers in the shortest form that reads back as the same."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, (int, float)) else _compact(value)


_compact: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode
