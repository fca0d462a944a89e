"""Six robots with wide states in one database, beside a server: what its work costs them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from typing import Any, Final

from tests.benchmarks.measuring import Samples, alternate
from tests.benchmarks.processes import Program
from tests.benchmarks.programs.wide_robot import STEP_S
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.servers import RunningServer
from tests.benchmarks.table import Line, Target, duration
from webots_mcp.contract import DATABASE_NAME

_ROBOTS: Final = 6
_BLOCK_S: Final = 10
_BLOCKS: Final = 3


@benchmark("beside", "publish() of 88 signals, 1.5 kB, by 6 robots at 62.5 Hz, beside a server")
def measure_beside(bench: Bench) -> Iterable[Line]:
    bench.say(f"starting {_ROBOTS} robots")
    database = bench.folder / DATABASE_NAME
    steps = bench.count(round(_BLOCK_S / STEP_S), least=20)
    with ExitStack() as stack:
        robots = [
            stack.enter_context(Program("wide_robot", bench.folder, n)) for n in range(_ROBOTS)
        ]
        for robot in robots:
            robot.hear()
        contenders = {
            "no server": _driving(robots, steps, nullcontext()),
            "an idle server": _driving(robots, steps, RunningServer(database, looking=False)),
            "a server that looks back each second": _driving(
                robots, steps, RunningServer(database, looking=True)
            ),
        }
        bench.say("16 ms steps")
        taken = alternate(contenders, bench.count(_BLOCKS), warm_up=False)
    for beside, blocks in taken.items():
        yield from _lines(beside, blocks)


def _driving(
    robots: list[Program], steps: int, beside: AbstractContextManager[None]
) -> Callable[[], list[Any]]:
    def run_block() -> list[Any]:
        with beside:
            for robot in robots:
                robot.send(str(steps))
            return [robot.hear() for robot in robots]

    return run_block


def _lines(beside: str, blocks: list[list[Any]]) -> Iterable[Line]:
    answers = [answer for block in blocks for answer in block]
    for what, key, target in (
        ("returned with rows not in the database yet", "waiting", 2),
        ("of them in memory only, which a kill loses", "in_memory", 0),
    ):
        waiting = [rows for answer in answers for rows in answer[key]]
        share = 100 * sum(rows > 0 for rows in waiting) / len(waiting)
        most = f"{max(waiting)} rows at most, {len(waiting):,} calls"
        yield Line(f"{what}, {beside}", f"{share:.3g} %", most, share, "%", Target(target))
    took = Samples([[s for answer in answers for s in answer["durations"]]])
    beside_worst = f"p50 {duration(took.p50)}, p99.9 {duration(took.p999)}"
    yield Line(
        f"worst, {beside}", duration(took.worst), beside_worst, 1e3 * took.worst, "ms", Target(5)
    )
