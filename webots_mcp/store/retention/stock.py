"""What each run holds, and about how much room it takes."""

from __future__ import annotations

import sqlite3
from typing import Final, NamedTuple

from webots_mcp.store.retention.policy import KEPT

_RUNS: Final = (
    f"SELECT id, robot_id, rows, started_wall_time_s, last_wall_time_s, {KEPT}, "
    "ended_wall_time_s IS NULL OR id = (SELECT max(id) FROM run n WHERE n.robot_id = run.robot_id)"
    " AS is_current FROM run ORDER BY is_current, started_wall_time_s, id"
)
_ROWS_BY_RUN: Final = "SELECT run_id, count(*) FROM {table} GROUP BY run_id"
_ROWS: Final = "SELECT count(*) FROM {table} WHERE run_id = ?"
# Rows of a run in the order of its simulation time are in the order of their ids.
_NTH_ID: Final = (
    "SELECT id FROM {table} WHERE run_id = ? ORDER BY sim_time_s, id LIMIT 1 OFFSET ? - 1"
)
_FIRST_TIME: Final = "SELECT min(sim_time_s) FROM {table} WHERE run_id = ?"
_LAST_TIME: Final = "SELECT max(sim_time_s) FROM {table} WHERE run_id = ?"
_SIZE_AT: Final = (
    "SELECT {size} FROM {table} WHERE run_id = ? AND sim_time_s >= ? ORDER BY sim_time_s LIMIT 1"
)
_WALL_AT: Final = (
    "SELECT wall_time_s FROM {table} WHERE run_id = ? AND sim_time_s <= ? "
    "ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)
_ROWS_UP_TO: Final = "SELECT count(*) FROM {table} WHERE run_id = ? AND sim_time_s <= ?"

# SQL for about what a row takes on the disk, page slack and index entries included (measured on
# rows of 100 and 700 bytes of JSON); a picture takes its file.
_ROW_BYTES: Final = {
    "state": "length(CAST(data AS BLOB)) * 1.15 + coalesce(length(odd), 0) + 50",
    "log": "length(CAST(message AS BLOB)) + 90",
    "event": "coalesce(length(CAST(data AS BLOB)), 0) + 90",
    "image": "bytes",
}
TABLES: Final = tuple(_ROW_BYTES)
_SAMPLES: Final = 16
_BISECTIONS: Final = 50


class Run(NamedTuple):
    """A run as retention sees it."""

    id: int
    robot_id: int
    recorded_rows: int
    started_wall_time_s: float
    last_wall_time_s: float
    is_kept: bool
    is_current: bool


class Holding(NamedTuple):
    """What a run has in one table, and about what a row of it takes."""

    run: Run
    table: str
    rows: int
    row_bytes: float

    @property
    def size_bytes(self) -> float:
        """About what all of it takes."""
        return self.rows * self.row_bytes


def read_runs(connection: sqlite3.Connection) -> list[Run]:
    """All runs in the order in which they lose rows: finished ones, then current ones."""
    return [Run(*row) for row in connection.execute(_RUNS).fetchall()]


def holdings(connection: sqlite3.Connection, table: str, runs: list[Run]) -> list[Holding]:
    """What these runs have in a table; those that have nothing are left out."""
    rows: dict[int, int] = dict(connection.execute(_ROWS_BY_RUN.format(table=table)).fetchall())
    return [
        Holding(run, table, rows[run.id], _row_bytes(connection, table, run.id))
        for run in runs
        if run.id in rows
    ]


def count_rows(connection: sqlite3.Connection, table: str, run_id: int) -> int:
    """How many rows a run has in a table."""
    return int(connection.execute(_ROWS.format(table=table), (run_id,)).fetchone()[0])


def nth_id(connection: sqlite3.Connection, holding: Holding, number: int) -> int:
    """The id of the row of that number, from 1, counted from the oldest."""
    query = _NTH_ID.format(table=holding.table)
    return int(connection.execute(query, (holding.run.id, number)).fetchone()[0])


def rows_before(connection: sqlite3.Connection, holding: Holding, wall_time_s: float) -> int:
    """How many of the rows are older than that: wall time rises with simulation time."""
    table, run_id = holding.table, holding.run.id

    def is_older(time_s: float) -> bool:
        query = _WALL_AT.format(table=table)
        return float(connection.execute(query, (run_id, time_s)).fetchone()[0]) < wall_time_s

    older_s, younger_s = _bounds(connection, table, run_id)
    if is_older(younger_s):
        return holding.rows
    if not is_older(older_s):
        return 0
    for _ in range(_BISECTIONS):
        middle_s = (older_s + younger_s) / 2
        older_s, younger_s = (middle_s, younger_s) if is_older(middle_s) else (older_s, middle_s)
    query = _ROWS_UP_TO.format(table=table)
    return int(connection.execute(query, (run_id, older_s)).fetchone()[0])


def _row_bytes(connection: sqlite3.Connection, table: str, run_id: int) -> float:
    """The mean of a few rows, spread over the run's time."""
    first_s, last_s = _bounds(connection, table, run_id)
    query = _SIZE_AT.format(size=_ROW_BYTES[table], table=table)
    total = 0.0
    for i in range(_SAMPLES):
        time_s = min(first_s + (last_s - first_s) * i / (_SAMPLES - 1), last_s)
        total += connection.execute(query, (run_id, time_s)).fetchone()[0]
    return total / _SAMPLES


def _bounds(connection: sqlite3.Connection, table: str, run_id: int) -> tuple[float, float]:
    """Simulation times of the run's first and last row in a table."""
    first = connection.execute(_FIRST_TIME.format(table=table), (run_id,)).fetchone()[0]
    last = connection.execute(_LAST_TIME.format(table=table), (run_id,)).fetchone()[0]
    return first, last
