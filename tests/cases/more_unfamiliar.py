"""Ten more robots of kinds that no rule was made with, labelled before the first question.

They are entered into `unfamiliar.ROBOTS`, where they are asked.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.cases.columns import TURN, Array, Random, chosen, noise, wrapped
from tests.cases.situations import Columns
from tests.cases.unfamiliar import ramped, robot


def _second_order(t: Array, aims: Array, damping: float, turns_rad_s: float) -> Array:
    """What follows a target as a mass on a damped spring does."""
    step_s, at, speed = 0.004, float(aims[0]), 0.0
    moments = np.arange(0.0, float(t[-1]) + step_s, step_s)
    course = np.empty(len(moments))
    for row, aim in enumerate(np.interp(moments, t, aims).tolist()):
        speed += (turns_rad_s**2 * (aim - at) - 2 * damping * turns_rad_s * speed) * step_s
        at += speed * step_s
        course[row] = at
    return np.interp(t, moments, course)


def _driven(
    t: Array, left: Array, right: Array, grip: tuple[Array, Array], radius_m: float, track_m: float
) -> tuple[Array, Array, Array]:
    """Where two wheels take a robot: x, y, heading."""
    step = np.diff(t, prepend=0.0)
    rolled = left * grip[0] * radius_m, right * grip[1] * radius_m
    yaw = np.cumsum((rolled[1] - rolled[0]) / track_m * step)
    ahead = (rolled[0] + rolled[1]) / 2
    return np.cumsum(ahead * np.cos(yaw) * step), np.cumsum(ahead * np.sin(yaw) * step), yaw


@robot(
    "tower crane", 120, fault="its load begins to oscillate with growing amplitude at 60 s",
    check="stays stable", kind="oscillation", names="sway", at_s=60, within_s=8,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    jib = ramped(t, [0, 10, 30, 50, 80, 100, 120], [0, 0, 1.2, 1.2, -0.4, -0.4, -0.4])
    trolley = ramped(t, [0, 12, 25, 55, 70, 120], [8, 8, 21, 21, 12, 12])
    hoist = ramped(t, [0, 5, 15, 90, 110, 120], [2, 2, 18, 18, 3, 3])
    swings = 1.2 * np.exp(-(t % 40) / 15) * np.sin(TURN * t / 6.5)
    grows = faulty * np.where(t > 60, 0.4 * np.exp((t - 60) / 16), 0) * np.sin(TURN * t / 6.5)
    return {
        "jib.angle_rad": jib + noise(random, t, 0.001),
        "trolley.radius_m": trolley + noise(random, t, 0.004),
        "hook.height_m": hoist + noise(random, t, 0.01),
        "hook.load_kg": 850 * ((t > 15) & (t < 108)) + noise(random, t, 4),
        "hook.sway_deg": np.where(faulty & (t > 60), grows, swings) + noise(random, t, 0.05),
        "wind_m_s": 4 + 1.5 * np.sin(TURN * t / 47) + noise(random, t, 0.5),
        "operator": chosen((t < 5, "idle"), (t < 110, "lift"), otherwise="idle"),
    }


@robot(
    "swimming snake", 60, fault="its seventh joint hangs limp from 30 s on",
    check="follows its targets", kind="off_target", names="joint7|joint_7|7", at_s=30,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    gait = np.clip((t - 4) / 3, 0, 1) * np.clip((56 - t) / 2, 0, 1)
    columns: dict[str, Any] = {
        "head.x": 0.18 * np.clip(t - 5, 0, 50) + noise(random, t, 0.004),
        "head.y": 0.03 * np.sin(TURN * t / 1.4) * gait + noise(random, t, 0.004),
        "water_temperature_c": np.round(14 + 0.2 * np.sin(t / 20), 1),
        "battery_v": 14.6 - 0.003 * t + noise(random, t, 0.01),
    }
    for joint in range(1, 11):
        aim = 0.5 * gait * np.sin(TURN * t / 1.4 - 0.6 * joint)
        follows = 0.85 * np.interp(t - 0.09, t, aim)
        limp = faulty & (joint == 7) & (t >= 30)
        drags = 0.08 * np.sin(TURN * t / 1.4 - 5.5)
        columns[f"joints.{joint}.target_rad"] = aim
        columns[f"joints.{joint}.angle_rad"] = np.where(limp, drags, follows) + noise(
            random, t, 0.004
        )
    return columns


@robot(
    "balancing unicycle", 70, fault="it falls at 40 s",
    check="stays upright", kind="fall", names="fell", at_s=40.5,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    lies = faulty * np.clip((t - 40) / 0.8, 0, 1)
    pitch = 0.05 * np.sin(TURN * t / 1.9) + 0.02 * np.sin(TURN * t / 0.7)
    up = 1 - lies
    speed = 0.3 * ramped(t, [0, 8, 10, 30, 33, 50, 70], [0, 0, 1, 1, 0.5, 1, 1]) * (lies < 0.1)
    step = t[1] - t[0]
    return {
        "position.x": np.cumsum(speed) * step + 0.01 * pitch + noise(random, t, 0.002),
        "position.y": noise(random, t, 0.002),
        "imu.pitch": up * pitch + 1.5 * lies + noise(random, t, 0.004),
        "imu.roll": up * 0.03 * np.sin(TURN * t / 2.3) + noise(random, t, 0.004),
        "imu.yaw": noise(random, t, 0.004),
        "wheel.speed_rad_s": speed / 0.1 + 2 * up * np.cos(TURN * t / 1.9) + noise(random, t, 0.05),
        "flywheel_rpm": up * (600 * np.sin(TURN * t / 2.3)) + noise(random, t, 5),
    }


@robot(
    "cleaner along walls", 130, fault="its right wheel slips on a wet spot from 55 to 64 s",
    check="wheels grip", kind="slip", names="right", at_s=55,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    at = t % 26
    turns = (at > 20) & (at < 23)
    ahead = np.where(turns | ((at >= 23) & (at < 24)), 0.0, 6.0)
    bumped = (at >= 19.6) & (at < 20)
    wall = 0.25 * np.sin(TURN * t / 8) * (ahead > 0)
    left, right = ahead - 2.5 * turns - wall, ahead + 2.5 * turns + wall
    slips = faulty & (t >= 55) & (t < 64)
    right = np.where(slips, right + 2.5, right)
    left = np.where(slips, left - 2.8, left)
    x, y, yaw = _driven(t, left, right, (1 - 0 * t, np.where(slips, 0.32, 1.0)), 0.035, 0.24)
    return {
        "gps.x": x + noise(random, t, 0.002),
        "gps.y": y + noise(random, t, 0.002),
        "imu.yaw": wrapped(yaw + noise(random, t, 0.003)),
        "wheel_left_rad_s": left + noise(random, t, 0.04),
        "wheel_right_rad_s": right + noise(random, t, 0.04),
        "wall_distance_m": np.maximum(0.02, 0.08 + 0.03 * np.sin(TURN * t / 8)
                                      + noise(random, t, 0.003)),
        "bumper": bumped,
        "brush_a": 0.9 + 0.2 * np.sin(t / 3) + noise(random, t, 0.05),
        "mode": chosen((turns, "turn"), (ahead == 0, "wait"), otherwise="clean"),
    }  # fmt: skip


@robot(
    "indoor airship", 160, fault="from 75 s on it stays 1.5 m below its target",
    check="follows its targets", kind="off_target", names="altitude", at_s=80, within_s=12,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    aims = np.select([t < 5, t < 70], [0.5, 4.0], 7.0)
    altitude = _second_order(t, aims, 1.1, 0.5)
    altitude = np.where(faulty & (t > 70), np.minimum(altitude, 5.5), altitude)
    gusts = 0.05 * np.sin(TURN * t / 11) + 0.03 * np.sin(TURN * t / 4.3)
    return {
        "position.x": 0.25 * t + 0.4 * np.sin(TURN * t / 25) + noise(random, t, 0.05),
        "position.y": 0.3 * np.sin(TURN * t / 31) + noise(random, t, 0.05),
        "altitude_m": altitude + gusts + noise(random, t, 0.03),
        "altitude_setpoint_m": aims,
        "heading_deg": (30 + 20 * np.sin(TURN * t / 60) + noise(random, t, 1)) % 360,
        "props.left_pct": 40 + 10 * np.sin(TURN * t / 25) + noise(random, t, 1),
        "props.right_pct": 40 - 10 * np.sin(TURN * t / 25) + noise(random, t, 1),
        "helium_pressure_pa": 310 + 2 * np.sin(t / 30) + noise(random, t, 0.5),
    }


@robot(
    "stick insect", 60, fault="the force of its third foot is NaN from 35 to 47 s",
    check="sensors speak", kind="missing", names="feet|foot|leg3|legs?.3", at_s=35,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    walks = (t > 6) & (t < 54)
    columns: dict[str, Any] = {
        "thorax.x": 0.04 * np.clip(t - 6, 0, 48) + noise(random, t, 0.001),
        "thorax.y": noise(random, t, 0.001),
        "thorax.z": 0.09 + 0.004 * walks * np.sin(TURN * t / 0.8) + noise(random, t, 0.0005),
    }
    for leg in range(1, 7):
        phase = TURN * t / 1.6 + math.pi * (leg % 2)
        for joint, size in (("coxa", 0.4), ("femur", 0.3)):
            aim = size * walks * np.sin(phase + (joint == "femur"))
            columns[f"leg{leg}.{joint}_cmd_rad"] = aim
            columns[f"leg{leg}.{joint}_pos_rad"] = np.interp(t - 0.05, t, aim) + noise(
                random, t, 0.003
            )
        force = np.maximum(0, 1.2 + 1.2 * walks * np.sin(phase)) + noise(random, t, 0.03)
        silent = faulty & (leg == 3) & (t >= 35) & (t < 47)
        columns[f"leg{leg}.foot_force_n"] = np.where(silent, np.nan, force)
    return columns


@robot(
    "lift cabin", 200, fault="from the ride at 80 s on it passes its floors by a third of the ride",
    check="follows its targets", kind="off_target", names="height", at_s=84, within_s=5,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    floors = np.array([0.0, 9.6, 3.2, 12.8, 0.0])[np.minimum((t // 40).astype(int), 4)]
    healthy, less = (_second_order(t, floors, each, 0.9) for each in (0.95, 0.32))
    height = np.where(faulty & (t >= 80), less, healthy)
    moves = np.abs(np.gradient(height, t)) > 0.02
    return {
        "cabin.height_m": height + noise(random, t, 0.003),
        "cabin.target_height_m": floors,
        "cabin.speed_m_s": np.gradient(height, t) + noise(random, t, 0.01),
        "motor.current_a": 2 + 9 * np.abs(np.gradient(height, t)) + noise(random, t, 0.2),
        "load_kg": np.select([t < 40, t < 120], [75, 320], 0) + noise(random, t, 1.5),
        "door": chosen((moves, "closed"), otherwise="open"),
    }


@robot(
    "swarm member that waits", 120, fault="commanded to leave at 50 s, it stays until 68 s",
    check="moves when commanded", kind="stuck", names="stuck", at_s=50,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    commanded = np.where(((t > 5) & (t < 25)) | ((t >= 50) & (t < 90)), 0.2, 0.0)
    moves = np.where(faulty & (t >= 50) & (t < 68), 0.0, commanded)
    step = t[1] - t[0]
    return {
        "pose.x": np.cumsum(moves) * step + noise(random, t, 0.002),
        "pose.y": noise(random, t, 0.002),
        "pose.theta": noise(random, t, 0.003),
        "cmd_vel.linear_m_s": commanded,
        "cmd_vel.angular_rad_s": 0.0 * t,
        "neighbours": np.where(t % 30 < 15, 3, 5).astype(int),
        "nearest_m": 0.6 + 0.2 * np.sin(TURN * t / 30) + noise(random, t, 0.01),
        "led": chosen((t % 2 < 1, "green"), otherwise="off"),
        "role": chosen((commanded > 0, "follow"), otherwise="beacon"),
    }


@robot(
    "pipe crawler on tracks", 100, fault="the reading of its gas sensor is frozen from 40 to 62 s",
    check="sensors live", kind="flat", names="pressure", at_s=40,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    speed = 0.08 * ramped(t, [0, 4, 6, 30, 31, 36, 37, 90, 92, 100], [0, 0, 1, 1, 0, 0, 1, 1, 0, 0])
    step = t[1] - t[0]
    pressure = 3.1 + 0.05 * np.sin(TURN * t / 33) + noise(random, t, 0.006)
    frozen = faulty & (t >= 40) & (t < 62)
    return {
        "distance_travelled_m": np.cumsum(speed) * step,
        "gps.x": np.cumsum(speed) * step + noise(random, t, 0.01),
        "gps.y": noise(random, t, 0.01),
        "tracks.left.speed_m_s": speed + noise(random, t, 0.002),
        "tracks.right.speed_m_s": speed + noise(random, t, 0.002),
        "gas_pressure_bar": np.where(frozen, pressure[np.argmax(t >= 40)], pressure),
        "roll_deg": 4 * np.sin(TURN * t / 21) + noise(random, t, 0.3),
        "pitch_deg": 2 * np.sin(TURN * t / 17) + noise(random, t, 0.3),
        "lamp": t > 4,
        "task": chosen((speed > 0, "inspect"), otherwise="hold"),
    }


@robot(
    "rope climber", 120, fault="its altimeter becomes eight times as noisy at 60 s",
    check="sensors keep their noise", kind="degradation", names="height|altitude", at_s=60,
    within_s=3,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    height = ramped(t, [0, 8, 40, 50, 80, 110, 120], [0, 0, 9, 9, 20, 4, 4])
    scatter = np.where(faulty & (t >= 60), 0.16, 0.02)
    return {
        "height_m": height + random.normal(0, 1, len(t)) * scatter,
        "rope.tension_n": 82 + 6 * np.sign(np.gradient(height, t)) + noise(random, t, 1.5),
        "gripper.upper": (t % 4 < 2),
        "gripper.lower": (t % 4 >= 2),
        "sway_deg": 5 * np.sin(TURN * t / 4.2) * np.exp(-(t % 30) / 12) + noise(random, t, 0.2),
        "motor_temperature_c": np.round(31 + 12 * (1 - np.exp(-t / 50)), 1),
        "cpu_pct": 20 + noise(random, t, 3),
    }
