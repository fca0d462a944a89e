"""Read state rows as columns from their chunks, for exports, if chunks hold every value exactly.

If they do not, `chunk_table` returns None and rows are read one by one. That is so for long arrays,
long texts, integers beyond 2^53 and signals of several kinds, and if rows were deleted, arrived
late or belong to a full-rate segment.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from webots_mcp.analysis.arrays import Array, Flags, np
from webots_mcp.signals.naming import REDUCTIONS
from webots_mcp.store.chunk_making import count_lost
from webots_mcp.store.chunks import (
    EXACT_INTEGERS,
    FIRST_LABEL,
    IS_ABSENT,
    IS_NUMBER,
    STATE_IDS,
    WALL_TIMES,
    Decoded,
    Replaced,
)
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.segment import Deadline, Segment, full_rate_parts
from webots_mcp.store.registered_signals import registered

Kind = Literal["null", "bool", "int", "num", "text"]

MOST_NEW_ROWS: Final = 20_000  # Rows in no chunk are parsed and stay in memory.
_NOT_FINITE: Final = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


@dataclass(frozen=True)
class RunColumns:
    """The rows of one run in such a table.

    Attributes:
        kinds: The kind of the values of each signal that occurs.
        first_rows: The id of the first state that has each signal.
    """

    run_id: int
    frame: Frame
    kinds: dict[str, set[Kind]]
    first_rows: dict[str, int]

    def slices(self, rows: int) -> Iterator[Frame]:
        """Yield its rows, N at a time."""
        for start in range(0, len(self.frame), rows):
            yield self.frame.rows(start, start + rows)
            self.frame.forget()


def chunk_table(
    connection: sqlite3.Connection, segments: Sequence[Segment], counts: Sequence[int], last_id: int
) -> list[RunColumns] | None:
    """Return the rows of some segments as columns; None unless chunks hold all values exactly.

    Args:
        connection: An open database.
        segments: The segments to read.
        counts: The number of state rows of each segment.
        last_id: The highest id among them.
    """
    parts = list[RunColumns]()
    for segment, count in zip(segments, counts, strict=True):
        part = _part(connection, segment, count, last_id)
        if part is None:
            return None
        parts.append(part)
    return parts


def _part(
    connection: sqlite3.Connection, segment: Segment, count: int, last_id: int
) -> RunColumns | None:
    run_id = segment.run_id
    (waiting,) = connection.execute(
        "SELECT (SELECT count(*) FROM state "
        "WHERE run_id = :run) - (SELECT coalesce(sum(row_count), 0) FROM row_group "
        "WHERE run_id = :run AND is_complete = 1)",
        {"run": run_id},
    ).fetchone()
    asked = (run_id, segment.end_s, segment.start_s)
    query = (
        "SELECT EXISTS (SELECT 1 FROM row_group WHERE run_id = ? AND is_complete = 1 "
        "AND start_sim_time_s < ? AND end_sim_time_s >= ? "
        "AND (lost_value_count > 0 OR stored_row_count < row_count))"
    )
    if (
        waiting > MOST_NEW_ROWS
        or connection.execute(query, asked).fetchone()[0]
        or full_rate_parts(connection, run_id, segment.start_s, segment.end_s)
    ):
        return None
    frame = read_frame(connection, segment, Deadline(math.inf), full_rate=False)
    if len(frame) < count or not frame.is_as_stored:
        return None
    frame = frame.rows(0, count)  # more rows were added since they were counted
    (robot_id,) = connection.execute("SELECT robot_id FROM run WHERE id = ?", (run_id,)).fetchone()
    known = registered(connection, robot_id)
    if count_lost(frame.new_rows, known):
        return None
    ids: Array = np.zeros(count)
    for at, values in frame.parts(STATE_IDS):
        ids[at : at + len(values.numbers)] = values.numbers
    if ids.max(initial=0) > last_id or not _is_in_wall_time(frame, segment):
        return None
    kinds, first_rows = dict[str, set[Kind]](), dict[str, int]()
    for name in dict.fromkeys([*known, *frame.new_rows.values]):
        found, first = _kinds_of(frame, name)
        if found is None:
            return None
        if first < count:
            kinds[name], first_rows[name] = found, int(ids[first])
    return None if frame.unread else RunColumns(run_id, frame, kinds, first_rows)


def _is_in_wall_time(frame: Frame, segment: Segment) -> bool:
    """Return whether all rows lie within the limits in wall time, whatever the clock did."""
    limits = (segment.wall_start_s, segment.wall_end_s)
    if not any(map(math.isfinite, limits)):
        return True
    walls = (values.numbers for _, values in frame.parts(WALL_TIMES))
    return all(((limits[0] <= each) & (each < limits[1])).all() for each in walls)


def _kinds_of(frame: Frame, name: str) -> tuple[set[Kind] | None, int]:
    """Return the kind of a signal's values and its first row; None if the values are mixed.

    A name may be that of a reduction, or `*`, which records what was replaced in an array. If a
    signal of its own has that name, its nulls are ambiguous.
    """
    kinds, first, last_part = set[Kind](), len(frame), name.rpartition(".")[2]
    for at, values in frame.parts(name):
        numbers = values.numbers
        held = _held(values)
        if held.any():
            first = min(first, at + int(np.argmax(held)))
        is_number = np.ones(len(numbers), np.bool_)
        if values.codes is not None:
            is_number = values.codes == IS_NUMBER
        if is_number.any():
            kinds.add("int" if values.is_whole else "num")
        if is_number.any() and not values.is_whole:
            held_numbers = numbers[is_number]
            if (np.abs(held_numbers) == EXACT_INTEGERS).any():
                return None, first
            is_cut = frame.cuts_chunks and (at == 0 or at + len(numbers) == len(frame))
            if is_cut and (held_numbers == np.floor(held_numbers)).all():
                return None, first  # the value that made the chunk one of floats may lie outside
        present: set[int] = set() if values.codes is None else set(np.unique(values.codes).tolist())
        for code, label in enumerate(values.labels, FIRST_LABEL):
            if code not in present:
                continue
            kind = _kind_of_label(label)
            if isinstance(label, Replaced) and last_part in (*REDUCTIONS, "*"):
                return None, first
            kinds.add(kind)
    if last_part == "*" and first < len(frame):
        return None, first
    return kinds, first


def _held(values: Decoded) -> Flags:
    if values.codes is None:
        return np.ones(len(values.numbers), np.bool_)
    return values.codes != IS_ABSENT


def _kind_of_label(label: object) -> Kind:
    if isinstance(label, Replaced):
        return "num" if label.why in _NOT_FINITE else "null"
    if isinstance(label, bool):
        return "bool"
    return "null" if label is None else "text"


class ColumnCells:
    """The values of a signal in some rows, in the form that column libraries take.

    Attributes:
        values: One value per row; for texts the index of the text in `labels`.
        is_null: Flags of the rows without a value.
    """

    def __init__(self, frame: Frame, name: str, kind: str) -> None:
        values = frame.recorded(name)
        codes = values.codes
        if codes is None:
            codes = np.full(len(values.numbers), IS_NUMBER, np.intp)
        labels = list(values.labels)
        self.labels = [label if isinstance(label, str) else "" for label in labels]
        numbers: Array = np.array(values.numbers)
        has_value = [True, False]  # by code
        for place, label in enumerate(labels):
            code = place + FIRST_LABEL
            if isinstance(label, Replaced) and label.why in _NOT_FINITE:
                numbers[codes == code] = _NOT_FINITE[label.why]
                has_value.append(True)
            else:
                has_value.append(isinstance(label, str | bool))
        self.is_null: Flags = ~np.array(has_value)[codes]
        if kind == "text":
            self.values: Any = np.maximum(codes - FIRST_LABEL, 0)
        elif kind == "num":
            self.values = numbers
        else:
            whole = np.where(self.is_null, 0, numbers)
            self.values = whole.astype(np.bool_ if kind == "bool" else np.int64)
