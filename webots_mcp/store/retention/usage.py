"""What a recording holds, in portions small enough to be deleted one after the other.

State rows and chunks are counted by their row groups, which know what they take on the disk; only
rows that are in no group yet, and the smaller tables, are counted row by row.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import KEPT_FRAME
from webots_mcp.store.retention.pages import INDEX_BYTES, disk_bytes
from webots_mcp.store.retention.policy import KEPT

TABLES: Final = ("state", "chunk", "kept_state", "log", "event", "image")
UNBOUNDED: Final = 2**62
_BLOCK_IDS: Final = 512

_RUNS: Final = (
    f"SELECT id, robot_id, row_count, started_wall_time_s, last_wall_time_s, {KEPT}, "
    "ended_wall_time_s IS NULL OR id = (SELECT max(id) FROM run n WHERE n.robot_id = run.robot_id)"
    " AS is_current FROM run WHERE typeof(started_wall_time_s) IN ('real', 'integer') "
    "AND typeof(last_wall_time_s) IN ('real', 'integer') ORDER BY started_wall_time_s, id"
)
_GROUPS: Final = (
    "SELECT g.id, g.run_id, g.max_state_id, g.row_count, g.stored_row_count, g.stored_row_bytes, "
    "g.chunk_bytes, coalesce(i.min, 0), w.min, w.max FROM row_group g "
    "LEFT JOIN chunk i ON i.run_id = g.run_id AND i.signal_id = -2 AND i.group_id = g.id "
    "LEFT JOIN chunk w ON w.run_id = g.run_id AND w.signal_id = -1 AND w.group_id = g.id "
    "WHERE g.is_complete = 1"
)
_IN_NO_GROUP: Final = (
    "s.run_id = r.id AND s.sim_time_s >= coalesce((SELECT max(end_sim_time_s) FROM row_group g "
    "WHERE g.run_id = r.id AND g.is_complete = 1), -9e999) AND s.id > coalesce((SELECT "
    "max(max_state_id) FROM row_group g WHERE g.run_id = r.id AND g.is_complete = 1), 0)"
)
_WALLS: Final = "min(CAST(wall_time_s AS REAL)), max(CAST(wall_time_s AS REAL))"
_TAILS: Final = (
    f"SELECT r.id, min(s.id), max(s.id), json_group_array({{payload}}), {_WALLS} "
    f"FROM run r CROSS JOIN state s ON {_IN_NO_GROUP} GROUP BY r.id"
)
_BLOCKS: Final = (
    f"SELECT run_id, min(id), max(id), json_group_array({{payload}}), {_WALLS} FROM {{table}} "
    f"WHERE 1 {{own}} GROUP BY id / {_BLOCK_IDS}, run_id"
)
# The frames of a kept stretch count with its states, and go with them.
_OWN: Final = f"AND kind <> '{KEPT_FRAME}'"
_FILE_BYTES: Final = "iif(size_bytes BETWEEN 0 AND 1e12, size_bytes, 0)"
_FRAMES: Final = (
    f"SELECT run_id, sum({_FILE_BYTES}) * 1.0 / max(1, (SELECT count(*) FROM kept_state k "
    f"WHERE k.run_id = image.run_id)) FROM image WHERE kind = '{KEPT_FRAME}' GROUP BY run_id"
)
_COLUMNS: Final = "SELECT name, type, pk FROM pragma_table_info(?)"
_ROWS: Final = {
    "group": "FROM state s JOIN row_group g ON g.id = :group_id WHERE s.run_id = g.run_id "
    "AND s.sim_time_s BETWEEN g.start_sim_time_s AND g.end_sim_time_s "
    "AND (s.sim_time_s, s.id) <= (g.end_sim_time_s, g.last_state_id) AND s.id <= g.max_state_id",
    "tail": f"FROM run r CROSS JOIN state s ON {_IN_NO_GROUP} WHERE r.id = :run_id",
    "block": "FROM {table} s WHERE s.run_id = :run_id AND s.id >= :first_id AND s.id <= :last_id "
    "{own}",
}


class Run(NamedTuple):
    """A run as retention sees it."""

    id: int
    robot_id: int
    recorded_rows: int
    started_wall_time_s: float
    last_wall_time_s: float
    is_kept: bool
    is_current: bool


class Portion(NamedTuple):
    """Rows of one run in one table that follow each other.

    Attributes:
        group_id: Of states and chunks their row group; 0 of states that are in none.
        first_id: No row of it is below; `last_id` none is beyond.
        rows: So many; of chunks the states that they stand for.
        row_bytes: What one of them takes on the disk.
        oldest_s: Wall time of the oldest one; `newest_s` of the newest one.
        is_held: Of chunks: the states that they stand for are there as well.
    """

    table: str
    run: Run
    group_id: int
    first_id: int
    last_id: int
    rows: int
    row_bytes: float
    oldest_s: float
    newest_s: float
    is_held: bool = False

    @property
    def size_bytes(self) -> float:
        """What all of it takes on the disk."""
        return self.rows * self.row_bytes


def read_runs(connection: sqlite3.Connection) -> list[Run]:
    """All runs in the order in which they began.

    A run whose times are no numbers, which no bridge writes, has no place in it: it stays.
    """
    return [Run(*row) for row in connection.execute(_RUNS).fetchall()]


def portions_of(connection: sqlite3.Connection, runs: Sequence[Run]) -> dict[str, list[Portion]]:
    """What these runs hold, by table, the newest first."""
    by_id = {run.id: run for run in runs}
    found: dict[str, list[Portion]] = {table: [] for table in TABLES}
    for portion in (*_grouped(connection, by_id), *_counted(connection, by_id)):
        found[portion.table].append(portion)
    for portions in found.values():
        portions.sort(key=lambda each: -each.last_id)
    return found


def _grouped(connection: sqlite3.Connection, runs: Mapping[int, Run]) -> Iterator[Portion]:
    for row in connection.execute(_GROUPS).fetchall():
        group_id, run_id, last_id, rows, stored, row_bytes, chunk_bytes, first_id, *walls = row
        if (run := runs.get(run_id)) is None:
            continue
        oldest_s, newest_s = (run.last_wall_time_s if wall is None else wall for wall in walls)
        last, times = (group_id, last_id), (oldest_s, newest_s)
        if stored:
            yield Portion("state", run, group_id, int(first_id), last_id, stored, row_bytes, *times)
        yield Portion("chunk", run, *last, last_id, rows, chunk_bytes / rows, *times, stored > 0)


def _counted(connection: sqlite3.Connection, runs: Mapping[int, Run]) -> Iterator[Portion]:
    (page_bytes,) = connection.execute("PRAGMA page_size").fetchone()
    frame_bytes: dict[int, float] = dict(connection.execute(_FRAMES).fetchall())
    for table in ("state", "kept_state", "log", "event", "image"):
        query = _TAILS if table == "state" else _BLOCKS
        payload = _FILE_BYTES if table == "image" else _payload(connection, table)
        asked = query.format(table=table, payload=payload, own=_OWN if table == "image" else "")
        for run_id, first_id, last_id, sizes, *times in connection.execute(asked).fetchall():
            if run_id not in runs:
                continue
            each: list[int] = json.loads(sizes)
            row_bytes = sum(each) / len(each)
            if table != "image":
                row_bytes = disk_bytes(each, page_bytes) / len(each) + INDEX_BYTES
            if table == "kept_state":
                row_bytes += frame_bytes.get(run_id, 0.0)
            yield Portion(table, runs[run_id], 0, first_id, last_id, len(each), row_bytes, *times)


def _payload(connection: sqlite3.Connection, table: str) -> str:
    """SQL for the bytes of a record: each column takes a byte or two in its head, and its value."""
    parts = ["2"]
    for name, kind, is_key in connection.execute(_COLUMNS, (table,)).fetchall():
        if kind == "TEXT":
            parts.append(f"coalesce(length(CAST({name} AS BLOB)) + 1, 1)")
        elif not is_key:
            parts.append("9" if kind == "FLOAT" else "3")
    return " + ".join(parts)


def rows_of(portion: Portion) -> tuple[str, dict[str, Any]]:
    """The rows of a portion that are there now: SQL from FROM on, of `s`, and its values."""
    values = {
        "run_id": portion.run.id, "group_id": portion.group_id,
        "first_id": portion.first_id, "last_id": portion.last_id,
    }  # fmt: skip
    kind = "block" if portion.table != "state" else "group" if portion.group_id else "tail"
    own = _OWN if portion.table == "image" else ""
    return _ROWS[kind].format(table=portion.table, own=own), values


def nth_id(connection: sqlite3.Connection, portion: Portion, number: int) -> int:
    """The id of the row of that number, from 1, counted from the oldest."""
    rows, values = rows_of(portion)
    query = f"SELECT s.id {rows} ORDER BY s.id LIMIT 1 OFFSET :number - 1"
    row = connection.execute(query, values | {"number": number}).fetchone()
    return row[0] if row else UNBOUNDED


def rows_before(connection: sqlite3.Connection, portion: Portion, wall_time_s: float) -> int:
    """How many of the rows are older than that."""
    if portion.newest_s < wall_time_s:
        return portion.rows
    if portion.oldest_s >= wall_time_s or portion.table == "chunk":
        return 0
    rows, values = rows_of(portion)
    query = f"SELECT count(*) {rows} AND s.wall_time_s < :before_s"
    return int(connection.execute(query, values | {"before_s": wall_time_s}).fetchone()[0])


def rows_up_to(connection: sqlite3.Connection, portion: Portion, last_id: float) -> int:
    """How many of the rows have ids up to that."""
    if portion.last_id <= last_id:
        return portion.rows
    if portion.first_id > last_id or portion.table == "chunk":
        return 0
    rows, values = rows_of(portion)
    query = f"SELECT count(*) {rows} AND s.id <= :until"
    return int(connection.execute(query, values | {"until": last_id}).fetchone()[0])


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
