"""Eight robots in processes of their own, one database, and a reader beside them."""

from __future__ import annotations

import json
import sqlite3
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from pathlib import Path
from statistics import fmean
from typing import Any

from tests.benchmarks.measuring import Samples, alternate
from tests.benchmarks.processes import Program
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.servers import RunningServer
from tests.benchmarks.table import Line, Target, duration
from webots_mcp.connection import connect
from webots_mcp.contract import DATABASE_NAME

_ROBOTS = 8
_STEPS = 300
_BLOCKS = 5
_READ_INTERVAL_S = 0.1
_RANGE = "SELECT sim_time_s, data FROM state WHERE id > (SELECT max(id) FROM state) - 2000"


class _Reader(ABC):
    """Reads ten times a second as long as its `with` block lasts."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __enter__(self) -> None:
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(_READ_INTERVAL_S):
            self.read(self._folder)

    @abstractmethod
    def read(self, folder: Path) -> None:
        """What one look reads."""


class _RowReader(_Reader):
    def read(self, folder: Path) -> None:
        connection: sqlite3.Connection = connect(folder / DATABASE_NAME, "reader")
        connection.execute(_RANGE).fetchall()
        connection.close()


class _FileReader(_Reader):
    def read(self, folder: Path) -> None:
        for file in folder.glob("files */status.json"):
            with suppress(ValueError):  # half written: this way has no better answer
                json.loads(file.read_text())


@benchmark(
    "crowd", "publish() by 8 robots at once in 8 ms loops, and a reader of 2,000 rows at 10 Hz"
)
def measure_crowd(bench: Bench) -> Iterable[Line]:
    bench.say("starting 8 robots")
    steps = bench.count(_STEPS, least=20)
    with ExitStack() as stack:
        robots = [
            stack.enter_context(Program("crowd_robot", bench.folder, n)) for n in range(_ROBOTS)
        ]
        for robot in robots:
            robot.hear()
        contenders = {
            "bridge": _driving(robots, f"bridge {steps}", _RowReader(bench.folder)),
            "served": _driving(
                robots,
                f"bridge {steps}",
                RunningServer(bench.folder / DATABASE_NAME, looking=True),
            ),
            "files": _driving(robots, f"files {steps}", _FileReader(bench.folder)),
            "noise": _driving(robots, f"noise {steps}", None),
        }
        bench.say("8 ms steps")
        taken = alternate(contenders, bench.count(_BLOCKS, least=2))
    yield from _lines(taken)


def _lines(taken: dict[str, list[list[Any]]]) -> Iterable[Line]:
    ours, served, files, noise = (
        Samples([[d for answer in block for d in answer["durations"]] for block in taken[name]])
        for name in ("bridge", "served", "files", "noise")
    )
    put_off = fmean(answer["put_off"] for block in taken["bridge"] for answer in block)
    beside = f"JSON files {duration(files.p999)}"
    yield Line("p99.9", duration(ours.p999), beside, ours.p999 / files.p999)
    beside = f"json.dumps alone {duration(noise.worst)}, JSON files {duration(files.worst)}"
    for what, taken_by in (("worst", ours), ("worst, and a server that looks back", served)):
        yield Line(what, duration(taken_by.worst), beside, taken_by.worst * 1e3, "ms", Target(5))
    beside = "another writer held the lock, and nothing waited for it"
    yield Line("put off to the next call", f"{put_off:.1%}", beside, 100 * put_off, "%")


def _driving(
    robots: list[Program], order: str, beside: AbstractContextManager[None] | None
) -> Callable[[], list[Any]]:
    def run_block() -> list[Any]:
        with beside or nullcontext():
            for robot in robots:
                robot.send(order)
            return [robot.hear() for robot in robots]

    return run_block
