"""Carry out a retention plan in small steps, so that no writer has to wait.

Rows are deleted in transactions of about a millisecond. Between two transactions the caller rests
for longer than the lock was held. The tables take turns, and freed space returns to the disk in
between. If another writer holds the lock, the write is retried later. State rows are deleted only
after their values were put into chunks.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from webots_mcp.contract import KEPT_FRAME
from webots_mcp.database.tapes.tape import tape_files
from webots_mcp.database.transactions import LONGEST_WRITE_S, AtomicStatements, is_busy
from webots_mcp.errors import DatabaseError, InvalidInputError, NothingRecordedError
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks, remake_if_damaged
from webots_mcp.store.retention_limits import DEFAULT, KEPT, Retention, in_force
from webots_mcp.store.retention_plan import OLD_COMMANDS, Going, Plan, Portion, ids_of, plan
from webots_mcp.store.run_rows import inside

BATCH_ROWS: Final = 500
_NOT_GOING: Final = (
    "DELETE FROM going WHERE run_id IN (SELECT id FROM run WHERE {kept}) "
    "OR NOT EXISTS (SELECT 1 FROM {table} WHERE id = going.id)"
)
_COUNT_STORED: Final = (
    "UPDATE row_group SET stored_row_count = max(0, stored_row_count - "
    "(SELECT count(*) FROM going)) WHERE id = NEW.group_id"
)
_COUNT_PURGED: Final = (
    "UPDATE run SET purged_rows = purged_rows + "
    "(SELECT count(*) FROM going WHERE run_id = run.id) WHERE id IN (SELECT run_id FROM going)"
)
# Deleted states within a full-rate segment stay in it, under a limit of its own. CROSS JOIN:
# otherwise SQLite would scan all states in order instead of sorting the few that are deleted.
_MOVE_KEPT: Final = (
    "INSERT INTO kept_state (run_id, sim_time_s, wall_time_s, data, replaced) "
    "SELECT s.run_id, s.sim_time_s, s.wall_time_s, s.data, s.replaced FROM going g "
    "CROSS JOIN state s ON s.id = g.id WHERE EXISTS (SELECT 1 FROM kept_stretch k "
    "WHERE k.run_id = s.run_id AND s.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s) "
    "ORDER BY g.id"
)
_END_KEEPING: Final = (
    "DELETE FROM kept_stretch WHERE EXISTS (SELECT 1 FROM going g "
    "CROSS JOIN kept_state s ON s.id = g.id WHERE s.run_id = kept_stretch.run_id "
    "AND s.sim_time_s BETWEEN kept_stretch.start_sim_time_s AND kept_stretch.end_sim_time_s)"
)
_FORGET_SESSIONS: Final = (
    "DELETE FROM session WHERE ended_wall_time_s IS NOT NULL AND id IN "
    "(SELECT session_id FROM run WHERE id IN (SELECT id FROM going)) AND NOT EXISTS (SELECT 1 "
    "FROM run WHERE session_id = session.id AND id NOT IN (SELECT id FROM going))"
)
_BEFORE_DELETION: Final = {
    "state": (_COUNT_STORED, _COUNT_PURGED, _MOVE_KEPT),
    "kept_state": (_END_KEEPING,),
    "run": (_FORGET_SESSIONS,),
}
_DELETE_GOING: Final = "DELETE FROM {table} WHERE id IN (SELECT id FROM going)"
_PATHS: Final = {  # pictures that are deleted with rows
    "image": "SELECT path FROM image WHERE id IN (SELECT id FROM temp.going)",
    "run": "SELECT path FROM image WHERE run_id IN (SELECT id FROM temp.going)",
}
_TAPES: Final = (  # sessions that may be deleted with runs
    "SELECT DISTINCT s.uuid FROM session s JOIN run r ON r.session_id = s.id "
    "WHERE r.id IN (SELECT id FROM temp.going)"
)
INTERVAL_S: Final = 60.0  # between two checks; a check of ten million rows takes about a second
BUDGET_S: Final = 0.75  # of each round of the maintainer, nine tenths of it at rest


@dataclass(frozen=True)
class PurgeLimits:
    """How a purge is divided, so that robots can write meanwhile.

    Attributes:
        chunked_rows: Rows that are put into chunks before their states are deleted.
        rest_s: Minimum time between two writes.
        hurried_rest_s: The same where no robot records; a checkpoint still gets its turn.
        rests: Time between two writes in units of the last write: the lock is held for a tenth of
            the time.
        failures: Attempts to take the write lock before a purge is given up.
        spare_pages: Maximum number of pages, 10 MB, that stay free in the file for the next rows; a
            fortieth of the file where that is less.
    """

    chunked_rows: int = 4096
    rest_s: float = 0.005
    hurried_rest_s: float = 0.001
    rests: int = 9
    failures: int = 200
    spare_pages: int = 2500


_LIMITS: Final = PurgeLimits()


_STEPS: Final = {
    table: AtomicStatements(
        f"purge_{table}",
        ("group_id",),
        _NOT_GOING.format(table=table, kept=KEPT),
        *_BEFORE_DELETION.get(table, ()),
        _DELETE_GOING.format(table=table),
    )
    for table in ("state", "chunk", "kept_state", "log", "event", "image", "command", "run")
}


@dataclass
class Purged:
    """What was deleted so far.

    Attributes:
        rows: By table.
        files: Pictures and tapes.
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
        """Return how long to leave the lock to other processes now."""
        return max(_LIMITS.rest_s, _LIMITS.rests * self.held_s)


def prune(
    connection: sqlite3.Connection,
    data_dir: Path,
    retention: Retention = DEFAULT,
    *,
    now_s: float | None = None,
    rest: bool = True,
    progress: Callable[[int, int], object] | None = None,
) -> Purged:
    """Delete everything beyond the limits, and return the space to the disk.

    Args:
        connection: A connection of the role "writer", in autocommit mode, with a short busy
            timeout.
        data_dir: The folder that the paths of pictures are relative to.
        retention: The limits.
        now_s: Unix time, from which ages are counted; None for now.
        rest: Leave the lock free for longer than it was held; false if no robot records.
        progress: Called after each batch with the number of deleted rows and the total.

    Raises:
        DatabaseError: Another process held the write lock all the time.
        sqlite3.Error: The file cannot be written or is damaged; what was deleted stays deleted.
    """
    while not make_chunks(connection, _LIMITS.chunked_rows, 0.002 if rest else 0.0).done:
        pass
    wanted = plan(connection, retention, now_s)
    purged = Purged()
    for purged in purge(connection, wanted, data_dir):
        if progress is not None:
            progress(purged.rows.total(), wanted.rows)
        time.sleep(purged.rest_s if rest else _LIMITS.hurried_rest_s)
    return purged


def purge(
    connection: sqlite3.Connection, wanted: Plan, data_dir: Path, spare_pages: int = 0
) -> Iterator[Purged]:
    """Carry out a plan write by write; the caller rests at each yield.

    Args:
        connection: As for `prune`.
        wanted: The plan.
        data_dir: The folder that the paths of pictures are relative to.
        spare_pages: Number of free pages that stay in the file for new rows.

    Yields:
        What was deleted so far: always the same object, at least once.
    """
    work = _Purge(connection, data_dir, spare_pages)
    yield work.purged
    # Chunks are deleted after their states, and a run after everything that belongs to it.
    for tables in (
        ("state", "kept_state", "log", "event", "image", "command"),
        ("chunk",),
        ("run",),
    ):
        steps = {name: [step for step in wanted.steps if step.table == name] for name in tables}
        yield from work.in_turn([work.carry_out(its) for its in steps.values() if its])
        if steps.get("kept_state"):
            yield from work.forget_frames()
    yield from work.give_back()


class _Pace:
    """Number of items per write; a write takes about half the time that the lock may be held."""

    def __init__(self) -> None:
        self.count = 8

    def measure(self, count: int, held_s: float) -> None:
        """Adapt to the duration of the last write; at most double the number."""
        fitting = count * LONGEST_WRITE_S / 2 / max(held_s, 1e-6)  # some writes take twice as long
        self.count = max(1, min(int(fitting), 2 * self.count, BATCH_ROWS))


class _Purge:
    def __init__(self, connection: sqlite3.Connection, data_dir: Path, spare_pages: int) -> None:
        self._connection = connection
        self._data_dir = data_dir
        self._spare_pages = spare_pages
        self._failures = 0
        self._vacuuming = _Pace()
        self._paces = {table: _Pace() for table in _STEPS}
        self.purged = Purged()

    def in_turn(self, tables: Sequence[Iterator[Purged]]) -> Iterator[Purged]:
        """Yield writes of each table in turn and returns of space, until nothing remains."""
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
        """Return free space to the disk in many small transactions (SQLite, PRAGMA auto_vacuum)."""
        while self._give_some_back():
            yield self.purged

    def carry_out(self, steps: Sequence[Going]) -> Iterator[Purged]:
        """Delete the steps of one table."""
        for step in steps:
            if step.portion is None:
                yield from self._by_key(step)
            elif step.table == "chunk":
                yield from self._chunks(step, step.portion)
            elif step.table == "state" and not step.portion.group_id:
                yield from self._in_no_group(step.portion)
            else:
                group_id = step.portion.group_id
                if step.table == "state":  # its rows are needed to remake a damaged group
                    group_id = remake_if_damaged(self._connection, group_id)
                yield from self._rows(step.portion._replace(group_id=group_id))

    def _in_no_group(self, portion: Portion) -> Iterator[Purged]:
        """Put states that are in no group into one, then delete them."""
        while not self._unless_locked(lambda: self._chunked(portion.run_id)):
            yield self.purged
        found = self._connection.execute(
            "SELECT id, stored_row_count FROM row_group WHERE run_id = ? AND is_complete = 1 "
            "AND stored_row_count > 0 ORDER BY max_state_id",
            (portion.run_id,),
        ).fetchall()
        for group_id, rows in found:
            yield from self._rows(portion._replace(group_id=group_id, rows=rows))
        yield from self._rows(portion)  # rows that no bridge writes are in no chunk

    def _chunked(self, run_id: int) -> bool:
        """Put rows into chunks for a moment. Return whether all rows of a run are in chunks."""
        if not make_chunks(self._connection, _LIMITS.chunked_rows).done:
            return False
        return chunk_whole_run(self._connection, run_id)

    def _rows(self, portion: Portion) -> Iterator[Purged]:
        """Delete the rows of a portion in the order of ids, except rows added since."""
        ids = [row_id for row_id in ids_of(self._connection, portion) if row_id <= portion.last_id]
        yield from self._delete(
            portion.table, [(row_id, portion.run_id) for row_id in ids], portion.group_id
        )
        if portion.group_id:
            # Rows that other programs deleted were not counted.
            self._execute(
                "UPDATE row_group SET stored_row_count = (SELECT count(*) FROM json_each(?) j "
                "CROSS JOIN state s ON s.id = j.value) WHERE id = ?",
                json.dumps(ids),
                portion.group_id,
            )

    def _chunks(self, step: Going, portion: Portion) -> Iterator[Purged]:
        """Delete the chunks of a group that readers no longer use."""
        # Readers skip an incomplete group. If this process ends now, the maker of chunks deletes
        # the rest.
        if not self._execute(
            "UPDATE row_group SET is_complete = 0 WHERE id = ? AND is_complete = 1 "
            f"AND stored_row_count = 0 AND NOT EXISTS (SELECT 1 FROM run WHERE id = ? AND {KEPT})",
            portion.group_id,
            step.owner_id,
        ):
            return
        found = self._connection.execute(
            "SELECT id FROM chunk WHERE group_id = ?", (portion.group_id,)
        ).fetchall()
        yield from self._delete("chunk", [(chunk_id, 0) for (chunk_id,) in found])
        self._execute("DELETE FROM row_group WHERE id = ? AND is_complete = 0", portion.group_id)
        self.purged.rows["chunk"] += step.rows
        yield self.purged

    def forget_frames(self) -> Iterator[Purged]:
        """Delete the camera frames of removed full-rate segments, with their files."""
        after = 0
        # These frames belong to no full-rate segment any more.
        while found := self._connection.execute(
            f"SELECT id, run_id FROM image i WHERE kind = '{KEPT_FRAME}' AND id > ? "
            "AND NOT EXISTS (SELECT 1 FROM kept_stretch k WHERE k.run_id = i.run_id "
            "AND i.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s) ORDER BY id "
            "LIMIT ?",
            (after, BATCH_ROWS),
        ).fetchall():
            after = found[-1][0]
            yield from self._delete("image", found)

    def _by_key(self, step: Going) -> Iterator[Purged]:
        """Delete a run, or commands of a robot."""
        keys = [(step.owner_id, step.owner_id)]
        if step.table == "command":
            before = {"robot_id": step.owner_id, "before_s": step.newest_s, "limit": step.rows}
            found = self._connection.execute(
                f"SELECT id {OLD_COMMANDS} ORDER BY id LIMIT :limit", before
            ).fetchall()
            keys = [(row_id, 0) for (row_id,) in found]
        yield from self._delete(step.table, keys)

    def _delete(
        self, table: str, keys: Sequence[tuple[int, int]], group_id: int | None = None
    ) -> Iterator[Purged]:
        """Delete rows by id, each with its run; a run that was marked since the plan is skipped."""
        while keys:
            keys = keys[self._unless_locked(partial(self._run_step, table, keys, group_id)) :]
            yield self.purged

    def _run_step(self, table: str, keys: Sequence[tuple[int, int]], group_id: int | None) -> int:
        """Run one short transaction. Return how many of the keys are done."""
        pace = self._paces[table]
        some = keys[: pace.count]
        # One statement deletes many rows at once, see `AtomicStatements`. Rows that remain in
        # `going` were deleted.
        self._connection.execute(
            "CREATE TEMP TABLE IF NOT EXISTS going (id INTEGER PRIMARY KEY, run_id INTEGER)"
        )
        self._connection.execute("DELETE FROM going")
        self._connection.executemany("INSERT INTO going VALUES (?, ?)", some)
        paths = self._connection.execute(_PATHS[table]).fetchall() if table in _PATHS else []
        taped = self._connection.execute(_TAPES).fetchall() if table == "run" else []
        started_s = time.perf_counter()
        _STEPS[table].run(self._connection, group_id)
        held_s = time.perf_counter() - started_s
        pace.measure(len(some), held_s)
        if table != "chunk":  # of which states are counted
            self.purged.rows[table] += self._first("SELECT count(*) FROM going")
        self._note(held_s)
        for (path,) in paths:
            if not self._first("SELECT 1 FROM image WHERE path = ? LIMIT 1", path):
                self._delete_file(path)
        for (uuid,) in taped:
            if self._first("SELECT 1 FROM session WHERE uuid = ?", uuid):
                continue
            for file in filter(Path.exists, tape_files(self._data_dir, str(uuid))):
                self._delete_file(file.relative_to(self._data_dir).as_posix())
        return len(some)

    def _delete_file(self, path: str) -> None:
        try:
            inside(self._data_dir, path).unlink()
            self.purged.files += 1
        except OSError as error:
            self.purged.problems.append(f"{path}: {error}")
        except (InvalidInputError, NothingRecordedError):
            pass  # A foreign path must not be deleted, and a missing file need not be.

    def _give_some_back(self) -> bool:
        """Return some space in one short transaction. Return whether more may remain."""
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

    def _execute(self, statement: str, *values: object) -> int:
        """Run a short statement of its own.

        Return how many rows changed; 0 if the database was locked.
        """
        return self._unless_locked(lambda: self._connection.execute(statement, values).rowcount)

    def _unless_locked(self, write: Callable[[], int]) -> int:
        """Return how many rows were written; 0 if another process holds the write lock."""
        try:
            written = write()
        except sqlite3.OperationalError as error:
            if not is_busy(error):
                raise
            self._failures += 1
            if self._failures > _LIMITS.failures:
                raise DatabaseError(
                    f"Another process held the write lock in {_LIMITS.failures} attempts. End it "
                    "and try again."
                ) from error
            return 0
        self._failures = 0
        return written

    def _pragma(self, name: str) -> int:
        return int(self._connection.execute(f"PRAGMA {name}").fetchone()[0])


class Upkeep:
    """Run retention as part of a maintainer, which calls it once in each of its rounds.

        Maintainer(database, "server", work=Upkeep(data_dir))

    Args:
        data_dir: The folder that the paths of pictures are relative to.
        limits: Returns the limits in force.
        interval_s: Time between two plans; limits that change are planned for at once.
        budget_s: How long a call may last, rests included; one write may go on after that.
    """

    def __init__(
        self,
        data_dir: Path,
        limits: Callable[[sqlite3.Connection], Retention] = in_force,
        *,
        interval_s: float = INTERVAL_S,
        budget_s: float = BUDGET_S,
    ) -> None:
        self._data_dir = data_dir
        self._limits = limits
        self._interval_s = interval_s
        self._budget_s = budget_s
        self._next_plan_s = 0.0
        self._planned: Retention | None = None
        self._connection: sqlite3.Connection | None = None
        self._under_way: Iterator[Purged] | None = None

    def __call__(self, connection: sqlite3.Connection) -> None:
        """Delete for a moment, if anything exceeds the limits.

        Raises:
            sqlite3.Error, DatabaseError: The next call begins with a new plan.
        """
        if connection is not self._connection:
            self._connection, self._under_way, self._planned = connection, None, None
        try:
            self._work(connection)
        except BaseException:
            self._under_way = self._planned = None
            raise

    def _work(self, connection: sqlite3.Connection) -> None:
        started_s = time.monotonic()
        if self._under_way is None:
            limits = self._limits(connection)
            if limits == self._planned and started_s < self._next_plan_s:
                return
            self._planned, self._next_plan_s = limits, started_s + self._interval_s
            pages = int(connection.execute("PRAGMA page_count").fetchone()[0])
            spare_pages = min(pages // 40, _LIMITS.spare_pages)
            wanted = plan(connection, limits)
            self._under_way = purge(connection, wanted, self._data_dir, spare_pages)
        for purged in self._under_way:
            if time.monotonic() - started_s > self._budget_s:
                return
            time.sleep(purged.rest_s)
        self._under_way = None
