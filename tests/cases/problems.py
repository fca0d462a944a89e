"""Problems that users met: each is noticed, or is said not to have been searched."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Final

import numpy as np

from tests.cases.columns import TURN, Array, Random, noise, wrapped
from tests.cases.situations import (
    PROBLEMS,
    Columns,
    counts,
    fails,
    finds,
    holds_with,
    never_denies,
    noticed,
    says,
    situation,
)

_problem = partial(situation, PROBLEMS)


def _resting(t: Array, random: Random) -> dict[str, Any]:
    return {
        "position.x": 1 + noise(random, t, 1e-4),
        "position.y": 2 + noise(random, t, 1e-4),
        "yaw": 0.3 + noise(random, t, 1e-4),
    }


# -- it should move, and does not ------------------------------------------------------------------


@_problem(
    "one wheel is commanded and the robot does not turn",
    noticed,
    never_denies("stuck"),
    lasts_s=30,
    source="cyberbotics/webots#3035",
)
def _(t: Array, random: Random) -> Columns:
    return {**_resting(t, random), "leftSpeed": 0 * t, "rightSpeed": 0 * t + 6.28}


@_problem("a turn is commanded and the heading stays", noticed, never_denies("stuck"), lasts_s=30)
def _(t: Array, random: Random) -> Columns:
    return {**_resting(t, random), "cmd_vel.linear": 0 * t, "cmd_vel.angular": 0 * t + 1.0}


_COMMANDS: Final[dict[str, tuple[str, Any]]] = {
    "in millimetres": ("cmd_mm_s", 300),
    "a throttle": ("throttle", 0.6),
    "called u": ("u", 0.3),
    "an action": ("action.forward", 1.0),
    "a target speed": ("target_speed", 0.3),
    "revolutions of two wheels": ("wheel_rpm_cmd", [60.0, 60.0]),
    "not published": ("", None),
}


def _held(name: str, value: Any) -> Any:
    def draw(t: Array, random: Random) -> Columns:
        way = 0.3 * (np.minimum(t, 20) + np.maximum(0, t - 40))
        command = {name: [value] * len(t)} if name else {}
        return {
            "pose.x": way + noise(random, t, 5e-4),
            "pose.y": noise(random, t, 5e-4),
            "pose.yaw": noise(random, t, 1e-3),
            **command,
        }

    return draw


for _phrase, (_name, _value) in _COMMANDS.items():
    _problem(f"a robot is held; its command is {_phrase}", never_denies("stuck"), lasts_s=60)(
        _held(_name, _value)
    )


@_problem(
    "a robot turns in place for 90 s", finds("standstill", 30, 120, 2.0), lasts_s=120,
    source="ROBOTIS-GIT/turtlebot3_machine_learning#7",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    yaw = 1.2 * np.maximum(0, t - 30)
    return {
        "pose.x": 0.15 * np.minimum(t, 30) + 0.01 * np.sin(yaw),
        "pose.y": 0.01 * np.cos(yaw) - 0.01,
        "pose.yaw": wrapped(yaw),
    }


# -- it does not do what it was told ---------------------------------------------------------------


def _short_of_target(
    t: Array,
    random: Random,
    target: str,
    measured: str,
    full: float,
    share: float,
    deviation: float,
) -> Columns:
    on = (t >= 5) & (t < 65)
    return {
        target: full * on,
        measured: share * full * on + noise(random, t, deviation * full),
    }


@_problem(
    "an elbow stays 22 % short of its target, every 8 ms", fails, lasts_s=70, interval_s=0.008,
    source="Vector-Wangel/XLeRobot#123",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    return _short_of_target(t, random, "elbow.target", "elbow.position", 10, 0.78, 0.005)


@_problem("an elbow called pos stays short of its target", fails, lasts_s=70)
def _(t: Array, random: Random) -> Columns:
    return _short_of_target(t, random, "elbow.target", "elbow.pos", 1, 0.6, 0.004)


@_problem(
    "wheels turn at 78 % of their target speed", noticed, lasts_s=70,
    source="Vector-Wangel/XLeRobot#123",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    sides = [
        _short_of_target(
            t, random, f"wheels.{side}.target", f"wheels.{side}.velocity", 10, 0.78, 0.002
        )
        for side in ("left", "right")
    ]
    return {**sides[0], **sides[1]}


@_problem("the left wheel grips half from 40 s on", noticed, lasts_s=80)
def _(t: Array, random: Random) -> Columns:
    left, right = 0.18 * np.where(t > 40, 0.5, 1.0), 0.18
    yaw = np.cumsum((right - left) / 0.2) * 0.032
    way = (left + right) / 2 * 0.032
    return {
        "pose.x": np.cumsum(way * np.cos(yaw)) + noise(random, t, 5e-4),
        "pose.y": np.cumsum(way * np.sin(yaw)) + noise(random, t, 5e-4),
        "pose.yaw": wrapped(yaw + noise(random, t, 1e-3)),
        "wheels.left": 0 * t + 6,
        "wheels.right": 0 * t + 6,
    }


@_problem(
    "odometry drifts by 0.08 mm/s at rest", finds("standstill", 0, 300, 5.0), lasts_s=300,
    interval_s=0.1, source="manankharwar/fusioncore#13",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    return {
        "odometry.x": 7.7e-5 * t + noise(random, t, 1e-4),
        "odometry.y": noise(random, t, 1e-4),
        "cmd.linear": 0 * t,
        "cmd.angular": 0 * t,
    }


@_problem(
    "a robot turns by 0.24 rad while its command is 0", noticed, lasts_s=60,
    source="Interbotix/interbotix_ros_rovers#46",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    return {
        "pose.x": 0.2 * np.minimum(t, 20) + noise(random, t, 2e-4),
        "pose.y": noise(random, t, 2e-4),
        "pose.yaw": np.clip(0.008 * (t - 25), 0, 0.24) + noise(random, t, 5e-4),
        "cmd_vel.linear": 0.2 * (t < 20),
        "cmd_vel.angular": 0 * t,
    }


# -- it fell ---------------------------------------------------------------------------------------


@_problem(
    "a walking robot tips over", fails, says(r"\bfell|fall|tipped"), lasts_s=45, interval_s=0.016
)
def _(t: Array, random: Random) -> Columns:
    down = np.clip((t - 33.5) / 0.6, 0, 1)
    step = np.sin(2 * TURN * t)
    return {
        "pose.x": 0.3 * np.minimum(t, 33.5),
        "pose.y": 0 * t,
        "pose.z": 0.30 - 0.22 * down + noise(random, t, 0.002),
        "imu.roll": noise(random, t, 0.01),
        "imu.pitch": 1.5 * down + 0.02 * step * (1 - down),
        "imu.yaw": 0 * t,
        "knee_torque_nm": np.where(t > 33.5, 8.0, 3 + 2 * step),
        "mode": ["walk"] * len(t),
    }


@_problem("a rover rolls over at a kerb", fails, says(r"\bfell|fall|tipped"), lasts_s=40)
def _(t: Array, random: Random) -> Columns:
    return {
        "pose.x": 0.2 * np.minimum(t, 12.2) + noise(random, t, 5e-4),
        "pose.y": 0.1 * np.clip(t - 12, 0, 1),
        "pose.z": 0 * t + 0.05,
        "roll": np.clip(3 * (t - 12), 0, 1.57) + noise(random, t, 0.003),
        "pitch": noise(random, t, 0.003),
        "wheels.left": 0 * t + 5,
        "wheels.right": 0 * t + 5,
    }


# -- sensors ---------------------------------------------------------------------------------------


@_problem(
    "every seventh reading of a range sensor is 0", noticed, lasts_s=60,
    source="USC-ACTLab/crazyswarm#259",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    reading = 1.5 + 0.3 * np.sin(t / 5) + noise(random, t, 0.005)
    reading[3::7] = 0
    return {"range_m": reading}


@_problem(
    "half of the rays of a lidar are NaN", noticed, lasts_s=30,
    source="cyberbotics/webots_ros2#770",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    scan = 0.2 + 0.005 * np.arange(-50, 50) + random.normal(0, 0.002, (len(t), 100))
    scan[:, :50] = math.nan
    return {"scan": scan}


@_problem("the noise of a range sensor grows 15 times", noticed, says("nois"), lasts_s=120)
def _(t: Array, random: Random) -> Columns:
    return {
        "pose.x": 0.1 * t,
        "pose.y": 0 * t,
        "pose.yaw": 0 * t,
        "front_m": 2 + 0.4 * np.sin(t / 9) + np.where(t < 60, 0.004, 0.06) * noise(random, t, 1),
    }


@_problem(
    "the first speed of a satellite receiver is absurd", never_denies("jump"), lasts_s=30,
    source="cyberbotics/webots#5371",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    speed = np.full(len(t), 0.2)
    speed[0] = 156.4
    return {"gps.x": 4 + 0.2 * t, "gps.y": 0 * t - 3, "speed": speed}


def _straight(t: Array, random: Random) -> dict[str, Any]:
    return {"gps.x": 0.25 * t + noise(random, t, 0.002), "gps.y": noise(random, t, 0.002)}


@_problem(
    "odometry goes twice as far as the robot", noticed, lasts_s=40,
    source="jfstepha/differential-drive#5",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    return {**_straight(t, random), "odom.x": 0.5 * t, "odom.y": 0 * t}


@_problem(
    "odometry goes in circles while the robot goes straight", noticed, lasts_s=40,
    source="jfstepha/differential-drive#5",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    turned = 0.35 * t
    circle = {"odom.x": 0.714 * np.sin(turned), "odom.y": 0.714 * (1 - np.cos(turned))}
    return {**_straight(t, random), **circle}


# -- oscillations ----------------------------------------------------------------------------------


@_problem(
    "a roll oscillation grows for a minute", finds("oscillation", 0, 60, 3.0, ("roll",)),
    lasts_s=60, interval_s=0.02, source="PX4/PX4-Autopilot#9295",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    swing = 0.05 * np.exp(t / 20) * np.sin(TURN * t / 2)
    return {"roll": swing + noise(random, t, 0.005), "x": 0 * t, "y": 0 * t}


@_problem(
    "a wheel command changes its sign in every row",
    never_denies("oscillation", ("motors.*",)),
    lasts_s=60,
    interval_s=0.064,
)
def _(t: Array, random: Random) -> Columns:
    flips = 3.1 * (-1.0) ** np.arange(len(t))
    return {"motors.left_command_rad_s": flips, "motors.right_command_rad_s": flips}


# -- conditions and rows ---------------------------------------------------------------------------


@_problem(
    "a battery gets low while the robot drives",
    holds_with("battery_pct < 20 and mode == 'drive'", r"\b11\.[67]"),
    lasts_s=100,
)
def _(t: Array, random: Random) -> Columns:
    return {
        "pose.x": 0.2 * t,
        "pose.y": 0 * t,
        "pose.yaw": 0 * t,
        "battery_pct": 41.6 - 0.3 * t,
        "mode": ["drive"] * len(t),
    }


@_problem(
    "gaps of two lengths lie between rows", counts("gap", 74), lasts_s=101, interval_s=0.017,
    source="the fr2_desk recording of TUM",
)  # fmt: skip
def _(t: Array, random: Random) -> Columns:
    rows = np.arange(len(t))
    since = (rows - 40) % 80
    long = ((rows - 40) // 80) % 2 == 0
    lost = (rows >= 40) & (since < np.where(long, 20, 11))
    return {"recorded": ~lost, "pose.x": 0.1 * t, "pose.y": 0 * t, "pose.yaw": 0 * t}
