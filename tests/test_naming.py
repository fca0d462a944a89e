"""Which of a state's numbers are the place of the robot."""

from __future__ import annotations

import pytest

from webots_mcp.naming import find_position


def numbers(*branches: str) -> set[str]:
    return {f"{branch}.{axis}" for branch in branches for axis in "xy"}


@pytest.mark.parametrize("branch", ["velocity", "accel", "cmd_vel.linear", "target", "ball", "imu"])
def test_what_is_no_place_or_the_place_of_something_else_is_not_taken(branch: str) -> None:
    assert find_position(numbers(branch)) is None
    assert find_position(numbers(branch, "rover")) == ("rover.x", "rover.y")


def test_a_nested_position_is_taken_before_other_branches() -> None:
    found = find_position(numbers("base", "odometry.position"))
    assert found == ("odometry.position.x", "odometry.position.y")
