"""Six robots for minutes, a server that keeps limits, and robots that are killed."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Final

from tests.benchmarks.measuring import Samples
from tests.benchmarks.processes import Program, environment
from tests.benchmarks.registry import Bench, NotMeasurableError, benchmark
from tests.benchmarks.table import Line, Target, duration
from webots_mcp.connection import connect
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.store.retention_plan import file_sizes

_ROBOTS: Final = 6
_SECONDS: Final = 240
_BLOCK_ROWS: Final = 60  # of 16 ms: about a second
_BLOCKS_PER_KILL: Final = 30
_LIMIT_MB: Final = 20
_SETTLE_S: Final = 5.0
_SAMPLE_S: Final = 0.5
_ROWS: Final = (
    "SELECT s.pid, sum(r.purged_rows + (SELECT count(*) FROM state WHERE run_id = r.id)) "
    "FROM run r JOIN session s ON s.id = r.session_id GROUP BY s.pid"
)
_STATE_BYTES: Final = "SELECT sum(pgsize) FROM dbstat WHERE name IN ('state', ?)"
_TIME_INDEX: Final = "ix_state_run_id_sim_time_s"


@benchmark(
    "soak",
    f"6 robots of 62.5 Hz with wide states, a server that keeps {_LIMIT_MB} MB of them, kills",
)
def measure_soak(bench: Bench) -> Iterable[Line]:
    file, seconds = bench.folder / DATABASE_NAME, bench.count(_SECONDS, least=2)
    kept = ["--keep-states", f"{_LIMIT_MB}MB"]
    line = [sys.executable, "-m", "webots_mcp", "serve", "--database", str(file), *kept]
    with (
        ExitStack() as robots,
        subprocess.Popen(
            line, env=environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as server,
    ):
        crowd = _Crowd(bench.folder, robots)
        sizes = _Sizes(file)
        sizes.start()
        for second in range(seconds):
            bench.say(f"{second} of {seconds} s")
            crowd.drive(kill=second % _BLOCKS_PER_KILL == _BLOCKS_PER_KILL - 1)
        robots.close()
        time.sleep(_SETTLE_S)
        sizes.stop()
        server.communicate()
    yield from _lines(file, crowd, sizes)


class _Crowd:
    """Robots that are driven at once; one that is killed has a successor."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder = folder
        self._stack = stack
        self.published: dict[int, int] = {}  # rows by pid, of calls that returned
        self.durations = list[list[float]]()
        self.kills = 0
        self._robots = [self._start(number) for number in range(_ROBOTS)]

    def drive(self, *, kill: bool) -> None:
        """A second of each; in the middle of it one robot may be killed."""
        for robot in self._robots:
            robot.send(f"{_BLOCK_ROWS}")
        if kill:
            number = self.kills % _ROBOTS
            time.sleep(0.1 + 0.8 * (self.kills * 0.618 % 1))
            self._robots[number].process.kill()
            self._robots[number].process.wait()
            self.kills += 1
        for number, robot in enumerate(self._robots):
            if robot.process.poll() is None:
                answer = robot.hear()
                self.published[robot.process.pid] += _BLOCK_ROWS
                self.durations.append(answer["durations"])
            else:
                self._robots[number] = self._start(number)

    def _start(self, number: int) -> Program:
        robot = self._stack.enter_context(Program("wide_robot", self._folder, f"{number}"))
        robot.hear()
        self.published[robot.process.pid] = 0
        return robot


class _Sizes(threading.Thread):
    """The size of the file, and what of it is free, twice a second."""

    def __init__(self, file: Path) -> None:
        super().__init__(name="sizes", daemon=True)
        self._file = file
        self._over = threading.Event()
        self.found: list[dict[str, int]] = []

    def run(self) -> None:
        with closing(connect(self._file, "reader")) as db:
            while not self._over.wait(_SAMPLE_S):
                self.found.append(file_sizes(db))

    def stop(self) -> None:
        """End it."""
        self._over.set()
        self.join()


def _lines(file: Path, crowd: _Crowd, sizes: _Sizes) -> Iterable[Line]:
    with closing(connect(file, "reader")) as db:
        rows = dict(db.execute(_ROWS).fetchall())
        purged = db.execute("SELECT sum(purged_rows) FROM run").fetchone()[0]
        states_mb = _states_bytes(db) / 1e6
        last = file_sizes(db)
    if not purged:
        yield Line("rows purged: the run is too short for any", "0", "", 0, "rows")
    lost = sum(max(count - rows.get(pid, 0), 0) for pid, count in crowd.published.items())
    total = sum(crowd.published.values())
    beside = f"{total:,} published, {crowd.kills} robots killed, {purged:,} rows purged"
    yield Line("rows that are neither there nor purged", f"{lost}", beside, lost, "rows", Target(0))
    beside = f"limit {_LIMIT_MB} MB, file {last['file_bytes'] / 1e6:.1f} MB"
    what = "states and their time index at the end"
    over = states_mb / _LIMIT_MB
    yield Line(what, f"{states_mb:.1f} MB", beside, over, target=Target(1.1))
    late = [each["file_bytes"] / 1e6 for each in sizes.found[len(sizes.found) // 2 :]]
    free = max(each["free_in_file_bytes"] for each in sizes.found) / 1e6
    log = max(each["log_beside_bytes"] for each in sizes.found) / 1e6
    beside = f"of it free {free:.1f} MB at most, log beside {log:.1f} MB at most"
    swing = max(late) / min(late)
    what = "file in the second half, largest to smallest"
    yield Line(what, f"{min(late):.1f} to {max(late):.1f} MB", beside, swing)
    taken = Samples(crowd.durations)
    beside = f"p50 {duration(taken.p50)}, p99.9 {duration(taken.p999)}"
    yield Line("worst publish()", duration(taken.worst), beside, taken.worst * 1e3, "ms")


def _states_bytes(db: sqlite3.Connection) -> int:
    try:
        return int(db.execute(_STATE_BYTES, (_TIME_INDEX,)).fetchone()[0])
    except sqlite3.OperationalError as error:
        raise NotMeasurableError("this SQLite cannot tell the size of a table") from error
