"""State rows that retention has deleted, as their chunks give them back: JSON, as it was recorded.

What chunks do not hold (docs/database.md) is missing in them; `notes` says how much that is.
"""

from __future__ import annotations

import json
import math
import re
import sqlite3
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, Indexes, np
from webots_mcp.store.chunks.codec import ABSENT, IS_NUMBER, Decoded, Replaced
from webots_mcp.store.chunks.stored import (
    SIM_TIMES,
    STATE_IDS,
    WALL_TIMES,
    Group,
    groups_in,
    signals_in,
    values_in,
)
from webots_mcp.store.reading.frame import deleted_part
from webots_mcp.store.reading.frame_source import Unread
from webots_mcp.store.reading.segment import Segment
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
