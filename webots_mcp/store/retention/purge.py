"""Carrying out a plan, a little at a time, so that no writer has to wait for it.

Rows go in transactions of about a millisecond, as many at once as that allows; between two of them
the caller rests for longer than the lock was held. The tables take turns, and space that became
free goes back to the disk in between. Where another writer holds the lock, it is tried again later.
State rows go only after they were rolled up and put into chunks.
"""

from __future__ import annotations

import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from webots_mcp.contract import KEPT_FRAME
from webots_mcp.errors import DatabaseError, InvalidInputError, NothingRecordedError
from webots_mcp.store.chunks.making import chunk_whole_run
from webots_mcp.store.chunks.stored import reached
from webots_mcp.store.images import inside
from webots_mcp.store.retention.planning import OLD_COMMANDS, ROLLED, Plan, plan
from webots_mcp.store.retention.planning import Step as Going
from webots_mcp.store.retention.policy import DEFAULT, KEPT, Retention
from webots_mcp.store.retention.usage import TABLES, first_id, rows_of
from webots_mcp.store.rollup.rolling import roll, watermark
from webots_mcp.transactions import LONGEST_WRITE_S, ShortWrites, Step, is_busy

BATCH_ROWS: Final = 500
ROLLED_ROWS: Final = 100
REST_S: Final = 0.005  # at least, between two writes
HURRIED_REST_S: Final = 0.001  # where no robot records: a checkpoint still gets its turn
RESTS: Final = 9  # the lock is held for a tenth of the time at most

_FREE_RUN: Final = f"NOT EXISTS (SELECT 1 FROM run WHERE id = :run_id AND {KEPT})"
_IN_TIME: Final = (
    "SELECT id, run_id FROM {table} NOT INDEXED WHERE id > :after AND id <= :bound "
    "AND run_id IN (SELECT value FROM json_each(:runs)) {own} ORDER BY id LIMIT :limit"
)
_LAST: Final = "SELECT coalesce(max(id), 0) FROM {table}"
_IN_RUN: Final = "SELECT run_id, signal_id, {third} FROM {table} WHERE run_id = ? LIMIT ?"
_OLD_COMMANDS: Final = f"SELECT id {OLD_COMMANDS} ORDER BY id LIMIT :limit"
_THIRD_KEY: Final = {"rollup": "bucket", "coarse_rollup": "bucket", "change": "state_id"}
_DELETE: Final = {
    table: f"DELETE FROM {table} WHERE id = :id AND {_FREE_RUN}" for table in (*TABLES, "run")
} | {
    table: f"DELETE FROM {table} WHERE run_id = :run_id AND signal_id = :signal_id "
    f"AND {_THIRD_KEY[table]} = :third AND {_FREE_RUN}"
    for table in ROLLED
}
_DELETE["command"] = "DELETE FROM command WHERE id = :id"
# Rows without files go many at once, in one statement: see `Step`. What is left in `going` went.
_GOING: Final = "CREATE TEMP TABLE IF NOT EXISTS going (id INTEGER PRIMARY KEY, run_id INTEGER)"
_NOT_GOING: Final = (
    "DELETE FROM going WHERE run_id IN (SELECT id FROM run WHERE {kept}) "
    "OR NOT EXISTS (SELECT 1 FROM {table} WHERE id = going.id)"
)
_COUNT_PURGED: Final = (
    "UPDATE run SET purged_rows = purged_rows + "
    "(SELECT count(*) FROM going WHERE run_id = run.id) WHERE id IN (SELECT run_id FROM going)"
)
# What goes from the states and lies in a kept stretch stays with it, under a limit of its own.
# CROSS JOIN: SQLite would go through all states in their order rather than sort the few that go.
_MOVE_KEPT: Final = (
    "INSERT INTO kept_state (run_id, sim_time_s, wall_time_s, data, odd) "
    "SELECT s.run_id, s.sim_time_s, s.wall_time_s, s.data, s.odd FROM going g "
    "CROSS JOIN state s ON s.id = g.id WHERE EXISTS (SELECT 1 FROM kept_stretch k "
    "WHERE k.run_id = s.run_id AND s.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s) "
    "ORDER BY g.id"
)
_END_KEEPING: Final = (
    "DELETE FROM kept_stretch WHERE EXISTS (SELECT 1 FROM going g "
    "CROSS JOIN kept_state s ON s.id = g.id WHERE s.run_id = kept_stretch.run_id "
    "AND s.sim_time_s BETWEEN kept_stretch.start_sim_time_s AND kept_stretch.end_sim_time_s)"
)
_BEFORE_DELETION: Final = {"state": (_COUNT_PURGED, _MOVE_KEPT), "kept_state": (_END_KEEPING,)}
_DELETE_GOING: Final = "DELETE FROM {table} WHERE id IN (SELECT id FROM going)"
_STEPS: Final = {
    table: Step(
        f"purge_{table}",
        ("step",),
        _NOT_GOING.format(table=table, kept=KEPT),
        *_BEFORE_DELETION.get(table, ()),
        _DELETE_GOING.format(table=table),
    )
    for table in ("state", "kept_state", "log", "event")
}
# Frames whose kept stretch is gone.
_LEFT_FRAMES: Final = (
    f"SELECT id, run_id FROM image i WHERE kind = '{KEPT_FRAME}' AND id > ? AND NOT EXISTS ("
    "SELECT 1 FROM kept_stretch k WHERE k.run_id = i.run_id "
    "AND i.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s) ORDER BY id LIMIT ?"
)
_SESSION: Final = "SELECT session_id FROM run WHERE id = ?"
_FORGET_SESSION: Final = (
    "DELETE FROM session WHERE id = ? AND ended_wall_time_s IS NOT NULL "
    "AND NOT EXISTS (SELECT 1 FROM run WHERE session_id = session.id)"
)
_PATH: Final = "SELECT path FROM image WHERE id = ?"
_PATHS: Final = "SELECT path FROM image WHERE run_id = ?"
_IN_USE: Final = "SELECT 1 FROM image WHERE path = ? LIMIT 1"
_MOST_FAILURES: Final = 200


@dataclass
class Purged:
    """What was deleted so far.

    Attributes:
        rows: By table.
        files: Pictures.
        freed_bytes: Given back by the database file (it shrinks with the next checkpoint).
        problems: Files that could not be deleted, and why.
        held_s: How long the last transaction held the write lock.
        longest_held_s: How long the longest one did.
    """

    rows: Counter[str] = field(default_factory=Counter[str])
    files: int = 0
    freed_bytes: int = 0
    problems: list[str] = field(default_factory=list[str])
    held_s: float = 0.0
    longest_held_s: float = 0.0

    @property
    def rest_s(self) -> float:
        """How long to leave the lock to others now."""
        return max(REST_S, RESTS * self.held_s)


def prune(
    connection: sqlite3.Connection,
    data_dir: Path,
    retention: Retention = DEFAULT,
    *,
    now_s: float | None = None,
    rest: bool = True,
    progress: Callable[[int, int], object] | None = None,
) -> Purged:
    """Delete what is beyond the limits, and give the space back to the disk.

    Args:
        connection: Of the role "writer", in autocommit mode, with a short busy timeout.
        data_dir: The folder that the paths of pictures are relative to.
        retention: The limits.
        now_s: Unix time, from which ages are counted; None for now.
        rest: Leave the lock to others for longer than it was held; false where no robot records.
        progress: Called after each batch with the rows deleted so far and in all.

    Raises:
        DatabaseError: Another process held the write lock all the time.
        sqlite3.Error: The file cannot be written or is damaged; what was deleted stays deleted.
    """
    wanted = plan(connection, retention, now_s)
    purged = Purged()
    for purged in purge(connection, wanted, data_dir):
        if progress is not None:
            progress(purged.rows.total(), wanted.rows)
        time.sleep(purged.rest_s if rest else HURRIED_REST_S)
    return purged


def purge(
    connection: sqlite3.Connection, wanted: Plan, data_dir: Path, spare_pages: int = 0
) -> Iterator[Purged]:
    """Carry out a plan, write by write; the caller rests wherever this yields.

    Args:
        connection: As for `prune`.
        wanted: The plan.
        data_dir: The folder that the paths of pictures are relative to.
        spare_pages: So many free pages stay in the file, for the rows to come.

    Yields:
        What was deleted so far; always the same object, and once at least.
    """
    work = _Purge(connection, data_dir, spare_pages)
    yield work.purged
    # Summaries go after the states that they stand for, and a run after all that it holds.
    for tables in ((*TABLES, "command"), ROLLED, ("run",)):
        steps = {name: [step for step in wanted.steps if step.table == name] for name in tables}
        yield from work.in_turn([work.carry_out(name, its) for name, its in steps.items() if its])
        if steps.get("kept_state"):
            yield from work.forget_frames()
    yield from work.give_back()


class _Pace:
    """How many to take at once, so that they take about the time that the lock may be held."""

    def __init__(self) -> None:
        self.count = 8

    def measure(self, count: int, held_s: float) -> None:
        """Go on from what these have taken; twice as many at most."""
        fitting = count * LONGEST_WRITE_S / max(held_s, 1e-6)
        self.count = max(1, min(int(fitting), 2 * self.count, BATCH_ROWS))


class _Purge:
    def __init__(self, connection: sqlite3.Connection, data_dir: Path, spare_pages: int) -> None:
        self._connection = connection
        self._data_dir = data_dir
        self._spare_pages = spare_pages
        self._failures = 0
        self._writes = ShortWrites(connection)
        self._vacuuming = _Pace()
        self._paces = {table: _Pace() for table in _STEPS}
        self._in_chunks: dict[int, int] = {}  # run: the id up to which all that can be is
        self.purged = Purged()

    def in_turn(self, tables: Sequence[Iterator[Purged]]) -> Iterator[Purged]:
        """A write of each table, then some of the space back, until nothing is left to delete."""
        left = list(tables)
        while left:
            for table in tuple(left):
                if next(table, None) is None:
                    left.remove(table)
                else:
                    yield self.purged
            if self._give_some_back():
                yield self.purged

    def give_back(self) -> Iterator[Purged]:
        """Return what is free to the disk: many small transactions (SQLite, PRAGMA auto_vacuum)."""
        while self._give_some_back():
            yield self.purged

    def carry_out(self, table: str, steps: Sequence[Going]) -> Iterator[Purged]:
        """Delete what has to go of a table."""
        find = self._in_time if table in TABLES else self._by_owner
        for keys in find(table, steps):
            while keys:
                if table == "state" and keys[-1]["id"] > watermark(self._connection):
                    roll(self._connection, ROLLED_ROWS)
                elif table == "state" and (run_id := self._not_in_chunks(keys)):
                    if chunk_whole_run(self._connection, run_id):
                        # What is in no chunk now holds what no bridge writes, and may go.
                        self._in_chunks[run_id] = keys[-1]["id"]
                else:
                    keys = keys[self._delete_some(table, keys) :]
                yield self.purged

    def forget_frames(self) -> Iterator[Purged]:
        """Delete the frames of kept stretches that are gone, with their files."""
        after = 0
        while found := self._connection.execute(_LEFT_FRAMES, (after, BATCH_ROWS)).fetchall():
            after = found[-1][0]
            keys = [{"id": row_id, "run_id": run_id} for row_id, run_id in found]
            while keys:
                keys = keys[self._delete_some("image", keys) :]
                yield self.purged

    def _not_in_chunks(self, keys: Sequence[dict[str, Any]]) -> int | None:
        """A run of which rows are in no chunk yet; None if there is none."""
        newest = {key["run_id"]: key["id"] for key in keys}
        return next(
            (
                run
                for run, last in newest.items()
                if max(reached(self._connection, run).max_in_groups, self._in_chunks.get(run, 0))
                < last
            ),
            None,
        )

    def _in_time(self, table: str, steps: Sequence[Going]) -> Iterator[list[dict[str, Any]]]:
        """Keys in the order in which the rows were recorded, so that whole pages become free."""
        left: dict[int, int] = {step.owner_id: step.rows for step in steps}
        bounds = {step.owner_id: step.bound for step in steps}
        after = first_id(self._connection, table, list(left)) - 1
        last = self._first(_LAST.format(table=table))  # what comes later was not planned
        while left:
            values = {
                "after": after,
                "bound": min(max(bounds.values()), last),
                "runs": f"[{','.join(map(str, left))}]",
                "limit": BATCH_ROWS,
            }
            found = self._connection.execute(rows_of(_IN_TIME, table), values).fetchall()
            if not found:
                return  # another has deleted them
            after = found[-1][0]
            keys: list[dict[str, Any]] = []
            for row_id, run_id in found:
                if left.get(run_id) and row_id <= bounds[run_id]:
                    left[run_id] -= 1
                    keys.append({"id": row_id, "run_id": run_id})
            left = {run_id: rows for run_id, rows in left.items() if rows}
            yield keys

    def _by_owner(self, table: str, steps: Sequence[Going]) -> Iterator[list[dict[str, Any]]]:
        """Keys of summaries and runs of a run, of commands of a robot."""
        for step in steps:
            left = step.rows
            while left > 0 and (keys := self._keys_of(table, step, min(left, BATCH_ROWS))):
                yield keys
                left -= len(keys)

    def _keys_of(self, table: str, step: Going, limit: int) -> list[dict[str, Any]]:
        if table == "run":
            return [{"id": step.owner_id, "run_id": step.owner_id}]
        if table == "command":
            before = {"robot_id": step.owner_id, "before_s": step.bound, "limit": limit}
            found = self._connection.execute(_OLD_COMMANDS, before).fetchall()
            return [{"id": row[0]} for row in found]
        query = _IN_RUN.format(table=table, third=_THIRD_KEY[table])
        names = ("run_id", "signal_id", "third")
        found = self._connection.execute(query, (step.owner_id, limit)).fetchall()
        return [dict(zip(names, row, strict=True)) for row in found]

    def _delete_some(self, table: str, keys: Sequence[dict[str, Any]]) -> int:
        """One short transaction; returns how many of the keys are done, 0 where it was locked."""
        if table in _STEPS:
            return self._unless_locked(lambda: self._run_step(table, keys))
        deleted = 0

        def delete(key: dict[str, Any]) -> None:
            nonlocal deleted
            deleted += self._delete(table, key)

        done = self._unless_locked(lambda: self._writes.write(keys, delete))
        if done:
            self.purged.rows[table] += deleted
            self._note(self._writes.held_s)
        return done

    def _run_step(self, table: str, keys: Sequence[dict[str, Any]]) -> int:
        pace = self._paces[table]
        some = keys[: pace.count]
        self._connection.execute(_GOING)
        self._connection.execute("DELETE FROM going")
        self._connection.executemany("INSERT INTO going VALUES (:id, :run_id)", some)
        started_s = time.perf_counter()
        _STEPS[table].run(self._connection, None)
        held_s = time.perf_counter() - started_s
        pace.measure(len(some), held_s)
        self.purged.rows[table] += self._first("SELECT count(*) FROM going")
        self._note(held_s)
        return len(some)

    def _delete(self, table: str, key: dict[str, Any]) -> int:
        """How many rows; none of a run that was marked since the plan."""
        paths = self._pictures_of(table, key)
        session = self._first(_SESSION, key["id"]) if table == "run" else None
        deleted = self._connection.execute(_DELETE[table], key).rowcount
        if not deleted:
            return 0
        if session is not None:
            self._connection.execute(_FORGET_SESSION, (session,))
        for path in paths:
            if not self._first(_IN_USE, path):
                self._delete_file(path)
        return deleted

    def _pictures_of(self, table: str, key: dict[str, Any]) -> list[str]:
        """The paths of what goes with a row: the picture, or those that a run still has."""
        query = {"image": _PATH, "run": _PATHS}.get(table)
        if query is None:
            return []
        return [path for (path,) in self._connection.execute(query, (key["id"],)) if path]

    def _delete_file(self, path: str) -> None:
        """Before the commit: a row that comes back without its file is found again."""
        try:
            inside(self._data_dir, path).unlink()
            self.purged.files += 1
        except OSError as error:
            self.purged.problems.append(f"{path}: {error}")
        except (InvalidInputError, NothingRecordedError):
            pass  # a foreign path is not ours to delete, and a file that is gone need not be

    def _give_some_back(self) -> bool:
        """One short transaction of it; whether there may be more."""
        free = self._pragma("freelist_count")
        if self._pragma("auto_vacuum") != 2 or free <= self._spare_pages:
            return False
        pages = min(self._vacuuming.count, free - self._spare_pages)
        self._unless_locked(lambda: self._give_pages_back(pages))
        return True

    def _give_pages_back(self, pages: int) -> int:
        started_s = time.perf_counter()
        # execute() would stop after the first page.
        self._connection.executescript(f"PRAGMA incremental_vacuum({pages})")
        held_s = time.perf_counter() - started_s
        self._vacuuming.measure(pages, held_s)
        self.purged.freed_bytes += pages * self._pragma("page_size")
        self._note(held_s)
        return pages

    def _note(self, held_s: float) -> None:
        self.purged.held_s = held_s
        self.purged.longest_held_s = max(self.purged.longest_held_s, held_s)

    def _first(self, query: str, *values: object) -> Any:
        row = self._connection.execute(query, values).fetchone()
        return row[0] if row else None

    def _unless_locked(self, write: Callable[[], int]) -> int:
        """How many were written; 0 where another holds the write lock."""
        try:
            written = write()
        except sqlite3.OperationalError as error:
            if not is_busy(error):
                raise
            self._failures += 1
            if self._failures > _MOST_FAILURES:
                raise DatabaseError(
                    f"another process held the write lock in {_MOST_FAILURES} attempts: end it "
                    "and try again"
                ) from error
            return 0
        self._failures = 0
        return written

    def _pragma(self, name: str) -> int:
        return int(self._connection.execute(f"PRAGMA {name}").fetchone()[0])
