"""Keys that say nothing of what stands below them do not change what a name means."""

from __future__ import annotations

import pytest

from webots_mcp.signals.meaning import meanings_by_name, own_names
from webots_mcp.signals.register import Kind, decide_roles


def kinds_of(*names: str) -> dict[str, Kind]:
    return {name: "angle" if name.endswith(("yaw", "roll", "pitch")) else "num" for name in names}


@pytest.mark.parametrize(
    ("names", "own"),
    [
        (("state.gps.x", "mode"), ("gps.x", "mode")),
        (("telemetry.robot.speed", "t"), ("speed", "t")),
        (("freddy.gps.x", "freddy.mode", "time"), ("gps.x", "mode", "time")),
        (("freddy.data.gps.x", "freddy.mode"), ("gps.x", "mode")),
        (("freddy.gps.x", "anna.gps.x"), ("freddy.gps.x", "anna.gps.x")),
        (("wheels.left", "wheels.right"), ("wheels.left", "wheels.right")),
        (("ball.x", "ball.y"), ("ball.x", "ball.y")),
        (("target.speed", "target.x"), ("target.speed", "target.x")),
        (("world.ROVER.x_m", "world.ROVER.y_m"), ("world.ROVER.x_m", "world.ROVER.y_m")),
        (("state", "status"), ("state", "status")),
        (("state.0", "state.1"), ("state.0", "state.1")),
        (("speed",), ("speed",)),
        (("a.", ".b"), ("a.", "b")),
        (("gps.x", "state.gps.x", "mode"), ("gps.x", "state.gps.x", "mode")),
    ],
)
def test_what_is_left_of_names(names: tuple[str, ...], own: tuple[str, ...]) -> None:
    assert tuple(own_names(names).values()) == own


@pytest.mark.parametrize("key", ["", "state.", "telemetry.", "freddy."])
def test_roles_and_meanings_are_those_without_the_key(key: str) -> None:
    names = ("gps.x", "gps.y", "imu.yaw", "cmd_vel", "wheels.left", "wheels.right", "battery_v")
    kinds = kinds_of(*(f"{key}{name}" for name in names))
    roles = decide_roles(kinds)
    assert {name.removeprefix(key): role for name, role in roles.items()} == {
        "gps.x": "x", "gps.y": "y", "imu.yaw": "yaw", "cmd_vel": "commanded_speed",
        "wheels.left": "wheel", "wheels.right": "wheel",
    }  # fmt: skip
    meanings = meanings_by_name(kinds, roles)
    assert [meanings[name].quantity for name in kinds] == [
        "x", "y", "heading", "speed", "wheel speed", "wheel speed", "voltage",
    ]  # fmt: skip


def test_a_name_at_the_top_goes_before_the_same_one_below_a_key() -> None:
    roles = decide_roles(kinds_of("state.x_m", "state.y_m", "x_m", "y_m"))
    assert (roles["x_m"], roles["y_m"]) == ("x", "y")
    assert (roles["state.x_m"], roles["state.y_m"]) == ("x2", "y2")


@pytest.mark.parametrize("prefix", ["pose_", "robot_", "gps_", "filtered_", "body_"])
def test_a_pose_of_flat_names_has_all_of_its_roles(prefix: str) -> None:
    roles = decide_roles(kinds_of(*(f"{prefix}{part}" for part in ("x", "y", "z", "yaw"))))
    assert roles == {
        f"{prefix}x": "x", f"{prefix}y": "y", f"{prefix}z": "z", f"{prefix}yaw": "yaw",
    }  # fmt: skip


@pytest.mark.parametrize("prefix", ["", "pose.", "robot."])
def test_roll_and_pitch_beside_a_position_are_no_heading(prefix: str) -> None:
    roles = decide_roles(kinds_of(*(f"{prefix}{part}" for part in ("x", "y", "roll", "pitch"))))
    assert set(roles.values()) == {"x", "y"}


@pytest.mark.parametrize(
    "names",
    [("accel_x", "accel_y"), ("mouse_x", "mouse_y"), ("ball_x", "ball_y"), ("v_x", "v_y")],
    ids=lambda names: names[0],
)
def test_flat_names_of_other_things_are_no_position(names: tuple[str, str]) -> None:
    assert decide_roles(kinds_of(*names)) == {}
