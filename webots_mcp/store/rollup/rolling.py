"""Rollups: 10 s of simulation time of each signal of each run, kept in addition to the state rows.

`roll` is the maintainer's work, never the control loop's. It also keeps the register of signals,
and the change points of text and boolean signals. Its progress is kept in two marks, the id of
the last state row that is in: the watermark of all runs, and one of each run that is beyond it. Ids
are given under the write lock, so a row never comes late.
"""

from __future__ import annotations

import sqlite3
import time
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

from webots_mcp.errors import warn
from webots_mcp.store.analysis.summary import Summary, merge
from webots_mcp.store.invalid_rows import InvalidValues, is_over_a_value, valid_rows
from webots_mcp.store.reading.rows import cleaned
from webots_mcp.store.rollup.batch import Batch, BatchColumn
from webots_mcp.store.rollup.buckets import BUCKET_S, bucket_of
from webots_mcp.store.rollup.coarse import merge_coarse
from webots_mcp.store.rollup.tables import (
    IS_ID,
    Addition,
    Held,
    forget,
    held,
    move,
    run_mark,
    store,
    watermark,
)
from webots_mcp.store.signals.flatten import shown
from webots_mcp.store.signals.registry import Signal, count, enter_signals

__all__ = ["Rolled", "forget", "roll", "watermark"]

BATCH_ROWS: Final = 2000

_SET_WATERMARK: Final = (
    "INSERT INTO watermark (name, state_id) VALUES ('rollup', ?) "
    "ON CONFLICT (name) DO UPDATE SET state_id = "
    f"iif({IS_ID.format('state_id')}, max(state_id, excluded.state_id), excluded.state_id)"
)
_COLUMNS: Final = "s.id, r.robot_id, s.run_id, s.sim_time_s, s.wall_time_s, s.data, s.replaced"
_ROWS: Final = (
    f"SELECT {_COLUMNS} FROM state s JOIN run r ON r.id = s.run_id "
    "WHERE s.id > ? ORDER BY s.id LIMIT ?"
)
_IDS: Final = "SELECT id FROM state WHERE id > ? ORDER BY id LIMIT ?"
_SOUND_ROWS: Final = (
    f"SELECT {_COLUMNS} FROM valid_state s JOIN valid_run r ON r.id = s.run_id "
    "WHERE s.id > ? AND s.id <= ? ORDER BY s.id"
)
_LAST_CHANGE: Final = (
    "SELECT value FROM change WHERE run_id = ? AND signal_id = ? ORDER BY state_id DESC LIMIT 1"
)
# The rollups were emptied by hand, although rows are there that they once held.
_EMPTIED: Final = (
    "SELECT NOT EXISTS (SELECT 1 FROM rollup) "
    "AND (SELECT total(row_count) FROM signal) > (SELECT total(rows) FROM recent_rollup) "
    "AND EXISTS (SELECT 1 FROM state WHERE id <= (SELECT state_id FROM watermark))"
)


class Rolled(NamedTuple):
    """What a call of `roll` did.

    Attributes:
        rows: State rows that it took in.
        done: Whether it reached the newest row, and no rollups are left to merge.
    """

    rows: int
    done: bool


def roll(connection: sqlite3.Connection, budget_rows: int = 2000, pause_s: float = 0.0) -> Rolled:
    """Take in the state rows after the watermark, at most `budget_rows` of them.

    Rows are read, parsed and summed up outside the write lock. What they come to is stored run by
    run, each in one step of less than a millisecond that first looks whether the run's mark is
    still where it was: of two callers one stores, the other finds nothing left to do. Rows that
    hold what no bridge writes are left out, and said on stderr. Rollups emptied by hand begin at
    the first row again.

    Args:
        connection: Of a maintainer (the role "writer"), in autocommit mode.
        budget_rows: Bounds the time of the call: about 50 us per row of 40 leaves. As many rollups
            of 10 s are merged into coarse ones.
        pause_s: Between two steps, for others to write; 0 where no other process does.

    Raises:
        sqlite3.Error: The database is locked or damaged; nothing of the step was stored.
    """
    if connection.execute(_EMPTIED).fetchone()[0]:
        forget(connection)
    taken, done = 0, False
    while taken < budget_rows and not done:
        rows = _roll_batch(connection, min(BATCH_ROWS, budget_rows - taken), pause_s)
        done = rows is None
        taken += rows or 0
    move(connection, pause_s)
    # Later, where rows are left: one of an old run would go into what was merged already.
    return Rolled(taken, done and merge_coarse(connection, budget_rows, pause_s))


def _roll_batch(connection: sqlite3.Connection, limit: int, pause_s: float) -> int | None:
    """The rows taken in: None if there are no more, 0 if another caller was faster."""
    after = watermark(connection)
    try:
        rows = connection.execute(_ROWS, (after, limit)).fetchall()
        ids = [row[0] for row in rows]
        stored = _take_in(connection, rows, pause_s)
    except Exception as error:
        if not is_over_a_value(error):
            raise
        ids = [row[0] for row in connection.execute(_IDS, (after, limit))]
        stored = _take_in_sound(connection, after, ids[-1], pause_s)
    if stored and ids:
        connection.execute(_SET_WATERMARK, (ids[-1],))
    return (len(ids) if stored else 0) if ids else None


def _take_in_sound(connection: sqlite3.Connection, after: int, last: int, pause_s: float) -> bool:
    """As `_take_in`, of rows among which are some that no bridge has written: they are left out."""
    with valid_rows(connection) as invalid:
        rows = connection.execute(_SOUND_ROWS, (after, last)).fetchall()
        stored = _take_in_halves(connection, rows, pause_s, invalid)
    if stored:
        warn(f"left out of the rollups: {'; '.join(invalid.described())}")
    return stored


def _take_in_halves(
    connection: sqlite3.Connection, rows: Sequence[Any], pause_s: float, invalid: InvalidValues
) -> bool:
    """A row that cannot be summed up costs only itself: it is looked for by halving."""
    try:
        return _take_in(connection, rows, pause_s)
    except Exception as error:
        if not is_over_a_value(error):
            raise
        if len(rows) == 1:
            invalid.note("state", rows[0][0], "data", "state")
            return True
    middle = len(rows) // 2
    return all(
        _take_in_halves(connection, half, pause_s, invalid)
        for half in (rows[:middle], rows[middle:])
    )


def _take_in(connection: sqlite3.Connection, rows: Sequence[Any], pause_s: float) -> bool:
    """Whether all of them are in, run by run; the mark of a run shows which were before."""
    robots = {row[2]: row[1] for row in rows}
    for run_id, robot_id in robots.items():
        mark = run_mark(connection, run_id)
        if mark is None:
            return False  # the run was deleted, and its rows with it
        before = held(connection, run_id, mark)
        fresh = [row for row in rows if row[2] == run_id and row[0] > mark]
        addition = _sum_up(connection, before, robot_id, fresh)
        if fresh and not store(connection, before, addition, fresh[-1][0]):
            return False
        time.sleep(pause_s)
    return True


def _sum_up(
    connection: sqlite3.Connection, before: Held, robot_id: int, rows: Sequence[Any]
) -> Addition:
    """What the rows of a run make of what is held of it; only names that are new are written."""
    batch = Batch()
    for row in rows:
        batch.add(*row)
    columns = list(batch.columns())
    known = enter_signals(connection, robot_id, columns)
    addition = Addition([], [], [])
    for column in columns:
        signal = known.get(column.name)
        if signal is None:
            continue  # beyond the number of signals that a robot may have
        addition.counts.append(count(signal, column))
        addition.rollups.extend(_rollups(connection, before, signal, column))
        if signal.kind not in ("num", "angle"):  # null may yet become text
            addition.changes.extend(_changes(connection, signal, column))
    return addition


def _rollups(
    connection: sqlite3.Connection, before: Held, signal: Signal, column: BatchColumn
) -> Iterator[tuple[Any, ...]]:
    assert signal.id is not None
    _, times, values = zip(*column.points, strict=True)
    if signal.kind == "text":
        values = cleaned(signal, list(values))
    end = 0
    while (start := end) < len(times):
        bucket = bucket_of(times[start])
        end = bisect_left(times, (bucket + 1) * BUCKET_S, start)
        summary = signal.summarise(times[start:end], values[start:end])
        known, is_over = before.find(connection, (bucket, signal.id))
        if known is not None:
            summary = merge([_of_kind(signal, known), summary])
        yield (is_over, column.run_id, bucket, signal.id, *summary)


def _of_kind(signal: Signal, before: Summary) -> Summary:
    """What was summed up while it was still a number is text now."""
    if signal.kind != "text" or before.sum is None:
        return before
    kept = ("rows", "present", "first_sim_time_s", "last_sim_time_s")
    return Summary(**{name: getattr(before, name) for name in kept})


def _changes(
    connection: sqlite3.Connection, signal: Signal, column: BatchColumn
) -> Iterator[tuple[Any, ...]]:
    key = (column.run_id, signal.id)
    last = connection.execute(_LAST_CHANGE, key).fetchone()
    before: str | tuple[()] | None = last[0] if last else ()
    for state_id, time_s, value in column.points:
        if (text := shown(value)) != before:
            yield (*key, state_id, time_s, text)
            before = text
