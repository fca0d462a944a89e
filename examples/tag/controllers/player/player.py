"""One of the two who play tag: the hunter drives at the other, the runner away from it.

Which of them it is stands in the world, as the controller's argument. Where the other is comes
from the referee, in the field `customData` of this robot.
"""

import json
import sys
from math import atan2, cos, hypot, inf, pi, sin
from typing import Any

from controller import Robot

from webots_mcp import MCPBridge

SIDES = ("left", "right")
HALF_ARENA_M = 2.0
WALL_REACH_M = 0.9
"""From here on a wall pushes the runner away."""


class Player:
    """Knows where it and the other are, and turns its wheels."""

    def __init__(self, robot: Robot, bridge: MCPBridge, role: str) -> None:
        self.robot, self.role = robot, role
        self.speed = bridge.parameter(
            "speed", 7.0 if role == "hunter" else 6.0, low=0.0, high=12.0, unit="rad/s"
        )
        time_step = int(robot.getBasicTimeStep())
        self.motors = [robot.getDevice(f"{side} wheel motor") for side in SIDES]
        self.gps, self.imu = robot.getDevice("gps"), robot.getDevice("inertial unit")
        for sensor in (self.gps, self.imu):
            sensor.enable(time_step)
        self.start()

    def start(self) -> None:
        """Sets the motors to turn without end: at the start, and after a reset."""
        for motor in self.motors:
            motor.setPosition(inf)

    def sense(self) -> dict[str, Any]:
        """Reads the sensors and the referee's word; the result is what gets published."""
        self.x_m, self.y_m, _ = self.gps.getValues()
        self.heading_rad = self.imu.getRollPitchYaw()[2]
        self.other = json.loads(self.robot.getCustomData() or "null")
        return {
            "pose": {"x": self.x_m, "y": self.y_m, "yaw": self.heading_rad},
            "role": self.role,
            "mode": "wait" if self.other is None else "play",
            "heading_error_rad": self.heading_error_rad(),
        }

    def wanted_direction(self) -> tuple[float, float]:
        """The hunter's way is to the other; the runner's is away from it and from the walls."""
        ahead_x, ahead_y = self.other[0] - self.x_m, self.other[1] - self.y_m
        if self.role == "hunter":
            return ahead_x, ahead_y
        near = hypot(ahead_x, ahead_y) or 1.0
        return push_m(self.x_m) - ahead_x / near**2, push_m(self.y_m) - ahead_y / near**2

    def heading_error_rad(self) -> float:
        """How far to turn to the left, from -pi to pi; 0 as long as it waits."""
        if self.other is None:
            return 0.0
        x, y = self.wanted_direction()
        return (atan2(y, x) - self.heading_rad + pi) % (2.0 * pi) - pi

    def act(self) -> None:
        """Turns towards the way that it wants, and drives the faster the less it has to turn."""
        speed = self.speed.value if self.other else 0.0
        error = self.heading_error_rad()
        ahead, turn = speed * max(0.0, cos(error)), speed * sin(error / 2.0)
        for motor, wheel in zip(self.motors, (ahead - turn, ahead + turn), strict=True):
            motor.setVelocity(max(-12.0, min(12.0, wheel)))


def push_m(place_m: float) -> float:
    """How strongly the two walls of one axis push back."""
    gap_m = HALF_ARENA_M - abs(place_m)
    return 0.0 if gap_m > WALL_REACH_M else (-1.0 if place_m > 0 else 1.0) * WALL_REACH_M / gap_m


def main() -> None:
    robot = Robot()
    bridge = MCPBridge(robot)
    player = Player(robot, bridge, sys.argv[1])
    bridge.describe("heading_error_rad", quantity="angle", unit="rad")

    while robot.step(int(robot.getBasicTimeStep())) != -1:
        if bridge.detect_reload():
            player.start()
        bridge.publish(player.sense())
        bridge.get_command()
        player.act()


if __name__ == "__main__":
    main()
