"""Any stretch of a run in pieces: rollups where they are complete, rows at the edges.

However long the stretch, counts and extremes are exact: the rollups give the whole buckets inside
(coarse ones where no finer pieces are asked for), the state rows what is cut off at both ends, and
what came after the watermark.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Indexes, np
from webots_mcp.store.analysis.summaries import Summaries
from webots_mcp.store.analysis.summary import COUNTS, Summary, merge
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.moments import shown_time
from webots_mcp.store.reading.ranges import Segment, recorded_bounds
from webots_mcp.store.reading.rows import Columns, read_columns
from webots_mcp.store.rollup.buckets import (
    BUCKET_S,
    COARSE_S,
    FINE,
    Grain,
    bucket_of,
    bucket_table,
    by_grain,
)
from webots_mcp.store.rollup.tables import watermark
from webots_mcp.store.signals.registry import Signal

# By ids, from the watermark on: the + keeps SQLite from sorting all rows of the run instead.
_FIRST_AFTER: Final = (
    "SELECT sim_time_s FROM state WHERE id > ? AND +run_id = ? ORDER BY id LIMIT 1"
)
# Time stood still right at the start, partly before it in wall time.
_STOOD_BEFORE: Final = (
    "SELECT EXISTS (SELECT 1 FROM state WHERE run_id = ? AND sim_time_s = ? AND wall_time_s < ?)"
)
# Without any, the last bucket of the run was purged: of it the rollup is all there is.
_ROWS_FROM: Final = "SELECT EXISTS (SELECT 1 FROM state WHERE run_id = ? AND sim_time_s >= ?)"
_ROW_IN: Final = (
    "SELECT EXISTS (SELECT 1 FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ?)"
)


_BEFORE_ALL: Final = -(2**62)
_BUCKETS_AT_ONCE: Final = 500  # of all signals, between two looks at what they hold together
_Part = tuple["Indexes", "Array"]  # the numbers of pieces, and a table of their summaries
# The signal that is in most rows shows how many a bucket has, and its first and last time.
_IN_MOST_ROWS: Final = (
    "FROM {table} WHERE run_id = :run AND bucket >= :first AND bucket < :end AND signal_id = "
    "(SELECT id FROM signal s WHERE robot_id = (SELECT robot_id FROM run WHERE id = :run) "
    "AND EXISTS (SELECT 1 FROM all_rollup WHERE run_id = :run AND signal_id = s.id) "
    "ORDER BY s.row_count - s.null_row_count DESC LIMIT 1)"
)
_BUCKETS: Final = (
    f"SELECT bucket, rows, first_sim_time_s, last_sim_time_s {_IN_MOST_ROWS} ORDER BY bucket"
)


def rows_by_bucket(
    connection: sqlite3.Connection, run_id: int, grain: Grain, span: range
) -> dict[int, int]:
    """How many rows each bucket has in the rollups: also of a signal that not all of them hold."""
    bounds = {"run": run_id, "first": span.start, "end": span.stop}
    rows = connection.execute(_BUCKETS.format(table=grain.table), bounds)
    return {bucket: count for bucket, count, *_ in rows}


class Pieces:
    """A stretch of a run in pieces of equal length; parts of a piece are added in order of time.

    Attributes:
        piece_s: The length of a piece.
        rows: How many state rows are in all pieces, with whatever signals.
        cut_at_s: Where the deadline stopped the reading: nothing behind it is in the pieces. None
            if it did not.
    """

    def __init__(self, signals: Sequence[Signal], piece_s: float) -> None:
        self.piece_s = piece_s
        self.rows = 0
        self.cut_at_s: float | None = None
        self._signals = signals
        nothing = np.empty(0, np.intp), Summaries.of([]).table
        self._parts: dict[str, list[_Part]] = {signal.name: [nothing] for signal in signals}

    def add_rows(self, columns: Columns) -> None:
        """Add state rows."""
        self.rows += len(columns.times)
        self.cut_at_s = columns.cut_at_s
        pieces: Indexes = (columns.moments // self.piece_s).astype(np.intp)
        starts = np.flatnonzero(np.diff(pieces, prepend=_BEFORE_ALL))
        spans = list(pairwise([*starts.tolist(), len(pieces)]))
        for signal in self._signals:
            values = columns.values[signal.name]
            summaries = [signal.summarise(columns.times[a:b], values[a:b]) for a, b in spans]
            self._parts[signal.name].append((pieces[starts], Summaries.of(summaries).table))

    def add_rollups(
        self,
        connection: sqlite3.Connection,
        run_id: int,
        grain: Grain,
        span: range,
        deadline: Deadline,
    ) -> None:
        """Add the stored rollups of those buckets, of all signals or of none.

        As with rows, all count: also those that do not hold the signal.
        """
        rows = rows_by_bucket(connection, run_id, grain, span)
        found: dict[str, _Part] = {}
        for signal in self._signals:
            if signal.id is None:
                continue
            if deadline.passed:
                self.cut_at_s = span.start * grain.bucket_s
                return
            table = bucket_table(connection, run_id, signal.id, span, grain)
            found[signal.name] = self._counted(table, rows, grain)
        self.rows += sum(rows.values())
        for name, part in found.items():
            self._parts[name].append(part)

    def of(self, name: str) -> list[tuple[int, Summary]]:
        """The pieces of a signal that have rows, by their numbers, in order."""
        pieces, summaries = self.numbered(name)
        return list(zip(pieces.tolist(), summaries.as_list(), strict=True))

    def summaries(self, name: str) -> Summaries:
        """The same without their numbers, as arrays."""
        return self.numbered(name)[1]

    def numbered(self, name: str) -> tuple[Indexes, Summaries]:
        """Their numbers, and they as arrays; each piece once."""
        pieces = np.concatenate([pieces for pieces, _ in self._parts[name]])
        table = np.concatenate([table for _, table in self._parts[name]])
        order = np.argsort(pieces, kind="stable")
        pieces, table = pieces[order], table[order]
        starts = np.flatnonzero(np.diff(pieces, prepend=_BEFORE_ALL))
        ends = np.append(starts[1:], len(pieces))
        for at in np.flatnonzero(ends - starts > 1).tolist():
            together = Summaries(table[starts[at] : ends[at]]).as_list()
            table[starts[at]] = merge(together)
        return pieces[starts], Summaries(table[starts])

    def _counted(self, found: Array, rows: dict[int, int], grain: Grain) -> _Part:
        """Buckets of a signal, as those that are there have rows; with those that lack it."""
        there: Array = np.array(list(rows), np.float64)
        numbers: Array = np.sort(np.concatenate((found[:, 0], there)))
        numbers = numbers[np.diff(numbers, prepend=-np.inf) > 0]
        table = np.full((len(numbers), found.shape[1] - 1), np.nan)
        table[:, :COUNTS] = 0
        table[np.searchsorted(numbers, found[:, 0])] = found[:, 1:]
        places = np.searchsorted(numbers, there)
        table[places, 0] = np.maximum(table[places, 0], list(rows.values()))
        return (numbers * grain.bucket_s // self.piece_s).astype(np.intp), table


def piece_length_s(
    connection: sqlite3.Connection, segment: Segment, pieces: int, least_s: float = 0.0
) -> float:
    """How long pieces are: as coarse rollups, where a stretch has so many of them, else 10 s.

    Args:
        connection: Any.
        segment: The stretch.
        pieces: How many it is to have at least.
        least_s: Coarse ones do as well where pieces are to be that long.
    """
    first_s, last_s = recorded_bounds(connection, segment.run_id) or (0.0, 0.0)
    length_s = min(segment.end_s, last_s) - max(segment.start_s, first_s)
    return COARSE_S if max(length_s / pieces, least_s) >= COARSE_S else BUCKET_S


def read_pieces(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    deadline: Deadline,
    piece_s: float = BUCKET_S,
) -> Pieces:
    """Read a stretch of any length; only rows that are not in a whole rollup are looked at.

    Args:
        connection: Any.
        segment: Which stretch.
        signals: Which numbers of it.
        deadline: After it nothing more is read: the pieces say from where on, and hold nothing of
            what lies behind that.
        piece_s: How fine the pieces are: `BUCKET_S` or, from coarse rollups, `COARSE_S`.
    """
    pieces = Pieces(signals, piece_s)
    span = _whole_buckets(connection, segment)
    if not span:
        pieces.add_rows(read_columns(connection, segment, signals, deadline))
        return pieces
    start_s, end_s = span.start * BUCKET_S, span.stop * BUCKET_S
    head, foot = replace(segment, end_s=start_s), replace(segment, start_s=end_s)
    middle = replace(segment, start_s=start_s, end_s=min(end_s, segment.end_s))
    mark = watermark(connection, segment.run_id)
    pieces.add_rows(read_columns(connection, head, signals, deadline))
    parts = [(FINE, span)] if piece_s < COARSE_S else by_grain(connection, segment.run_id, span)
    for grain, part in parts:
        for first in part[::_BUCKETS_AT_ONCE]:
            some = range(first, min(first + _BUCKETS_AT_ONCE, part.stop))
            if pieces.cut_at_s is None:
                pieces.add_rollups(connection, segment.run_id, grain, some, deadline)
    late = rows_after(connection, middle, mark)
    if late is not None and pieces.cut_at_s is None:
        pieces.add_rows(read_columns(connection, late, signals, deadline, after=mark))
    if pieces.cut_at_s is None:
        pieces.add_rows(read_columns(connection, foot, signals, deadline))
    return pieces


def rows_after(connection: sqlite3.Connection, segment: Segment, mark: int) -> Segment | None:
    """The part of a segment whose rows have ids above the watermark; None without any."""
    first = connection.execute(_FIRST_AFTER, (mark, segment.run_id)).fetchone()
    if first is None or first[0] >= segment.end_s:
        return None
    return replace(segment, start_s=max(segment.start_s, first[0]))


def _has_rows(connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float) -> bool:
    return bool(connection.execute(_ROW_IN, (run_id, start_s, end_s)).fetchone()[0])


def _whole_buckets(connection: sqlite3.Connection, segment: Segment) -> range:
    """The buckets that lie wholly inside."""
    first = math.ceil(segment.start_s / BUCKET_S)
    if first == bucket_of(segment.start_s):
        start = (segment.run_id, segment.start_s, segment.wall_start_s)
        first += connection.execute(_STOOD_BEFORE, start).fetchone()[0]
    # The end of a bucket that is given as the end of a range lies half a millisecond before it.
    end_s = segment.end_s
    end = bucket_of(max(end_s, shown_time(end_s)))
    if end != bucket_of(end_s) and _has_rows(connection, segment.run_id, end_s, end * BUCKET_S):
        end -= 1
    if segment.open_end:
        rows_left = connection.execute(_ROWS_FROM, (segment.run_id, end * BUCKET_S)).fetchone()[0]
        end += not rows_left
    return range(first, end)
