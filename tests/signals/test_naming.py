"""What the name of a signal says: place or mode of the robot, unit, angle."""

from __future__ import annotations

import math

import pytest

from webots_mcp.signals.naming import find_mode, find_position, metres_in, unit_in
from webots_mcp.signals.register import kind_of, turn_of


def numbers(*branches: str) -> set[str]:
    return {f"{branch}.{axis}" for branch in branches for axis in "xy"}


@pytest.mark.parametrize("branch", ["velocity", "accel", "cmd_vel.linear", "target", "ball", "imu"])
def test_what_is_no_place_or_the_place_of_something_else_is_not_taken(branch: str) -> None:
    assert find_position(numbers(branch)) is None
    assert find_position(numbers(branch, "rover")) == ("rover.x", "rover.y")


@pytest.mark.parametrize("place", ["odometry.position", "currentPosition"])
def test_a_branch_that_is_called_a_place_is_taken_before_others(place: str) -> None:
    assert find_position(numbers("base", place)) == (f"{place}.x", f"{place}.y")


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


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("front_mm", "mm"),
        ("x_cm", "cm"),
        ("distance_m.left", "m"),
        ("speed_m_s", "m/s"),
        ("speed_mm_s", "mm/s"),
        ("turn_deg_s", "deg/s"),
        ("accel_m_s2.0", "m/s²"),
        ("wheels.left_rad_s", "rad/s"),
        ("speed.m_s", "m/s"),
        ("yawRateDegPerS", "deg/s"),
        ("headingDeg", "deg"),
        ("Lage.xMm", "mm"),
        ("Lage.XMm", "mm"),
        ("heading_degrees", "deg"),
        ("deg_heading", "deg"),
        ("mmAlong", "mm"),
        ("cm_x", "cm"),
        ("x_mm_filtered", "mm"),
        ("radPerSLeft", "rad/s"),
        ("speed_mm_per_sec", "mm/s"),
        ("growth_mm_per_day", None),
        ("ticks_per_mm", None),
        ("mAlong", None),
        ("battery_v", "V"),
        ("side.a", None),
        ("sideA", None),
        ("v", None),
        ("items", None),
    ],
)
def test_the_unit_of_a_value_stands_in_its_name(name: str, unit: str | None) -> None:
    assert unit_in(name) == unit


def test_a_length_without_a_unit_is_in_metres() -> None:
    assert [metres_in(name) for name in ("x", "x_mm", "pose_cm.0", "mmAlong")] == [
        1.0, 0.001, 0.01, 0.001,
    ]  # fmt: skip


@pytest.mark.parametrize(
    "name",
    ["heading_deg", "deg_heading", "headingDeg", "heading_degrees", "yaw_deg", "bearing_deg",
     "bearing.deg", "pose.yaw_degrees", "goal_bearing_deg", "roll_deg.0", "course_deg"],
)  # fmt: skip
def test_an_angle_in_degrees_has_a_turn_of_360(name: str) -> None:
    assert turn_of(name, kind_of(name, 270.0)) == 360.0
    assert turn_of(name, kind_of(name, 2.0)) == 360.0


@pytest.mark.parametrize(
    "name", ["heading", "yawRad", "rad_bearing", "lidar.bearing_rad", "roll.0"]
)
def test_any_other_angle_is_in_radians(name: str) -> None:
    assert turn_of(name, kind_of(name, 2.0)) == math.tau


@pytest.mark.parametrize("name", ["heading_error", "yaw_deg_s", "yaw.rate", "course", "degrees"])
def test_what_is_no_angle_has_no_turn(name: str) -> None:
    assert turn_of(name, kind_of(name, 2.0)) is None
