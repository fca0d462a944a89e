"""What is beyond the limits: a plan lists it, and is carried out unchanged."""

from __future__ import annotations

import math
import sqlite3
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from webots_mcp.contract import FINAL_STATUSES
from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.retention.policy import DEFAULT, KEPT, Limit, Retention
from webots_mcp.store.retention.shipped import Shipped, complete_until_s, last_shipped, shipped_of
from webots_mcp.store.retention.usage import TABLES, Holdings, Portion, read_runs, rows_of

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
    return _Planner(connection, retention, now_s, holdings or Holdings()).plan()


class _Planner:
    """The recording at one moment, against the limits."""

    def __init__(
        self, connection: sqlite3.Connection, retention: Retention, now_s: float, held: Holdings
    ) -> None:
        self._connection = connection
        self._retention = retention
        self._now_s = now_s
        self._runs = read_runs(connection)
        self._held = held.portions(connection, self._runs)
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
        sizes = {table: _size_of(portions) for table, portions in self._held.items()}
        kept = [self._kept(table, is_kept=True) for table in TABLES]
        return Plan(
            tuple(steps),
            {table: round(size_bytes) for table, size_bytes in sizes.items()},
            _listed(self._spared),
            tuple(run.id for run in self._runs.values() if run.is_kept),
            round(sum(map(_size_of, kept))),
            _listed(self._unshipped),
        )

    def _kept(self, table: str, *, is_kept: bool) -> list[Portion]:
        """Portions of the runs that are retention's to judge, or of those that are not."""
        return [each for each in self._held[table] if self._runs[each.run_id].is_kept == is_kept]

    def _find_forgotten(self) -> set[int]:
        """Finished runs after which `outlive` times the limits of state was recorded.

        As of states, age alone does not do it where few were recorded since.
        """
        states = self._kept("state", is_kept=False)
        row_bytes = _size_of(states) / max(sum(portion.rows for portion in states), 1)
        limit, after, forgotten = self._retention.state, 0, set[int]()
        free = [run for run in self._runs.values() if not run.is_kept]
        for run in sorted(free, key=lambda run: (-run.started_wall_time_s, -run.id)):
            age_s = self._now_s - run.last_wall_time_s if after >= limit.spared_rows else 0
            if not run.is_current and limit.is_exceeded(
                size_bytes=after * row_bytes, rows=after, age_s=age_s, times=self._retention.outlive
            ):
                forgotten.add(run.id)
            after += run.recorded_rows
        return forgotten

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
        first, last, rows, size = np.transpose(np.reshape(np.array(facts, np.float64), (-1, 4)))
        low, high = 0, held[0].last_id if held else 0
        while low < high:
            middle = (low + high) // 2
            whole = first > middle
            rows_left, bytes_left = float(rows[whole].sum()), float(size[whole].sum())
            cut: list[int] = np.flatnonzero(~whole & (last > middle)).tolist()
            for place in cut:
                stays = held[place].rows - self._up_to(held[place], middle)
                rows_left += stays
                bytes_left += stays * held[place].row_bytes
            if limit.is_exceeded(size_bytes=bytes_left, rows=rows_left):
                low = middle + 1
            else:
                high = middle
        return low

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
