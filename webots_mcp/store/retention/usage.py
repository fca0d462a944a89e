"""What a recording holds, in portions small enough to be deleted one after the other.

State rows and chunks are counted by their row groups, which know what they take on the disk. Other
rows are counted once, when they have come: a `Holdings` that is kept reads only what is new.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import KEPT_FRAME
from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.chunks.codec import Decoded
from webots_mcp.store.chunks.stored import STATE_IDS, WALL_TIMES, Group, values_in
from webots_mcp.store.retention.disk_size import INDEX_BYTES, disk_bytes
from webots_mcp.store.retention.policy import KEPT

TABLES: Final = ("state", "chunk", "kept_state", "log", "event", "image")
_COUNTED: Final = ("kept_state", "log", "event", "image")
_BLOCK_IDS: Final = 512

_RUNS: Final = (
    f"SELECT id, robot_id, row_count, started_wall_time_s, last_wall_time_s, {KEPT}, "
    "ended_wall_time_s IS NULL OR id = (SELECT max(id) FROM run n WHERE n.robot_id = run.robot_id)"
    " AS is_current, is_chunked FROM run WHERE typeof(started_wall_time_s) IN ('real', 'integer') "
    "AND typeof(last_wall_time_s) IN ('real', 'integer') ORDER BY started_wall_time_s, id"
)
_STORED: Final = "SELECT id, stored_row_count FROM row_group WHERE is_complete = 1"
_GROUPS: Final = (
    "SELECT g.id, g.run_id, g.max_state_id, g.row_count, g.stored_row_bytes, g.chunk_bytes, "
    "coalesce(i.min, 0), w.min, w.max FROM row_group g "
    "LEFT JOIN chunk i ON i.run_id = g.run_id AND i.group_id = g.id "
    f"AND i.signal_id = {STATE_IDS} "
    "LEFT JOIN chunk w ON w.run_id = g.run_id AND w.group_id = g.id "
    f"AND w.signal_id = {WALL_TIMES} WHERE g.is_complete = 1 AND g.id > ?"
)
_PLACE: Final = (
    "SELECT id, start_sim_time_s, end_sim_time_s, last_state_id, max_state_id, row_count "
    "FROM row_group WHERE id = ?"
)
_SUMS: Final = (
    "run_id, min(id), max(id), json_group_array({payload}), min(CAST(wall_time_s AS REAL)), "
    "max(CAST(wall_time_s AS REAL))"
)
_IN_NO_GROUP: Final = (
    f"SELECT {_SUMS} FROM state WHERE run_id = :run AND sim_time_s >= coalesce((SELECT "
    "max(end_sim_time_s) FROM row_group WHERE run_id = :run AND is_complete = 1), -9e999) "
    "AND id > coalesce((SELECT max(max_state_id) FROM row_group WHERE run_id = :run "
    "AND is_complete = 1), 0)"
)
_BLOCKS: Final = (
    f"SELECT {_SUMS} FROM {{table}} WHERE id > ? {{own}} GROUP BY id / {_BLOCK_IDS}, run_id"
)
_ROWS: Final = (
    "SELECT id, CAST(wall_time_s AS REAL) FROM {table} WHERE +run_id = ? AND id BETWEEN ? "
    "AND ? {own} ORDER BY id"
)
# The frames of a kept stretch count with its states, and go with them.
_OWN: Final = f"AND kind <> '{KEPT_FRAME}'"
_FILE_BYTES: Final = "iif(size_bytes BETWEEN 0 AND 1e12, size_bytes, 0)"
_FRAMES: Final = (
    f"SELECT run_id, sum({_FILE_BYTES}) FROM image WHERE kind = '{KEPT_FRAME}' GROUP BY run_id"
)
_COLUMNS: Final = "SELECT name, type, pk FROM pragma_table_info(?)"


class Run(NamedTuple):
    """A run as retention sees it."""

    id: int
    robot_id: int
    recorded_rows: int
    started_wall_time_s: float
    last_wall_time_s: float
    is_kept: bool
    is_current: bool
    is_chunked: bool


class Portion(NamedTuple):
    """Rows of one run in one table that follow each other.

    Attributes:
        group_id: Of states and chunks their row group; 0 of states that are in none.
        first_id: No row of it is below; `last_id` none is beyond. Of chunks that of their states.
        rows: So many; of chunks the states that they stand for.
        size_bytes: What all of it takes on the disk.
        oldest_s: Wall time of the oldest one; `newest_s` of the newest one.
        is_held: Of chunks: the states that they stand for are there as well.
    """

    table: str
    run_id: int
    group_id: int
    first_id: int
    last_id: int
    rows: int
    size_bytes: float
    oldest_s: float
    newest_s: float
    is_held: bool = False

    @property
    def row_bytes(self) -> float:
        """What one of them takes on the disk; at least a byte."""
        return max(self.size_bytes / max(self.rows, 1), 1.0)


class Holdings:
    """What a recording holds; whoever keeps it reads only what has come since.

    Rows that others delete are noticed when they should go.
    """

    def __init__(self) -> None:
        self._groups: dict[int, tuple[Any, ...]] = {}
        self._in_no_group: dict[int, tuple[Run, Portion | None]] = {}
        self._counted: dict[str, dict[int, Portion]] = {table: {} for table in _COUNTED}
        self._last_ids: dict[str, int] = dict.fromkeys(_COUNTED, 0)

    def portions(
        self, connection: sqlite3.Connection, runs: dict[int, Run]
    ) -> dict[str, list[Portion]]:
        """What these runs hold, by table, the newest first."""
        found: dict[str, list[Portion]] = {table: [] for table in TABLES}
        for portion in self._grouped(connection, runs):
            found[portion.table].append(portion)
        sizes = _Sizes(connection)
        found["state"] += self._states_in_no_group(sizes, runs)
        for table in _COUNTED:
            self._count_new(sizes, table)
            held = self._counted[table].values()
            found[table] += [portion for portion in held if portion.run_id in runs]
        frame_bytes: dict[int, float] = dict(connection.execute(_FRAMES).fetchall())
        found["kept_state"] = _with_frames(found["kept_state"], frame_bytes)
        for portions in found.values():
            portions.sort(key=lambda each: -each.last_id)
        return found

    def recount(self, connection: sqlite3.Connection, portion: Portion) -> None:
        """Count a portion again from which rows may have gone."""
        if portion.table in self._counted:
            held = self._counted[portion.table]
            held.pop(portion.first_id, None)
            sizes, bounds = _Sizes(connection), (portion.first_id, portion.last_id)
            for each in sizes.blocks(portion.table, "AND run_id = ? AND id BETWEEN ? AND ?", 0,
                                     portion.run_id, *bounds):  # fmt: skip
                held[each.first_id] = each
        self._in_no_group.pop(portion.run_id, None)

    def _grouped(self, connection: sqlite3.Connection, runs: dict[int, Run]) -> Iterator[Portion]:
        for group_id, *facts in connection.execute(_GROUPS, (max(self._groups, default=0),)):
            self._groups[group_id] = tuple(facts)
            self._in_no_group.pop(facts[0], None)
        stored = dict(connection.execute(_STORED).fetchall())
        self._groups = {each: facts for each, facts in self._groups.items() if each in stored}
        for group_id, facts in self._groups.items():
            run_id, last_id, rows, row_bytes, chunk_bytes, first_id, *walls = facts
            if run_id not in runs:
                continue
            of = (run_id, group_id, int(first_id), last_id)
            own_s = runs[run_id].last_wall_time_s
            oldest_s, newest_s = (own_s if wall is None else wall for wall in walls)
            times = (oldest_s, newest_s)
            if left := stored[group_id]:
                yield Portion("state", *of, left, left * row_bytes, *times)
            yield Portion("chunk", *of, rows, chunk_bytes, *times, is_held=left > 0)

    def _states_in_no_group(self, sizes: _Sizes, runs: dict[int, Run]) -> Iterator[Portion]:
        """The newest rows of each run; those of one that is in chunks are counted once."""
        for run in runs.values():
            known, portion = self._in_no_group.get(run.id, (None, None))
            if known != run or not run.is_chunked:
                query = _IN_NO_GROUP.format(payload=sizes.payload("state"))
                row = sizes.connection.execute(query, {"run": run.id}).fetchone()
                portion = None if row[0] is None else sizes.portion("state", *row)
                self._in_no_group[run.id] = run, portion
            if portion is not None:
                yield portion

    def _count_new(self, sizes: _Sizes, table: str) -> None:
        held = self._counted[table]
        newest = {each.run_id: each for each in held.values()}
        for each in sizes.blocks(table, "", self._last_ids[table]):
            self._last_ids[table] = max(self._last_ids[table], each.last_id)
            before = newest.get(each.run_id)
            if before is not None and before.rows + each.rows <= _BLOCK_IDS:
                each = before._replace(
                    last_id=each.last_id,
                    rows=before.rows + each.rows,
                    size_bytes=before.size_bytes + each.size_bytes,
                    newest_s=max(before.newest_s, each.newest_s),
                    oldest_s=min(before.oldest_s, each.oldest_s),
                )
            held[each.first_id] = newest[each.run_id] = each


class _Sizes:
    """What rows take on the disk."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self.connection = connection
        self._payloads: dict[str, str] = {"image": _FILE_BYTES}

    @cached_property
    def _page_bytes(self) -> int:
        return int(self.connection.execute("PRAGMA page_size").fetchone()[0])

    def blocks(self, table: str, where: str, after: int, *values: int) -> Iterator[Portion]:
        """The rows after an id, in portions."""
        own = where + (f" {_OWN}" if table == "image" else "")
        query = _BLOCKS.format(table=table, own=own, payload=self.payload(table))
        for row in self.connection.execute(query, (after, *values)).fetchall():
            yield self.portion(table, *row)

    def portion(
        self,
        table: str,
        run_id: int,
        first_id: int,
        last_id: int,
        sizes: str,
        oldest_s: float,
        newest_s: float,
    ) -> Portion:
        """A portion of rows that were looked at one by one."""
        each: list[int] = json.loads(sizes)
        size_bytes = sum(each) + 0.0
        if table != "image":
            size_bytes = disk_bytes(each, self._page_bytes) + INDEX_BYTES * len(each)
        ids = (first_id, last_id)
        return Portion(table, run_id, 0, *ids, len(each), size_bytes, oldest_s, newest_s)

    def payload(self, table: str) -> str:
        """SQL for the bytes of a record: each column takes a byte or two in its head too."""
        if table not in self._payloads:
            parts = ["2"]
            for name, kind, is_key in self.connection.execute(_COLUMNS, (table,)).fetchall():
                if kind == "TEXT":
                    parts.append(f"coalesce(length(CAST({name} AS BLOB)) + 1, 1)")
                elif not is_key:
                    parts.append("9" if kind == "FLOAT" else "3")
            self._payloads[table] = " + ".join(parts)
        return self._payloads[table]


def _with_frames(stretches: list[Portion], frame_bytes: dict[int, float]) -> list[Portion]:
    """Rows of kept stretches with their share of the run's frames."""
    rows = dict[int, int]()
    for each in stretches:
        rows[each.run_id] = rows.get(each.run_id, 0) + each.rows
    return [
        each._replace(
            size_bytes=each.size_bytes
            + frame_bytes.get(each.run_id, 0.0) * each.rows / rows[each.run_id]
        )
        for each in stretches
    ]


def read_runs(connection: sqlite3.Connection) -> dict[int, Run]:
    """All runs by their ids, in the order in which they began.

    A run whose times are no numbers, which no bridge writes, has no place in it: it stays.
    """
    return {row[0]: Run(*row) for row in connection.execute(_RUNS).fetchall()}


def rows_of(connection: sqlite3.Connection, portion: Portion) -> tuple[Array, Array]:
    """Ids of the rows that a portion had when it was counted, rising, and their wall times."""
    if portion.group_id:
        group = Group(*connection.execute(_PLACE, (portion.group_id,)).fetchone())
        ids, walls = (_times(connection, portion.run_id, each, group)
                      for each in (STATE_IDS, WALL_TIMES))  # fmt: skip
        if ids is not None:
            order = np.argsort(ids)[-portion.rows :]  # the oldest of a group go first
            known = np.full(len(ids), portion.newest_s) if walls is None else walls
            return ids[order], known[order]
    own = _OWN if portion.table == "image" else ""
    bounds = (portion.run_id, portion.first_id, portion.last_id)
    found = connection.execute(_ROWS.format(table=portion.table, own=own), bounds).fetchall()
    table: Array = np.reshape(np.array(found, np.float64), (-1, 2))
    return table[:, 0], table[:, 1]


def _times(
    connection: sqlite3.Connection, run_id: int, signal_id: int, group: Group
) -> Array | None:
    """Numbers of a chunk; None where it is missing or damaged."""
    for _, values in values_in(connection, run_id, signal_id, {group.id: group.row_count}):
        return values.numbers if isinstance(values, Decoded) else None
    return None


def file_sizes(connection: sqlite3.Connection) -> dict[str, int]:
    """Bytes of the database on the disk: the file, what of it is free, and the log next to it."""

    def pragma(name: str) -> int:
        return int(connection.execute(f"PRAGMA {name}").fetchone()[0])

    page_bytes = pragma("page_size")
    sizes = {
        "file_bytes": pragma("page_count") * page_bytes,
        "free_in_file_bytes": pragma("freelist_count") * page_bytes,
    }
    (file,) = connection.execute("SELECT file FROM pragma_database_list").fetchone()
    log = Path(f"{file}-wal")
    return sizes | {"log_beside_bytes": log.stat().st_size if file and log.exists() else 0}
