"""Recordings of the situations in `public_labels.toml`, and how many points the answers earn."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from tests.cases.columns import TURN, Array, Random, chosen, noise, wrapped
from tests.cases.situations import Columns, Recording, Situation, recorded, situation

LABELS: Final = Path(__file__).with_name("public_labels.toml")
RIGHT, HELPFUL, NO_HELP, FALSE = 2, 1, 0, -1
PUBLIC: Final[dict[str, Situation]] = {}
GRAVITY: Final = 9.81

_drawn = partial(situation, PUBLIC)


class Scored(NamedTuple):
    """How an answer compares with the label: points, and what was answered."""

    points: int
    answered: str


@cache
def labels() -> dict[str, dict[str, Any]]:
    """Return the labels by name of the situation."""
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    return toml.loads(LABELS.read_text("utf-8"))


def score(name: str) -> Scored:
    """Record a situation, ask about it, and compare the answers with its label."""
    label = labels()[name]
    with recorded(PUBLIC[name]) as asked:
        alarms = [f"{each.name}: {each.evidence}" for each in asked.checked.of("warn", "fail")]
        said = "; ".join(alarms) or "no alarm"
        if label.get("healthy"):
            return Scored(FALSE if alarms else RIGHT, said)
        for points, wanted in ((RIGHT, label["right"]), (HELPFUL, label["helpful"])):
            if found := next(filter(None, (_answered(asked, each) for each in wanted)), None):
                return Scored(points, found)
        passed = {each.name for each in asked.checked.of("pass")}
        denied = passed.intersection(label["denied_by"])
        return Scored(FALSE if denied else NO_HELP, f"{', '.join(sorted(denied))}: pass; {said}")


def _answered(asked: Recording, wanted: Mapping[str, Any]) -> str | None:
    """Return the alarm or the event that a label names; None if nothing matches."""
    if check := wanted.get("check"):
        for each in asked.checked.of("warn", "fail"):
            text = f"{each.name}: {each.evidence}"
            if check in ("*", each.name) and _fits(wanted, text, each.since_s):
                return text
        return None
    kinds = () if wanted["kind"] == "*" else (wanted["kind"],)
    for each in asked.events(*kinds).events:
        if each.kind not in ("run", "change") and _fits(wanted, each.name or "", each.start_s):
            return f"event {each.kind} {each.name or ''} at {each.start_s:.1f} s"
    return None


def _fits(wanted: Mapping[str, Any], text: str, since_s: float | None) -> bool:
    if not re.search(wanted.get("names", ""), text, re.I):
        return False
    at_s = wanted.get("at_s")
    return at_s is None or (since_s is not None and abs(since_s - at_s) <= wanted["within_s"])


def _pose(x: Array, y: Array, yaw: Array) -> dict[str, Array]:
    return {"pose.x": x, "pose.y": y, "pose.yaw": yaw}


# -- healthy, and odd ------------------------------------------------------------------------------


@_drawn("hand_guided_arm", lasts_s=60)
def _(t: Array, random: Random) -> Columns:
    by_hand = (t >= 15) & (t < 40)
    columns: dict[str, Any] = {}
    for at, joint in enumerate(("shoulder", "elbow", "wrist")):
        planned = 0.6 * np.sin(TURN * t / 12 + at)
        target = np.where(by_hand, planned[t < 15][-1], planned)
        since = np.clip(t - 15, 0, 25)
        pushed = (0.7 - 0.2 * at) * np.sin(math.pi * since / 25) ** 2
        columns[f"joints.{joint}.target"] = target
        columns[f"joints.{joint}.position"] = np.where(by_hand, target + pushed, target) + noise(
            random, t, 3e-4
        )
    columns["robot_mode"] = chosen((by_hand, "freedrive"), otherwise="running")
    return columns


@_drawn("tail_sitter", lasts_s=90, interval_s=0.02)
def _(t: Array, random: Random) -> Columns:
    pitch = -np.radians(80) * np.interp(t, [0, 15, 18, 60, 64, 90], [0, 0, 1, 1, 0, 0])
    speed = np.interp(t, [0, 15, 20, 58, 66, 90], [0, 0, 16, 16, 0, 0])
    height = np.interp(t, [0, 3, 12, 66, 84, 90], [0, 0, 40, 40, 0, 0])
    throttle = np.interp(t, [0, 1, 3, 12, 18, 62, 84, 85], [0, 0.2, 0.6, 0.55, 0.35, 0.5, 0.4, 0])
    return {
        "position.x": np.cumsum(speed) * 0.02 + noise(random, t, 0.02),
        "position.y": noise(random, t, 0.02),
        "position.z": height + noise(random, t, 0.02),
        "attitude.roll": noise(random, t, 0.006),
        "attitude.pitch": pitch + noise(random, t, 0.006),
        "attitude.yaw": 0.8 + noise(random, t, 0.006),
        "airspeed_m_s": np.maximum(0, speed + noise(random, t, 0.2)),
        "throttle": throttle,
        "vtol_state": chosen(
            (t < 3, "ground"), (t < 15, "multicopter"), (t < 18, "transition"), (t < 60, "plane"),
            (t < 64, "transition"), (t < 85, "multicopter"), otherwise="ground",
        ),
    }  # fmt: skip


@_drawn("fixes_once_a_second", lasts_s=120, interval_s=0.02)
def _(t: Array, random: Random) -> Columns:
    speed = np.interp(t, [0, 8, 50, 56, 70, 78, 120], [0, 11, 11, 0, 0, 11, 11])
    way = np.cumsum(speed) * 0.02
    heading = 0.9 + 0.3 * np.sin(way / 120)
    x, y = np.cumsum(speed * np.cos(heading)) * 0.02, np.cumsum(speed * np.sin(heading)) * 0.02
    fix = np.floor(t).astype(np.intp)  # the number of the newest fix, which came at that second
    held = np.minimum(np.searchsorted(t, fix.astype(np.float64)), len(t) - 1)
    scatter = random.normal(0, 0.4, (int(fix[-1]) + 1, 2))
    return {
        "gps.x": x[held] + scatter[fix, 0],
        "gps.y": y[held] + scatter[fix, 1],
        "speed_m_s": speed + noise(random, t, 0.03),
        "heading_rad": heading + noise(random, t, 0.003),
        "steering_rad": 0.02 * np.sin(way / 120),
        "state": chosen(((t >= 50) & (t < 70), "yield"), otherwise="drive"),
    }


@_drawn("holds_its_place_in_a_current", lasts_s=150, interval_s=0.05)
def _(t: Array, random: Random) -> Columns:
    moved = np.clip(0.3 * (t - 70), 0, 3)
    sway = 0.02 * np.sin(TURN * t / 7)
    thrust = 0.34 + 0.03 * np.sin(TURN * t / 7)[:, None]
    return {
        "pose.x": moved + sway + noise(random, t, 0.004),
        "pose.y": 0.5 * sway + noise(random, t, 0.004),
        "depth_m": 8.5 + 0.01 * np.sin(TURN * t / 5) + noise(random, t, 0.003),
        "heading_deg": 118 + noise(random, t, 0.3),
        "thrusters": thrust + random.normal(0, 0.01, (len(t), 6)),
        "mode": chosen(((t >= 70) & (t < 80), "guided"), otherwise="poshold"),
    }


@_drawn("sits_and_lies_down", lasts_s=90, interval_s=0.016)
def _(t: Array, random: Random) -> Columns:
    walks = (t < 20) | (t >= 65)
    way = 0.4 * (np.minimum(t, 20) + np.maximum(0, t - 65))
    marks = [0, 22, 24, 34, 36, 55, 58, 90]
    sitting = np.interp(t, marks, [0, 0, 1, 1, 0, 0, 0, 0])
    lying = np.interp(t, marks, [0, 0, 0, 0, 1, 1, 0, 0])
    gait = walks * np.sin(2 * TURN * t)
    knee = 1.1 + 0.7 * sitting + 1.0 * lying + 0.3 * gait
    return {
        "body.x": way + noise(random, t, 0.001),
        "body.y": noise(random, t, 0.001),
        "body.z": 0.30 - 0.08 * sitting - 0.22 * lying + 0.004 * gait + noise(random, t, 0.001),
        "imu.roll": 0.02 * gait + noise(random, t, 0.004),
        "imu.pitch": -0.65 * sitting + 0.02 * gait + noise(random, t, 0.004),
        "imu.yaw": noise(random, t, 0.004),
        "knee_target_rad": knee,
        "knee_position_rad": knee + noise(random, t, 0.004),
        "behaviour": chosen(
            (t < 20, "walk"), (t < 34, "sit"), (t < 55, "lie"), (t < 65, "stand"), otherwise="walk"
        ),
    }


# -- problems --------------------------------------------------------------------------------------


@_drawn("dead_encoder", lasts_s=60)
def _(t: Array, random: Random) -> Columns:
    target = 5 + 2 * np.sin(TURN * t / 15)
    columns: dict[str, Any] = {"cmd_vel.linear": 0.05 * target, "cmd_vel.angular": 0 * t}
    for wheel in ("front_left", "front_right", "rear_left", "rear_right"):
        dead = (t >= 20) & (wheel == "rear_left")
        columns[f"wheels.{wheel}.target_rad_s"] = target
        measured = target + noise(random, t, 0.05)
        columns[f"wheels.{wheel}.velocity_rad_s"] = np.where(dead, 0.0, measured)
        columns[f"wheels.{wheel}.pwm"] = np.where(dead, 255, np.round(24 * target)).astype(int)
    return columns


@_drawn("accelerometer_at_its_limit", lasts_s=90, interval_s=0.01)
def _(t: Array, random: Random) -> Columns:
    shaken = (t >= 40) & (t < 41)
    limit = 13 * GRAVITY
    calm = random.normal((0.0, 0.0, -GRAVITY), 1.2, (len(t), 3))
    shaken_values = random.normal((0.0, 0.0, -GRAVITY), (60, 60, 220), (len(t), 3))
    accel = np.clip(np.where(shaken[:, None], shaken_values, calm), -limit, limit)
    return {
        "accel_m_s2": accel,
        "airspeed_m_s": 17 + noise(random, t, 0.3),
        "attitude.roll": 0.05 * np.sin(t / 4) + noise(random, t, 0.004),
        "attitude.pitch": 0.04 + noise(random, t, 0.004),
        "altitude_m": 80 + 2 * np.sin(t / 11) + noise(random, t, 0.05),
        "mode": ["cruise"] * len(t),
    }


@_drawn("propeller_lost", lasts_s=40, interval_s=0.01)
def _(t: Array, random: Random) -> Columns:
    lost = np.maximum(0, t - 25)
    falling = np.minimum(lost, 2.0)
    rate = np.where(lost > 0, np.minimum(9.0, 14 * lost), 0.0) * (lost < 2.0)
    roll = np.cumsum(rate) * 0.01
    roll += (math.pi - roll[-1] % TURN) * np.clip((lost - 2.0) / 0.2, 0, 1)
    height = np.minimum(20, 2 * t) - np.where(lost > 0, GRAVITY / 2 * falling**2, 0)
    down = lost >= 2.0
    return {
        "pose.x": 0.5 * np.minimum(t, 26) + noise(random, t, 0.01),
        "pose.y": noise(random, t, 0.01),
        "pose.z": np.where(down, 0.1, np.maximum(0.1, height)) + noise(random, t, 0.01),
        "attitude.roll": wrapped(roll + noise(random, t, 0.004)),
        "attitude.pitch": 0.05 * ~down + noise(random, t, 0.004),
        "rates.roll_setpoint": np.where(lost > 0, -3.0, 0.2 * np.sin(t)) * ~down,
        "rates.roll": np.where(lost > 0, rate, 0.2 * np.sin(t)) + noise(random, t, 0.03),
        "thrust": np.where(down, 0.0, np.where(lost > 0, 0.9, 0.5)),
    }


@_drawn("position_glitch", lasts_s=60, interval_s=0.05)
def _(t: Array, random: Random) -> Columns:
    glitch = (t >= 30) & (t < 38)
    x, y = 0.3 * np.sin(t / 9), 0.3 * np.cos(t / 7)
    return {
        "gps.x": x + 10 * glitch + noise(random, t, 0.05),
        "gps.y": y + noise(random, t, 0.05),
        "estimate.x": x + noise(random, t, 0.01),
        "estimate.y": y + noise(random, t, 0.01),
        "altitude_m": 10 + noise(random, t, 0.05),
        "mode": ["loiter"] * len(t),
    }


@_drawn("through_the_floor", lasts_s=24)
def _(t: Array, random: Random) -> Columns:
    fallen = np.maximum(0, t - 18)
    return {
        **_pose(
            0.4 * np.minimum(t, 18) + noise(random, t, 0.001), noise(random, t, 0.001), 0 * t
        ),
        "pose.z": 0.12 - GRAVITY / 2 * fallen**2 + noise(random, t, 0.001),
        "imu.roll": 0.1 * fallen + noise(random, t, 0.003),
        "imu.pitch": 0.15 * fallen + noise(random, t, 0.003),
        "wheels.left": 0 * t + 4,
        "wheels.right": 0 * t + 4,
    }  # fmt: skip


@_drawn("compass_and_motors", lasts_s=90, interval_s=0.05)
def _(t: Array, random: Random) -> Columns:
    drives = ((t >= 10) & (t < 35)) | ((t >= 45) & (t < 80))
    true = 40 + 15 * np.sin(TURN * t / 60)
    pull = drives * (50 + 40 * np.sin(TURN * t / 6))
    return {
        "compass_heading_deg": (true + pull + noise(random, t, 0.8)) % 360,
        "gyro_heading_deg": (true + noise(random, t, 0.2)) % 360,
        "motors.left": 0.5 * drives,
        "motors.right": 0.5 * drives,
    }


@_drawn("spins_instead_of_driving", lasts_s=50)
def _(t: Array, random: Random) -> Columns:
    on = (t >= 5) & (t < 35)
    yaw = np.cumsum(1.4 * on) * 0.032
    return {
        **_pose(
            0.01 * np.sin(yaw) + noise(random, t, 3e-4),
            0.01 * np.cos(yaw) + noise(random, t, 3e-4),
            wrapped(yaw + noise(random, t, 0.002)),
        ),
        "cmd_vel.linear": 0.4 * on,
        "cmd_vel.angular": 0 * t,
    }


@_drawn("temperature_spikes", lasts_s=240, interval_s=0.05)
def _(t: Array, random: Random) -> Columns:
    knee = 40 + 3 * (1 - np.exp(-t / 120))
    reading = (knee + noise(random, t, 0.15)).round(1)
    reading[random.choice(len(t), 12, replace=False)] = random.uniform(100, 130, 12).round(1)
    return {
        "knee_motor_temp_c": reading,
        "hip_motor_temp_c": (38 + 2 * (1 - np.exp(-t / 100)) + noise(random, t, 0.15)).round(1),
        "knee_position_rad": 0.4 * np.sin(TURN * t / 2),
    }


@_drawn("gripper_loses_a_block", lasts_s=30)
def _(t: Array, random: Random) -> Columns:
    closed = t >= 5
    lost = t >= 14
    lift = np.interp(t, [0, 8, 20, 30], [0.05, 0.05, 0.45, 0.45])
    fall = np.maximum(0.05, lift[t < 14][-1] - GRAVITY / 2 * np.maximum(0, t - 14) ** 2)
    held = closed & ~lost
    opening = np.interp(t, [0, 5, 6, 14, 14.3, 30], [0.08, 0.08, 0.04, 0.04, 0.0, 0.0])
    return {
        "gripper.command": 1.0 * closed,
        "gripper.force_n": held * (12 + noise(random, t, 0.2)),
        "gripper.opening_m": opening + noise(random, t, 1e-4),
        "tool.z_m": lift + noise(random, t, 3e-4),
        "block.z_m": np.where(lost, fall, np.where(closed, lift, 0.05)) + noise(random, t, 3e-4),
        "phase": chosen((t < 5, "approach"), (t < 8, "grasp"), (t < 20, "lift"), otherwise="place"),
    }


@_drawn("estimate_freezes", lasts_s=70, interval_s=0.05)
def _(t: Array, random: Random) -> Columns:
    heading = 0.6 * np.sin(t / 12)
    x, y = np.cumsum(0.5 * np.cos(heading)) * 0.05, np.cumsum(0.5 * np.sin(heading)) * 0.05
    at = np.minimum(np.arange(len(t)), np.searchsorted(t, 25.0))
    return {
        "odom.x": x * 1.01,
        "odom.y": y * 1.01,
        "filtered.x": (x + noise(random, t, 0.004))[at],
        "filtered.y": (y + noise(random, t, 0.004))[at],
        "filtered.yaw": heading + noise(random, t, 0.002),
        "wheels.left": 5 - 0.2 * np.cos(t / 12),
        "wheels.right": 5 + 0.2 * np.cos(t / 12),
    }
