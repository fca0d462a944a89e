"""Which of a state's numbers are the place of the robot."""

from __future__ import annotations

import pytest

from webots_mcp.naming import find_mode, find_position


def numbers(*branches: str) -> set[str]:
    return {f"{branch}.{axis}" for branch in branches for axis in "xy"}


@pytest.mark.parametrize("branch", ["velocity", "accel", "cmd_vel.linear", "target", "ball", "imu"])
def test_what_is_no_place_or_the_place_of_something_else_is_not_taken(branch: str) -> None:
    assert find_position(numbers(branch)) is None
    assert find_position(numbers(branch, "rover")) == ("rover.x", "rover.y")


def test_a_nested_position_is_taken_before_other_branches() -> None:
    found = find_position(numbers("base", "odometry.position"))
    assert found == ("odometry.position.x", "odometry.position.y")


@pytest.mark.parametrize(
    ("x", "y"),
    [
        ("Lage.xMm", "Lage.yMm"),
        ("robotPose.posX", "robotPose.posY"),
        ("currentPosition.x", "currentPosition.y"),
        ("currentPosition.0", "currentPosition.1"),
        ("robot.pose_m.0", "robot.pose_m.1"),
        ("posX", "posY"),
        ("x_pos", "y_pos"),
        ("robot_x", "robot_y"),
        ("XMm", "YMm"),
    ],
)
def test_a_position_is_found_however_its_words_are_joined(x: str, y: str) -> None:
    others = {"targetPose.x", "targetPose.y", "ballX", "ballY", "gyro.0", "gyro.1", "max", "y2"}
    assert find_position({x, y, *others}) == (x, y)
    assert find_position(others) is None


def test_a_branch_that_is_called_a_place_is_taken_before_others_in_camel_case_too() -> None:
    assert find_position(numbers("base", "currentPosition")) == (
        "currentPosition.x",
        "currentPosition.y",
    )


@pytest.mark.parametrize("name", [
    "driveMode", "nav.currentState", "drive_mode", "robotTask", "state_name", "modeName",
    "nav.STATE_STR", "current_state_label",
])  # fmt: skip
def test_a_mode_is_found_by_the_last_word_of_its_name(name: str) -> None:
    others = {"lastAction", "next_state_name", "previousMode", "modest", "text", "name", "x.str"}
    assert find_mode({name, *others}) == name
    assert find_mode(others) is None


def test_of_several_robots_that_an_observer_sees_none_is_meant() -> None:
    rover = {"world.ROVER.x_m", "world.ROVER.y_m", "solid.CRATE.x_m", "solid.CRATE.y_m"}
    assert find_position(rover) == ("world.ROVER.x_m", "world.ROVER.y_m")
    assert find_position({*rover, "world.TWO.x_m", "world.TWO.y_m"}) is None
