"""What a run's goal and parameters cost with each round of the loop, in the processor's time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from statistics import median
from typing import Any, Final

from tests.benchmarks.measuring import alternate
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.rover import Rover
from tests.benchmarks.states import make_states
from tests.benchmarks.table import Line, duration
from webots_mcp import MCPBridge
from webots_mcp.connection import connect
from webots_mcp.contract import DATABASE_NAME, MAX_RUN_S
from webots_mcp.queue import CommandQueue

_BLOCKS: Final = 15
_ROUNDS: Final = 5_000
_NEVER: Final = 1_000_000_000  # is a call recorded
_PARAMETERS: Final = 20
_GOALS: Final[dict[str, dict[str, Any]]] = {
    "a run for a time": {},
    "a run until a threshold": {"until": "battery_j < -1"},
    "a run until it moves less": {"until": "displacement(3) < -1"},
}


class SupervisedRover(Rover):
    """A rover that may set the simulation mode."""

    SIMULATION_MODE_PAUSE, SIMULATION_MODE_REAL_TIME, SIMULATION_MODE_FAST = 0, 1, 2

    def __init__(self) -> None:
        super().__init__()
        self._mode = self.SIMULATION_MODE_REAL_TIME

    def getSupervisor(self) -> bool:
        return True

    def simulationGetMode(self) -> int:
        return self._mode

    def simulationSetMode(self, mode: int) -> None:
        self._mode = mode


@benchmark("steering", "a run's goal and parameters, per round of the loop (processor time)")
def measure_steering(bench: Bench) -> Iterable[Line]:
    """Of step, publish() (not recorded), get_command(); beside a bridge that has neither."""
    rounds = bench.count(_ROUNDS, least=50)
    loops = {"neither": _Loop(bench.place("neither"))}
    for number, (name, goal) in enumerate(_GOALS.items()):
        loops[name] = _Loop(bench.place(f"goal {number}"))
        loops[name].run(goal)
    name = f"{_PARAMETERS} parameters"
    loops[name] = _Loop(bench.place("parameters"), parameters=_PARAMETERS)
    loops[f"{name}, read each round"] = _Loop(bench.place("read"), parameters=_PARAMETERS)
    loops[f"{name}, read each round"].reads = True
    taken = alternate(
        {name: loop.block(rounds) for name, loop in loops.items()}, bench.count(_BLOCKS, least=2)
    )
    bare_s = median(taken.pop("neither")) / rounds
    for name, blocks in taken.items():
        round_s = median(blocks) / rounds
        beside = f"without {duration(bare_s)}"
        yield Line(name, duration(round_s), beside, 1e6 * (round_s - bare_s), "us more")
    for loop in loops.values():
        loop.bridge.close()


class _Loop:
    """A controller's loop."""

    def __init__(self, folder: Path, parameters: int = 0) -> None:
        self._file = folder / DATABASE_NAME
        self._robot = SupervisedRover()
        self.bridge = MCPBridge(self._robot, data_dir=folder, throttle_interval=_NEVER)
        self._parameters = [
            self.bridge.parameter(f"gain_{number}", 1.0, low=0.0, high=10.0)
            for number in range(parameters)
        ]
        self.reads = False

    def run(self, goal: dict[str, Any]) -> None:
        """Have a `run` command under way that ends after the benchmark."""
        with closing(connect(self._file, "writer")) as connection:
            queue, params = CommandQueue(connection), {"for_s": MAX_RUN_S, **goal}
            command = queue.enqueue(1, "run", params, time_to_live_s=60, requested_by="benchmark")
            status = "SELECT status FROM command WHERE id = ?"
            while connection.execute(status, (command.id,)).fetchone()[0] != "claimed":
                self._robot.step(8)
                self.bridge.publish({})
                self.bridge.get_command()

    def block(self, rounds: int) -> Callable[[], float]:
        """Seconds of the processor for so many rounds."""
        states = make_states()

        def run_block() -> float:
            robot, bridge, reads = self._robot, self.bridge, self.reads
            started_s = time.process_time()
            for i in range(rounds):
                robot.step(8)
                bridge.publish(states[i % len(states)])
                bridge.get_command()
                if reads:
                    for parameter in self._parameters:
                        _ = parameter.value
            return time.process_time() - started_s

        return run_block
