"""How long the maintenance of a server holds the write lock, on which every robot waits."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from tests.benchmarks.measuring import Samples
from tests.benchmarks.programs.wide_robot import STEP_S
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.states import State, make_states, make_wide_states
from tests.benchmarks.table import Line, Target, duration
from tests.recordings.rover import Recorder
from webots_mcp.connection import connect, create_schema
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.store.chunk_making import make_chunks

_ROBOTS: Final = 6
_SECONDS: Final = 30
_ROWS_PER_S: Final = round(1 / STEP_S)
_INSERT: Final = "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) VALUES (?, ?, ?, ?)"
_WRITES: Final = ("INSERT", "UPDATE", "DELETE")


class _Timed:
    """A connection that measures for how long its transactions hold the write lock.

    Both by the clock, which on a busy machine counts other programs' turns too, and in processor
    time of the thread: nothing waits for the disk in them.
    """

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self._began = (0.0, 0.0)
        self.held = list[tuple[float, float]]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    def execute(self, sql: str, parameters: Any = ()) -> sqlite3.Cursor:
        """Run a statement that may be, begin or end a transaction."""
        return self._measured(sql, lambda: self._connection.execute(sql, parameters))

    def executemany(self, sql: str, parameters: Any) -> sqlite3.Cursor:
        """Run a statement for each of the parameters."""
        return self._measured(sql, lambda: self._connection.executemany(sql, parameters))

    def _measured(self, sql: str, run: Callable[[], sqlite3.Cursor]) -> sqlite3.Cursor:
        inside, started = self._connection.in_transaction, _now()
        try:
            return run()
        finally:
            now = _now()
            if self._connection.in_transaction:
                locks = "IMMEDIATE" in sql
                self._began = self._began if inside else now if locks else (0.0, 0.0)
            elif inside and self._began[0]:
                self._end(self._began, now)
            elif not inside and sql.startswith(_WRITES):
                self._end(started, now)

    def _end(self, began: tuple[float, float], now: tuple[float, float]) -> None:
        self.held.append((now[0] - began[0], now[1] - began[1]))


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.thread_time()


@benchmark(
    "maintenance",
    "chunks of 6 robots at 62.5 Hz, once a second: how long each step holds the write lock",
)
def measure_maintenance(bench: Bench) -> Iterable[Line]:
    for signals, states in ((39, make_states()), (88, make_wide_states())):
        bench.say(f"{signals} signals")
        file = bench.place(f"{signals} signals") / DATABASE_NAME
        held, took_s = _make_chunks(file, states, bench.count(_SECONDS, 2))
        yield from _lines(f"{signals} signals", held, took_s)


def _make_chunks(
    file: Path, states: list[State], seconds: int
) -> tuple[list[tuple[float, float]], float]:
    """How long each transaction held the lock, and the processor time per state row."""
    texts = [json.dumps(state, separators=(",", ":")) for state in states]
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        runs = [_begin_run(connection, number) for number in range(_ROBOTS)]
        timed, took_s = _Timed(connection), 0.0
        for second in range(seconds):
            _record(connection, runs, texts, second)
            started_s = time.thread_time()
            while not make_chunks(timed).done:  # pyright: ignore[reportArgumentType]
                pass
            took_s += time.thread_time() - started_s
        return timed.held, took_s / (seconds * _ROWS_PER_S * _ROBOTS)


def _begin_run(connection: sqlite3.Connection, number: int) -> int:
    recorder = Recorder(connection)
    robot_id = recorder.robot(f"rover {number}")
    return recorder.run(recorder.session(robot_id, "a" * 64), robot_id)


def _record(connection: sqlite3.Connection, runs: list[int], texts: list[str], second: int) -> None:
    connection.execute("BEGIN IMMEDIATE")
    for row in range(second * _ROWS_PER_S, (second + 1) * _ROWS_PER_S):
        time_s = row * STEP_S
        values = [(run_id, time_s, time_s, texts[row % len(texts)]) for run_id in runs]
        connection.executemany(_INSERT, values)
    connection.execute("COMMIT")
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()


def _lines(what: str, held: list[tuple[float, float]], row_s: float) -> Iterable[Line]:
    clock, busy = (Samples([list(column)]) for column in zip(*held, strict=True))
    beside = f"p50 {duration(busy.p50)}, {len(held):,} steps"
    worst_ms = 1e3 * busy.worst
    yield Line(
        f"longest, in processor time, {what}",
        duration(busy.worst),
        beside,
        worst_ms,
        "ms",
        Target(1.0),
    )
    beside = f"p50 {duration(clock.p50)}, p99 {duration(clock.p99)}"
    yield Line(
        f"longest, by the clock, {what}",
        duration(clock.worst),
        beside,
        1e3 * clock.worst,
        "ms",
    )
    target = Target(35.0 if what.startswith("39") else 80.0)
    yield Line(
        f"processor time of a state row, {what}", duration(row_s), "", 1e6 * row_s, "us", target
    )
