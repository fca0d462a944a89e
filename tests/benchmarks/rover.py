"""The robot that records in the benchmarks."""

from __future__ import annotations

import time
from typing import Any, Final

STEP_S: Final = 0.008


class Rover:
    """What a bridge asks of a Webots `Robot`, without a simulator.

    `step` only counts simulation time; `pace` also lets the wall time of a step pass, asleep, as a
    controller does that waits for Webots.
    """

    def __init__(self, name: str = "rover", step_s: float = STEP_S) -> None:
        self.devices: dict[str, Any] = {}
        self._name = name
        self._step_s = step_s
        self._time_s = 0.0
        self._due_s = time.perf_counter()

    def step(self, duration_ms: int) -> int:
        """Let simulation time pass."""
        self._time_s += duration_ms / 1000
        return 0

    def reset(self) -> None:
        """Simulation time begins again."""
        self._time_s = 0.0

    def pace(self) -> None:
        """Let one step pass in real time."""
        self._time_s += self._step_s
        now = time.perf_counter()
        self._due_s = max(self._due_s + self._step_s, now)  # a late step is not caught up with
        time.sleep(self._due_s - now)

    def getTime(self) -> float:
        return self._time_s

    def getName(self) -> str:
        return self._name

    def getBasicTimeStep(self) -> float:
        return self._step_s * 1000

    def getWorldPath(self) -> str:
        return ""

    def getSupervisor(self) -> bool:
        return False
