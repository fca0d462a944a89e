"""What the real bridge records of a robot on the stand-in: two runs with everything in them.

Run 1, 20 s of simulation time, one row each 32 ms:

    0 to 6 s      cruise
    6 to 8 s      stuck: the motors stand, the mode says cruise, `stuck` is true
    8 to 9 s      back_up
    9 to 12 s     turn; from 10 to 11 s the front sensor gives NaN
    12 to 15 s    nothing is published
    15 to 20 s    cruise

with a picture each 4 s, log lines at each change of mode, commands that succeed and that fail.
Run 2, after a reset: the same for 12 s, but nothing is published from 4 to 5.5 s.
"""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path
from typing import Any

from tests.bridge.conftest import eager, send
from webots_mcp import MCPBridge
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor

STEP_MS = 16
MODES = ((15.0, "cruise"), (9.0, "turn"), (8.0, "back_up"), (0.0, "cruise"))
SPEEDS_RADPS = {"cruise": (5.0, 5.0), "back_up": (-5.0, -5.0), "turn": (-3.0, 3.0)}
COMMANDS: dict[float, tuple[str, dict[str, Any]]] = {
    1.0: ("set_speed", {"speed": 4}),
    3.0: ("grasp", {}),
    16.0: ("set_speed", {"speed": 5}),
}


class Rover:
    """The user's controller: senses, drives by the clock, publishes."""

    def __init__(self, database: Path) -> None:
        self.robot = InProcessSupervisor("rover")
        self.bridge = MCPBridge(self.robot, throttle_interval=2, database=database)
        self.database = database
        self.motors = [self.robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
        self.gps, self.imu = self.robot.getDevice("gps"), self.robot.getDevice("inertial unit")
        self.eyes = [self.robot.getDevice(f"ds_{side}") for side in ("left", "right")]
        self.camera = self.robot.getDevice("camera")
        for sensor in (self.gps, self.imu, *self.eyes, self.camera):
            sensor.enable(STEP_MS)
        self.mode = "cruise"
        self.bridge.register_command("set_speed", self.set_speed)
        self.bridge.register_command("grasp", self.grasp)

    def set_speed(self, command: dict[str, Any]) -> dict[str, float]:
        """Set the cruising speed."""
        return {"speed_radps": float(command["speed"])}

    def grasp(self, command: dict[str, Any]) -> None:
        """Close the gripper."""
        raise RuntimeError("the gripper is not mounted")

    def drive(self, until_s: float, commands: dict[float, Any], missing_s: tuple[float, float]):
        while self.robot.step(STEP_MS) != -1 and self.robot.getTime() < until_s:
            time_s = round(self.robot.getTime(), 3)
            self.act(time_s)
            if not missing_s[0] <= time_s < missing_s[1]:
                self.bridge.publish(self.state(time_s))
            self.answer(commands, time_s)
            if time_s % 4 < STEP_MS / 1000:
                self.bridge.save_camera_frame(self.camera)

    def act(self, time_s: float) -> None:
        mode = next(mode for start_s, mode in MODES if time_s >= start_s)
        if mode != self.mode:
            self.bridge.log(
                f"{self.mode} -> {mode}", level="warning" if self.mode == "cruise" else "info"
            )
        self.mode = mode
        speeds = (0.0, 0.0) if 6 <= time_s < 8 else SPEEDS_RADPS[mode]
        for motor, speed in zip(self.motors, speeds, strict=True):
            motor.setPosition(math.inf)  # a reset makes motors hold
            motor.setVelocity(speed)

    def state(self, time_s: float) -> dict[str, Any]:
        x, y, _ = self.gps.getValues()
        left, right = (eye.getValue() for eye in self.eyes)
        return {
            "pose": [x, y, self.imu.getRollPitchYaw()[2]],
            "mode": self.mode,
            "stuck": 6.5 <= time_s < 8,
            "distance_m": {"left": left, "right": right},
            "front_m": math.nan if 10 <= time_s < 11 else min(left, right),
            "battery_v": 12.6 - 0.01 * time_s,
            "lidar": [1.0 + 0.01 * i for i in range(24)],
        }

    def answer(self, commands: dict[float, Any], time_s: float) -> None:
        due = [at_s for at_s in commands if at_s <= time_s]
        for at_s in due:
            with closing(connect(self.database, "writer")) as connection:
                send(connection, *commands.pop(at_s))
        if due:
            eager(self.bridge)


def record(folder: Path) -> Path:
    """Make the recording; returns its database."""
    rover = Rover(folder / "webots.db")
    rover.drive(20.0, dict(COMMANDS), (12.0, 15.0))
    rover.robot.simulationReset()
    rover.drive(12.0, {}, (4.0, 5.5))
    rover.bridge.close()
    return rover.database
