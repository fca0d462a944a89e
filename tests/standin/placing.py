"""Puts a robot somewhere, as a supervisor does."""

from __future__ import annotations

from webots_mcp.standin import InProcessSupervisor


def place(robot: InProcessSupervisor, x: float, y: float, yaw: float = 0.0) -> None:
    """Moves the robot; what it senses follows with its next step."""
    node = robot.getSelf()
    translation, rotation = node.getField("translation"), node.getField("rotation")
    assert translation is not None and rotation is not None
    translation.setSFVec3f([x, y, 0.04])
    rotation.setSFRotation([0.0, 0.0, 1.0, yaw])
    assert robot.step(0) == 0
