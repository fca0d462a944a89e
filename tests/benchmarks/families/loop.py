"""Inside a loop of 8 ms steps that sleeps between them, as a controller waits for Webots."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from statistics import fmean, median

from tests.benchmarks.measuring import Samples, alternate, ratio
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.rover import Rover
from tests.benchmarks.states import make_states
from tests.benchmarks.table import Line, Target, duration
from tests.benchmarks.ways import ORJSON, BridgeWay, JsonFiles, RawSqlite, Way

_STEPS = 125
_BLOCKS = 16

Step = tuple[float, float]
"""How long publish() and get_command() took, in seconds."""


@benchmark("loop", "publish() and get_command() in every step of a real 8 ms loop")
def measure_loop(bench: Bench) -> Iterable[Line]:
    taken = _measure_ways(bench)
    ours, files, raw = taken["bridge"], taken["files"], taken["raw"]
    yield _mean_line("publish, mean", ours.publish, "JSON file", files.publish, Target(0.30))
    if "orjson" in taken:
        fast = taken["orjson"].publish
        yield _mean_line("publish, mean, orjson", fast, "JSON file", files.publish, Target(0.15))
    yield _mean_line("publish, mean", ours.publish, "raw sqlite3", raw.publish)
    yield _p999_line("publish, p99.9", ours.publish, files.publish, Target(0.3))
    yield Line(
        "get_command, p50",
        duration(ours.poll.p50),
        f"exists, open, json.load {duration(files.poll.p50)}",
        ratio(ours.poll, files.poll, median),
        target=Target(0.3),
    )
    yield _mean_line("whole step, mean", ours.step, "JSON files", files.step, Target(0.35))
    if "orjson" in taken:
        yield _mean_line("whole step, mean, orjson", taken["orjson"].step, "JSON files", files.step)
    yield _p999_line("whole step, p99.9", ours.step, files.step)


class _Taken:
    """The durations of one way's calls."""

    def __init__(self, blocks: list[list[Step]]) -> None:
        self.publish = Samples([[publish for publish, _ in block] for block in blocks])
        self.poll = Samples([[poll for _, poll in block] for block in blocks])
        self.step = Samples([[sum(step) for step in block] for block in blocks])


def _measure_ways(bench: Bench) -> dict[str, _Taken]:
    bench.say("8 ms steps")
    robots = {"bridge": Rover(), "files": Rover(), "raw": Rover()}
    ways: dict[str, Way] = {
        "bridge": BridgeWay(robots["bridge"], bench.place("bridge")),
        "files": JsonFiles(bench.place("files")),
        "raw": RawSqlite(bench.place("raw")),
    }
    if ORJSON is not None:
        robots["orjson"] = Rover()
        ways["orjson"] = BridgeWay(robots["orjson"], bench.place("orjson"), orjson=True)
    steps = min(_STEPS, bench.count(5 * _STEPS, least=5))
    contenders = {name: _driving(way, robots[name], steps) for name, way in ways.items()}
    taken = alternate(contenders, bench.count(_BLOCKS, least=1))
    for way in ways.values():
        way.close()
    return {name: _Taken(blocks) for name, blocks in taken.items()}


def _driving(way: Way, robot: Rover, steps: int) -> Callable[[], list[Step]]:
    states = make_states()

    def step(i: int) -> Step:
        robot.pace()
        started = time.perf_counter()
        way.publish(states[i % len(states)])
        published = time.perf_counter()
        way.get_command()
        return published - started, time.perf_counter() - published

    def run_block() -> list[Step]:
        way.begin()
        return [step(i) for i in range(steps)]

    return run_block


def _mean_line(
    what: str, ours: Samples, name: str, theirs: Samples, target: Target | None = None
) -> Line:
    beside = f"{name} {duration(theirs.mean)}"
    return Line(what, duration(ours.mean), beside, ratio(ours, theirs, fmean), target=target)


def _p999_line(what: str, ours: Samples, theirs: Samples, target: Target | None = None) -> Line:
    beside = f"JSON file {duration(theirs.p999)}"
    return Line(what, duration(ours.p999), beside, ours.p999 / theirs.p999, target=target)
