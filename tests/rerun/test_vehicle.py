"""A controller of a vehicle, whose `Driver` makes its own steps and commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.rerun.taping import recorded, rerun_of

pytestmark = pytest.mark.slow

# As Webots' package `vehicle`, in Python: its real library needs a car in the world.
DRIVER = """\
from math import inf
from controller import Supervisor
class Driver(Supervisor):
    INDICATOR_OFF = 0
    SPEED = 0
    api = None
    @staticmethod
    def loadApi():
        Driver.api = True
    def __init__(self):
        super().__init__()
        if not Driver.api:
            Driver.loadApi()
        self._speed = 0.0
        self._motors = [self.getDevice(f"{s} wheel motor") for s in ("left", "right")]
        for each in self._motors:
            each.setPosition(inf)
    def step(self):
        for each in self._motors:
            each.setVelocity(self._speed)
        return super().step(int(self.getBasicTimeStep()))
    def setCruisingSpeed(self, speed):
        self._speed = speed
    def getTargetCruisingSpeed(self):
        return self._speed
    def getCurrentSpeed(self):
        return self._motors[0].getVelocity() * 0.9
    @property
    def targetCruisingSpeed(self):
        return self._speed
    @targetCruisingSpeed.setter
    def targetCruisingSpeed(self, speed):
        self._speed = speed
"""
CAR = """\
from vehicle.driver import Driver


class Car(Driver):
    TRACTION = 0

    def getType(self):
        return 1
"""
CODE = """\
import sys

sys.path.append({folder!r})

from webots_mcp import MCPBridge
from vehicle import {kind}

driver = {kind}()
bridge = MCPBridge.attach(driver)
eye = driver.getDevice("ds_left")
eye.enable(16)
rounds = 0
while driver.step() != -1:
    rounds += 1
    driver.setCruisingSpeed(3.0 + min(eye.getValue(), 5.0) + driver.getCurrentSpeed() % 1)
    if rounds == 20:
        driver.targetCruisingSpeed = 2.0
"""


@pytest.mark.parametrize("kind", ["Driver", "Car"])
def test_a_vehicle_repeats_and_an_edit_is_found_at_its_round(tmp_path: Path, kind: str) -> None:
    package = tmp_path / "lib" / "vehicle"
    package.mkdir(parents=True)
    text = "from vehicle.driver import Driver\nfrom vehicle.car import Car\n"
    (package / "__init__.py").write_text(text, "utf-8")
    (package / "driver.py").write_text(DRIVER, "utf-8")
    (package / "car.py").write_text(CAR, "utf-8")
    code = CODE.format(folder=str(package.parent), kind=kind)
    controller = recorded(tmp_path / "project", code, 2.0)
    answer = rerun_of(tmp_path / "project", controller)
    assert answer.outcome == "equal", answer.text
    assert answer.rounds == 126
    controller.write_text(code.replace("rounds == 20", "rounds == 30"), "utf-8")
    answer = rerun_of(tmp_path / "project", controller)
    assert (answer.outcome, answer.rounds) == ("differs", 20)
    assert "robot.targetCruisingSpeed nothing instead of 2.0" in answer.text
