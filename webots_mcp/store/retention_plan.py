"""What a recording holds and what of it is beyond the limits: a plan lists it.

State rows and chunks are counted by their row groups, which know what they take on the disk. Other
rows are counted once, when they have come: a `Holdings` that is kept reads only what is new. All is
counted in portions small enough to be deleted one after the other.
"""

from __future__ import annotations

import json
import math
import sqlite3
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from pydantic import TypeAdapter
from pydantic.dataclasses import dataclass as pydantic_dataclass

from webots_mcp.contract import FINAL_STATUSES, KEPT_FRAME, whole_file
from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.chunk_making import INDEX_BYTES, disk_bytes
from webots_mcp.store.chunks import STATE_IDS, WALL_TIMES, Decoded, Group, values_in
from webots_mcp.store.retention import DEFAULT, KEPT, Limit, Retention

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

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self._page_bytes = int(connection.execute("PRAGMA page_size").fetchone()[0])
        self._payloads: dict[str, str] = {"image": _FILE_BYTES}
        self._groups: dict[int, tuple[Any, ...]] = {}
        self._in_no_group: dict[int, tuple[Run, Portion | None]] = {}
        self._counted: dict[str, dict[int, Portion]] = {table: {} for table in _COUNTED}
        self._last_ids: dict[str, int] = dict.fromkeys(_COUNTED, 0)

    def portions(self, runs: dict[int, Run]) -> dict[str, list[Portion]]:
        """What these runs hold, by table, the newest first."""
        found: dict[str, list[Portion]] = {table: [] for table in TABLES}
        for portion in (*self._grouped(runs), *self._states_in_no_group(runs)):
            found[portion.table].append(portion)
        for table, held in self._counted.items():
            self._count_new(table, held)
            found[table] = [portion for portion in held.values() if portion.run_id in runs]
        frame_bytes: dict[int, float] = dict(self._connection.execute(_FRAMES).fetchall())
        found["kept_state"] = _with_frames(found["kept_state"], frame_bytes)
        for portions in found.values():
            portions.sort(key=lambda each: -each.last_id)
        return found

    def recount(self, portion: Portion) -> None:
        """Count a portion again from which rows may have gone."""
        if (held := self._counted.get(portion.table)) is not None:
            held.pop(portion.first_id, None)
            where = "AND run_id = ? AND id BETWEEN ? AND ?"
            bounds = (portion.run_id, portion.first_id, portion.last_id)
            held |= {each.first_id: each for each in self._blocks(portion.table, where, 0, *bounds)}
        self._in_no_group.pop(portion.run_id, None)

    def _grouped(self, runs: dict[int, Run]) -> Iterator[Portion]:
        last_id = max(self._groups, default=0)
        for group_id, *facts in self._connection.execute(_GROUPS, (last_id,)):
            self._groups[group_id] = tuple(facts)
            self._in_no_group.pop(facts[0], None)
        stored = dict(self._connection.execute(_STORED).fetchall())
        self._groups = {each: facts for each, facts in self._groups.items() if each in stored}
        for group_id, facts in self._groups.items():
            run_id, last_id, rows, row_bytes, chunk_bytes, first_id, *walls = facts
            if run_id not in runs:
                continue
            of = (run_id, group_id, int(first_id), last_id)
            times = (runs[run_id].last_wall_time_s if wall is None else wall for wall in walls)
            oldest_s, newest_s = times
            if left := stored[group_id]:
                yield Portion("state", *of, left, left * row_bytes, oldest_s, newest_s)
            yield Portion("chunk", *of, rows, chunk_bytes, oldest_s, newest_s, is_held=left > 0)

    def _states_in_no_group(self, runs: dict[int, Run]) -> Iterator[Portion]:
        """The newest rows of each run; those of one that is in chunks are counted once."""
        query = _IN_NO_GROUP.format(payload=self._payload("state"))
        for run in runs.values():
            known, portion = self._in_no_group.get(run.id, (None, None))
            if known != run or not run.is_chunked:
                row = self._connection.execute(query, {"run": run.id}).fetchone()
                portion = None if row[0] is None else self._portion("state", row)
                self._in_no_group[run.id] = run, portion
            if portion is not None:
                yield portion

    def _count_new(self, table: str, held: dict[int, Portion]) -> None:
        newest = {each.run_id: each for each in held.values()}
        for each in self._blocks(table, "", self._last_ids[table]):
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

    def _blocks(self, table: str, where: str, after: int, *values: int) -> Iterator[Portion]:
        """The rows after an id, in portions."""
        own = where + (f" {_OWN}" if table == "image" else "")
        query = _BLOCKS.format(table=table, own=own, payload=self._payload(table))
        for row in self._connection.execute(query, (after, *values)).fetchall():
            yield self._portion(table, row)

    def _portion(self, table: str, row: Sequence[Any]) -> Portion:
        """A portion of rows that were looked at one by one."""
        run_id, first_id, last_id, payloads, oldest_s, newest_s = row
        each: list[int] = json.loads(payloads)
        size_bytes = float(sum(each))
        if table != "image":
            size_bytes = disk_bytes(each, self._page_bytes) + INDEX_BYTES * len(each)
        ids = (first_id, last_id)
        return Portion(table, run_id, 0, *ids, len(each), size_bytes, oldest_s, newest_s)

    def _payload(self, table: str) -> str:
        """SQL for the bytes of a record: each column takes a byte or two in its head too."""
        if table not in self._payloads:
            parts = ["2"]
            for name, kind, is_key in self._connection.execute(_COLUMNS, (table,)).fetchall():
                if kind == "TEXT":
                    parts.append(f"coalesce(length(CAST({name} AS BLOB)) + 1, 1)")
                elif not is_key:
                    parts.append("9" if kind == "FLOAT" else "3")
            self._payloads[table] = " + ".join(parts)
        return self._payloads[table]


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


def read_runs(connection: sqlite3.Connection) -> dict[int, Run]:
    """All runs by their ids, in the order in which they began.

    A run whose times are no numbers, which no bridge writes, has no place in it: it stays.
    """
    return {row[0]: Run(*row) for row in connection.execute(_RUNS).fetchall()}


def rows_of(connection: sqlite3.Connection, portion: Portion) -> tuple[Array, Array]:
    """Ids of the rows that a portion had when it was counted, rising, and their wall times."""
    if portion.group_id:
        group = Group(*connection.execute(_PLACE, (portion.group_id,)).fetchone())
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


# Those that were created during a kept run stay with it.
OLD_COMMANDS: Final = (
    f"FROM command c WHERE robot_id = :robot_id AND status IN {FINAL_STATUSES} "
    "AND created_wall_time_s < :before_s AND NOT EXISTS (SELECT 1 FROM run "
    f"WHERE robot_id = c.robot_id AND {KEPT} "
    "AND c.created_wall_time_s BETWEEN started_wall_time_s AND last_wall_time_s)"
)
_COMMAND_BYTES: Final = 400


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
    def row_bytes(self) -> float:
        """About what one of them takes; at least a byte."""
        return max(self.size_bytes / max(self.rows, 1), 1.0)

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
        unshipped: Of what goes, what no pool holds, because more waits than is kept until then.
    """

    steps: tuple[Going, ...]
    held_bytes: dict[str, int]
    spared: tuple[Spared, ...]
    kept_run_ids: tuple[int, ...]
    kept_bytes: int
    unshipped: tuple[Spared, ...] = ()

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
    connection: sqlite3.Connection,
    retention: Retention = DEFAULT,
    now_s: float | None = None,
    holdings: Holdings | None = None,
) -> Plan:
    """Find what is beyond the limits; nothing is changed.

    Args:
        connection: Any.
        retention: The limits.
        now_s: Unix time, from which ages are counted; None for now.
        holdings: What was counted before, so that only new rows are looked at; None for a look at
            all logs, events, pictures and kept stretches.
    """
    now_s = time.time() if now_s is None else now_s
    return _Planner(connection, retention, now_s, holdings or Holdings(connection)).plan()


class _Planner:
    """The recording at one moment, against the limits."""

    def __init__(
        self, connection: sqlite3.Connection, retention: Retention, now_s: float, held: Holdings
    ) -> None:
        self._connection = connection
        self._retention = retention
        self._now_s = now_s
        self._runs = read_runs(connection)
        self._held = held.portions(self._runs)
        self._rows: dict[Portion, tuple[Array, Array]] = {}  # of the few that are looked into
        self._spared = dict[tuple[str, str], list[float]]()
        self._unshipped = dict[tuple[str, str], list[float]]()
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
        if limit_bytes := self._retention.unshipped.size_bytes:
            steps = self._after_shipping(steps, limit_bytes)
        kept = [self._kept(table, is_kept=True) for table in TABLES]
        return Plan(
            tuple(steps),
            {table: round(_size_of(portions)) for table, portions in self._held.items()},
            _listed(self._spared),
            tuple(run.id for run in self._runs.values() if run.is_kept),
            round(sum(map(_size_of, kept))),
            _listed(self._unshipped),
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
            _add(self._spared, portion, old - going, why)
            rows += portion.rows
            if table == "chunk":
                going = portion.rows if over or aged == portion.rows else 0
                if portion.is_held and portion.group_id not in whole_groups:
                    _add(self._spared, portion, going, "the states are still there")
                    going = 0
            if going:
                yield self._step(portion, going)

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

    def _after_shipping(self, steps: Sequence[Going], left_bytes: float) -> list[Going]:
        """Without what waits to be shipped: the newest of it stays, up to that size."""
        pools = shipped_of(self._connection)
        going = list[Going]()
        runs = set[int]()  # that have to wait for their rows
        for step in sorted(steps, key=lambda each: (each.table == "run", -each.newest_s)):
            waiting = self._waiting(step, pools)
            stays = min(waiting, int(left_bytes / step.row_bytes))
            if step.table == "run":
                stays = int(step.owner_id in runs or (waiting > 0 and left_bytes > 0))
            elif step.table == "chunk" and stays:
                stays = step.rows
            left_bytes -= stays * step.row_bytes if step.table != "run" else 0
            if stays and step.table != "command":
                runs.add(step.owner_id)
            _add(self._spared, step, stays, "not shipped yet")
            lost = max(waiting - stays, 0)
            _add(self._unshipped, step, lost, "not shipped: beyond what is kept for shipping")
            if stays < step.rows:
                less = replace(step, rows=step.rows - stays)
                going.append(self._step(less.portion, less.rows) if less.portion else less)
        return [step for table in dict.fromkeys(s.table for s in steps)
                for step in reversed(going) if step.table == table]  # fmt: skip

    def _waiting(self, step: Going, pools: Sequence[Shipped]) -> int:
        """How many of a step's rows are not in all pools."""
        if step.portion is None:
            return step.rows if step.newest_s > complete_until_s(pools) else 0
        shipped = self._up_to(step.portion, last_shipped(pools, step.table))
        return max(step.rows - shipped, 0)


def _add(
    found: dict[tuple[str, str], list[float]], of: Portion | Going, rows: int, why: str
) -> None:
    """Note so many rows, by table and reason."""
    if rows > 0:
        sums = found.setdefault((of.table, why), [0, 0.0])
        sums[0] += rows
        sums[1] += rows * of.row_bytes


def _listed(found: dict[tuple[str, str], list[float]]) -> tuple[Spared, ...]:
    return tuple(
        Spared(table, int(rows), round(size_bytes), why)
        for (table, why), (rows, size_bytes) in found.items()
    )


def _size_of(portions: Sequence[Portion]) -> float:
    return sum(portion.size_bytes for portion in portions)


# What pools hold of a recording: a small file next to the database, written by `webots-mcp ship`.
#
# The progress itself is at the pool. This file only spares what is not there yet: where it is lost
# or cannot be written, rows are kept that need not be, within the limit of `--keep-until-shipped`.


_NAME: Final = "{}-shipped.json"
_FILE: Final = "SELECT file FROM pragma_database_list WHERE name = 'main'"
_UUID: Final = "SELECT uuid FROM recording"


@pydantic_dataclass(frozen=True)
class Shipped:
    """What one pool holds of a recording.

    Attributes:
        recording: Its UUID.
        last_ids: By table, up to which row it was shipped; what is not in it is not shipped.
        complete_wall_time_s: All that was recorded before was shipped; 0 before the first time.
        wall_time_s: When this was so.
    """

    recording: str
    last_ids: dict[str, int]
    complete_wall_time_s: float
    wall_time_s: float


_BY_ADDRESS: Final = TypeAdapter(dict[str, Shipped])


def last_shipped(pools: Sequence[Shipped], table: str) -> float:
    """Up to which row all pools hold a table; infinite where none wants it."""
    if not pools:
        return 0.0
    return min(each.last_ids.get(table, math.inf) for each in pools)


def complete_until_s(pools: Sequence[Shipped]) -> float:
    """All that was recorded before is in all pools."""
    return min((each.complete_wall_time_s for each in pools), default=0.0)


def shipped_of(connection: sqlite3.Connection) -> list[Shipped]:
    """What each pool holds of the recording; nothing where none was shipped to."""
    (name,) = connection.execute(_FILE).fetchone()
    row = connection.execute(_UUID).fetchone()
    return list(read_shipped(Path(name), row[0]).values()) if name and row else []


def read_shipped(database: Path, recording: str) -> dict[str, Shipped]:
    """The same by the pools' addresses; a damaged file says nothing."""
    return {
        address: shipped
        for address, shipped in _read(_file_of(database)).items()
        if shipped.recording == recording
    }


def write_shipped(database: Path, address: str, shipped: Shipped) -> None:
    """Say what a pool holds now.

    Raises:
        OSError: The folder cannot be written.
    """
    file = _file_of(database)
    stored = {**_read(file), address: shipped}
    with whole_file(file) as aside:
        aside.write_bytes(_BY_ADDRESS.dump_json(stored, indent=1))


def _file_of(database: Path) -> Path:
    return database.with_name(_NAME.format(database.name))


def _read(file: Path) -> dict[str, Shipped]:
    try:
        return _BY_ADDRESS.validate_json(file.read_bytes())
    except (OSError, ValueError):
        return {}
