"""What the bridge adds to a controller's memory, and whether that stays."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median
from typing import Any

from tests.benchmarks.measuring import alternate
from tests.benchmarks.processes import run_module
from tests.benchmarks.registry import Bench, NotMeasurableError, benchmark
from tests.benchmarks.states import make_states
from tests.benchmarks.table import Line, Target
from tests.benchmarks.ways import ORJSON

_HOUR_ROWS = 112_500  # 31.25 Hz
_ROWS_PER_S = 4500
_WARM_ROWS = 1000
_MB = 1e6

Figures = dict[str, Any]


@benchmark("memory", "memory over a bare process that imports sqlite3 and json")
def measure_memory(bench: Bench) -> Iterable[Line]:
    states = _write_states(bench.folder)
    contenders = {"bare": lambda: _run("bare", states)}
    for kind in ("bridge", "orjson") if ORJSON else ("bridge",):
        contenders[kind] = _recording(bench, kind, states)
    bench.say("small processes")
    taken = alternate(contenders, bench.count(3))
    if not taken["bare"][0].get("private"):
        raise NotMeasurableError("only Linux tells what is private to a process")
    yield _line("private memory (USS)", "private", taken, "bridge", Target(6))
    yield _line("resident memory (RSS)", "resident", taken, "bridge", Target(6))
    if "orjson" in taken:
        yield _line("private memory, with orjson", "private", taken, "orjson")
    yield from _hour(bench, states)


def _recording(bench: Bench, kind: str, states: Path) -> Callable[[], Figures]:
    """A new database each time, some rows."""
    numbers = iter(range(1_000_000))
    rows = min(_WARM_ROWS, bench.count(10 * _WARM_ROWS, least=50))
    return lambda: _run(kind, states, bench.place(f"{kind} {next(numbers)}"), rows, 2000)


def _line(
    what: str, name: str, taken: dict[str, list[Figures]], kind: str, target: Target | None = None
) -> Line:
    ours = median(figures[name] for figures in taken[kind])
    bare = median(figures[name] for figures in taken["bare"])
    over = (ours - bare) / _MB
    return Line(what, f"{ours / _MB:.1f} MB", f"bare {bare / _MB:.1f} MB", over, "MB", target)


def _hour(bench: Bench, states: Path) -> Iterable[Line]:
    rows = bench.count(_HOUR_ROWS, least=500)
    bench.say(f"{rows} rows")
    figures = _run("bridge", states, bench.place("hour"), rows, _ROWS_PER_S)
    what = f"{rows:,} rows ({rows / 31.25 / 60:.0f} min at 31.25 Hz)"
    pace = f"written at {_ROWS_PER_S:,}/s"
    total = f"{figures['private'] / _MB:.1f} MB"
    yield Line(f"growth over {what}", total, pace, figures["grown"] / _MB, "MB", Target(1))
    log = figures["log"] / _MB
    yield Line("longest write-ahead log", f"{log:.1f} MB", pace, log, "MB", Target(32))


def _write_states(folder: Path) -> Path:
    states = folder / "states.json"
    states.write_text(json.dumps(make_states()))
    return states


def _run(*arguments: object) -> Figures:
    return json.loads(run_module("memory", *arguments))
