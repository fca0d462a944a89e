"""The rows of a run that are in no chunk: the newest ones, and those that came late.

Parsing them is what a question about a running robot costs, so that the newest are cached between
questions, and only what has come since is read.
"""

from __future__ import annotations

import sqlite3
import threading
from collections import OrderedDict
from typing import Final, NamedTuple

from webots_mcp.store.chunks import STATE_COLUMNS, Reached, StateColumns
from webots_mcp.store.reading.deadline import Deadline

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
    f"SELECT {STATE_COLUMNS} FROM state WHERE id > ? AND +run_id = ? AND {_IN} "
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
    at: Reached,
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
    columns = StateColumns()
    cut_s = read_rows(
        connection, _LATE, (at.max_state_id, run_id, *span, *place), columns, deadline
    )
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


def has_few_new_rows(connection: sqlite3.Connection, run_id: int, at: Reached) -> bool:
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

    Without a row it is minus infinity.
    """
    cursor = connection.execute(query, values)
    while rows := cursor.fetchmany(ROWS_AT_ONCE):
        if deadline.passed:
            return columns.times[-1] if len(columns) else float("-inf")
        columns.add(rows)
    return None


def _key(connection: sqlite3.Connection, run_id: int) -> tuple[str, str] | None:
    """Which run of which file it is; None where what is read now is not what others will read."""
    file, run = connection.execute(_FILE).fetchone(), connection.execute(_RUN, (run_id,)).fetchone()
    if not file or not file[0] or not run or not isinstance(run[0], str):
        return None
    return None if connection.execute(_SHADOWED).fetchone()[0] else (file[0], run[0])
