"""An e-puck that avoids obstacles by its eyes, and reckons its way by what its wheels turn.

It has no GPS and is no Supervisor, like the robot on the desk. The bridge is in five places: it is
made, two parameters are declared, and the loop asks whether the world was reset, publishes, and
asks for commands.
"""

from math import cos, inf, sin
from typing import Any

from controller import Robot

from webots_mcp import MCPBridge

WHEEL_RADIUS_M = 0.02
TRACK_M = 0.052
MAX_SPEED_RADPS = 6.28
RIGHT, LEFT = (0, 1, 2), (5, 6, 7)
"""The proximity sensors of the right and of the left, from ps0 ahead to ps7 ahead."""


class EPuck:
    """Senses, reckons where it is, and turns the wheels."""

    def __init__(self, robot: Robot, bridge: MCPBridge) -> None:
        self.robot = robot
        self.speed = bridge.parameter(
            "speed", 4.0, low=0.0, high=MAX_SPEED_RADPS, unit="rad/s", doc="cruising speed"
        )
        self.threshold = bridge.parameter(
            "threshold", 90.0, low=70.0, high=1000.0, doc="what a sensor reads where it turns away"
        )
        time_step = int(robot.getBasicTimeStep())
        self.motors = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
        self.encoders = [robot.getDevice(f"{side} wheel sensor") for side in ("left", "right")]
        self.eyes = [robot.getDevice(f"ps{number}") for number in range(8)]
        for sensor in (*self.encoders, *self.eyes):
            sensor.enable(time_step)
        self.start()

    def start(self) -> None:
        """Begins anew: at the start, and when the simulation was reset under our feet."""
        self.mode, self.turns = "cruise", 0
        self.x_m, self.y_m, self.heading_rad = 0.0, 0.0, 0.0
        self.wheels_rad: list[float] | None = None
        for motor in self.motors:
            motor.setPosition(inf)

    def sense(self) -> dict[str, Any]:
        """Reads the sensors; the result is what gets published."""
        self.proximity = [eye.getValue() for eye in self.eyes]
        self.reckon([encoder.getValue() for encoder in self.encoders])
        return {
            "odom": {"x_m": self.x_m, "y_m": self.y_m, "heading_rad": self.heading_rad},
            "mode": self.mode,
            "turns": self.turns,
            "proximity": {f"ps{number}": value for number, value in enumerate(self.proximity)},
            "wheel_target_radps": dict(zip(("left", "right"), self.wheel_speeds(), strict=True)),
        }

    def reckon(self, wheels_rad: list[float]) -> None:
        """Where it is since the start, from what the wheels have turned."""
        before, self.wheels_rad = self.wheels_rad or wheels_rad, wheels_rad
        left_m, right_m = (
            WHEEL_RADIUS_M * (now - then) for now, then in zip(wheels_rad, before, strict=True)
        )
        self.heading_rad += (right_m - left_m) / TRACK_M
        self.x_m += (left_m + right_m) / 2.0 * cos(self.heading_rad)
        self.y_m += (left_m + right_m) / 2.0 * sin(self.heading_rad)

    def decide(self) -> None:
        """Chooses the next mode: it turns until nothing is ahead of it."""
        right, left = (max(self.proximity[number] for number in side) for side in (RIGHT, LEFT))
        ahead = max(self.proximity[number] for number in (0, 1, 6, 7))
        if self.mode == "cruise" and ahead > self.threshold.value:
            self.mode = "turn_left" if right > left else "turn_right"
            self.turns += 1
        elif self.mode != "cruise" and ahead < self.threshold.value:
            self.mode = "cruise"

    def wheel_speeds(self) -> tuple[float, float]:
        """What the left and the right wheel should turn at, rad/s."""
        speed = self.speed.value
        turning = speed / 2.0
        return {
            "cruise": (speed, speed),
            "turn_left": (-turning, turning),
            "turn_right": (turning, -turning),
        }[self.mode]

    def act(self) -> None:
        for motor, speed in zip(self.motors, self.wheel_speeds(), strict=True):
            motor.setVelocity(speed)


def main() -> None:
    robot = Robot()
    bridge = MCPBridge(robot)
    e_puck = EPuck(robot, bridge)
    bridge.describe("proximity.*", quantity="light")  # infrared that comes back, no distance
    bridge.describe("odom.heading_rad", quantity="heading", unit="rad")
    bridge.describe("turns", quantity="count")

    while robot.step(int(robot.getBasicTimeStep())) != -1:
        if bridge.detect_reload():
            e_puck.start()
        bridge.publish(e_puck.sense())
        bridge.get_command()
        e_puck.decide()
        e_puck.act()


if __name__ == "__main__":
    main()
