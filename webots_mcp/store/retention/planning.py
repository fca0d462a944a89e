"""What is beyond the limits: a plan tells it, and is carried out as it is."""

from __future__ import annotations

import math
import sqlite3
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate
from typing import Final

from webots_mcp.contract import FINAL_STATUSES
from webots_mcp.store.retention.policy import DEFAULT, KEPT, Limit, Retention
from webots_mcp.store.retention.stock import (
    TABLES,
    Holding,
    count_rows,
    holdings,
    nth_id,
    read_runs,
    rows_before,
)

# Those that were created during a kept run stay with it.
OLD_COMMANDS: Final = (
    f"FROM command c WHERE robot_id = :robot_id AND status IN {FINAL_STATUSES} "
    "AND created_wall_time_s < :before_s AND NOT EXISTS (SELECT 1 FROM run "
    f"WHERE robot_id = c.robot_id AND {KEPT} "
    "AND c.created_wall_time_s BETWEEN started_wall_time_s AND last_wall_time_s)"
)
ROLLED: Final = ("rollup", "change")
_ROLLED_BYTES: Final = 150  # a row of those two, about
_COMMAND_BYTES: Final = 400


@dataclass(frozen=True)
class Step:
    """The oldest rows of one run in one table go.

    Attributes:
        table: Of `rollup`, `change` and `run` all rows of the run go.
        owner_id: The run; of commands the robot.
        rows: So many.
        size_bytes: About so much on the disk; of pictures their files.
        bound: The last id that goes; of commands the wall time before which they were created.
            By it two that carry out the same plan at once delete no more than one would.
    """

    table: str
    owner_id: int
    rows: int
    size_bytes: int = 0
    bound: float = math.inf


@dataclass(frozen=True)
class Plan:
    """What would go now.

    Attributes:
        steps: In the order in which they are carried out.
        kept_run_ids: Runs that a person named, described or marked: nothing of them goes.
    """

    steps: tuple[Step, ...]
    kept_run_ids: tuple[int, ...]

    @property
    def rows(self) -> int:
        """All rows that go."""
        return sum(step.rows for step in self.steps)

    @property
    def size_bytes(self) -> int:
        """About so much is freed."""
        return sum(step.size_bytes for step in self.steps)

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
        """The runs that lose rows of a table; commands have none."""
        if table == "command":
            return []
        return [step.owner_id for step in self.steps if step.table == table]


def plan(
    connection: sqlite3.Connection, retention: Retention = DEFAULT, now_s: float | None = None
) -> Plan:
    """Find what is beyond the limits; nothing is changed.

    Costs a pass over the time indexes: about 0.1 s per million state rows.

    Args:
        connection: Any.
        retention: The limits.
        now_s: Unix time, from which ages are counted; None for now.
    """
    return _Planner(connection, retention, time.time() if now_s is None else now_s).plan()


class _Planner:
    """The recording at one moment, against the limits."""

    def __init__(self, connection: sqlite3.Connection, retention: Retention, now_s: float) -> None:
        self._connection = connection
        self._retention = retention
        self._now_s = now_s
        self._runs = read_runs(connection)
        self._free = [run for run in self._runs if not run.is_kept]
        self._held = {table: holdings(connection, table, self._free) for table in TABLES}
        self._forgotten = self._find_forgotten() if retention.outlive else set[int]()

    def plan(self) -> Plan:
        steps: list[Step] = []
        for table in TABLES:
            steps += self._excess(self._held[table], getattr(self._retention, table))
        steps += self._rolled_up(
            {step.owner_id: step.rows for step in steps if step.table == "state"}
        )
        steps += (Step("run", run.id, 1) for run in self._free if run.id in self._forgotten)
        for robot_id in {run.robot_id: None for run in self._runs}:
            steps += self._commands(robot_id)
        return Plan(tuple(steps), tuple(run.id for run in self._runs if run.is_kept))

    def _find_forgotten(self) -> set[int]:
        """Finished runs after which `outlive` times the limits of state was recorded."""
        states, limit = self._held["state"], self._retention.state
        rows = sum(holding.rows for holding in states)
        row_bytes = sum(holding.size_bytes for holding in states) / max(rows, 1)
        newest_first = sorted(self._free, key=lambda run: (-run.started_wall_time_s, -run.id))
        rows_after = accumulate((run.recorded_rows for run in newest_first), initial=0)
        return {
            run.id
            for run, after in zip(newest_first, rows_after, strict=False)
            if not run.is_current
            and limit.is_exceeded(
                size_bytes=after * row_bytes,
                rows=after,
                age_s=self._now_s - run.last_wall_time_s,
                times=self._retention.outlive,
            )
        }

    def _excess(self, held: list[Holding], limit: Limit) -> Iterator[Step]:
        """Of each run as many rows as have to go; all of those that are forgotten."""
        rows = sum(holding.rows for holding in held)
        size_bytes = sum(holding.size_bytes for holding in held)
        for holding in held:
            going = self._going(holding, limit, rows, size_bytes)
            if going > 0:
                rows -= going
                size_bytes -= going * holding.row_bytes
                bound = nth_id(self._connection, holding, going)
                size = round(going * holding.row_bytes)
                yield Step(holding.table, holding.run.id, going, size, bound)

    def _going(self, holding: Holding, limit: Limit, rows: int, size_bytes: float) -> int:
        """How many rows of a run have to go, where so much of the kind is left."""
        run = holding.run
        if run.id in self._forgotten:
            return holding.rows
        going = [0]
        if limit.rows is not None:
            going.append(rows - limit.rows)
        if limit.size_bytes is not None and holding.row_bytes:
            going.append(math.ceil((size_bytes - limit.size_bytes) / holding.row_bytes))
        if limit.age_s is not None and run.started_wall_time_s < self._now_s - limit.age_s:
            going.append(rows_before(self._connection, holding, self._now_s - limit.age_s))
        return min(max(going), holding.rows - (limit.spared_rows if run.is_current else 0))

    def _rolled_up(self, going_states: dict[int, int]) -> Iterator[Step]:
        """Rollups and change points go by whole runs, after the state rows that they stand for."""
        limit = self._retention.rollup
        finished = [run for run in self._free if not run.is_current]
        asked = finished if limit.limits else [r for r in finished if r.id in self._forgotten]
        counts = {run.id: {table: self._count(table, run.id) for table in ROLLED} for run in asked}
        rows = sum(sum(count.values()) for count in counts.values())
        for run in asked:
            age_s = self._now_s - run.last_wall_time_s
            exceeded = limit.is_exceeded(size_bytes=rows * _ROLLED_BYTES, rows=rows, age_s=age_s)
            stays = self._count("state", run.id) > going_states.get(run.id, 0)
            if run.id not in self._forgotten and (stays or not exceeded):
                continue
            rows -= sum(counts[run.id].values())
            for table, count in counts[run.id].items():
                if count:
                    yield Step(table, run.id, count, count * _ROLLED_BYTES)

    def _commands(self, robot_id: int) -> Iterator[Step]:
        """Finished commands from before all runs of the robot that stay, or older than events."""
        runs = [run for run in self._runs if run.robot_id == robot_id]
        staying = [run.started_wall_time_s for run in runs if run.id not in self._forgotten]
        before_s = min(staying) if len(staying) < len(runs) else -math.inf
        if self._retention.event.age_s is not None:
            before_s = max(before_s, self._now_s - self._retention.event.age_s)
        values = {"robot_id": robot_id, "before_s": before_s}
        query = f"SELECT count(*) {OLD_COMMANDS}"
        if rows := int(self._connection.execute(query, values).fetchone()[0]):
            yield Step("command", robot_id, rows, rows * _COMMAND_BYTES, before_s)

    def _count(self, table: str, run_id: int) -> int:
        return count_rows(self._connection, table, run_id)
