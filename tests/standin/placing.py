"""Puts a robot somewhere, lets it drive and look, as a supervisor does."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Any

from webots_mcp.standin import InProcessSupervisor

STEP_MS = 16
"""The basic time step of the arena."""
_WHEELS = ("left wheel motor", "right wheel motor")


def place(robot: InProcessSupervisor, x: float, y: float, yaw: float = 0.0) -> None:
    """Moves the robot; what it senses follows with its next step."""
    node = robot.getSelf()
    translation, rotation = node.getField("translation"), node.getField("rotation")
    assert translation is not None and rotation is not None
    translation.setSFVec3f([x, y, 0.04])
    rotation.setSFRotation([0.0, 0.0, 1.0, yaw])
    assert robot.step(0) == 0


def enabled(robot: InProcessSupervisor, name: str, period_ms: int = STEP_MS) -> Any:
    """A sensor that measures."""
    device = robot.getDevice(name)
    device.enable(period_ms)
    return device


def steps(robot: InProcessSupervisor, count: int) -> None:
    """Lets time pass."""
    for _ in range(count):
        assert robot.step() == 0


def drive(
    robot: InProcessSupervisor,
    left_radps: float,
    right_radps: float,
    count: int,
    wheels: Sequence[str] = _WHEELS,
) -> None:
    """Turns the wheels for so many basic time steps; every other one is at the right."""
    for number, name in enumerate(wheels):
        motor = robot.getDevice(name)
        motor.setPosition(inf)
        motor.setVelocity(right_radps if number % 2 else left_radps)
    steps(robot, count)
