"""A robot that records while its page is open in two tabs of a browser, beside none."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Final

from tests.benchmarks.measuring import Samples, alternate
from tests.benchmarks.processes import Program
from tests.benchmarks.programs.wide_robot import STEP_S
from tests.benchmarks.registry import Bench, NotMeasurableError, benchmark
from tests.benchmarks.table import Line, Target, duration

_BLOCK_S: Final = 20
_BLOCKS: Final = 3
_TABS: Final = 2
_NONE, _OPEN = "no page", f"the page in {_TABS} tabs"


@benchmark("page", "publish() of 88 signals, 1.5 kB, at 62.5 Hz, beside the live page")
def measure_page(bench: Bench) -> Iterable[Line]:
    browser = _require_browser()
    steps = bench.count(round(_BLOCK_S / STEP_S), least=20)
    with Program("wide_robot", bench.folder, 0) as robot:
        robot.hear()
        robot.ask("20")  # something to show
        tabs = _Tabs(bench, browser)
        contenders = {
            _NONE: _driving(robot, steps, nullcontext()),
            _OPEN: _driving(robot, steps, tabs),
        }
        bench.say("16 ms steps")
        taken = alternate(contenders, bench.count(_BLOCKS), warm_up=False)
    none, opened = (
        Samples([[s for block in taken[name] for s in block]]) for name in (_NONE, _OPEN)
    )
    for what, ours, theirs, target in (
        ("p50", opened.p50, none.p50, Target(1.2)),
        ("p99.9", opened.p999, none.p999, None),
        ("worst", opened.worst, none.worst, None),
    ):
        beside = f"{_NONE} {duration(theirs)}"
        yield Line(f"{what}, {_OPEN}", duration(ours), beside, ours / theirs, target=target)
    yield Line(f"worst, {_OPEN}", duration(opened.worst), "", 1e3 * opened.worst, "ms", Target(5))


def _require_browser() -> str:
    if importlib.util.find_spec("playwright") is None:
        raise NotMeasurableError("playwright is not installed")
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        raise NotMeasurableError("there is no Chromium")
    return browser


class _Tabs(AbstractContextManager[None]):
    """The page of the robot in so many tabs, as long as the `with` block lasts."""

    def __init__(self, bench: Bench, browser: str) -> None:
        self._arguments = (bench.folder, browser, _TABS)

    def __enter__(self) -> None:
        self._program = Program("tabs", *self._arguments)
        self._program.hear()

    def __exit__(self, *_: object) -> None:
        self._program.process.communicate()


def _driving(
    robot: Program, steps: int, beside: AbstractContextManager[None]
) -> Callable[[], list[Any]]:
    def run_block() -> list[Any]:
        with beside:
            return robot.ask(str(steps))["durations"]

    return run_block
