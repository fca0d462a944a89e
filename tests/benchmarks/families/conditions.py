"""What conditions cost with each call of publish(), in the processor's time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from statistics import median

from tests.benchmarks.measuring import alternate
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.states import make_states
from tests.benchmarks.table import Line, Target, duration
from webots_mcp.conditions import parse_condition

_BLOCKS = 15
_CALLS = 2000
_TARGET_US = 2.0
_SEVERAL = "three in one"
_CONDITIONS = {
    "a threshold": "battery_j < 0.1",
    "for half a second": "distance.ds1 < 0.1 for 0.5",
    "arithmetic in a chain": "0 < abs(gyro[0] - 1) < step",
    "a changed text": "changed(mode)",
    "a rate": "rate(battery_j) < -1",
    "a signal that is missing": "absent.front < 1",
    "displacement": "displacement(3) < 0.05",
    _SEVERAL: "mode == 'drive' and (displacement(3) < 0.05 for 2)",
}


@benchmark("conditions", "a condition, evaluated with each published state (processor time)")
def measure_conditions(bench: Bench) -> Iterable[Line]:
    """Each kind by itself, and 32 at once as a robot may have."""
    calls = bench.count(_CALLS, least=100)
    contenders = {name: _evaluating([text], calls) for name, text in _CONDITIONS.items()}
    contenders["32 of these kinds"] = _evaluating(list(_CONDITIONS.values()) * 4, calls)
    taken = alternate(contenders, bench.count(_BLOCKS, least=2))
    for name, blocks in taken.items():
        count = 32 if name.startswith("32") else 1
        cost_s = median(blocks) / calls / count
        target = None if name == _SEVERAL else Target(_TARGET_US)
        yield Line(name, duration(cost_s), "each", 1e6 * cost_s, "us", target)


def _evaluating(texts: list[str], calls: int) -> Callable[[], float]:
    """Seconds of the processor for so many states."""
    states = make_states()

    def run_block() -> float:
        evaluators = [parse_condition(text).evaluator() for text in texts]
        started_s = time.process_time()
        for i in range(calls):
            state = states[i % len(states)]
            for evaluator in evaluators:
                evaluator.holds(state, i * 0.008)
        return time.process_time() - started_s

    return run_block
