"""Fetching runs of a pool into a local recording, where every question can be asked about them.

The runs are written into a temporary recording with the same ids, which is merged like any other:
by UUIDs, each run completely or not at all. Fetching can therefore be killed at any time, and
repeated. A run with missing rows arrives as one whose rows were purged.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Final

from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.processes import process_alive
from webots_mcp.database.tapes.tape import tape_file
from webots_mcp.database.transactions import transaction
from webots_mcp.plugins.pool.pool_contents import ChosenRuns, PooledRun
from webots_mcp.plugins.pool.pool_interface import Pool, is_whole, table
from webots_mcp.store.chunk_making import chunk_whole_run
from webots_mcp.store.chunks import STATE_IDS
from webots_mcp.store.merging import END_SESSIONS, merge, small_recording
from webots_mcp.store.run_rows import PICTURES

_FOLDER: Final = ".fetch-"
_OF_RUN: Final = ("kept_stretch", "kept_state", "log", "event", "parameter_value", "image")
_OF_GROUP: Final = {
    "stored_row_count": "0", "stored_row_bytes": "0", "chunk_bytes": "0", "is_complete": "1",
}  # fmt: skip


@dataclass(frozen=True)
class FetchLimits:
    """Limits of one temporary recording.

    Attributes:
        runs: Maximum number of runs.
        rows: Maximum number of rows, unless a single run has more.
        pause_s: Pause between two short writes, for robots that record here.
    """

    runs: int = 100
    rows: int = 200_000
    pause_s: float = 0.002


_LIMITS: Final = FetchLimits()


@dataclass
class FetchResult:
    """The outcome of fetching runs, by their UUIDs.

    Attributes:
        runs: Local ids of the runs that are in the recording now.
        known: Runs that were in the recording before.
        only_chunks: Fetched runs of which the pool has no rows.
        going_on: Runs that have not ended.
        arriving: Runs that have ended but are not completely shipped.
        unchunked: Number of rows in chunks, for runs of `only_chunks` of which not all are.
    """

    runs: dict[str, int] = field(default_factory=dict[str, int])
    known: list[str] = field(default_factory=list[str])
    only_chunks: list[str] = field(default_factory=list[str])
    going_on: list[str] = field(default_factory=list[str])
    arriving: list[str] = field(default_factory=list[str])
    unchunked: dict[str, int] = field(default_factory=dict[str, int])

    @property
    def come(self) -> list[int]:
        """Return the local ids of the fetched runs."""
        return [self.runs[uuid] for uuid in self.runs if uuid not in self.known]


def fetch(
    pool: Pool,
    connection: sqlite3.Connection,
    data_dir: Path,
    meant: ChosenRuns,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> FetchResult:
    """Fetch runs with their sessions, commands and trials.

    Args:
        pool: The pool, opened.
        connection: Connection to the local recording, in the role "writer".
        data_dir: Folder of its pictures.
        meant: The runs and trial sets to fetch.
        progress: Called with the number of fetched states and of all.

    Raises:
        PoolError: The pool cannot be read.
    """
    _sweep(data_dir)
    found, here = FetchResult(), _local_run_ids(connection)
    found.known = [run.uuid for run in meant.runs if run.uuid in here]
    new = [run for run in meant.runs if run.uuid and run.uuid not in here]
    found.going_on = [run.uuid for run in new if run.end_reason is None]
    ended = [run for run in new if run.end_reason is not None]
    shipped = {each: pool.progress(each) for each in {run.recording_uuid for run in ended}}
    whole = [run for run in ended if is_whole(shipped[run.recording_uuid], run.run_id)]
    found.arriving = [run.uuid for run in ended if run not in whole]
    fetcher = _Fetcher(pool, connection, data_dir, found)
    done, of = 0, sum(run.row_count for run in whole)
    for part in _parts(whole):
        fetcher.take(part, lambda rows, before=done: progress(before + rows, of))
        done += sum(run.row_count for run in part)
        progress(done, of)
    fetcher.take_trials(meant)
    here = _local_run_ids(connection)
    found.runs = {run.uuid: here[run.uuid] for run in meant.runs if run.uuid in here}
    return found


def _local_run_ids(connection: sqlite3.Connection) -> dict[str, int]:
    return dict(connection.execute("SELECT uuid, id FROM run WHERE uuid IS NOT NULL").fetchall())


def _parts(runs: Sequence[PooledRun]) -> Iterator[list[PooledRun]]:
    """Yield runs of one recording that are fetched together, in the order of their start."""
    for _, group in groupby(runs, lambda run: run.recording_uuid):
        part, rows = list[PooledRun](), 0
        for run in group:
            if part and (len(part) >= _LIMITS.runs or rows + run.row_count > _LIMITS.rows):
                yield part
                part, rows = [], 0
            part.append(run)
            rows += run.row_count
        yield part


class _Fetcher:
    """Makes temporary recordings of what a pool holds, and merges them one by one."""

    def __init__(
        self, pool: Pool, connection: sqlite3.Connection, data_dir: Path, found: FetchResult
    ) -> None:
        self._pool, self._connection, self._data_dir = pool, connection, data_dir
        self._found = found

    def take(self, runs: Sequence[PooledRun], copied: Callable[[int], None]) -> None:
        """Fetch ended runs of one recording, except those that are still being shipped.

        Args:
            runs: The runs.
            copied: Called with the number of copied states.
        """
        ids = [run.run_id for run in runs]
        query = (
            f"FROM state s, chunk c WHERE c.group_id = row_group.id AND c.signal_id = {STATE_IDS} "
            "AND s.run_id = row_group.run_id AND s.id BETWEEN c.min AND c.max"
        )
        with _folder(self._data_dir) as folder:
            with small_recording(folder) as small:
                copy = _Copy(self._pool, runs[0].recording_uuid, small)
                copy.context(ids)
                for name in _OF_RUN:
                    copy.rows(name, "run_id", ids)
                copy.rows("state", "run_id", ids, copied)
                copy.pictures(folder)
                copy.tapes(folder)
                lacking = self._settle(small, runs)
                copy.rows(
                    "row_group", "run_id", lacking
                )  # For the other runs they are made locally.
                copy.rows("chunk", "run_id", lacking)
                # A group with damaged times has no chunks.
                small.execute(
                    f"UPDATE row_group SET stored_row_count = (SELECT count(*) {query}), "
                    "stored_row_bytes = "
                    f"coalesce((SELECT avg(length(CAST(s.data AS BLOB))) {query}), 0), "
                    "chunk_bytes = coalesce((SELECT sum(coalesce(length(numbers), 0) "
                    "+ coalesce(length(codes), 0) + coalesce(length(labels), 0)) "
                    "FROM chunk WHERE group_id = row_group.id), 0)"
                )
                for run in runs:
                    (chunked,) = small.execute(
                        "SELECT coalesce(sum(row_count), 0) FROM row_group WHERE run_id = ?",
                        (run.run_id,),
                    ).fetchone()
                    if run.uuid in self._found.only_chunks and chunked < run.row_count:
                        self._found.unchunked[run.uuid] = chunked
            here = merge(self._connection, self._data_dir, folder / DATABASE_NAME)
        for run_id in here.values():
            chunk_whole_run(self._connection, run_id, _LIMITS.pause_s)

    def take_trials(self, meant: ChosenRuns) -> None:
        """Fetch the trials of fetched runs, and all other trials of the chosen sets."""
        here = _local_run_ids(self._connection)
        wanted = defaultdict[str, tuple[set[int], set[int]]](lambda: (set(), set()))
        for run in meant.runs:
            if run.uuid in here:
                wanted[run.recording_uuid][0].add(run.run_id)
        for each in meant.trial_sets:
            wanted[each.recording_uuid][1].add(each.trial_set_id)
        for recording, (run_ids, set_ids) in wanted.items():
            with _folder(self._data_dir) as folder:
                with small_recording(folder) as small:
                    if not _Copy(self._pool, recording, small).trials(run_ids, set_ids):
                        continue
                    small.execute(END_SESSIONS)
                merge(self._connection, self._data_dir, folder / DATABASE_NAME)

    def _settle(self, small: sqlite3.Connection, runs: Sequence[PooledRun]) -> list[int]:
        """Store the number of missing rows of each run, and drop runs that are still shipped.

        Returns:
            The runs with missing rows.
        """
        lacking: list[int] = []
        uuids = {run.run_id: run.uuid for run in runs}
        # States that retention moved to kept_state may have been shipped before it moved them.
        small.execute(
            "DELETE FROM kept_state WHERE call IS NULL AND EXISTS (SELECT 1 FROM state s "
            "WHERE s.run_id = kept_state.run_id AND s.sim_time_s = kept_state.sim_time_s "
            "AND s.wall_time_s = kept_state.wall_time_s)"
        )
        for run_id, rows, purged, left, kept in small.execute(
            "SELECT id, row_count, purged_rows, (SELECT count(*) FROM state "
            "WHERE run_id = run.id), (SELECT count(*) FROM state s WHERE run_id = run.id "
            "AND EXISTS (SELECT 1 FROM kept_stretch k WHERE k.run_id = s.run_id "
            "AND s.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s)) FROM run "
            "ORDER BY id"
        ).fetchall():
            gone = max(0, rows - left)
            if gone and left == kept:
                gone = rows
                small.execute(
                    "INSERT INTO kept_state (run_id, sim_time_s, wall_time_s, data, replaced) "
                    "SELECT run_id, sim_time_s, wall_time_s, data, replaced FROM state "
                    "WHERE run_id = ? ORDER BY id",
                    (run_id,),
                )
                small.execute("DELETE FROM state WHERE run_id = ?", (run_id,))
                self._found.only_chunks.append(uuids[run_id])
            elif left < rows - purged:
                self._found.arriving.append(uuids[run_id])
                small.execute("DELETE FROM run WHERE id = ?", (run_id,))
                continue
            lacking += [run_id] if gone else []
            small.execute("UPDATE run SET purged_rows = ? WHERE id = ?", (gone, run_id))
        small.execute("DELETE FROM session WHERE id NOT IN (SELECT session_id FROM run)")
        small.execute(END_SESSIONS)
        return lacking


class _Copy:
    """Copies rows of a recording in a pool into a temporary recording."""

    def __init__(self, pool: Pool, recording_uuid: str, small: sqlite3.Connection) -> None:
        self._pool, self._recording_uuid, self._small = pool, recording_uuid, small
        small.execute(
            "PRAGMA foreign_keys=OFF"
        )  # Rows that others refer to may be missing in a pool.

    def context(self, run_ids: Collection[int]) -> None:
        """Copy the runs, their robots and signals, and what belongs to their sessions."""
        self.rows("run", "id", run_ids)
        sessions, robots = self._ids("session_id", "run"), self._ids("robot_id", "run")
        self.rows("session", "id", sessions)
        self.rows("robot", "id", robots)
        self.rows("signal", "robot_id", robots)
        self.rows("meaning", "robot_id", robots)
        self.rows("command", "session_id", sessions)
        self.rows("parameter", "session_id", sessions)

    def trials(self, run_ids: Collection[int], set_ids: Collection[int]) -> bool:
        """Copy the trials of runs and sets, without those of other runs.

        Return whether there are any.
        """
        self.rows("trial", "run_id", run_ids)
        self.rows("trial", "trial_set_id", set_ids)
        others = {*self._ids("run_id", "trial")} - {*run_ids}
        self._small.executemany("DELETE FROM trial WHERE run_id = ?", [(each,) for each in others])
        self.rows("trial_set", "id", self._ids("trial_set_id", "trial"))
        self.rows("run", "id", self._ids("run_id", "trial"))
        self.rows("session", "id", self._ids("session_id", "run"))
        self.rows("robot", "id", self._ids("robot_id", "run"))
        return bool(self._ids("id", "trial"))

    def rows(
        self,
        name: str,
        column: str,
        values: Collection[int],
        copied: Callable[[int], None] = lambda count: None,
    ) -> None:
        """Copy the rows whose column has one of some values; report the number of rows so far."""
        if not values:
            return
        columns, local = table(name).columns, _OF_GROUP if name == "row_group" else {}
        marks = ", ".join((*["?"] * len(columns), *local.values()))
        insert = f"INSERT OR REPLACE INTO {name} ({', '.join((*columns, *local))}) VALUES ({marks})"
        count = 0
        where = {column: sorted(values)}
        for batch in self._pool.rows(self._recording_uuid, table(name), where):
            with transaction(self._small):
                self._small.executemany(insert, batch.rows)
            count += len(batch.rows)
            copied(count)

    def pictures(self, folder: Path) -> None:
        """Copy the picture files that were shipped."""
        for (path,) in self._small.execute("SELECT DISTINCT path FROM image").fetchall():
            file = folder / path
            is_ours = file.resolve().is_relative_to(folder.resolve())
            if not is_ours or file.suffix.lower() not in PICTURES:
                continue
            if (content := self._pool.picture(self._recording_uuid, path)) is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(content)

    def tapes(self, folder: Path) -> None:
        """Copy the tapes that were shipped."""
        for (uuid,) in self._small.execute("SELECT uuid FROM session").fetchall():
            file = tape_file(folder, str(uuid))
            path = file.relative_to(folder).as_posix()
            if (content := self._pool.picture(self._recording_uuid, path)) is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(content)

    def _ids(self, column: str, name: str) -> list[int]:
        query = f"SELECT DISTINCT {column} FROM {name} WHERE {column} IS NOT NULL"
        return [key for (key,) in self._small.execute(query).fetchall()]


@contextmanager
def _folder(data_dir: Path) -> Generator[Path]:
    """Make a folder next to the recording, which is removed after the block."""
    with tempfile.TemporaryDirectory(prefix=f"{_FOLDER}{os.getpid()}-", dir=data_dir) as name:
        yield Path(name)


def _sweep(data_dir: Path) -> None:
    """Remove the folders of processes that were killed while they fetched."""
    for each in data_dir.glob(f"{_FOLDER}*"):
        pid = each.name.removeprefix(_FOLDER).partition("-")[0]
        if pid.isdigit() and not process_alive(int(pid), None, time.time()):
            shutil.rmtree(each, ignore_errors=True)
