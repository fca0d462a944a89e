"""Robots whose parameters can be tried, and how a client tries them."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcp import Client

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import Start, data_dir, filed, has_states, start  # fixtures
from tests.server.conftest import STEP_MS, Driver, ask
from tests.server.story import rows_of
from webots_mcp.standin import Simulation

__all__ = ["data_dir", "filed", "start"]
# The robot drives as fast as it is told; a file that the test makes lets trials end.
ROVER = """
import math
from pathlib import Path

speed = bridge.parameter("speed", 1.0, low=0.0, high=10.0, unit="rad/s")
motors = [robot.getDevice(f"{{side}} wheel motor") for side in ("left", "right")]
gps = robot.getDevice("gps")
gps.enable(16)
while robot.step(16) != -1:
    for motor in motors:
        motor.setPosition(math.inf)
        motor.setVelocity(speed.value)
    x, y, _ = gps.getValues()
    bridge.publish({{"pose": {{"x": x, "y": y}}, "released": int(Path({release!r}).exists())}})
    bridge.get_command()
"""
HANGS_AT = 99.0
SPEEDS = {"speed": [1.0, 2.0, 3.0, 4.0, 5.0]}


class TunableDriver(Driver):
    """A robot whose `distance` grows with `kp`."""

    def __init__(self, file: Path) -> None:
        super().__init__(file)
        self.kp = self.bridge.parameter("kp", 2.0, low=0, high=100)
        self.gait = self.bridge.parameter("gait", "trot", choices=["trot", "walk"])
        self.goes_on = threading.Event()
        self.resets = 0

    def run(self) -> None:
        before_s = 0.0
        while self.robot.step(STEP_MS) != -1:
            self.resets += self.robot.getTime() < before_s
            before_s = self.robot.getTime()
            distance = self.kp.value * before_s
            self.bridge.publish({"distance": distance, "gait": self.gait.value})
            if self.kp.value == HANGS_AT and self.robot.getTime() > 0.1:
                self.goes_on.wait()
            self.bridge.get_command()

    def stop(self) -> None:
        self.goes_on.set()
        super().stop()


@pytest.fixture
def tunable(file: Path) -> Iterator[TunableDriver]:
    driving = TunableDriver(file)
    driving.start()
    yield driving
    driving.stop()


@pytest.fixture
def release(tmp_path: Path) -> Path:
    return tmp_path / "release"


@pytest.fixture
def simulation(start: Start, filed: Recording, release: Path) -> Simulation:
    arena = start(ROVER.format(release=str(release)), mode="realtime")
    arena.wait_for(lambda: has_states(filed), 30)
    return arena


async def trials(client: Client, **arguments: Any) -> dict[str, Any]:
    arguments = {"score": "last(distance)", "for_s": 0.16} | arguments
    return await ask(client, "webots_run_trials", **arguments)


async def value_of(client: Client, name: str) -> Any:
    rows = rows_of((await ask(client, "webots_get_parameters"))["parameters"])
    return next(row["value"] for row in rows if row["name"] == name)
