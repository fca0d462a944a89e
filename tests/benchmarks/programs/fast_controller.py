"""A controller on the stand-in in fast mode: the same loop with one way to record after the other.

The stand-in runs it. The environment variable `BENCH_ORDER` says how much, as JSON: `folder`,
`blocks`, `steps`. It leaves `result.json` in the folder: per way the steps per second of each
block.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from controller import Supervisor

from tests.benchmarks.measuring import alternate
from tests.benchmarks.states import State, make_states
from tests.benchmarks.ways import ORJSON, JsonFiles, use_encoder
from webots_mcp import MCPBridge

_STEP_MS = 16
_THROTTLE = 5  # the bridge's default

Loop = Callable[[State], object]


def main(folder: str, blocks: int, steps: int) -> None:
    """Drive, and leave the result."""
    robot = Supervisor()
    with MCPBridge(robot, folder, throttle_interval=_THROTTLE) as bridge:
        loops = _loops(bridge, Path(folder))
        contenders = {name: _driving(robot, loop, steps) for name, loop in loops.items()}
        if ORJSON is not None:
            contenders["orjson"] = _driving(robot, loops["bridge"], steps, ORJSON)
        result = alternate(contenders, blocks)
    (Path(folder) / "result.part").write_text(json.dumps(result))
    (Path(folder) / "result.part").rename(Path(folder) / "result.json")


def _loops(bridge: MCPBridge, folder: Path) -> dict[str, Loop]:
    some, every = JsonFiles(folder, every=_THROTTLE), JsonFiles(folder)
    return {
        "none": lambda state: None,
        "bridge": lambda state: (bridge.publish(state), bridge.get_command()),
        "bridge every": lambda state: (bridge.publish(state, force=True), bridge.get_command()),
        "files": lambda state: (some.publish(state), some.get_command()),
        "files every": lambda state: (every.publish(state), every.get_command()),
    }


def _driving(robot: Supervisor, loop: Loop, steps: int, orjson: Any = None) -> Callable[[], float]:
    states = make_states()

    def run_block() -> float:
        use_encoder(orjson)
        started = time.perf_counter()
        for i in range(steps):
            robot.step(_STEP_MS)
            loop(states[i % len(states)])
        return steps / (time.perf_counter() - started)

    return run_block


if __name__ == "__main__":
    main(**json.loads(os.environ["BENCH_ORDER"]))
