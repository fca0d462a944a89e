"""Fast mode on the stand-in, with a controller in a process of its own."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from tests.benchmarks.measuring import Samples, ratio
from tests.benchmarks.processes import PROGRAMS, environment
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.table import Line, Target
from tests.benchmarks.ways import ORJSON
from webots_mcp.standin import Simulation
from webots_mcp.standin.in_process import DEFAULT_WORLD

_BLOCKS = 40
_STEPS = 200


@benchmark("fast", "fast mode on the stand-in: steps per second kept")
def measure_fast_mode(bench: Bench) -> Iterable[Line]:
    target = Target(0.85, least=True)
    yield _kept(bench, "every 5th step recorded (default)", _Loop("bridge"), target)
    with_sensors = _Loop("bridge", sensors=True)
    yield _kept(bench, "the same, 5 sensors enabled", with_sensors, target)
    if ORJSON is not None:
        yield _kept(bench, "the same, no sensors, orjson", _Loop("bridge", orjson=True))
    yield _kept(bench, "the same, no sensors, JSON files", _Loop("files"))
    yield _kept(bench, "every step recorded", _Loop("bridge every"))
    yield _kept(bench, "every step, JSON files", _Loop("files every"))


class _Loop(NamedTuple):
    """What the controller's loop does; see `programs.fast_controller`."""

    way: str
    orjson: bool = False
    sensors: bool = False


def _kept(bench: Bench, what: str, loop: _Loop, target: Target | None = None) -> Line:
    """Each way takes turns with nothing alone: what it leaves to the disk slows no other down."""
    bench.say(what)
    folder = bench.place(f"{loop}")
    order: dict[str, object] = {
        **loop._asdict(),
        "folder": str(folder),
        "blocks": bench.count(_BLOCKS, least=2),
        "steps": min(_STEPS, bench.count(5 * _STEPS, least=20)),
    }
    taken = _drive(order, folder / "result.json")
    ours, none = taken[loop.way], taken["none"]
    beside = f"no bridge {none.p50:.0f}/s"
    return Line(what, f"{ours.p50:.0f}/s", beside, ratio(ours, none), target=target)


def _drive(order: dict[str, object], result: Path) -> dict[str, Samples]:
    with Simulation(
        DEFAULT_WORLD,
        mode="fast",
        controllers={"rover": PROGRAMS / "fast_controller.py"},
        environment={**environment(), "BENCH_ORDER": json.dumps(order)},
    ) as simulation:
        simulation.wait_for(result.exists, timeout_s=300)
    return {name: Samples.of(speeds) for name, speeds in json.loads(result.read_text()).items()}
