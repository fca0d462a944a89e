"""Questions about the past of a long run, in comparison with one pass over its JSON rows in SQL.

Measured is the processor time of this process, so that other programs do not count.
"""

from __future__ import annotations

import importlib.util
import math
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from statistics import median
from typing import Final

from tests.benchmarks.core import Bench, Line, Target, benchmark, compared, processor_s
from tests.recordings.long import CYCLE_S, INTERVAL_S, build
from tests.recordings.rover import WALL_START_S
from webots_mcp.database.connection import connect
from webots_mcp.judging.checks.check_run import check_run
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events, timeline
from webots_mcp.judging.divergence import compare_rows
from webots_mcp.judging.trends import trends
from webots_mcp.plotting import plot
from webots_mcp.questions.monitor import look_back
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.logs import LogFilter, LogWindow, count_lines, newest_lines
from webots_mcp.store.reading.catalogue import list_signals
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.signal_history import query_history

_ROWS: Final = 1_000_000
_OVERVIEW: Final = "pose.0"
_TEN: Final = ("pose", "ds.0", "ds.1", "ds.2", "battery_v", "imu.roll", "imu.pitch", "accel.0")
_THIRTY: Final = (
    "pose", "wheels", "ds", "imu", "accel", "gyro", "encoders", "errors", "battery_v",
    "commanded_m_s",
)  # fmt: skip
_ONE_PASS: Final = (
    "SELECT CAST(sim_time_s / 600 AS INTEGER), min(json_extract(data, '$.pose[0]')), "
    "max(json_extract(data, '$.pose[0]')), avg(json_extract(data, '$.pose[0]')) "
    "FROM state WHERE run_id = 1 GROUP BY 1"
)
LINE_INTERVAL_S: Final = 1.0
_PART_ROWS: Final = 16 * round(CYCLE_S / INTERVAL_S)  # whole cycles: the story goes on at a seam
_ROLLED_ROWS: Final = 100_000
_REPEAT: Final = (
    "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) "
    "SELECT run_id, round(sim_time_s + :later_s, 3), wall_time_s + :later_s, data "
    "FROM state WHERE id <= :rows ORDER BY id"
)
_END_RUN: Final = (
    "UPDATE run SET row_count = :rows, last_sim_time_s = :sim_s, last_wall_time_s = :wall_s, "
    "ended_wall_time_s = :wall_s"
)
_LOG: Final = (
    "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message) "
    "VALUES (1, ?, ?, 'info', 'controller', ?)"
)


@benchmark("history", "questions about the past, in comparison with SQL over the JSON rows")
def measure_history(bench: Bench) -> Iterable[Line]:
    rows = bench.rows or bench.count(_ROWS, least=2000)
    bench.say(f"building {rows:,} rows")
    file = bench.folder / "webots.db"
    record(file, rows)
    with closing(connect(file, "reader")) as db:
        bench.say("one pass in SQL")
        naive_s = processor_s(lambda: db.execute(_ONE_PASS).fetchall())
        for what, ask, limit_s in _questions(db, file):
            bench.say(what)
            ours_s = median(processor_s(ask) for _ in range(bench.count(5)))
            line = f"{what}, {rows:,} rows"
            yield compared(line, ours_s, "min, max, avg of one signal", naive_s, ours_s / naive_s)
            yield Line(line, "", "", 1e3 * ours_s, "ms", Target(1e3 * limit_s))
        yield _stuck(db, rows)
    _repeat_run(file)
    with closing(connect(file, "reader")) as db:
        ask = partial(compare_rows, db, [1, 2], deadline_s=math.inf)
        assert ask().rows == rows
        ours_s = median(processor_s(ask) for _ in range(bench.count(5)))
        line = f"first difference of two runs, 39 signals, {rows:,} rows each"
        yield compared(line, ours_s, "min, max, avg of one signal", naive_s, ours_s / naive_s)
        yield Line(line, "", "", 1e3 * ours_s, "ms", Target(3000))


def _repeat_run(file: Path) -> None:
    """A second run with the chunks of the first: all of it has to be read to say that."""
    with closing(connect(file, "writer")) as connection:
        connection.execute("BEGIN IMMEDIATE")
        (groups,) = connection.execute("SELECT max(id) FROM row_group").fetchone()
        for table, changed in (
            ("run", {"id": "2", "uuid": "NULL"}),
            ("row_group", {"id": f"id + {groups}", "run_id": "2"}),
            ("chunk", {"id": "NULL", "group_id": f"group_id + {groups}", "run_id": "2"}),
        ):
            names = [str(each[1]) for each in connection.execute(f"PRAGMA table_info({table})")]
            values = ", ".join(changed.get(name) or name for name in names)
            connection.execute(f"INSERT INTO {table} SELECT {values} FROM {table}")
        connection.execute("COMMIT")


def _questions(
    db: sqlite3.Connection, file: Path
) -> Iterator[tuple[str, Callable[[], object], float]]:
    """What is asked, how, and the processor time aimed at for a million rows, in seconds.

    Events and checks are asked without a deadline: nothing may be left out to be fast.
    """
    whole, minute, ten = (find_range(db, Scope(last_s=last_s)) for last_s in (None, 60, 600))
    recording, lines = RecordingAccess(file, file.parent), LogWindow(-math.inf, math.inf)
    asked, never = LogFilter(1, lines, text="SLIP"), "battery_v < 1 and pose.0 > 1000"
    rare = EventOptions(kinds=("condition",), where=never)
    yield "last minute of 10 signals", lambda: query_history(db, minute, _TEN), 0.025
    yield "whole run, 1 signal", lambda: query_history(db, whole, [_OVERVIEW]), 0.05
    yield "list_signals", lambda: list_signals(db), 0.02
    yield "trends of 30 signals, whole run", lambda: trends(db, whole, _THIRTY), 0.3
    yield "trends of 30 signals, 10 minutes", lambda: trends(db, ten, _THIRTY), 0.4
    yield "find_events of all kinds", lambda: find_events(db, whole, deadline_s=math.inf), 0.8
    yield "check_run", lambda: check_run(db, 1, deadline_s=math.inf), 1.5
    yield "a condition that never held", lambda: find_events(db, whole, rare), 0.3
    yield "timeline", lambda: timeline(db, whole), 0.05
    yield "log search", lambda: (newest_lines(db, asked, 50), count_lines(db, asked)), 0.5
    yield "monitor, an hour back", lambda: look_back(recording, None, 3600), 0.4
    if importlib.util.find_spec("resvg_py"):
        yield "plot, 1 signal", lambda: plot(db, "signals", [_OVERVIEW]), 1.2
        yield "plot, way of the robot", lambda: plot(db, "trajectory"), 1.2


def _stuck(db: sqlite3.Connection, rows: int) -> Line:
    """Of a long run the statistics of chunks tell where to look: nothing may be missed."""
    expected = max(0, math.ceil((end_s(rows) - 46) / CYCLE_S))  # each ends 46 s into its cycle
    stuck = find_events(db, find_range(db, Scope()), EventOptions(kinds=("stuck",)))
    found = stuck.verdicts.found.get("stuck", 0)
    beside = f"in the recording {expected:,}"
    what = f"stuck places, {rows:,} rows"
    return Line(what, f"found {found:,}", beside, abs(expected - found), "off", Target(0))


def record(file: Path, rows: int) -> None:
    """One run of that many rows, in chunks, with a log line a second; every 97th tells of slip.

    Only the first 50,000 rows are made one by one. The others repeat their texts.
    """
    build(file, min(rows, _PART_ROWS), chunked=False)
    with closing(connect(file, "writer")) as connection:
        connection.execute("BEGIN IMMEDIATE")
        _lengthen(connection, rows)
        lines = range(int(end_s(rows) / LINE_INTERVAL_S))
        connection.executemany(_LOG, map(_log_line, lines))
        connection.execute("COMMIT")
        while not make_chunks(connection, _ROLLED_ROWS).done:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        while not make_chunks(connection, _ROLLED_ROWS).done:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()


def end_s(rows: int) -> float:
    """Simulation time of the row after the last."""
    return rows * INTERVAL_S


def _lengthen(connection: sqlite3.Connection, rows: int) -> None:
    for there in range(_PART_ROWS, rows, _PART_ROWS):
        values = {"later_s": end_s(there), "rows": min(_PART_ROWS, rows - there)}
        connection.execute(_REPEAT, values)
    last_s = end_s(rows - 1)
    ended = {"rows": rows, "sim_s": round(last_s, 3), "wall_s": WALL_START_S + last_s}
    connection.execute(_END_RUN, ended)


def _log_line(number: int) -> tuple[float, float, str]:
    time_s = number * LINE_INTERVAL_S
    what = "wheel slip" if number % 97 == 0 else "waypoint reached, turning to the next"
    return time_s, WALL_START_S + time_s, f"{what} ({number})"


BENCHMARKS = (measure_history,)
