"""Which unit, and which angle, the name of a signal says."""

from __future__ import annotations

import math

import pytest

from webots_mcp.naming import metres_in, unit_in
from webots_mcp.signal_register import kind_of, turn_of


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
