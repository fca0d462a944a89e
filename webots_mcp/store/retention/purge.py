"""Carrying out a plan, a little at a time, so that no writer has to wait for it.

Each batch looks up the keys of at most 500 rows, then deletes them in one transaction of 1 to 2
ms. Between batches the caller pauses. Where another writer holds the lock, the batch is tried
again later. State rows go only after they were rolled up.
"""

from __future__ import annotations

import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.connection import is_busy, transaction
from webots_mcp.errors import DatabaseError, InvalidInputError, NothingRecordedError
from webots_mcp.store.history.rollup import roll, watermark
from webots_mcp.store.images import inside
from webots_mcp.store.retention.planning import OLD_COMMANDS, Plan, Step, plan
from webots_mcp.store.retention.policy import DEFAULT, KEPT, Retention

BATCH_ROWS: Final = 500
ROLLED_ROWS: Final = 100  # a batch of rolling up holds the lock longer than one of deleting
BATCH_FILES: Final = 50
BATCH_PAGES: Final = 200
PAUSE_S: Final = 0.05


class _Batch(NamedTuple):
    """How the keys of the oldest rows are found, and one of them deleted."""

    keys: str
    delete: str


_IN_TIME: Final = (
    "SELECT id FROM {table} WHERE run_id = :owner_id AND id <= :bound "
    "ORDER BY sim_time_s, id LIMIT :limit"
)
_IN_RUN: Final = (
    "SELECT run_id, signal_id, {third} FROM {table} WHERE run_id = :owner_id LIMIT :limit"
)
_BATCHES: Final = {
    table: _Batch(_IN_TIME.format(table=table), f"DELETE FROM {table} WHERE id = ?")
    for table in ("state", "log", "event", "image")
} | {
    table: _Batch(
        _IN_RUN.format(table=table, third=third),
        f"DELETE FROM {table} WHERE run_id = ? AND signal_id = ? AND {third} = ?",
    )
    for table, third in (("rollup", "bucket"), ("change", "state_id"))
}
_BATCHES["run"] = _Batch("SELECT id FROM run WHERE id = :owner_id", "DELETE FROM run WHERE id = ?")
_BATCHES["command"] = _Batch(
    f"SELECT id {OLD_COMMANDS.replace(':robot_id', ':owner_id').replace(':before_s', ':bound')} "
    "ORDER BY id LIMIT :limit",
    "DELETE FROM command WHERE id = ?",
)
_COUNT_PURGED: Final = "UPDATE run SET purged_rows = purged_rows + ? WHERE id = ?"
_SESSION: Final = "SELECT session_id FROM run WHERE id = ?"
_FORGET_SESSION: Final = (
    "DELETE FROM session WHERE id = ? AND ended_wall_time_s IS NOT NULL "
    "AND NOT EXISTS (SELECT 1 FROM run WHERE session_id = session.id)"
)
_PATH: Final = "SELECT path FROM image WHERE id = ?"
_IN_USE: Final = "SELECT 1 FROM image WHERE path = ? LIMIT 1"
_IS_KEPT: Final = f"SELECT 1 FROM run WHERE id = ? AND {KEPT}"
_MOST_FAILURES: Final = 200


@dataclass
class Purged:
    """What was deleted so far.

    Attributes:
        rows: By table.
        files: Pictures.
        freed_bytes: Given back by the database file (it shrinks with the next checkpoint).
        problems: Files that could not be deleted, and why.
    """

    rows: Counter[str] = field(default_factory=Counter[str])
    files: int = 0
    freed_bytes: int = 0
    problems: list[str] = field(default_factory=list[str])


def prune(
    connection: sqlite3.Connection,
    data_dir: Path,
    retention: Retention = DEFAULT,
    *,
    now_s: float | None = None,
    pause_s: float = PAUSE_S,
    progress: Callable[[int, int], object] | None = None,
) -> Purged:
    """Delete what is beyond the limits, and give the space back to the disk.

    Args:
        connection: Of the role "writer", in autocommit mode, with a short busy timeout.
        data_dir: The folder that the paths of pictures are relative to.
        retention: The limits.
        now_s: Unix time, from which ages are counted; None for now.
        pause_s: Between batches; 0 where nobody else writes.
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
        time.sleep(pause_s)
    return purged


def purge(
    connection: sqlite3.Connection, wanted: Plan, data_dir: Path, spare_pages: int = 0
) -> Iterator[Purged]:
    """Carry out a plan batch by batch; the caller pauses wherever this yields.

    Args:
        connection: As for `prune`.
        wanted: The plan.
        data_dir: The folder that the paths of pictures are relative to.
        spare_pages: So many free pages stay in the file, for the rows to come.

    Yields:
        What was deleted so far; always the same object, and once at least.
    """
    work = _Purge(connection, data_dir)
    yield work.purged
    for step in wanted.steps:
        yield from work.carry_out(step)
    yield from work.give_back(spare_pages)


class _Purge:
    def __init__(self, connection: sqlite3.Connection, data_dir: Path) -> None:
        self._connection = connection
        self._data_dir = data_dir
        self._failures = 0
        self.purged = Purged()

    def carry_out(self, step: Step) -> Iterator[Purged]:
        left, most = step.rows, BATCH_FILES if step.table == "image" else BATCH_ROWS
        while left > 0:
            keys = self._oldest(step, min(left, most))
            if not keys:
                return  # another has deleted them
            if step.table == "state" and keys[-1][0] > watermark(self._connection):
                roll(self._connection, ROLLED_ROWS)
            elif self._deleted(step, keys):
                left -= len(keys)
            yield self.purged

    def give_back(self, spare_pages: int) -> Iterator[Purged]:
        """Return free pages to the disk: many small transactions (SQLite, PRAGMA auto_vacuum)."""
        page_bytes = self._pragma("page_size")
        while self._pragma("auto_vacuum") == 2:
            free = self._pragma("freelist_count")
            if free <= spare_pages:
                return
            pages = min(BATCH_PAGES, free - spare_pages)
            # execute() would stop after the first page.
            script = f"PRAGMA incremental_vacuum({pages})"
            if self._unless_locked(lambda script=script: self._connection.executescript(script)):
                self.purged.freed_bytes += (free - self._pragma("freelist_count")) * page_bytes
            yield self.purged

    def _oldest(self, step: Step, limit: int) -> list[tuple[Any, ...]]:
        values = {"owner_id": step.owner_id, "bound": step.bound, "limit": limit}
        return self._connection.execute(_BATCHES[step.table].keys, values).fetchall()

    def _deleted(self, step: Step, keys: list[tuple[Any, ...]]) -> bool:
        """One batch in one transaction; False where another holds the write lock."""
        rows = 0

        def delete() -> None:
            nonlocal rows
            with transaction(self._connection):
                rows = self._delete(step, keys)

        if not self._unless_locked(delete):
            return False
        self.purged.rows[step.table] += rows
        return True

    def _delete(self, step: Step, keys: list[tuple[Any, ...]]) -> int:
        """So many rows; nothing of a run that was marked since the plan."""
        if step.table != "command" and self._first(_IS_KEPT, step.owner_id):
            return 0
        paths = [self._first(_PATH, *key) for key in keys] if step.table == "image" else []
        session = self._first(_SESSION, step.owner_id) if step.table == "run" else None
        deleted = self._connection.executemany(_BATCHES[step.table].delete, keys).rowcount
        if step.table == "state":
            self._connection.execute(_COUNT_PURGED, (deleted, step.owner_id))
        self._connection.execute(_FORGET_SESSION, (session,))
        for path in paths:
            if path and not self._first(_IN_USE, path):
                self._delete_file(path)
        return deleted

    def _delete_file(self, path: str) -> None:
        """Before the commit: a row that comes back without its file is found again."""
        try:
            inside(self._data_dir, path).unlink()
            self.purged.files += 1
        except OSError as error:
            self.purged.problems.append(f"{path}: {error}")
        except (InvalidInputError, NothingRecordedError):
            pass  # a foreign path is not ours to delete, and a file that is gone need not be

    def _first(self, query: str, *values: object) -> Any:
        row = self._connection.execute(query, values).fetchone()
        return row[0] if row else None

    def _unless_locked(self, work: Callable[[], object]) -> bool:
        try:
            work()
        except sqlite3.OperationalError as error:
            if not is_busy(error):
                raise
            self._failures += 1
            if self._failures > _MOST_FAILURES:
                raise DatabaseError(
                    f"another process held the write lock in {_MOST_FAILURES} attempts: end it "
                    "and try again"
                ) from error
            return False
        self._failures = 0
        return True

    def _pragma(self, name: str) -> int:
        return int(self._connection.execute(f"PRAGMA {name}").fetchone()[0])
