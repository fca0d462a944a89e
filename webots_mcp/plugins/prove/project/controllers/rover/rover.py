"""The robot of `webots-mcp prove`: it drives to and fro, and records what it sees of Webots."""

import sys
import time
from typing import Any

from controller import Supervisor

from webots_mcp import MCPBridge

STEP_MS = 16
ROUNDS_ONE_WAY = 125

robot: Any = Supervisor()
bridge = MCPBridge(robot, throttle_interval=1)
speed = bridge.parameter("speed", 1.0, low=0.0, high=10.0, unit="rad/s")
wheel = robot.getDevice("left wheel sensor")
wheel.enable(STEP_MS)
robot.getDevice("camera").enable(STEP_MS)
motors = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
for motor in motors:
    motor.setPosition(float("inf"))
    motor.setVelocity(speed.value)
modes = {
    robot.SIMULATION_MODE_PAUSE: "pause",
    robot.SIMULATION_MODE_REAL_TIME: "real_time",
    robot.SIMULATION_MODE_FAST: "fast",
}


def say(command: dict[str, Any]) -> None:
    """Print a text on stdout and on stderr."""
    for stream in (sys.stdout, sys.stderr):
        print(command["text"], file=stream, flush=True)


def stall(command: dict[str, Any]) -> None:
    """Sleep, so that the loop hangs."""
    time.sleep(command["seconds"])


def leave(command: dict[str, Any]) -> None:
    """End Webots with an exit status."""
    robot.simulationQuit(command["status"])


for handler in (say, stall, leave):
    bridge.register_command(handler.__name__, handler)

rounds = 0
while robot.step(STEP_MS) != -1:
    rounds += 1
    if rounds % ROUNDS_ONE_WAY == 0:
        sign = -1 if rounds // ROUNDS_ONE_WAY % 2 else 1
        for motor in motors:
            motor.setVelocity(sign * speed.value)
    bridge.publish(
        {
            "rounds": rounds,
            "simulation_mode": modes.get(robot.simulationGetMode()),
            "x_m": robot.getSelf().getPosition()[0],
            "wheel_rad": wheel.getValue(),
            "speed": speed.value,
            "python": sys.executable,
        }
    )
    bridge.get_command()
