"""What is beyond the limits: a plan lists it, and is carried out unchanged."""

from __future__ import annotations

import math
import sqlite3
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Final

from webots_mcp.contract import FINAL_STATUSES
from webots_mcp.store.retention.policy import DEFAULT, KEPT, Limit, Retention
from webots_mcp.store.retention.shipped import (
    Shipped,
    complete_until_s,
    last_shipped,
    shipped_of,
)
from webots_mcp.store.retention.usage import (
    TABLES,
    Holding,
    Oldest,
    count_rows,
    holdings,
    nth_id,
    nth_newest_id,
    oldest,
    read_runs,
    rows_before,
    rows_below,
)

# Those that were created during a kept run stay with it.
OLD_COMMANDS: Final = (
    f"FROM command c WHERE robot_id = :robot_id AND status IN {FINAL_STATUSES} "
    "AND created_wall_time_s < :before_s AND NOT EXISTS (SELECT 1 FROM run "
    f"WHERE robot_id = c.robot_id AND {KEPT} "
    "AND c.created_wall_time_s BETWEEN started_wall_time_s AND last_wall_time_s)"
)
ROLLED: Final = ("rollup", "coarse_rollup", "change")
_ROLLED_BYTES: Final = 150  # a row of those, about
_COMMAND_BYTES: Final = 400
_GUESSES: Final = 12


@dataclass(frozen=True)
class Step:
    """The oldest rows of one run in one table go.

    Attributes:
        table: Of those in `ROLLED` and of `run` all rows of the run go.
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

    @property
    def row_bytes(self) -> float:
        """About what one of them takes; at least a byte."""
        return max(self.size_bytes / max(self.rows, 1), 1.0)


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
        steps: What goes.
        held_bytes: About what each kind takes now, of all runs.
        spared: What would have to go as well, and why it does not.
        kept_run_ids: Runs that a person named, described or marked: nothing of them goes, and
            they do not count.
        kept_bytes: About what they take.
        unshipped: Of what goes, what no pool holds, because more waits than is kept until then.
    """

    steps: tuple[Step, ...]
    held_bytes: dict[str, int]
    spared: tuple[Spared, ...]
    kept_run_ids: tuple[int, ...]
    kept_bytes: int
    unshipped: tuple[Spared, ...] = ()

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

    Costs a pass over the time indexes, about 0.1 s per million state rows, and one over what goes.

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
        self._held = {table: holdings(connection, table, self._runs) for table in TABLES}
        self._spared: list[Spared] = []
        self._unshipped: list[Spared] = []
        self._forgotten = self._find_forgotten() if retention.outlive else set[int]()

    def plan(self) -> Plan:
        steps: list[Step] = []
        for table in TABLES:
            steps += self._beyond(self._of_free_runs(table), getattr(self._retention, table))
        steps += self._rolled_up(
            {step.owner_id: step.rows for step in steps if step.table == "state"}
        )
        steps += (Step("run", run.id, 1) for run in self._free if run.id in self._forgotten)
        for robot_id in {run.robot_id: None for run in self._runs}:
            steps += self._commands(robot_id)
        if limit_bytes := self._retention.unshipped.size_bytes:
            steps = [step for step in self._after_shipping(steps, limit_bytes) if step.rows]
        held_bytes = {table: round(_size_of(held)) for table, held in self._held.items()}
        free_bytes = sum(_size_of(self._of_free_runs(table)) for table in TABLES)
        return Plan(
            tuple(steps),
            held_bytes,
            tuple(self._spared),
            tuple(run.id for run in self._runs if run.is_kept),
            max(sum(held_bytes.values()) - round(free_bytes), 0),
            tuple(self._unshipped),
        )

    def _of_free_runs(self, table: str) -> list[Holding]:
        return [holding for holding in self._held[table] if not holding.run.is_kept]

    def _find_forgotten(self) -> set[int]:
        """Finished runs after which `outlive` times the limits of state was recorded.

        As of states, age alone does not do it where few were recorded since.
        """
        states, limit = self._of_free_runs("state"), self._retention.state
        row_bytes = _size_of(states) / max(sum(holding.rows for holding in states), 1)
        newest_first = sorted(self._free, key=lambda run: (-run.started_wall_time_s, -run.id))
        rows_after = accumulate((run.recorded_rows for run in newest_first), initial=0)
        return {
            run.id
            for run, after in zip(newest_first, rows_after, strict=False)
            if not run.is_current
            and limit.is_exceeded(
                size_bytes=after * row_bytes,
                rows=after,
                age_s=self._now_s - run.last_wall_time_s if after >= limit.spared_rows else 0,
                times=self._retention.outlive,
            )
        }

    def _beyond(self, held: Sequence[Holding], limit: Limit) -> Iterator[Step]:
        """Of each run as many rows as have to go; all of those that are forgotten."""
        staying = [holding for holding in held if holding.run.id not in self._forgotten]
        going = {
            holding.run.id: Oldest(holding.rows, math.inf)
            for holding in held
            if holding.run.id in self._forgotten
        }
        going |= self._oldest_beyond(staying, limit)
        for run_id, aged in self._aged(staying, limit).items():
            if run_id not in going or going[run_id].rows < aged.rows:
                going[run_id] = aged
        for holding in held:
            if (gone := going.get(holding.run.id)) and gone.rows:
                size = round(gone.rows * holding.row_bytes)
                yield Step(holding.table, holding.run.id, gone.rows, size, gone.bound)

    def _oldest_beyond(self, held: Sequence[Holding], limit: Limit) -> dict[int, Oldest]:
        """The oldest rows of all runs, as many as are beyond a size or a number of rows."""
        rows, size_bytes = sum(holding.rows for holding in held), _size_of(held)
        least_rows = 0 if limit.rows is None else max(rows - limit.rows, 0)
        excess_bytes = 0.0 if limit.size_bytes is None else size_bytes - limit.size_bytes
        going = oldest(self._connection, held, least_rows) if least_rows else {}
        freed_bytes = _size_of_oldest(held, going)
        if freed_bytes >= excess_bytes:
            return going
        return self._oldest_of_size(held, (least_rows, freed_bytes), (rows, size_bytes))

    def _oldest_of_size(
        self, held: Sequence[Holding], low: tuple[int, float], high: tuple[int, float]
    ) -> dict[int, Oldest]:
        """As many as free what the limit asks for, between two (rows, bytes), within a row."""
        excess_bytes = high[1] - (self._limit_of(held).size_bytes or 0)
        largest_bytes = max(holding.row_bytes for holding in held)
        going = {holding.run.id: Oldest(holding.rows, math.inf) for holding in held}
        for guess in range(_GUESSES):
            if high[1] - excess_bytes < largest_bytes or high[0] - low[0] <= 1:
                break
            share = (excess_bytes - low[1]) / (high[1] - low[1]) if guess % 2 == 0 else 0.5
            rows = min(low[0] + max(math.ceil((high[0] - low[0]) * share), 1), high[0] - 1)
            found = oldest(self._connection, held, rows)
            freed_bytes = _size_of_oldest(held, found)
            if freed_bytes >= excess_bytes:
                going, high = found, (rows, freed_bytes)
            else:
                low = (rows, freed_bytes)
        return going

    def _limit_of(self, held: Sequence[Holding]) -> Limit:
        return getattr(self._retention, held[0].table)

    def _aged(self, held: Sequence[Holding], limit: Limit) -> dict[int, Oldest]:
        """Rows that are too old, but for the newest of all runs."""
        if limit.age_s is None:
            return {}
        before_s = self._now_s - limit.age_s
        older = {
            holding: rows_before(self._connection, holding, before_s)
            for holding in held
            if holding.run.started_wall_time_s < before_s
        }
        older = {holding: rows for holding, rows in older.items() if rows}
        if not older:
            return {}
        spared_from = nth_newest_id(self._connection, held, limit.spared_rows)
        going = {
            holding: min(rows, rows_below(self._connection, holding, spared_from))
            for holding, rows in older.items()
        }
        self._spare_newest(limit, {each: rows - going[each] for each, rows in older.items()})
        return {
            holding.run.id: Oldest(rows, nth_id(self._connection, holding, rows))
            for holding, rows in going.items()
            if rows
        }

    def _spare_newest(self, limit: Limit, spared: dict[Holding, int]) -> None:
        if rows := sum(spared.values()):
            (table,) = {holding.table for holding in spared}
            size_bytes = sum(holding.row_bytes * count for holding, count in spared.items())
            why = f"too old, but among the newest {limit.spared_rows}"
            self._spared.append(Spared(table, rows, round(size_bytes), why))

    def _rolled_up(self, going_states: dict[int, int]) -> Iterator[Step]:
        """Rollups and change points go by whole runs, after the state rows that they stand for."""
        limit = self._retention.rollup
        asked = [run for run in self._free if limit.limits or run.id in self._forgotten]
        counts = {run.id: {table: self._count(table, run.id) for table in ROLLED} for run in asked}
        rows = sum(sum(count.values()) for count in counts.values())
        spared_rows = 0
        for run in asked:
            age_s = self._now_s - run.last_wall_time_s
            exceeded = limit.is_exceeded(size_bytes=rows * _ROLLED_BYTES, rows=rows, age_s=age_s)
            if not exceeded and run.id not in self._forgotten:
                continue
            rows_of_run = sum(counts[run.id].values())
            stays = self._count("state", run.id) > going_states.get(run.id, 0)
            if run.id not in self._forgotten and (stays or run.is_current):
                spared_rows += rows_of_run
                continue
            rows -= rows_of_run
            for table, count in counts[run.id].items():
                if count:
                    yield Step(table, run.id, count, count * _ROLLED_BYTES)
        if spared_rows:
            why = "of runs that go on or have states left"
            self._spared.append(Spared("rollup", spared_rows, spared_rows * _ROLLED_BYTES, why))

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

    def _after_shipping(self, steps: Sequence[Step], limit_bytes: float) -> Iterator[Step]:
        """Without what waits to be shipped: the newest of it stays, up to that size."""
        pools, left_bytes = shipped_of(self._connection), limit_bytes
        times = {run.id: run.last_wall_time_s for run in self._runs}
        waiting = {step: self._waiting(step, pools, times) for step in steps}
        kept = dict.fromkeys(steps, 0)
        newest_first = sorted(steps, key=lambda each: times.get(each.owner_id, 0), reverse=True)
        for step in newest_first:
            if step.table != "run":
                kept[step] = min(waiting[step], int(left_bytes / step.row_bytes))
                left_bytes -= kept[step] * step.row_bytes
        owners = {step.owner_id for step in steps if kept[step] and step.table != "command"}
        for step in steps:
            if step.table in ROLLED and step.owner_id in owners:
                kept[step] = step.rows  # they stand for states that may stay
            elif step.table == "run" and (step.owner_id in owners or left_bytes > 0):
                kept[step] = 1 if step.owner_id in owners else waiting[step]
        self._spared += _spared({step: kept[step] for step in steps}, "not shipped yet")
        lost = {step: max(waiting[step] - kept[step], 0) for step in steps}
        self._unshipped += _spared(lost, "not shipped: beyond what is kept for shipping")
        return (
            replace(
                step,
                rows=step.rows - kept[step],
                size_bytes=round(step.row_bytes * (step.rows - kept[step])),
            )
            for step in steps
        )

    def _waiting(self, step: Step, pools: Sequence[Shipped], times: Mapping[int, float]) -> int:
        """How many of a step's rows are not in all pools."""
        if step.table not in TABLES:
            newest_s = step.bound if step.table == "command" else times[step.owner_id]
            return step.rows if newest_s > complete_until_s(pools) else 0
        last = last_shipped(pools, step.table)
        if math.isinf(last):
            return 0
        (holding,) = (each for each in self._held[step.table] if each.run.id == step.owner_id)
        return max(step.rows - rows_below(self._connection, holding, int(last) + 1), 0)

    def _count(self, table: str, run_id: int) -> int:
        return count_rows(self._connection, table, run_id)


def _spared(rows: Mapping[Step, int], why: str) -> Iterator[Spared]:
    """The rows of steps as reported, by table."""
    for table in dict.fromkeys(step.table for step in rows):
        of_table = {step: count for step, count in rows.items() if step.table == table and count}
        if of_table:
            size_bytes = sum(step.row_bytes * count for step, count in of_table.items())
            yield Spared(table, sum(of_table.values()), round(size_bytes), why)


def _size_of(held: Sequence[Holding]) -> float:
    return sum(holding.size_bytes for holding in held)


def _size_of_oldest(held: Sequence[Holding], going: dict[int, Oldest]) -> float:
    return sum(going[each.run.id].rows * each.row_bytes for each in held if each.run.id in going)
