"""Rollups: 10 s of simulation time of each signal of each run, kept beside the state rows.

`roll` is the maintainer's work, never the control loop's. It also keeps the register of signals,
and the change points of text and boolean signals. How far it came is the watermark, the id of the
last state row that is in: ids are given under the write lock, so a row never comes late.
"""

from __future__ import annotations

import contextlib
import sqlite3
from bisect import bisect_left
from collections.abc import Generator, Iterator, Sequence
from typing import Any, Final, NamedTuple

from webots_mcp.store.history.batch import Batch, BatchColumn
from webots_mcp.store.history.columns import cleaned
from webots_mcp.store.history.leaves import shown
from webots_mcp.store.history.registry import Signal, enter_signals
from webots_mcp.store.history.summary import Summary, merge, summarise

BUCKET_S: Final = 10.0
BATCH_ROWS: Final = 200  # summing holds the write lock, about 0.1 ms a row: keep a batch short

_WATERMARK: Final = "SELECT state_id FROM watermark WHERE name = 'rollup'"
_SET_WATERMARK: Final = "INSERT OR REPLACE INTO watermark (name, state_id) VALUES ('rollup', ?)"
_ROWS: Final = (
    "SELECT s.id, r.robot_id, s.run_id, s.sim_time_s, s.wall_time_s, s.data, s.odd "
    "FROM state s JOIN run r ON r.id = s.run_id WHERE s.id > ? ORDER BY s.id LIMIT ?"
)
_COLUMNS: Final = ", ".join(Summary._fields)
_BUCKET: Final = f"SELECT {_COLUMNS} FROM rollup WHERE run_id = ? AND signal_id = ? AND bucket = ?"
_SET_BUCKET: Final = (
    f"INSERT OR REPLACE INTO rollup (run_id, signal_id, bucket, {_COLUMNS}) "
    f"VALUES (?, ?, ?{', ?' * len(Summary._fields)})"
)
_BUCKETS: Final = (
    f"SELECT bucket, {_COLUMNS} FROM rollup "
    "WHERE run_id = ? AND signal_id = ? AND bucket >= ? AND bucket < ? ORDER BY bucket"
)
_LAST_CHANGE: Final = (
    "SELECT value FROM change WHERE run_id = ? AND signal_id = ? ORDER BY state_id DESC LIMIT 1"
)
_ADD_CHANGE: Final = (
    "INSERT OR IGNORE INTO change (run_id, signal_id, state_id, sim_time_s, value) "
    "VALUES (?, ?, ?, ?, ?)"
)
# The rollups were emptied by hand, although rows are there that they once held.
_EMPTIED: Final = (
    "SELECT NOT EXISTS (SELECT 1 FROM rollup) "
    "AND EXISTS (SELECT 1 FROM signal WHERE rows > 0) "
    "AND EXISTS (SELECT 1 FROM state WHERE id <= (SELECT state_id FROM watermark))"
)
# What a row of foreign origin may hold: numbers, text and nesting that cannot be stored.
_UNSTORABLE: Final = (OverflowError, ValueError, RecursionError, sqlite3.DataError)
_FORGET: Final = (
    "DELETE FROM watermark WHERE name = 'rollup'",
    "DELETE FROM rollup",
    "DELETE FROM change",
    "UPDATE signal SET rows = 0, null_rows = 0, odd_rows = 0, min = NULL, max = NULL",
)


class Rolled(NamedTuple):
    """What a call of `roll` did.

    Attributes:
        rows: State rows that it took in.
        done: Whether it reached the newest row.
    """

    rows: int
    done: bool


def roll(connection: sqlite3.Connection, budget_rows: int = 2000) -> Rolled:
    """Take in the state rows after the watermark, at most `budget_rows` of them.

    Each batch is read and parsed outside the write lock, summed and stored in one transaction that
    first looks whether the watermark is still where it was: of two callers one stores, the other
    finds nothing left to do. A missing watermark, or rollups emptied by hand, begin at the first
    row again.

    Args:
        connection: Of a maintainer (the role "writer"), in autocommit mode.
        budget_rows: Bounds the time of the call: about 50 us per row of 40 leaves.

    Raises:
        sqlite3.Error: The database is locked or damaged; nothing of the batch was stored.
    """
    if connection.execute(_EMPTIED).fetchone()[0]:
        forget(connection)
    taken = 0
    while taken < budget_rows:
        rows = _roll_batch(connection, min(BATCH_ROWS, budget_rows - taken))
        if rows is None:
            return Rolled(taken, True)
        taken += rows
    return Rolled(taken, False)


def forget(connection: sqlite3.Connection) -> None:
    """Empty the rollups, so that the next calls of `roll` rebuild them from the state rows.

    What was rolled up from rows that have been deleted since is lost.
    """
    with _writing(connection):
        for statement in _FORGET:
            connection.execute(statement)


@contextlib.contextmanager
def _writing(connection: sqlite3.Connection) -> Generator[None]:
    """A transaction that takes the write lock first; all of it is stored, or nothing."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        connection.execute("ROLLBACK")
        raise


def watermark(connection: sqlite3.Connection) -> int:
    """The id of the last state row that the rollups hold; 0 before the first."""
    row = connection.execute(_WATERMARK).fetchone()
    return int(row[0]) if row else 0


def buckets(
    connection: sqlite3.Connection, run_id: int, signal_id: int, first: int, end: int
) -> Iterator[tuple[int, Summary]]:
    """The rollups of a signal in buckets [first, end), in order; empty ones are left out."""
    rows = connection.execute(_BUCKETS, (run_id, signal_id, first, end))
    return ((row[0], Summary._make(row[1:])) for row in rows)


def _roll_batch(connection: sqlite3.Connection, limit: int) -> int | None:
    """The rows taken in: None if there are no more, 0 if another caller was faster.

    A row that cannot be summed up costs only itself: it is looked for by halving, and left out.
    """
    mark = watermark(connection)
    rows = connection.execute(_ROWS, (mark, limit)).fetchall()
    if not rows:
        return None
    try:
        return _take_in(connection, mark, rows)
    except _UNSTORABLE:
        if len(rows) > 1:
            return _roll_batch(connection, len(rows) // 2)
        return _take_in(connection, mark, rows, leave_out=True)


def _take_in(
    connection: sqlite3.Connection, mark: int, rows: Sequence[Any], *, leave_out: bool = False
) -> int:
    batch = Batch()
    for row in () if leave_out else rows:
        batch.add(*row)
    with _writing(connection):
        current = watermark(connection) == mark
        if current:
            _store(connection, batch)
            connection.execute(_SET_WATERMARK, (rows[-1][0],))
    return len(rows) if current else 0


def _store(connection: sqlite3.Connection, batch: Batch) -> None:
    signals = enter_signals(connection, batch)
    for column in batch.columns():
        signal = signals.get((column.robot_id, column.name))
        if signal is None:
            continue  # beyond the number of signals that a robot may have
        _store_buckets(connection, signal, column)
        if signal.kind not in ("num", "angle"):  # null may yet become text
            _store_changes(connection, signal, column)


def _store_buckets(connection: sqlite3.Connection, signal: Signal, column: BatchColumn) -> None:
    _, times, values = zip(*column.points, strict=True)
    if signal.kind == "text":
        values = cleaned(signal, list(values))
    end = 0
    while (start := end) < len(times):
        bucket = bucket_of(times[start])
        end = bisect_left(times, (bucket + 1) * BUCKET_S, start)
        summary = summarise(times[start:end], values[start:end], angle=signal.kind == "angle")
        key = (column.run_id, signal.id, bucket)
        before = connection.execute(_BUCKET, key).fetchone()
        if before is not None:
            summary = merge([_of_kind(signal, Summary._make(before)), summary])
        connection.execute(_SET_BUCKET, (*key, *summary))


def _of_kind(signal: Signal, before: Summary) -> Summary:
    """What was summed up while it was still a number is text now."""
    if signal.kind != "text" or before.sum is None:
        return before
    kept = ("rows", "present", "first_sim_time_s", "last_sim_time_s")
    return Summary(**{name: getattr(before, name) for name in kept})


def _store_changes(connection: sqlite3.Connection, signal: Signal, column: BatchColumn) -> None:
    key = (column.run_id, signal.id)
    last = connection.execute(_LAST_CHANGE, key).fetchone()
    before: str | tuple[()] | None = last[0] if last else ()
    for state_id, time_s, value in column.points:
        if (text := shown(value)) != before:
            connection.execute(_ADD_CHANGE, (*key, state_id, time_s, text))
            before = text


def bucket_of(sim_time_s: float) -> int:
    """The number of the bucket that holds that time."""
    return int(sim_time_s // BUCKET_S)  # exact, which floor of a rounded quotient is not
