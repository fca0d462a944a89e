"""Wheels that were told once, before the loop, to turn without end, and a reset of the world."""

from __future__ import annotations

import math
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSupervisor

LOGGED = "SELECT message FROM log WHERE source = 'bridge' AND level = 'info'"


def wheels_of(robot: InProcessSupervisor) -> list[Any]:
    return [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]


def turn_without_end(robot: InProcessSupervisor, left: float, right: float) -> None:
    for motor, velocity in zip(wheels_of(robot), (left, right), strict=True):
        motor.setPosition(math.inf)
        motor.setVelocity(velocity)


def place_of(robot: InProcessSupervisor) -> tuple[float, float, float]:
    found = robot.simulation.robot("rover")
    return found.position[0], found.position[1], found.yaw_rad


def drive(robot: InProcessSupervisor, bridge: MCPBridge | None = None, steps: int = 30) -> None:
    for number in range(steps):
        assert robot.step(STEP_MS) != -1
        if bridge is not None:
            bridge.publish({"number": number})
            eager(bridge)


@pytest.mark.parametrize("attached", [False, True])
@pytest.mark.parametrize(("left", "right"), [(3.0, 3.0), (-2.0, 4.0), (0.0, 0.0)])
def test_a_robot_drives_on_after_a_reset_as_it_was_told_once_before_its_loop(
    robot: InProcessSupervisor,
    database: MemoryDatabase,
    recording: Recording,
    attached: bool,
    left: float,
    right: float,
) -> None:
    turn_without_end(robot, left, right)
    with (MCPBridge.attach if attached else MCPBridge)(robot, database=database) as bridge:
        asking = None if attached else bridge
        drive(robot, asking)
        before = place_of(robot)
        recording.send("reset")
        while recording.rows("SELECT count(*) FROM run") == [1]:
            drive(robot, asking, 1)
        drive(robot, asking, 30 - round(1000 * robot.getTime() / STEP_MS))
    # Of the first step only the end is theirs.
    assert place_of(robot) == pytest.approx(before, abs=0.06)
    (logged,) = recording.rows(LOGGED)
    assert f"left wheel motor ({left:g}), right wheel motor ({right:g})" in logged


def test_a_motor_that_was_sent_to_an_angle_is_left_to_the_controller(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    left, _ = wheels_of(robot)
    turn_without_end(robot, 0.0, 0.0)
    left.setPosition(1.0)
    drive(robot, bridge, 3)
    robot.simulationReset()
    drive(robot, bridge, 3)
    (logged,) = recording.rows(LOGGED)
    assert "right wheel motor" in logged
    assert "left wheel motor" not in logged


def test_a_motor_that_cannot_be_asked_again_is_told_and_the_other_turns_on(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    left, _ = wheels_of(robot)
    with MCPBridge(robot, database=database) as bridge:
        turn_without_end(robot, 3.0, 3.0)
        drive(robot, bridge)

        def refuse() -> float:
            raise OSError("the gear is gone")

        left.getTargetPosition = refuse
        robot.simulationReset()
        drive(robot, bridge)
        assert "left wheel motor" in str(bridge.stats().last_error)
    (logged,) = recording.rows(LOGGED)
    assert "right wheel motor" in logged
