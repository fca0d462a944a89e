"""What a run costs to put into chunks, in a recording of few runs and of thousands."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterable
from contextlib import closing
from typing import Final

from tests.benchmarks.core import Bench, Line, benchmark, compared
from tests.recordings.rover import Recorder
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.store.chunk_making import make_chunks

_RUNS: Final = (10, 100, 1000, 4000)
_ROWS: Final = 300  # of a run: what a controller that learns by resets records of one try
_LIVE_RUNS: Final = 5
_BATCH_ROWS: Final = 2000  # as a question makes them
_INTERVAL_S: Final = 0.032
_MOST: Final = 2.0  # times what a run costs among the fewest
_INSERT: Final = "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) VALUES (?, ?, ?, ?)"


@benchmark("many_runs", "chunks of a run, in comparison with one in a recording of few runs")
def measure_many_runs(bench: Bench) -> Iterable[Line]:
    with closing(connect(bench.folder / "warm.db", "writer", create=True)) as connection:
        _making_all_s(connection, runs=2)  # the first chunk takes the time of imports
    first_s = first_live_s = 0.0
    for runs in dict.fromkeys(bench.count(each, least=2) for each in _RUNS):
        bench.say(f"{runs:,} runs")
        with closing(connect(bench.folder / f"{runs}.db", "writer", create=True)) as connection:
            all_s = _making_all_s(connection, runs) / runs
            live_s = _live_s(connection)
        first_s, first_live_s = first_s or all_s, first_live_s or live_s
        for what, ours_s, fewest_s in (
            ("a run, all at once", all_s, first_s),
            ("a run that ends beside them", live_s, first_live_s),
        ):
            line = f"{what}, {runs:,} runs"
            yield compared(line, ours_s, "in the first", fewest_s, ours_s / fewest_s, _MOST)


def _making_all_s(connection: sqlite3.Connection, runs: int) -> float:
    create_schema(connection)
    recorder = Recorder(connection)
    connection.execute("BEGIN IMMEDIATE")
    robot_id = recorder.robot("rover")
    session_id = recorder.session(robot_id, "a" * 64)
    for _ in range(runs):
        _record_run(recorder, session_id, robot_id)
    connection.execute("COMMIT")
    return _making_s(connection)


def _live_s(connection: sqlite3.Connection) -> float:
    """Of some runs after the others, each put into chunks once it has ended."""
    recorder, taken_s = Recorder(connection), 0.0
    for _ in range(_LIVE_RUNS):
        connection.execute("BEGIN IMMEDIATE")
        _record_run(recorder, session_id=1, robot_id=1)
        connection.execute("COMMIT")
        taken_s += _making_s(connection)
    return taken_s / _LIVE_RUNS


def _making_s(connection: sqlite3.Connection) -> float:
    """Processor time, which the disk and other programs do not change."""
    started_s = time.process_time()
    while not make_chunks(connection, _BATCH_ROWS).done:
        pass
    return time.process_time() - started_s


def _record_run(recorder: Recorder, session_id: int, robot_id: int) -> None:
    run_id = recorder.run(session_id, robot_id, "reset")
    rows = ((step, json.dumps({"x": step * 0.01, "reward": step % 7})) for step in range(_ROWS))
    recorder.connection.executemany(
        _INSERT,
        (
            (run_id, step * _INTERVAL_S, recorder.wall_s + step * _INTERVAL_S, text)
            for step, text in rows
        ),
    )
    recorder.wall_s += _ROWS * _INTERVAL_S
    recorder.end_run("reset")


BENCHMARKS = (measure_many_runs,)
