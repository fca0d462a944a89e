"""Read state rows that are in no chunk: the newest of a run, and those that arrived late.

They are parsed once for each question. A maintainer puts rows into chunks in groups of 1,024, so
few rows are left while it works.
"""

from __future__ import annotations

import sqlite3
from bisect import bisect_left
from typing import Final

from webots_mcp.store.chunks import ABSENT, STATE_COLUMNS, ChunkProgress, StateColumns
from webots_mcp.store.reading.segment import Deadline, read_so_far
from webots_mcp.store.run_rows import reading_texts

FEW_ROWS: Final = 4096  # without a maintainer there may be more; those are sampled for new names
ROWS_AT_ONCE: Final = 1024  # rows between two checks of the deadline
_IN: Final = "sim_time_s >= ? AND sim_time_s < ?"
_LATE: Final = (
    f"SELECT {STATE_COLUMNS} FROM state WHERE +run_id = ? AND id > ? AND {_IN} "
    "AND (sim_time_s, id) <= (?, ?) ORDER BY sim_time_s, id"
)
_LATE_BY_TIME: Final = _LATE.replace("+run_id", "run_id")


def rows_in_no_chunk(
    connection: sqlite3.Connection,
    run_id: int,
    span: tuple[float, float],
    at: ChunkProgress,
    deadline: Deadline,
) -> tuple[StateColumns, float | None]:
    """Read the rows of a run in [start, end) that are in no chunk, in order of time.

    Args:
        connection: An open database.
        run_id: The run.
        span: Start and end, simulation times in s.
        at: Up to where the run is in chunks.
        deadline: For all reading.

    Returns:
        The rows, not to be changed, and the time of the last one if the deadline passed before all
        were read.
    """
    memo: dict[tuple[float, float], StateColumns] = read_so_far(connection).setdefault(
        ("rows in no chunk", run_id, at), {}
    )
    for (start_s, end_s), known in memo.items():
        if start_s <= span[0] and span[1] <= end_s and not deadline.passed:
            return _between(known, *span), None
    columns, cut_s = _read_new(connection, run_id, span, at, deadline)
    if cut_s is None:
        memo[span] = columns
    return columns, cut_s


def _between(columns: StateColumns, start_s: float, end_s: float) -> StateColumns:
    """Return the rows in [start, end), with the names that they hold."""
    first, behind = (bisect_left(columns.times, each) for each in (start_s, end_s))
    if (first, behind) == (0, len(columns)):
        return columns
    part = columns.part(first, behind - first)
    for name in [name for name, each in part.values.items() if all(v is ABSENT for v in each)]:
        del part.values[name]
    return part


def _read_new(
    connection: sqlite3.Connection,
    run_id: int,
    span: tuple[float, float],
    at: ChunkProgress,
    deadline: Deadline,
) -> tuple[StateColumns, float | None]:
    place = (at.end_s, at.last_state_id)
    columns, cut_s = StateColumns(), None
    # without a chunk no row is late, and this would read the whole file
    if at.end_s != float("-inf"):
        late = (run_id, at.max_state_id, *span, *place)
        # number of ids that each of the two methods for late rows searches
        ids, rows = connection.execute(
            "SELECT coalesce((SELECT max(id) "
            "FROM state), 0) - ?, (SELECT coalesce(sum(row_count), 0) FROM row_group "
            "WHERE run_id = ? AND is_complete = 1)",
            (at.max_state_id, run_id),
        ).fetchone()
        query = _LATE if ids <= rows else _LATE_BY_TIME
        cut_s = read_rows(connection, query, late, columns, deadline)
    if cut_s is None and span[1] >= at.end_s:
        # SQLite would otherwise scan all rows from the start of the range.
        after = (max(span[0], at.end_s), span[1])
        cut_s = read_rows(
            connection,
            f"SELECT {STATE_COLUMNS} FROM state WHERE run_id = ? AND {_IN} "
            "AND (sim_time_s, id) > (?, ?) ORDER BY sim_time_s, id",
            (run_id, *after, *place),
            columns,
            deadline,
        )
    return columns, cut_s


def has_few_new_rows(connection: sqlite3.Connection, run_id: int, at: ChunkProgress) -> bool:
    """Return whether few rows of a run follow those in chunks, so that all of them can be read."""
    asked = (run_id, at.end_s, at.last_state_id, FEW_ROWS + 1)
    return bool(
        connection.execute(
            "SELECT count(*) FROM (SELECT 1 FROM state WHERE run_id = ? "
            "AND (sim_time_s, id) > (?, ?) LIMIT ?)",
            asked,
        ).fetchone()[0]
        <= FEW_ROWS
    )


def read_rows(
    connection: sqlite3.Connection,
    query: str,
    values: tuple[object, ...],
    columns: StateColumns,
    deadline: Deadline,
) -> float | None:
    """Add the rows of a query to some columns.

    Args:
        connection: An open database.
        query: Selects `STATE_COLUMNS`.
        values: Parameters of the query; the first is the run.
        columns: Receives the rows.
        deadline: Checked after every 1,024 rows.

    Returns:
        None if all rows were read, else the time of the last one, or minus infinity without any.
    """
    with reading_texts(connection):
        cursor = connection.execute(query, values)
        while rows := cursor.fetchmany(ROWS_AT_ONCE):
            if deadline.passed:
                return columns.times[-1] if len(columns) else float("-inf")
            columns.add(rows, f"run {values[0]}: ")
    return None
