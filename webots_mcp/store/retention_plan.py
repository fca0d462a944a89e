"""What a recording holds and what of it is beyond the limits: a plan lists it.

State rows and chunks are counted by their row groups, which know what they take on the disk, other
rows one by one, in portions small enough to be deleted one after the other.
"""

from __future__ import annotations

import json
import math
import sqlite3
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.analysis.arrays import Array, np
from webots_mcp.contract import FINAL_STATUSES, KEPT_FRAME
from webots_mcp.store.chunk_making import INDEX_BYTES, disk_bytes
from webots_mcp.store.chunks import STATE_IDS, WALL_TIMES, ChunkGroup, Decoded, values_in
from webots_mcp.store.retention import DEFAULT, KEPT, Limit, Retention

TABLES: Final = ("state", "chunk", "kept_state", "log", "event", "image")
_COUNTED: Final = ("kept_state", "log", "event", "image")
_LONG: Final = ("state", "kept_state")  # rows, of which a few fill a page
_BLOCK_IDS: Final = 512
_SAMPLE: Final = 100

_RUNS: Final = (
    f"SELECT id, robot_id, row_count, started_wall_time_s, last_wall_time_s, {KEPT}, "
    "ended_wall_time_s IS NULL OR id = (SELECT max(id) FROM run n WHERE n.robot_id = run.robot_id)"
    " AS is_current, is_chunked FROM run WHERE typeof(started_wall_time_s) IN ('real', 'integer') "
    "AND typeof(last_wall_time_s) IN ('real', 'integer') ORDER BY started_wall_time_s, id"
)
_GROUPS: Final = (
    "SELECT g.id, g.run_id, g.max_state_id, g.row_count, g.stored_row_count, "
    "g.stored_row_bytes, g.chunk_bytes, coalesce(i.min, 0), w.min, w.max FROM row_group g "
    "LEFT JOIN chunk i ON i.run_id = g.run_id AND i.group_id = g.id "
    f"AND i.signal_id = {STATE_IDS} "
    "LEFT JOIN chunk w ON w.run_id = g.run_id AND w.group_id = g.id "
    f"AND w.signal_id = {WALL_TIMES} WHERE g.is_complete = 1"
)
_PLACE: Final = (
    "SELECT id, start_sim_time_s, end_sim_time_s, last_state_id, max_state_id, row_count "
    "FROM row_group WHERE id = ?"
)
_SUMS: Final = (
    "run_id, min(id), max(id), {payloads}, count(*), min(CAST(wall_time_s AS REAL)), "
    "max(CAST(wall_time_s AS REAL))"
)
_IN_NO_GROUP: Final = (
    f"SELECT {_SUMS} FROM state WHERE run_id = :run AND sim_time_s >= coalesce((SELECT "
    "max(end_sim_time_s) FROM row_group WHERE run_id = :run AND is_complete = 1), -9e999) "
    "AND id > coalesce((SELECT max(max_state_id) FROM row_group WHERE run_id = :run "
    "AND is_complete = 1), 0)"
)
_BLOCKS: Final = (
    f"SELECT {_SUMS} FROM {{table}} WHERE id > 0 {{own}} GROUP BY id / {_BLOCK_IDS}, run_id"
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
# Those that were created during a kept run stay with it.
OLD_COMMANDS: Final = (
    f"FROM command c WHERE robot_id = :robot_id AND status IN {FINAL_STATUSES} "
    "AND created_wall_time_s < :before_s AND NOT EXISTS (SELECT 1 FROM run "
    f"WHERE robot_id = c.robot_id AND {KEPT} "
    "AND c.created_wall_time_s BETWEEN started_wall_time_s AND last_wall_time_s)"
)
_COMMAND_BYTES: Final = 400


class RetainedRun(NamedTuple):
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


def _portions(
    connection: sqlite3.Connection, runs: dict[int, RetainedRun]
) -> dict[str, list[Portion]]:
    """What these runs hold, by table, the newest first."""
    found: dict[str, list[Portion]] = {table: [] for table in TABLES}
    for portion in (*_grouped(connection, runs), *_in_no_group(connection, runs)):
        found[portion.table].append(portion)
    for table in _COUNTED:
        own = _OWN if table == "image" else ""
        query = _BLOCKS.format(table=table, own=own, payloads=_payloads(connection, table))
        rows = connection.execute(query).fetchall()
        found[table] = [_portion(connection, table, row) for row in rows if row[0] in runs]
    frame_bytes: dict[int, float] = dict(connection.execute(_FRAMES).fetchall())
    found["kept_state"] = _with_frames(found["kept_state"], frame_bytes)
    for portions in found.values():
        portions.sort(key=lambda each: -each.last_id)
    return found


def _grouped(connection: sqlite3.Connection, runs: dict[int, RetainedRun]) -> Iterator[Portion]:
    """The states and chunks of row groups."""
    for facts in connection.execute(_GROUPS).fetchall():
        group_id, run_id, last_id, rows, left, row_bytes, chunk_bytes, first_id, *walls = facts
        if run_id not in runs:
            continue
        of = (run_id, group_id, int(first_id), last_id)
        times = (runs[run_id].last_wall_time_s if wall is None else wall for wall in walls)
        oldest_s, newest_s = times
        if left:
            yield Portion("state", *of, left, left * row_bytes, oldest_s, newest_s)
        yield Portion("chunk", *of, rows, chunk_bytes, oldest_s, newest_s, is_held=left > 0)


def _in_no_group(connection: sqlite3.Connection, runs: dict[int, RetainedRun]) -> Iterator[Portion]:
    """The newest states of each run."""
    query = _IN_NO_GROUP.format(payloads=_payloads(connection, "state"))
    for run_id in runs:
        row = connection.execute(query, {"run": run_id}).fetchone()
        if row[0] is not None:
            yield _portion(connection, "state", row)


def _portion(connection: sqlite3.Connection, table: str, row: Sequence[Any]) -> Portion:
    """A portion of rows that were looked at one by one."""
    run_id, first_id, last_id, payloads, rows, oldest_s, newest_s = row
    size_bytes = float(payloads) if table == "image" else rows * INDEX_BYTES
    (page_bytes,) = connection.execute("PRAGMA page_size").fetchone()
    if table in _LONG:
        size_bytes += disk_bytes(json.loads(payloads), page_bytes)
    elif table != "image":  # of a million rows their mean tells as much as a look at each
        size_bytes += disk_bytes([round(payloads / rows)] * _SAMPLE, page_bytes) * rows / _SAMPLE
    return Portion(table, run_id, 0, first_id, last_id, rows, size_bytes, oldest_s, newest_s)


def _payloads(connection: sqlite3.Connection, table: str) -> str:
    """SQL for the bytes of records: of long ones each, of short ones their sum."""
    if table == "image":
        return f"sum({_FILE_BYTES})"
    parts = ["2"]  # each column takes a byte or two in the head of the record too
    for name, kind, is_key in connection.execute(_COLUMNS, (table,)).fetchall():
        if kind == "TEXT":
            parts.append(f"coalesce(length(CAST({name} AS BLOB)) + 1, 1)")
        elif not is_key:
            parts.append("9" if kind == "FLOAT" else "3")
    return f"{'json_group_array' if table in _LONG else 'sum'}({' + '.join(parts)})"


def _with_frames(stretches: list[Portion], frame_bytes: dict[int, float]) -> list[Portion]:
    """Rows of kept stretches with their share of the run's frames."""
    rows = Counter[int]()
    for each in stretches:
        rows[each.run_id] += each.rows
    return [
        each._replace(size_bytes=each.size_bytes + frame_bytes.get(each.run_id, 0.0)
                      * each.rows / rows[each.run_id])
        for each in stretches
    ]  # fmt: skip


def read_runs(connection: sqlite3.Connection) -> dict[int, RetainedRun]:
    """All runs by their ids, in the order in which they began.

    A run whose times are no numbers, which no bridge writes, has no place in it: it stays.
    """
    return {row[0]: RetainedRun(*row) for row in connection.execute(_RUNS).fetchall()}


def rows_of(connection: sqlite3.Connection, portion: Portion) -> tuple[Array, Array]:
    """Ids of the rows that a portion had when it was counted, rising, and their wall times."""
    if portion.group_id:
        group = ChunkGroup(*connection.execute(_PLACE, (portion.group_id,)).fetchone())
        found = [
            [values.numbers for _, values in values_in(connection, portion.run_id, signal_id,
                                                       {group.id: group.row_count})
             if isinstance(values, Decoded)]
            for signal_id in (STATE_IDS, WALL_TIMES)
        ]  # fmt: skip
        ids, walls = found  # nothing of a chunk that is missing or damaged
        if ids:
            order = np.argsort(ids[0])[-portion.rows :]  # the oldest of a group go first
            known = walls[0] if walls else np.full(len(ids[0]), portion.newest_s)
            return ids[0][order], known[order]
    own = _OWN if portion.table == "image" else ""
    bounds = (portion.run_id, portion.first_id, portion.last_id)
    rows = connection.execute(_ROWS.format(table=portion.table, own=own), bounds).fetchall()
    table: Array = np.reshape(np.array(rows, np.float64), (-1, 2))
    return table[:, 0], table[:, 1]


def file_sizes(connection: sqlite3.Connection) -> dict[str, int]:
    """Bytes of the database on the disk: the file, what of it is free, and the log next to it."""
    page_bytes, pages, free_pages = (
        int(connection.execute(f"PRAGMA {name}").fetchone()[0])
        for name in ("page_size", "page_count", "freelist_count")
    )
    (file,) = connection.execute("SELECT file FROM pragma_database_list").fetchone()
    log = Path(f"{file}-wal")
    return {
        "file_bytes": pages * page_bytes,
        "free_in_file_bytes": free_pages * page_bytes,
        "log_beside_bytes": log.stat().st_size if file and log.exists() else 0,
    }


@dataclass(frozen=True)
class Going:
    """The oldest rows of a portion go; or a run, or commands of a robot.

    Attributes:
        table: From which they go; of chunks a row is a state that they stand for.
        owner_id: The run; of commands the robot.
        rows: So many.
        size_bytes: About so much on the disk; of pictures their files.
        newest_s: About when the newest of them was written, in wall time; commands are older.
        portion: Where they are; None of runs and commands.
        bound: The last id that goes: two that carry out the same plan at once delete no more
            than one would.
    """

    table: str
    owner_id: int
    rows: int
    size_bytes: int
    newest_s: float
    portion: Portion | None = None
    bound: int = 0

    @property
    def is_whole(self) -> bool:
        """Whether all of the portion goes."""
        return self.portion is not None and self.bound >= self.portion.last_id


@dataclass(frozen=True)
class Spared:
    """What is beyond a limit, and stays."""

    table: str
    rows: int
    size_bytes: int
    why: str


@dataclass(frozen=True)
class Plan:
    """What would go now.

    Attributes:
        steps: What goes, of each table the oldest first.
        held_bytes: About what each kind takes now, of all runs.
        spared: What would have to go as well, and why it does not.
        kept_run_ids: Runs that a person named, described or marked: nothing of them goes, and
            they do not count.
        kept_bytes: About what they take.
    """

    steps: tuple[Going, ...]
    held_bytes: dict[str, int]
    spared: tuple[Spared, ...]
    kept_run_ids: tuple[int, ...]
    kept_bytes: int

    @property
    def rows(self) -> int:
        """All rows that go."""
        return sum(step.rows for step in self.steps)

    def rows_by_table(self) -> Counter[str]:
        """How many rows of each table go."""
        rows = Counter[str]()
        for step in self.steps:
            rows[step.table] += step.rows
        return rows

    def size_of(self, table: str) -> int:
        """About what a table's rows that go take."""
        return sum(step.size_bytes for step in self.steps if step.table == table)

    def runs_of(self, table: str) -> list[int]:
        """The runs that lose rows of a table, in order; commands have none."""
        if table == "command":
            return []
        return list(dict.fromkeys(step.owner_id for step in self.steps if step.table == table))


def plan(
    connection: sqlite3.Connection, retention: Retention = DEFAULT, now_s: float | None = None
) -> Plan:
    """Find what is beyond the limits; nothing is changed.

    Args:
        connection: Any.
        retention: The limits.
        now_s: Unix time, from which ages are counted; None for now.
    """
    now_s = time.time() if now_s is None else now_s
    return _Planner(connection, retention, now_s).plan()


class _Planner:
    """The recording at one moment, against the limits."""

    def __init__(self, connection: sqlite3.Connection, retention: Retention, now_s: float) -> None:
        self._connection = connection
        self._retention = retention
        self._now_s = now_s
        self._runs = read_runs(connection)
        self._held = _portions(connection, self._runs)
        self._rows: dict[Portion, tuple[Array, Array]] = {}  # of the few that are looked into
        self._spared = dict[tuple[str, str], list[float]]()
        self._forgotten = self._find_forgotten() if retention.outlive else set[int]()

    def plan(self) -> Plan:
        steps: list[Going] = []
        for table in TABLES:
            gone = [each.portion for each in steps if each.portion and each.is_whole]
            whole_groups = {portion.group_id for portion in gone if portion.table == "state"}
            steps += reversed(list(self._beyond(table, whole_groups)))
        for run_id in self._runs:
            if run_id in self._forgotten:
                steps.append(Going("run", run_id, 1, 0, self._runs[run_id].last_wall_time_s))
        for robot_id in {run.robot_id: None for run in self._runs.values()}:
            steps += self._commands(robot_id)
        kept = [self._kept(table, is_kept=True) for table in TABLES]
        return Plan(
            tuple(steps),
            {table: round(_size_of(portions)) for table, portions in self._held.items()},
            tuple(
                Spared(table, int(rows), round(size_bytes), why)
                for (table, why), (rows, size_bytes) in self._spared.items()
            ),
            tuple(run.id for run in self._runs.values() if run.is_kept),
            round(sum(map(_size_of, kept))),
        )

    def _kept(self, table: str, *, is_kept: bool) -> list[Portion]:
        """Portions of the runs that are retention's to judge, or of those that are not."""
        return [each for each in self._held[table] if self._runs[each.run_id].is_kept == is_kept]

    def _find_forgotten(self) -> set[int]:
        """Finished runs after which `outlive` times the limits of chunks and states was recorded.

        As of these, age alone does not do it where few were recorded since.
        """
        limits = [(getattr(self._retention, table), self._row_bytes(table))
                  for table in ("chunk", "state")]  # fmt: skip
        after, forgotten, times = 0, set[int](), self._retention.outlive
        free = [run for run in self._runs.values() if not run.is_kept]
        for run in sorted(free, key=lambda run: (-run.started_wall_time_s, -run.id)):
            age_s = self._now_s - run.last_wall_time_s
            if not run.is_current and all(
                limit.is_exceeded(
                    size_bytes=after * row_bytes,
                    rows=after,
                    age_s=age_s if after >= limit.spared_rows else 0,
                    times=times,
                )
                for limit, row_bytes in limits
            ):
                forgotten.add(run.id)
            after += run.recorded_rows
        return forgotten

    def _row_bytes(self, table: str) -> float:
        held = self._kept(table, is_kept=False)
        return _size_of(held) / max(sum(portion.rows for portion in held), 1)

    def _beyond(self, table: str, whole_groups: set[int]) -> Iterator[Going]:
        """What goes of a table, the newest first; all of runs that are forgotten."""
        limit: Limit = getattr(self._retention, table)
        free = self._kept(table, is_kept=False)
        staying = [portion for portion in free if portion.run_id not in self._forgotten]
        before_s = -math.inf if limit.age_s is None else self._now_s - limit.age_s
        bound, rows = self._bound(staying, limit), 0
        for portion in free:
            if portion.run_id in self._forgotten:
                yield self._step(portion, portion.rows)
                continue
            over, old = self._up_to(portion, bound), self._before(portion, before_s)
            aged = min(old, max(portion.rows - max(limit.spared_rows - rows, 0), 0))
            going = max(over, aged)
            why = f"too old, but among the newest {limit.spared_rows}"
            self._spare(portion, old - going, why)
            rows += portion.rows
            if table == "chunk":
                going = portion.rows if over or aged == portion.rows else 0
                if portion.is_held and portion.group_id not in whole_groups:
                    self._spare(portion, going, "the states are still there")
                    going = 0
            if going:
                yield self._step(portion, going)

    def _spare(self, portion: Portion, rows: int, why: str) -> None:
        """Note so many rows, by table and reason."""
        if rows > 0:
            sums = self._spared.setdefault((portion.table, why), [0, 0.0])
            sums[0] += rows
            sums[1] += rows * portion.row_bytes

    def _bound(self, held: Sequence[Portion], limit: Limit) -> int:
        """The id up to which rows have to go, of all runs, for a size and a number of rows."""
        if not limit.is_exceeded(size_bytes=_size_of(held), rows=sum(each.rows for each in held)):
            return 0
        facts = [(each.first_id, each.last_id, each.rows, each.size_bytes) for each in held]
        first, last, rows, size = np.transpose(np.array(facts, np.float64))

        def fits(bound: int) -> bool:
            whole = first > bound
            rows_left, bytes_left = float(rows[whole].sum()), float(size[whole].sum())
            cut: list[int] = np.flatnonzero(~whole & (last > bound)).tolist()
            for portion in map(held.__getitem__, cut):
                stays = portion.rows - self._up_to(portion, bound)
                rows_left += stays
                bytes_left += stays * portion.row_bytes
            return not limit.is_exceeded(size_bytes=bytes_left, rows=rows_left)

        newest = held[0].last_id
        return bisect_left(range(newest), True, hi=newest, key=fits)

    def _up_to(self, portion: Portion, last_id: float) -> int:
        """How many of its rows have ids up to that."""
        if portion.last_id <= last_id:
            return portion.rows
        if portion.first_id > last_id or portion.table == "chunk":
            return 0
        return int(np.count_nonzero(self._rows_of(portion)[0] <= last_id))

    def _before(self, portion: Portion, wall_time_s: float) -> int:
        """How many of its rows are older than that."""
        if portion.newest_s < wall_time_s:
            return portion.rows
        if portion.oldest_s >= wall_time_s or portion.table == "chunk":
            return 0
        return int(np.count_nonzero(self._rows_of(portion)[1] < wall_time_s))

    def _rows_of(self, portion: Portion) -> tuple[Array, Array]:
        if portion not in self._rows:
            self._rows[portion] = rows_of(self._connection, portion)
        return self._rows[portion]

    def _step(self, portion: Portion, rows: int) -> Going:
        bound = portion.last_id
        if rows < portion.rows:
            ids = self._rows_of(portion)[0]
            bound = int(ids[min(rows, len(ids)) - 1]) if len(ids) else 0
        size_bytes = round(rows * portion.size_bytes / portion.rows)
        return Going(
            portion.table, portion.run_id, rows, size_bytes, portion.newest_s, portion, bound
        )

    def _commands(self, robot_id: int) -> Iterator[Going]:
        """Finished commands from before all runs of the robot that stay, or older than events."""
        runs = [run for run in self._runs.values() if run.robot_id == robot_id]
        staying = [run.started_wall_time_s for run in runs if run.id not in self._forgotten]
        before_s = min(staying) if len(staying) < len(runs) else -math.inf
        if self._retention.event.age_s is not None:
            before_s = max(before_s, self._now_s - self._retention.event.age_s)
        values = {"robot_id": robot_id, "before_s": before_s}
        query = f"SELECT count(*) {OLD_COMMANDS}"
        if rows := int(self._connection.execute(query, values).fetchone()[0]):
            yield Going("command", robot_id, rows, rows * _COMMAND_BYTES, before_s)


def _size_of(portions: Sequence[Portion]) -> float:
    return sum(portion.size_bytes for portion in portions)
