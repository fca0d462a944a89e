"""Plan retention: what a recording holds, and which parts exceed the limits.

States and chunks are deleted by whole row groups, other rows by blocks of consecutive rows. The
newest are counted first: what no longer fits a limit is deleted, and everything older with it.
"""

from __future__ import annotations

import math
import sqlite3
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import FINAL_STATUSES, KEPT_FRAME
from webots_mcp.store.chunk_making import INDEX_BYTES, disk_bytes
from webots_mcp.store.chunks import STATE_IDS, WALL_TIMES, Decoded, values_in
from webots_mcp.store.retention_limits import DEFAULT, KEPT, Limit, Retention

TABLES: Final = ("state", "chunk", "kept_state", "log", "event", "image")
_BLOCK_IDS: Final = {
    "kept_state": 64,
    "log": 512,
    "event": 512,
    "image": 16,
}  # ids that are deleted together

# A damaged time (after the year 5000) must not keep the rows around it.
_WALL_TIME: Final = (
    "max(CASE WHEN CAST(wall_time_s AS REAL) < 1e11 THEN CAST(wall_time_s AS REAL) END)"
)
_SUMS: Final = f"run_id, min(id), max(id), {{payloads}}, count(*), {_WALL_TIME}"
# The frames of full-rate segments count with their rows, and are deleted with them.
_OWN: Final = f"AND kind <> '{KEPT_FRAME}'"
_FILE_BYTES: Final = "iif(size_bytes BETWEEN 0 AND 1e12, size_bytes, 0)"
# Commands that were created during a kept run stay with it.
OLD_COMMANDS: Final = (
    f"FROM command c WHERE robot_id = :robot_id AND status IN {FINAL_STATUSES} "
    "AND created_wall_time_s < :before_s AND NOT EXISTS (SELECT 1 FROM run "
    f"WHERE robot_id = c.robot_id AND {KEPT} "
    "AND c.created_wall_time_s BETWEEN started_wall_time_s AND last_wall_time_s)"
)


@dataclass(frozen=True)
class SizeEstimates:
    """How the sizes of rows are estimated.

    Attributes:
        rows: Rows of mean size, from which the size of a block is estimated.
        command_bytes: Size of a command.
    """

    rows: int = 100
    command_bytes: int = 400


_ESTIMATES: Final = SizeEstimates()


class RetainedRun(NamedTuple):
    """A run from the viewpoint of retention."""

    id: int
    robot_id: int
    recorded_rows: int
    started_wall_time_s: float
    last_wall_time_s: float
    is_kept: bool
    is_current: bool
    is_chunked: bool


class Portion(NamedTuple):
    """Consecutive rows of one run in one table that are deleted together.

    Attributes:
        group_id: The row group of states and chunks; 0 for states that are in none.
        first_id: The lowest id; `last_id` is the highest. Chunks have those of their states.
        rows: The number of rows; for chunks that of the states they stand for.
        size_bytes: Their size on the disk.
        newest_s: Wall time of the newest row.
        is_held: For chunks: whether the states they stand for exist as well.
    """

    table: str
    run_id: int
    group_id: int
    first_id: int
    last_id: int
    rows: int
    size_bytes: float
    newest_s: float
    is_held: bool = False


@dataclass(frozen=True)
class Going:
    """A portion to delete; or a run, or commands of a robot.

    Attributes:
        table: The table of the rows; a row of `chunk` is a state that the chunks stand for.
        owner_id: The run; for commands the robot.
        rows: The number of rows.
        size_bytes: Approximate size on the disk; for pictures that of their files.
        newest_s: Approximate wall time of the newest of them; commands are older.
        portion: The rows; None for runs and commands.
    """

    table: str
    owner_id: int
    rows: int
    size_bytes: int
    newest_s: float
    portion: Portion | None = None


@dataclass(frozen=True)
class Spared:
    """What exceeds a limit and stays."""

    table: str
    rows: int
    size_bytes: int
    why: str


@dataclass(frozen=True)
class Plan:
    """What would be deleted now.

    Attributes:
        steps: What is deleted, the oldest of each table first.
        held_bytes: Approximate size of each kind now, of all runs.
        spared: What would have to be deleted as well, and why it stays.
        kept_run_ids: Runs that a person named, described or marked. They lose nothing and do not
            count.
        kept_bytes: Approximate size of those runs.
    """

    steps: tuple[Going, ...]
    held_bytes: dict[str, int]
    spared: tuple[Spared, ...]
    kept_run_ids: tuple[int, ...]
    kept_bytes: int

    @property
    def rows(self) -> int:
        """The number of all rows to delete."""
        return sum(step.rows for step in self.steps)

    def rows_by_table(self) -> Counter[str]:
        """Return the number of rows to delete by table."""
        rows = Counter[str]()
        for step in self.steps:
            rows[step.table] += step.rows
        return rows

    def size_of(self, table: str) -> int:
        """Return the approximate size of the rows of a table to delete."""
        return sum(step.size_bytes for step in self.steps if step.table == table)

    def runs_of(self, table: str) -> list[int]:
        """Return the runs that lose rows of a table, in order; commands have none."""
        if table == "command":
            return []
        return list(dict.fromkeys(step.owner_id for step in self.steps if step.table == table))


def plan(
    connection: sqlite3.Connection, retention: Retention = DEFAULT, now_s: float | None = None
) -> Plan:
    """Find what exceeds the limits, without changing anything.

    Args:
        connection: An open database.
        retention: The limits.
        now_s: Unix time, from which ages are counted; None for now.
    """
    now_s = time.time() if now_s is None else now_s
    return _Planner(connection, retention, now_s).plan()


def read_runs(connection: sqlite3.Connection) -> dict[int, RetainedRun]:
    """Return all runs by their ids, in the order in which they began.

    Runs whose times are not numbers, which no bridge writes, are left out: they stay.
    """
    return {
        row[0]: RetainedRun(*row)
        for row in connection.execute(
            f"SELECT id, robot_id, row_count, started_wall_time_s, last_wall_time_s, {KEPT}, "
            "ended_wall_time_s IS NULL OR id = (SELECT max(id) FROM run n WHERE n.robot_id = "
            "run.robot_id) AS is_current, is_chunked FROM run WHERE typeof(started_wall_time_s) IN "
            "('real', 'integer') AND typeof(last_wall_time_s) IN ('real', 'integer') ORDER BY "
            "started_wall_time_s, id"
        ).fetchall()
    }


def ids_of(connection: sqlite3.Connection, portion: Portion) -> list[int]:
    """Return the ids of the rows of a portion in order; the oldest of a group come first."""
    if portion.group_id:
        (rows,) = connection.execute(
            "SELECT row_count FROM row_group WHERE id = ?", (portion.group_id,)
        ).fetchone()
        wanted = {portion.group_id: rows}
        for _, values in values_in(connection, portion.run_id, STATE_IDS, wanted):
            if isinstance(values, Decoded):
                return sorted(map(int, values.numbers.tolist()))[-portion.rows :]
    own = _OWN if portion.table == "image" else ""
    bounds = (portion.run_id, portion.first_id, portion.last_id)
    rows_query = "SELECT id FROM {table} WHERE +run_id = ? AND id BETWEEN ? AND ? {own} ORDER BY id"
    query = rows_query.format(table=portion.table, own=own)
    return [row_id for (row_id,) in connection.execute(query, bounds).fetchall()]


def file_sizes(connection: sqlite3.Connection) -> dict[str, int]:
    """Return the bytes of the database on the disk: the file, its free space, and its log."""
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


def _portions(
    connection: sqlite3.Connection, runs: dict[int, RetainedRun]
) -> dict[str, list[Portion]]:
    """Return what these runs hold, by table, the newest first."""
    found: dict[str, list[Portion]] = {table: [] for table in TABLES}
    for portion in (*_grouped(connection, runs), *_in_no_group(connection, runs)):
        found[portion.table].append(portion)
    blocks_query = (
        f"SELECT {_SUMS} FROM {{table}} WHERE id > 0 {{own}} GROUP BY id / {{ids}}, run_id"
    )
    for table, ids in _BLOCK_IDS.items():
        own = _OWN if table == "image" else ""
        payloads = _payloads(connection, table)
        query = blocks_query.format(table=table, own=own, payloads=payloads, ids=ids)
        rows = connection.execute(query).fetchall()
        found[table] = [_portion(connection, table, row) for row in rows if row[0] in runs]
    frames_query = (
        f"SELECT run_id, sum({_FILE_BYTES}) FROM image WHERE kind = '{KEPT_FRAME}' GROUP BY run_id"
    )
    frame_bytes: dict[int, float] = dict(connection.execute(frames_query).fetchall())
    found["kept_state"] = _with_frames(found["kept_state"], frame_bytes)
    for portions in found.values():
        portions.sort(key=lambda each: -each.last_id)
    return found


def _grouped(connection: sqlite3.Connection, runs: dict[int, RetainedRun]) -> Iterator[Portion]:
    """Yield the states and chunks of row groups."""
    for facts in connection.execute(
        "SELECT g.id, g.run_id, g.max_state_id, g.row_count, g.stored_row_count, "
        "g.stored_row_bytes, g.chunk_bytes, coalesce(i.min, 0), w.max FROM row_group g "
        "LEFT JOIN chunk i ON i.run_id = g.run_id AND i.group_id = g.id "
        f"AND i.signal_id = {STATE_IDS} "
        "LEFT JOIN chunk w ON w.run_id = g.run_id AND w.group_id = g.id "
        f"AND w.signal_id = {WALL_TIMES} WHERE g.is_complete = 1"
    ).fetchall():
        group_id, run_id, last_id, rows, left, row_bytes, chunk_bytes, first_id, wall_s = facts
        if run_id not in runs:
            continue
        of = (run_id, group_id, int(first_id), last_id)
        newest_s = runs[run_id].last_wall_time_s if wall_s is None else wall_s
        if left:
            yield Portion("state", *of, left, left * row_bytes, newest_s)
        yield Portion("chunk", *of, rows, chunk_bytes, newest_s, is_held=left > 0)


def _in_no_group(connection: sqlite3.Connection, runs: dict[int, RetainedRun]) -> Iterator[Portion]:
    """Yield the states of each run that are in no group yet, which are its newest."""
    in_no_group_query = (
        f"SELECT {_SUMS} FROM state WHERE run_id = :run AND sim_time_s >= coalesce((SELECT "
        "max(end_sim_time_s) FROM row_group WHERE run_id = :run AND is_complete = 1), -9e999) "
        "AND id > coalesce((SELECT max(max_state_id) FROM row_group WHERE run_id = :run "
        "AND is_complete = 1), 0)"
    )
    query = in_no_group_query.format(payloads=_payloads(connection, "state"))
    for run_id in runs:
        row = connection.execute(query, {"run": run_id}).fetchone()
        if row[0] is not None:
            yield _portion(connection, "state", row)


def _portion(connection: sqlite3.Connection, table: str, row: Sequence[Any]) -> Portion:
    """Return a portion whose size is estimated from the mean size of its records."""
    run_id, first_id, last_id, payloads, rows, newest_s = row
    size_bytes = float(payloads)
    if table != "image":
        (page_bytes,) = connection.execute("PRAGMA page_size").fetchone()
        row_bytes = (
            disk_bytes([round(payloads / rows)] * _ESTIMATES.rows, page_bytes) / _ESTIMATES.rows
        )
        size_bytes = rows * (row_bytes + INDEX_BYTES)
    return Portion(table, run_id, 0, first_id, last_id, rows, size_bytes, newest_s)


def _payloads(connection: sqlite3.Connection, table: str) -> str:
    """Return the SQL for the bytes of the records of a table, or of the files of pictures."""
    if table == "image":
        return f"sum({_FILE_BYTES})"
    parts = ["2"]  # each column takes a byte or two in the header of the record too
    for name, kind, is_key in connection.execute(
        "SELECT name, type, pk FROM pragma_table_info(?)", (table,)
    ).fetchall():
        if kind == "TEXT":
            parts.append(f"coalesce(length(CAST({name} AS BLOB)) + 1, 1)")
        elif not is_key:
            parts.append("9" if kind == "FLOAT" else "3")
    return f"sum({' + '.join(parts)})"


def _with_frames(portions: list[Portion], frame_bytes: dict[int, float]) -> list[Portion]:
    """Return rows of full-rate segments with their share of the camera frames of their run."""
    rows = Counter[int]()
    for each in portions:
        rows[each.run_id] += each.rows
    return [
        each._replace(size_bytes=each.size_bytes + frame_bytes.get(each.run_id, 0.0)
                      * each.rows / rows[each.run_id])
        for each in portions
    ]  # fmt: skip


class _Planner:
    """The recording at one moment, against the limits."""

    def __init__(self, connection: sqlite3.Connection, retention: Retention, now_s: float) -> None:
        self._connection = connection
        self._retention = retention
        self._now_s = now_s
        self._runs = read_runs(connection)
        self._held = _portions(connection, self._runs)
        self._spared = dict[tuple[str, str], list[float]]()
        self._forgotten = self._find_forgotten() if retention.outlive else set[int]()

    def plan(self) -> Plan:
        steps: list[Going] = []
        for table in TABLES:
            groups = {step.portion.group_id for step in steps if step.portion}
            steps += reversed(list(self._beyond(table, groups)))
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
        """Return portions of the runs that retention may delete, or of those that it keeps."""
        return [each for each in self._held[table] if self._runs[each.run_id].is_kept == is_kept]

    def _find_forgotten(self) -> set[int]:
        """Find finished runs after which `outlive` times the limits of chunks and states was
        recorded.

        Age alone does not suffice if few states were recorded since.
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

    def _beyond(self, table: str, groups: set[int]) -> Iterator[Going]:
        """Yield what is deleted of a table, the newest first; everything of outlived runs.

        Args:
            table: The table.
            groups: The groups whose states are deleted.
        """
        limit: Limit = getattr(self._retention, table)
        before_s = -math.inf if limit.age_s is None else self._now_s - limit.age_s
        keeps_newest = 0 not in (limit.rows, limit.size_bytes)
        rows, size_bytes, is_over = 0, 0.0, False
        for portion in self._kept(table, is_kept=False):
            if portion.run_id in self._forgotten:
                yield _going(portion)
                continue
            newer, rows, size_bytes = rows, rows + portion.rows, size_bytes + portion.size_bytes
            is_over = is_over or limit.is_exceeded(size_bytes=size_bytes, rows=rows)
            is_old = portion.newest_s < before_s
            goes = is_over and (newer > 0 or not keeps_newest)
            if is_old and not goes:
                goes = newer >= limit.spared_rows
                if not goes:
                    self._spare(portion, f"too old, but among the newest {limit.spared_rows}")
            if goes and portion.is_held and portion.group_id not in groups:
                self._spare(portion, "the states are still there")
            elif goes:
                yield _going(portion)

    def _spare(self, portion: Portion, why: str) -> None:
        """Note what exceeds a limit and stays, by table and reason."""
        sums = self._spared.setdefault((portion.table, why), [0, 0.0])
        sums[0] += portion.rows
        sums[1] += portion.size_bytes

    def _commands(self, robot_id: int) -> Iterator[Going]:
        """Yield finished commands from before all remaining runs of the robot, or older than
        events.
        """
        runs = [run for run in self._runs.values() if run.robot_id == robot_id]
        staying = [run.started_wall_time_s for run in runs if run.id not in self._forgotten]
        before_s = min(staying) if len(staying) < len(runs) else -math.inf
        if self._retention.event.age_s is not None:
            before_s = max(before_s, self._now_s - self._retention.event.age_s)
        values = {"robot_id": robot_id, "before_s": before_s}
        query = f"SELECT count(*) {OLD_COMMANDS}"
        if rows := int(self._connection.execute(query, values).fetchone()[0]):
            yield Going("command", robot_id, rows, rows * _ESTIMATES.command_bytes, before_s)


def _going(portion: Portion) -> Going:
    size_bytes = round(portion.size_bytes)
    facts = (portion.table, portion.run_id, portion.rows, size_bytes, portion.newest_s)
    return Going(*facts, portion)


def _size_of(portions: Sequence[Portion]) -> float:
    return sum(portion.size_bytes for portion in portions)
