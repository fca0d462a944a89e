"""The robot of `webots-mcp prove`: it drives, and records what it sees of Webots."""

import sys
import time
from typing import Any

from controller import Supervisor

from webots_mcp import MCPBridge

STEP_MS = 16

robot: Any = Supervisor()
bridge = MCPBridge(robot, throttle_interval=1)
speed = bridge.parameter("speed", 1.0, unit="rad/s")
wheel = robot.getDevice("left wheel sensor")
wheel.enable(STEP_MS)
robot.getDevice("camera").enable(STEP_MS)
for side in ("left", "right"):
    motor = robot.getDevice(f"{side} wheel motor")
    motor.setPosition(float("inf"))
    motor.setVelocity(speed.value)


def say(command: dict[str, Any]) -> None:
    """Print a text on stdout and on stderr."""
    for stream in (sys.stdout, sys.stderr):
        print(command["text"], file=stream, flush=True)


bridge.register_command("say", say)
bridge.register_command("stall", lambda command: time.sleep(command["seconds"]))
bridge.register_command("leave", lambda command: robot.simulationQuit(command["status"]))
rounds = 0 if bridge.restored is None else bridge.restored.state["rounds"]
while robot.step(STEP_MS) != -1:
    rounds += 1
    x_m = robot.getSelf().getPosition()[0]
    state = {"rounds": rounds, "mode": robot.simulationGetMode(), "x_m": x_m, "speed": speed.value}
    bridge.publish({**state, "wheel_rad": wheel.getValue(), "python": sys.executable})
    bridge.get_command()
