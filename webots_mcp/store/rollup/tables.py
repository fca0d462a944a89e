"""The tables that hold rollups, and how they are written: in steps of about a millisecond.

In `rollup` the buckets of a signal stand together, so that its whole history is read fast; one
bucket of each signal is then a page to write for each. So the newest buckets of a run stand side by
side in `recent_rollup`, and move when they are over. The view `all_rollup` shows both.

What a step stores was computed before it, outside the write lock, from what stood there then. It
stores only where nothing of that has changed since, so that two callers do not spoil each other's
work.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, Final, NamedTuple, TypeVar

from webots_mcp.store.analysis.summary import Summary
from webots_mcp.store.rollup.buckets import COARSE_BUCKETS
from webots_mcp.store.signals.registry import Count
from webots_mcp.transactions import LONGEST_WRITE_S, Step, transaction

Item = TypeVar("Item")
Key = tuple[int, int]  # bucket, signal id

_FIGURES: Final = ", ".join(Summary._fields)
_COLUMNS: Final = f"run_id, bucket, signal_id, {_FIGURES}"
# What cannot be an id is passed over: the marks of the runs still tell which rows are in.
IS_ID: Final = f"typeof({{0}}) = 'integer' AND {{0}} BETWEEN 0 AND {2**53}"
_WATERMARK: Final = (
    f"SELECT state_id FROM watermark WHERE name = 'rollup' AND {IS_ID.format('state_id')}"
)
RUN_MARK: Final = (
    f"SELECT max(iif({IS_ID.format('rolled_state_id')}, rolled_state_id, 0), "
    f"coalesce(({_WATERMARK}), 0)) FROM run WHERE id = {{}}"
)
_RECENT_ROWS: Final = "SELECT count(*) FROM recent_rollup WHERE run_id = {}"
_RECENT: Final = f"SELECT bucket, signal_id, {_FIGURES} FROM recent_rollup WHERE run_id = ?"
_OVER: Final = f"SELECT {_FIGURES} FROM rollup WHERE run_id = ? AND signal_id = ? AND bucket = ?"
_TEMPORARY: Final = {
    "new_rollup": f"is_over, {_COLUMNS}",
    "new_change": "run_id, signal_id, state_id, sim_time_s, value",
    "new_count": ", ".join(Count._fields),
}
ADD_COUNTS: Final = (
    "UPDATE signal SET kind = n.kind, unit = n.unit, "
    "row_count = signal.row_count + n.row_count, "
    "null_row_count = signal.null_row_count + n.null_row_count, "
    "replaced_row_count = signal.replaced_row_count + n.replaced_row_count, "
    "last_seen_wall_time_s = max(signal.last_seen_wall_time_s, n.seen_wall_time_s), "
    "min = min(coalesce(signal.min, n.min), coalesce(n.min, signal.min)), "
    "max = max(coalesce(signal.max, n.max), coalesce(n.max, signal.max)) "
    "FROM new_count n WHERE signal.id = n.signal_id"
)
_STORE: Final = Step(
    "store_rollups",
    ("run_id", "mark", "recent_rows", "state_id", "first_coarse"),
    f"INSERT OR REPLACE INTO recent_rollup ({_COLUMNS}) "
    f"SELECT {_COLUMNS} FROM new_rollup WHERE NOT is_over",
    f"INSERT OR REPLACE INTO rollup ({_COLUMNS}) SELECT {_COLUMNS} FROM new_rollup WHERE is_over",
    f"INSERT OR IGNORE INTO change ({_TEMPORARY['new_change']}) SELECT * FROM new_change",
    ADD_COUNTS,
    "UPDATE run SET rolled_state_id = NEW.state_id, "
    "coarse_end = min(coarse_end, NEW.first_coarse) WHERE id = NEW.run_id",
    unless=f"({RUN_MARK.format('NEW.run_id')}) IS NOT NEW.mark "
    f"OR ({_RECENT_ROWS.format('NEW.run_id')}) <> NEW.recent_rows",
)
# A bucket is over when its run has a later one, or has ended.
_MOVABLE: Final = (
    "SELECT run_id, bucket, signal_id FROM recent_rollup r WHERE bucket < "
    "(SELECT max(bucket) FROM recent_rollup WHERE run_id = r.run_id) "
    "OR (SELECT ended_wall_time_s FROM run WHERE id = r.run_id) IS NOT NULL "
    "ORDER BY run_id, bucket, signal_id"
)
_MOVED: Final = (
    "FROM recent_rollup WHERE run_id = NEW.run_id AND bucket = NEW.bucket "
    "AND signal_id BETWEEN NEW.first_id AND NEW.last_id"
)
_MOVE: Final = Step(
    "move_rollups",
    ("run_id", "bucket", "first_id", "last_id"),
    f"INSERT OR REPLACE INTO rollup ({_COLUMNS}) SELECT {_COLUMNS} {_MOVED}",
    f"DELETE {_MOVED}",
)
_FIRST_AT_ONCE: Final = 20  # about 10 us each: in `rollup` each has a page of its own
_NONE: Final = 2**62  # beyond all buckets
_FORGET: Final = (
    "DELETE FROM watermark WHERE name = 'rollup'",
    "UPDATE run SET rolled_state_id = 0, coarse_end = NULL "
    "WHERE rolled_state_id > 0 OR coarse_end IS NOT NULL",
    "DELETE FROM coarse_rollup",
    "DELETE FROM rollup",
    "DELETE FROM recent_rollup",
    "DELETE FROM change",
    "UPDATE signal SET row_count = 0, null_row_count = 0, replaced_row_count = 0, "
    "min = NULL, max = NULL",
)


class Held(NamedTuple):
    """What the rollups of a run hold before a batch.

    Attributes:
        mark: Id of the last state row of the run that is in.
        recent: Its newest buckets.
    """

    run_id: int
    mark: int
    recent: dict[Key, Summary]

    def find(self, connection: sqlite3.Connection, key: Key) -> tuple[Summary | None, bool]:
        """A bucket of a signal, None where there is none, and whether it is in `rollup`."""
        if key in self.recent:
            return self.recent[key], False
        bucket, signal_id = key
        row = connection.execute(_OVER, (self.run_id, signal_id, bucket)).fetchone()
        return (None, False) if row is None else (Summary._make(row), True)


class Addition(NamedTuple):
    """What a batch of state rows of one run makes of its rollups: rows of the tables.

    Attributes:
        rollups: Whether it is over, run, bucket, signal, and the figures, as they will stand.
        changes: Run, signal, state row, simulation time, value.
        counts: What is added to the signals.
    """

    rollups: list[tuple[Any, ...]]
    changes: list[tuple[Any, ...]]
    counts: list[Count]


def run_mark(connection: sqlite3.Connection, run_id: int, schema: str = "") -> int | None:
    """The id of the last state row of a run that the rollups hold; None without such a run.

    Args:
        connection: Any.
        run_id: The run.
        schema: Of an attached database, with a dot.
    """
    query = RUN_MARK.format("?").replace("FROM ", f"FROM {schema}")
    row = connection.execute(query, (run_id,)).fetchone()
    return int(row[0]) if row else None


def watermark(connection: sqlite3.Connection, run_id: int | None = None) -> int:
    """The id of the last state row in the rollups, of a run or of all; 0 before the first."""
    if run_id is not None:
        return run_mark(connection, run_id) or 0
    row = connection.execute(_WATERMARK).fetchone()
    return int(row[0]) if row else 0


def held(connection: sqlite3.Connection, run_id: int, mark: int) -> Held:
    """The newest rollups of a run whose mark is known."""
    rows = connection.execute(_RECENT, (run_id,))
    return Held(run_id, mark, {(row[0], row[1]): Summary._make(row[2:]) for row in rows})


def store(connection: sqlite3.Connection, before: Held, addition: Addition, state_id: int) -> bool:
    """Store an addition, which holds the rows up to `state_id`; False where another was faster."""
    rows = (addition.rollups, addition.changes, addition.counts)
    _prepare(connection, dict(zip(_TEMPORARY, rows, strict=True)))
    first_coarse = min((row[2] // COARSE_BUCKETS for row in addition.rollups), default=_NONE)
    values = (before.run_id, before.mark, len(before.recent), state_id, first_coarse)
    return _STORE.run(connection, *values)


def _prepare(connection: sqlite3.Connection, rows: dict[str, Sequence[tuple[Any, ...]]]) -> None:
    """Fill the temporary tables, in a transaction that locks nothing but them."""
    connection.execute("BEGIN")
    try:
        for table in _TEMPORARY:
            fill(connection, table, rows[table])
    finally:
        connection.execute("COMMIT")


def fill(connection: sqlite3.Connection, table: str, rows: Sequence[tuple[Any, ...]]) -> None:
    """Let a temporary table hold these rows, and no others."""
    columns = _TEMPORARY[table]
    connection.execute(f"CREATE TEMP TABLE IF NOT EXISTS {table} ({columns})")
    connection.execute(f"DELETE FROM temp.{table}")
    marks = ", ".join("?" * len(columns.split(",")))
    connection.executemany(f"INSERT INTO temp.{table} VALUES ({marks})", rows)


def move(connection: sqlite3.Connection, pause_s: float) -> None:
    """Move the buckets that are over to `rollup`, as many at a time as a millisecond takes."""
    rows = connection.execute(_MOVABLE).fetchall()
    for (run_id, bucket), group in groupby(rows, lambda row: (row[0], row[1])):
        _move_bucket(connection, run_id, bucket, [row[2] for row in group], pause_s)


def _move_bucket(
    connection: sqlite3.Connection, run_id: int, bucket: int, ids: list[int], pause_s: float
) -> None:
    def move_some(some: Sequence[int]) -> bool:
        return _MOVE.run(connection, run_id, bucket, some[0], some[-1])

    in_short_steps(ids, move_some, pause_s)


def in_short_steps(
    items: Sequence[Item], store: Callable[[Sequence[Item]], bool], pause_s: float
) -> bool:
    """Store items in order, as many at a time as half a millisecond takes.

    Returns:
        False once `store` returned that: the others are not stored.
    """
    most, done = _FIRST_AT_ONCE, 0
    while done < len(items):
        some = items[done : done + most]
        started_s = time.perf_counter()
        if not store(some):
            return False
        took_s = time.perf_counter() - started_s
        done += len(some)
        most = max(1, round(len(some) * min(2.0, LONGEST_WRITE_S / 2 / took_s)))
        time.sleep(pause_s)
    return True


def forget(connection: sqlite3.Connection) -> None:
    """Empty the rollups, so that the next calls of `roll` rebuild them from the state rows.

    What was rolled up from rows that have been deleted since is lost.
    """
    with transaction(connection):
        for statement in _FORGET:
            connection.execute(statement)
