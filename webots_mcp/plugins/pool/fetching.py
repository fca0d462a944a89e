"""Bringing runs of a pool back into a local recording, where every question can be asked of them.

What the pool holds of some runs is written into a small recording with the same ids, and that is
merged like any other: by UUIDs, each run whole or not at all. So fetching may be killed anywhere,
and repeated. Of a run without all its rows what is left comes: it is one whose rows are purged.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sqlite3
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, Final, cast

from webots_mcp.connection import transaction
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.errors import PoolError
from webots_mcp.liveness import process_alive
from webots_mcp.plugins.pool.pool_contents import Meant
from webots_mcp.plugins.pool.pool_interface import Batch, Pool, PooledRun, SQLValue, is_whole, table
from webots_mcp.store.chunk_making import chunk_whole_run
from webots_mcp.store.chunks import STATE_IDS
from webots_mcp.store.merging import END_SESSIONS, merge, small_recording
from webots_mcp.store.run_rows import PICTURES

_FOLDER: Final = ".fetch-"
_MOST_RUNS: Final = 100  # that are written into one small recording,
_MOST_ROWS: Final = 200_000  # unless one of them has more rows by itself
_UNCOUNTED_ROWS: Final = 10_000
_PAUSE_S: Final = 0.002  # between two short writes, for robots that record here
_OF_RUN: Final = ("kept_stretch", "kept_state", "log", "event", "parameter_value", "image")
_STATES: Final = ("state", "kept_state")
_HERE: Final = "SELECT uuid, id FROM run WHERE uuid IS NOT NULL"
# What retention moved there may have been shipped before that as well.
_DROP_MOVED: Final = (
    "DELETE FROM kept_state WHERE call IS NULL AND EXISTS (SELECT 1 FROM state s "
    "WHERE s.run_id = kept_state.run_id AND s.sim_time_s = kept_state.sim_time_s "
    "AND s.wall_time_s = kept_state.wall_time_s)"
)
_COUNTED: Final = (
    "SELECT id, row_count, purged_rows, (SELECT count(*) FROM state WHERE run_id = run.id), "
    "(SELECT count(*) FROM state s WHERE run_id = run.id AND EXISTS (SELECT 1 FROM kept_stretch k "
    "WHERE k.run_id = s.run_id AND s.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s)) "
    "FROM run ORDER BY id"
)
_PURGED: Final = "UPDATE run SET purged_rows = ? WHERE id = ?"
_MOVE_KEPT: Final = (
    "INSERT INTO kept_state (run_id, sim_time_s, wall_time_s, data, replaced) "
    "SELECT run_id, sim_time_s, wall_time_s, data, replaced FROM state WHERE run_id = ? ORDER BY id"
)
_DROP_STATES: Final = "DELETE FROM state WHERE run_id = ?"
_DROP_RUN: Final = "DELETE FROM run WHERE id = ?"
_DROP_SESSIONS: Final = "DELETE FROM session WHERE id NOT IN (SELECT session_id FROM run)"
_OF_GROUP: Final = {
    "stored_row_count": "0", "stored_row_bytes": "0", "chunk_bytes": "0", "is_complete": "1",
}  # fmt: skip
_LEFT: Final = (
    f"FROM state s, chunk c WHERE c.group_id = row_group.id AND c.signal_id = {STATE_IDS} "
    "AND s.run_id = row_group.run_id AND s.id BETWEEN c.min AND c.max"
)
_COUNT_ROOM: Final = (
    f"UPDATE row_group SET stored_row_count = (SELECT count(*) {_LEFT}), stored_row_bytes = "
    f"coalesce((SELECT avg(length(CAST(s.data AS BLOB))) {_LEFT}), 0), chunk_bytes = coalesce(("
    "SELECT sum(coalesce(length(numbers), 0) + coalesce(length(codes), 0) "
    "+ coalesce(length(labels), 0)) "
    "FROM chunk WHERE group_id = row_group.id), 0)"  # none came of one whose times are damaged
)
_IN_CHUNKS: Final = "SELECT coalesce(sum(row_count), 0) FROM row_group WHERE run_id = ?"

Progress = Callable[[int, int], None]


@dataclass
class Fetched:
    """What became of the runs that were meant, by their UUIDs.

    Attributes:
        runs: The ids here of those that are here now.
        known: Of them, those that were here before.
        only_chunks: Of those that came now, the ones of which the pool has no rows.
        going_on: Those that are not over.
        arriving: Those that are over, and not yet wholly shipped.
        nameless: How many have no UUID, which no recording could tell from those that are there.
        unchunked: Of those in `only_chunks`, how many rows are in chunks, where not all are.
    """

    runs: dict[str, int] = field(default_factory=dict[str, int])
    known: list[str] = field(default_factory=list[str])
    only_chunks: list[str] = field(default_factory=list[str])
    going_on: list[str] = field(default_factory=list[str])
    arriving: list[str] = field(default_factory=list[str])
    nameless: int = 0
    unchunked: dict[str, int] = field(default_factory=dict[str, int])

    @property
    def come(self) -> list[int]:
        """The ids of those that came now."""
        return [self.runs[uuid] for uuid in self.runs if uuid not in self.known]


def fetch(
    pool: Pool,
    connection: sqlite3.Connection,
    data_dir: Path,
    meant: Meant,
    progress: Progress = lambda done, of: None,
) -> Fetched:
    """Bring the runs that are meant, with their sessions, commands and trials.

    Args:
        pool: Opened.
        connection: To the local recording, in the role "writer".
        data_dir: The folder of its pictures.
        meant: What is to come.
        progress: Called with how many states came of how many that the runs had.

    Raises:
        PoolError: The pool cannot be read.
    """
    _sweep(data_dir)
    fetcher = _Fetcher(pool, connection, data_dir)
    found, here = fetcher.found, _here(connection)
    found.known = [run.uuid for run in meant.runs if run.uuid in here]
    new = [run for run in meant.runs if run.uuid not in here]
    found.nameless = sum(not run.uuid for run in new)
    found.going_on = [run.uuid for run in new if run.uuid and run.end_reason is None]
    ended = [run for run in new if run.uuid and run.end_reason is not None]
    whole, found.arriving = _shipped(pool, ended)
    done, of = 0, sum(run.row_count for run in whole)
    for part in _parts(whole):
        fetcher.take(part, lambda rows, before=done: progress(before + rows, of))
        done += sum(run.row_count for run in part)
        progress(done, of)
    fetcher.take_trials(meant)
    here = _here(connection)
    found.runs = {run.uuid: here[run.uuid] for run in meant.runs if run.uuid in here}
    return found


def _shipped(pool: Pool, runs: Sequence[PooledRun]) -> tuple[list[PooledRun], list[str]]:
    """The runs that are wholly there, and the UUIDs of the others."""
    told = {each: pool.progress(each) for each in {run.recording_uuid for run in runs}}
    whole = [run for run in runs if is_whole(told[run.recording_uuid], run.run_id)]
    return whole, [run.uuid for run in runs if run not in whole]


def _here(connection: sqlite3.Connection) -> dict[str, int]:
    return dict(connection.execute(_HERE).fetchall())


def _parts(runs: Sequence[PooledRun]) -> Iterator[list[PooledRun]]:
    """Runs of one recording that are fetched together, in the order in which they began."""
    for _, group in groupby(runs, lambda run: run.recording_uuid):
        part, rows = list[PooledRun](), 0
        for run in group:
            if part and (len(part) >= _MOST_RUNS or rows + run.row_count > _MOST_ROWS):
                yield part
                part, rows = [], 0
            part.append(run)
            rows += run.row_count
        yield part


class _Fetcher:
    """Small recordings of what a pool holds, merged one by one."""

    def __init__(self, pool: Pool, connection: sqlite3.Connection, data_dir: Path) -> None:
        self.found = Fetched()
        self._pool, self._connection, self._data_dir = pool, connection, data_dir

    def take(self, runs: Sequence[PooledRun], told: Callable[[int], None]) -> None:
        """Take in runs of one recording that are over, but for those that are still shipped.

        Args:
            runs: Which.
            told: Called with how many of their states are copied.
        """
        ids = [run.run_id for run in runs]
        with _folder(self._data_dir) as folder:
            with small_recording(folder) as small:
                copy = _Copy(self._pool, runs[0].recording_uuid, small)
                copy.context(ids)
                for name in _OF_RUN:
                    copy.rows(name, "run_id", ids)
                copy.rows("state", "run_id", ids, _up_to(runs, told))
                copy.pictures(folder)
                copy.chunks(self._settle(small, {run.run_id: run.uuid for run in runs}))
                self._note_unchunked(small, runs)
            here = merge(self._connection, self._data_dir, folder / DATABASE_NAME)
        for run_id in here.values():
            chunk_whole_run(self._connection, run_id, _PAUSE_S)

    def take_trials(self, meant: Meant) -> None:
        """Take in the trials of runs that are here by now, and others of a set that is meant."""
        here = _here(self._connection)
        ids, sets = defaultdict[str, set[int]](set), defaultdict[str, set[int]](set)
        for run in meant.runs:
            if run.uuid in here:
                ids[run.recording_uuid].add(run.run_id)
        for each in meant.trial_sets:
            sets[each.recording_uuid].add(each.trial_set_id)
        for recording in {**ids, **sets}:
            self._take_trials_of(recording, ids[recording], sets[recording])

    def _take_trials_of(self, recording: str, ids: set[int], sets: set[int]) -> None:
        with _folder(self._data_dir) as folder:
            with small_recording(folder) as small:
                if not _Copy(self._pool, recording, small).trials(ids, sets):
                    return
                small.execute(END_SESSIONS)
            merge(self._connection, self._data_dir, folder / DATABASE_NAME)

    def _settle(self, small: sqlite3.Connection, uuids: Mapping[int, str]) -> list[int]:
        """Say of each run how many of its rows are gone; a run whose rows still come is dropped.

        Returns:
            The runs that lack rows: of the others, chunks are made here.
        """
        lacking: list[int] = []
        small.execute(_DROP_MOVED)
        for run_id, rows, purged, left, kept in small.execute(_COUNTED).fetchall():
            gone = max(0, rows - left)
            if gone and left == kept:
                gone = rows
                small.execute(_MOVE_KEPT, (run_id,))
                small.execute(_DROP_STATES, (run_id,))
                self.found.only_chunks.append(uuids[run_id])
            elif left < rows - purged:
                self.found.arriving.append(uuids[run_id])
                small.execute(_DROP_RUN, (run_id,))
                continue
            lacking += [run_id] if gone else []
            small.execute(_PURGED, (gone, run_id))
        small.execute(_DROP_SESSIONS)
        small.execute(END_SESSIONS)
        return lacking

    def _note_unchunked(self, small: sqlite3.Connection, runs: Sequence[PooledRun]) -> None:
        for run in runs:
            if run.uuid in self.found.only_chunks:
                (rows,) = small.execute(_IN_CHUNKS, (run.run_id,)).fetchone()
                self.found.unchunked |= {run.uuid: rows} if rows < run.row_count else {}


class _Copy:
    """Rows of a recording in a pool, written into a small one."""

    def __init__(self, pool: Pool, recording_uuid: str, small: sqlite3.Connection) -> None:
        self._pool, self._recording_uuid, self._small = pool, recording_uuid, small
        self._orders: dict[int, Order] = {}
        small.execute("PRAGMA foreign_keys=OFF")  # a pool keeps what refers to what it lacks

    def context(self, run_ids: Collection[int]) -> None:
        """The runs, whose they are, and what belongs to their sessions."""
        self.rows("run", "id", run_ids)
        sessions, robots = self._ids("session_id", "run"), self._ids("robot_id", "run")
        self.rows("session", "id", sessions)
        self.rows("robot", "id", robots)
        self.rows("signal", "robot_id", robots)
        self.rows("command", "session_id", sessions)
        self.rows("parameter", "session_id", sessions)
        if not self._pool.keeps_order:
            self._orders = self._known_orders()

    def trials(self, run_ids: Collection[int], set_ids: Collection[int]) -> bool:
        """The trials of these runs and sets, but those of other runs; whether there are any."""
        here = table("trial").columns.index("run_id")
        for column, values in (("run_id", run_ids), ("trial_set_id", set_ids)):
            for batch in self._rows("trial", column, values):
                rows = [row for row in batch.rows if row[here] is None or row[here] in run_ids]
                self._write(Batch(batch.table, rows))
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
        told: Callable[[int], None] = lambda copied: None,
    ) -> None:
        """Copy the rows whose column has one of these values; tell how many are copied so far."""
        copied = 0
        for batch in self._rows(name, column, values):
            self._write(self._in_order(batch))
            copied += len(batch.rows)
            told(copied)

    def chunks(self, run_ids: Collection[int]) -> None:
        """The row groups and chunks of runs, and what they and the rows take on the disk here."""
        self.rows("row_group", "run_id", run_ids)
        self.rows("chunk", "run_id", run_ids)
        self._small.execute(_COUNT_ROOM)

    def pictures(self, folder: Path) -> None:
        """The files that the rows of pictures name, where they were shipped."""
        for (path,) in self._small.execute("SELECT DISTINCT path FROM image").fetchall():
            file = folder / path
            is_ours = file.resolve().is_relative_to(folder.resolve())
            if not is_ours or file.suffix.lower() not in PICTURES:
                continue
            if (content := self._pool.picture(self._recording_uuid, path)) is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(content)

    def _rows(self, name: str, column: str, values: Collection[int]) -> Iterable[Batch]:
        if not values:
            return ()
        return self._pool.rows(self._recording_uuid, table(name), {column: sorted(values)})

    def _write(self, batch: Batch) -> None:
        local = _OF_GROUP if batch.table.name == "row_group" else {}
        columns = ", ".join((*batch.table.columns, *local))
        marks = ", ".join((*["?"] * len(batch.table.columns), *local.values()))
        insert = f"INSERT OR REPLACE INTO {batch.table.name} ({columns}) VALUES ({marks})"
        with transaction(self._small):
            self._small.executemany(insert, batch.rows)

    def _ids(self, column: str, name: str) -> list[int]:
        query = f"SELECT DISTINCT {column} FROM {name} WHERE {column} IS NOT NULL"
        return [key for (key,) in self._small.execute(query).fetchall()]

    def _known_orders(self) -> dict[int, Order]:
        """Of the keys in the states of each run."""
        runs = self._small.execute("SELECT id, robot_id FROM run").fetchall()
        paths = "SELECT path FROM signal WHERE robot_id = ? ORDER BY id"
        orders = {
            robot_id: order_of(path for (path,) in self._small.execute(paths, (robot_id,)))
            for robot_id in {robot_id for _, robot_id in runs}
        }
        return {run_id: orders[robot_id] for run_id, robot_id in runs}

    def _in_order(self, batch: Batch) -> Batch:
        if not self._orders or batch.table.name not in _STATES:
            return batch
        run, data = (batch.table.columns.index(each) for each in ("run_id", "data"))
        known: Mapping[SQLValue, Order] = {**self._orders}
        rows = [
            (*row[:data], in_order(str(row[data]), known.get(row[run], {})), *row[data + 1 :])
            for row in batch.rows
        ]
        return Batch(batch.table, rows)


def _up_to(runs: Sequence[PooledRun], told: Callable[[int], None]) -> Callable[[int], None]:
    """Tells how many states are copied, and stops where they are far more than the runs had.

    A run whose process was killed has a few more than the last heartbeat counted.
    """
    counted = sum(run.row_count for run in runs)

    def tell(copied: int) -> None:
        if copied > 2 * counted + _UNCOUNTED_ROWS:
            raise PoolError(
                f"the pool has more than {copied:,} states of runs that had {counted:,} "
                f"({runs[0].uuid}, ...): somebody else has written there; nothing of them is taken"
            )
        told(copied)

    return tell


@contextmanager
def _folder(data_dir: Path) -> Generator[Path]:
    """A folder beside the recording, for as long as the block goes on."""
    with tempfile.TemporaryDirectory(prefix=f"{_FOLDER}{os.getpid()}-", dir=data_dir) as name:
        yield Path(name)


def _sweep(data_dir: Path) -> None:
    """Remove the folders of those that were killed while they fetched."""
    for each in data_dir.glob(f"{_FOLDER}*"):
        pid = each.name.removeprefix(_FOLDER).partition("-")[0]
        if pid.isdigit() and not process_alive(int(pid), None, time.time()):
            shutil.rmtree(each, ignore_errors=True)


# The keys of a state in the order in which its controller gave them.
#
# A pool that holds JSON parsed (PostgreSQL's jsonb) has an order of its own. The register of
# signals knows the one from before: names are entered as they first come.


_STEP: Final = re.compile(r'\.("(?:[^"\\]|\\.)*"|[^."\[\]]+)|\[(\d+)\]')
_ENCODED: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode
_LONG: Final = re.compile(r"\d{19}")

Order = dict[str, Any]


def order_of(paths: Iterable[str]) -> Order:
    """The order of keys that the paths of a robot's signals tell, in the order of their ids."""
    order: Order = {}
    for path in paths:
        level = order
        for key, index in _STEP.findall(path):
            level = level.setdefault(_key(key) if key else index, {})
    return order


def _key(step: str) -> str:
    try:
        return str(json.loads(step)) if step.startswith('"') else step
    except ValueError:
        return step[1:-1]


def in_order(text: str, order: Order) -> str:
    """A state as JSON text with its keys in that order; what the order lacks comes last.

    A whole number beyond those of SQLite was a float, which a pool without exponents spells out.
    """
    try:
        state = json.loads(text, parse_int=_number if _LONG.search(text) else None)
        ordered = _ENCODED(_sorted(state, order))
        ordered.encode()
    except (ValueError, OverflowError, RecursionError):
        return text  # no JSON, or halves of characters: a pool holds it as the text that it was
    return ordered


def _number(digits: str) -> int | float:
    number = int(digits)
    return number if -(2**63) <= number < 2**63 else float(number)


def _sorted(value: Any, order: Order) -> Any:
    if isinstance(value, dict):
        members = cast("dict[str, Any]", value)
        known = {key: _sorted(members[key], order[key]) for key in order if key in members}
        return known if len(known) == len(members) else known | members | known
    if isinstance(value, list) and any(order.values()):
        items = cast("list[Any]", value)
        return [_sorted(item, order.get(str(at), {})) for at, item in enumerate(items)]
    return cast("Any", value)
