"""A controller on the stand-in in fast mode: the same loop without and with a way to record.

The stand-in runs it. The environment variable `BENCH_ORDER` says how, as JSON: `folder`, `way`,
`orjson` (or the standard library), `sensors` (enabled or not), `blocks`, `steps`. It leaves
`result.json` in the folder: the steps per second of each block of `none` and of the way.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

from controller import Supervisor

from tests.benchmarks.measuring import alternate
from tests.benchmarks.states import State, make_states
from tests.benchmarks.ways import ORJSON, JsonFiles, use_encoder
from webots_mcp import MCPBridge

_STEP_MS = 16
_THROTTLE = 5  # the bridge's default

Loop = Callable[[State], object]


def main(folder: str, way: str, sensors: bool, blocks: int, steps: int) -> None:
    """Drive with nothing and with that way in turn, and leave the result."""
    robot, place = Supervisor(), Path(folder)
    if sensors:
        _enable_sensors(robot)
    with MCPBridge(robot, folder, throttle_interval=_THROTTLE) as bridge:
        loop = _loops(bridge, place)[way]
        none = _driving(robot, lambda state: None, steps)
        result = alternate({"none": none, way: _driving(robot, loop, steps)}, blocks)
    (place / "result.part").write_text(json.dumps(result))
    (place / "result.part").rename(place / "result.json")


def _enable_sensors(robot: Supervisor) -> None:
    """Have the simulator work as for a controller that looks around in every step."""
    for name in ("ds_left", "ds_right", "gps", "inertial unit", "lidar"):
        robot.getDevice(name).enable(_STEP_MS)


def _loops(bridge: MCPBridge, folder: Path) -> dict[str, Loop]:
    some, every = JsonFiles(folder, every=_THROTTLE), JsonFiles(folder)
    return {
        "bridge": lambda state: (bridge.publish(state), bridge.get_command()),
        "bridge every": lambda state: (bridge.publish(state, force=True), bridge.get_command()),
        "files": lambda state: (some.publish(state), some.get_command()),
        "files every": lambda state: (every.publish(state), every.get_command()),
    }


def _driving(robot: Supervisor, loop: Loop, steps: int) -> Callable[[], float]:
    states = make_states()

    def run_block() -> float:
        started = time.perf_counter()
        for i in range(steps):
            robot.step(_STEP_MS)
            loop(states[i % len(states)])
        return steps / (time.perf_counter() - started)

    return run_block


if __name__ == "__main__":
    order = json.loads(os.environ["BENCH_ORDER"])
    use_encoder(ORJSON if order.pop("orjson") else None)
    main(**order)
