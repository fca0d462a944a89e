"""Fast mode on the stand-in, with a controller in a process of its own."""

from __future__ import annotations

import json
from collections.abc import Iterable

from tests.benchmarks.measuring import Samples, ratio
from tests.benchmarks.processes import PROGRAMS, environment
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.table import Line, Target
from webots_mcp.standin import Simulation
from webots_mcp.standin.in_process import DEFAULT_WORLD

_BLOCKS = 40
_STEPS = 200


@benchmark("fast", "fast mode on the stand-in: steps per second kept")
def measure_fast_mode(bench: Bench) -> Iterable[Line]:
    bench.say("running the arena")
    taken = _run(bench)
    none = taken["none"]
    beside = f"no bridge {none.p50:.0f}/s"
    for name, what, target in (
        ("bridge", "every 5th step recorded (default)", Target(0.85, least=True)),
        ("orjson", "the same, with orjson", None),
        ("files", "the same with JSON files", None),
        ("bridge every", "every step recorded", None),
        ("files every", "the same with JSON files", None),
    ):
        if name in taken:
            kept = ratio(taken[name], none)
            yield Line(what, f"{taken[name].p50:.0f}/s", beside, kept, target=target)


def _run(bench: Bench) -> dict[str, Samples]:
    order = {
        "folder": str(bench.folder),
        "blocks": bench.count(_BLOCKS, least=2),
        "steps": min(_STEPS, bench.count(10 * _STEPS, least=20)),
    }
    result = bench.folder / "result.json"
    with Simulation(
        DEFAULT_WORLD,
        mode="fast",
        controllers={"rover": PROGRAMS / "fast_controller.py"},
        environment={**environment(), "BENCH_ORDER": json.dumps(order)},
    ) as simulation:
        simulation.wait_for(result.exists, timeout_s=300)
    return {name: Samples.of(speeds) for name, speeds in json.loads(result.read_text()).items()}
