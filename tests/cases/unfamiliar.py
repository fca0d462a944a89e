"""Robots of kinds that no rule was made with: healthy at three rates, and with one fault.

What each answer should be was written down before the first question was asked.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from tests.cases.columns import TURN, Array, Random, chosen, noise, wrapped
from tests.cases.situations import Columns, Recording, Situation, recorded

INTERVALS_S: Final = (0.016, 0.05, 0.2)
FAULTY_INTERVAL_S: Final = 0.05
RIGHT, HELPFUL, NOT_JUDGED, DENIED, FALSE = (
    "right",
    "helpful",
    "not judged",
    "denied",
    "false alarm",
)
GOOD: Final = "quiet"
# Of the first answers, before a rule was changed for what was missed: of 15 robots, then of 10.
FIRST_ANSWERS: Final = {
    GOOD: 39 + 30,
    FALSE: 6,
    RIGHT: 10 + 8,
    HELPFUL: 3 + 2,
    NOT_JUDGED: 2,
    DENIED: 0,
}
Draw = Callable[[Array, Random, bool], Columns]


@dataclass(frozen=True)
class Robot:
    """A robot, and what is wrong with it where it is faulty.

    Attributes:
        draw: Its columns, given times, a random generator and whether it is faulty.
        fault: What is wrong, for a person.
        check: The check that has to warn or fail.
        kind: The kind of event that shows it.
        names: A pattern of what the answer has to name.
        at_s: When it begins.
        within_s: How exactly that has to be known.
    """

    draw: Draw
    lasts_s: float
    fault: str
    check: str
    kind: str
    names: str
    at_s: float
    within_s: float = 2.0


ROBOTS: Final[dict[str, Robot]] = {}


def robot(name: str, lasts_s: float, **label: Any) -> Callable[[Draw], Draw]:
    def register(draw: Draw) -> Draw:
        ROBOTS[name] = Robot(draw, lasts_s, **label)
        return draw

    return register


def ramped(t: Array, marks: Sequence[float], values: Sequence[float]) -> Array:
    return np.interp(t, marks, values)


@robot(
    "gantry", 70, fault="its y axis stalls at 30 s while its target goes on",
    check="follows its targets", kind="off_target", names="y", at_s=31,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    marks = [0, 5, 12, 18, 25, 30, 38, 45, 52, 60, 70]
    aims = {
        "x": ramped(t, marks, [0, 0, 1.2, 1.2, 0.4, 0.4, 1.5, 1.5, 0.2, 0.2, 0.9]),
        "y": ramped(t, marks, [0, 0.5, 0.5, 0.9, 0.9, 0.1, 0.8, 0.8, 0.3, 0.6, 0.6]),
        "z": ramped(t, marks, [0.3, 0.3, 0.1, 0.3, 0.1, 0.3, 0.1, 0.3, 0.1, 0.3, 0.3]),
    }
    columns: dict[str, Any] = {}
    for axis, aim in aims.items():
        lag = np.interp(t - 0.06, t, aim)
        stalled = faulty & (axis == "y") & (t >= 30)
        at = np.where(stalled, lag[np.argmax(t >= 30)], lag)
        columns[f"axes.{axis}.target_m"] = aim
        columns[f"axes.{axis}.position_m"] = at + noise(random, t, 2e-4)
        columns[f"axes.{axis}.motor_current_a"] = (
            0.8 + 3 * np.abs(np.gradient(at, t)) + noise(random, t, 0.05)
        )
    columns["program_line"] = np.searchsorted(marks, t).astype(int)
    return columns


@robot(
    "rocker-bogie rover", 90, fault="the motor of its rear left wheel is dead from 40 s on",
    check="follows its targets", kind="off_target", names="rear_left|rl", at_s=40,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    speed = 0.05 * ramped(t, [0, 3, 5, 60, 62, 66, 68, 90], [0, 0, 1, 1, 0, 0, 1, 1])
    heading = 0.4 * np.sin(TURN * t / 80)
    step = t[1] - t[0]
    columns: dict[str, Any] = {
        "pose.x": np.cumsum(speed * np.cos(heading)) * step + noise(random, t, 0.003),
        "pose.y": np.cumsum(speed * np.sin(heading)) * step + noise(random, t, 0.003),
        "pose.yaw": heading + noise(random, t, 0.004),
        "rocker_deg": 8 * np.sin(TURN * t / 13) + noise(random, t, 0.2),
        "bogie_deg": 11 * np.sin(TURN * t / 9 + 1) + noise(random, t, 0.2),
        "bus_v": 28.4 - 0.004 * t + noise(random, t, 0.02),
    }
    for at, wheel in enumerate(
        f"{end}_{side}" for end in ("front", "middle", "rear") for side in ("left", "right")
    ):
        slope = 1 + 0.04 * np.sin(TURN * t / 7 + at)
        dead = faulty & (wheel == "rear_left") & (t >= 40)
        columns[f"drive.{wheel}.target_rad_s"] = speed / 0.125
        turns = np.where(dead, 0.0, speed / 0.125 * slope)
        columns[f"drive.{wheel}.speed_rad_s"] = turns + noise(random, t, 0.004)
    return columns


@robot(
    "sailing dinghy", 160, fault="its rudder jams at 80 s while the autopilot goes on",
    check="follows its targets", kind="off_target", names="rudder", at_s=80, within_s=4,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    port = (t // 40) % 2 == 0
    course = 45 + 45 * ~port + 3 * np.sin(TURN * t / 6)
    rudder = 9 * np.sin(TURN * t / 6 + 1) + 20 * np.exp(-(t % 40) / 1.5) * (t > 40)
    measured = np.interp(t - 0.25, t, rudder)
    measured = np.where(faulty & (t >= 80), measured[np.argmax(t >= 80)], measured)
    speed = 2.1 * (1 - 0.5 * np.exp(-(t % 40) / 4))
    step = t[1] - t[0]
    return {
        "gps.x": np.cumsum(speed * np.cos(np.radians(course))) * step + noise(random, t, 0.2),
        "gps.y": np.cumsum(speed * np.sin(np.radians(course))) * step + noise(random, t, 0.2),
        "heading_deg": course + noise(random, t, 0.8),
        "heel_deg": np.where(port, 16, -16) + 3 * np.sin(TURN * t / 5) + noise(random, t, 0.4),
        "rudder.target_deg": rudder,
        "rudder.angle_deg": measured + noise(random, t, 0.15),
        "wind.speed_m_s": 7 + np.sin(TURN * t / 31) + noise(random, t, 0.4),
        "sheet_m": np.where(port, 1.4, 1.5) + noise(random, t, 0.005),
    }


@robot(
    "trotting quadruped", 50, fault="its rear right knee hangs limp from 25 s on",
    check="follows its targets", kind="off_target", names="rr", at_s=25,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    trots = (t >= 5) & (t < 45)
    phase = TURN * 1.6 * t
    columns: dict[str, Any] = {
        "base.x": 0.6 * np.clip(t - 5, 0, 40) + noise(random, t, 0.002),
        "base.y": noise(random, t, 0.002),
        "base.z": 0.32 + 0.006 * trots * np.sin(2 * phase) + noise(random, t, 0.001),
        "imu.roll": 0.03 * trots * np.sin(phase) + noise(random, t, 0.004),
        "imu.pitch": 0.02 * trots * np.sin(2 * phase) + noise(random, t, 0.004),
        "cmd.forward_m_s": 0.6 * trots,
    }
    for at, leg in enumerate(("fl", "fr", "rl", "rr")):
        shift = math.pi * (at in (1, 2))
        for joint, middle, size in (("hip", 0.0, 0.06), ("thigh", 0.8, 0.35), ("knee", -1.5, 0.4)):
            aim = middle + size * trots * np.sin(phase + shift)
            follows = middle + size * trots * 0.96 * np.sin(phase + shift - 0.2)
            limp = faulty & (leg == "rr") & (joint == "knee") & (t >= 25)
            hangs = -1.1 + 0.03 * trots * np.sin(2 * phase)
            columns[f"legs.{leg}.{joint}.target_rad"] = aim
            columns[f"legs.{leg}.{joint}.position_rad"] = np.where(limp, hangs, follows) + noise(
                random, t, 0.004
            )
        columns[f"legs.{leg}.foot_force_n"] = np.maximum(
            0, 60 + 60 * trots * np.sin(phase + shift) + noise(random, t, 2)
        )
    return columns


@robot(
    "paint robot", 80, fault="its pressure reading is frozen from 30 to 48 s",
    check="sensors live", kind="flat", names="pressure", at_s=30,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    sprays = (t % 20 >= 4) & (t % 20 < 17)
    pressure = 2.4 + 0.3 * sprays + 0.05 * np.sin(t / 3) + noise(random, t, 0.01)
    frozen = faulty & (t >= 30) & (t < 48)
    pressure = np.where(frozen, pressure[np.argmax(t >= 30)], pressure)
    columns: dict[str, Any] = {
        "spray": sprays,
        "paint.pressure_bar": pressure,
        "paint.flow_ml_min": sprays * 210 + noise(random, t, 1.5),
        "bell_rpm": 32_000 + 400 * np.sin(t / 5) + noise(random, t, 60),
    }
    for joint in range(1, 7):
        aim = 0.4 * np.sin(TURN * t / (9 + joint)) + 0.1 * joint
        columns[f"joint{joint}.target_rad"] = aim
        columns[f"joint{joint}.actual_rad"] = np.interp(t - 0.03, t, aim) + noise(random, t, 3e-4)
    return columns


@robot(
    "warehouse vehicle with a lift", 120, fault="its lift stops half way up at 44 s",
    check="follows its targets", kind="off_target", names="lift", at_s=46, within_s=4,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    step = t[1] - t[0]
    speed = ramped(t, [0, 5, 7, 30, 32, 75, 77, 100, 102, 120], [0, 0, 1, 1, 0, 0, 1, 1, 0, 0])
    up = 0.6 * ((t >= 40) & (t < 70))
    lift = np.clip((t - 40) * 0.08, 0, 0.6) - np.clip((t - 70) * 0.08, 0, 0.6)
    lift = np.where(faulty & (t < 70), np.minimum(lift, 0.32), lift)
    lift = np.where(faulty & (t >= 70), np.clip(0.32 - (t - 70) * 0.08, 0, 1), lift)
    return {
        "odometry.x": np.cumsum(speed) * step + noise(random, t, 0.002),
        "odometry.y": noise(random, t, 0.002),
        "odometry.yaw": noise(random, t, 0.002),
        "cmd_speed_m_s": speed,
        "wheels.left_rad_s": speed / 0.1 + noise(random, t, 0.05),
        "wheels.right_rad_s": speed / 0.1 + noise(random, t, 0.05),
        "lift.height_m": lift + noise(random, t, 5e-4),
        "lift.target_height_m": up,
        "load_kg": 240 * ((t >= 42) & (t < 74)) + noise(random, t, 0.8),
        "battery_pct": np.round(84 - t / 60),
        "task": chosen(
            (t < 5, "wait"), (t < 32, "fetch"), (t < 75, "lift"), (t < 102, "bring"),
            otherwise="wait",
        ),
    }  # fmt: skip


@robot(
    "drone that drops a payload", 90, fault="its rangefinder reads 0 for moments from 50 s on",
    check="sensors drop nothing", kind="jump", names="range", at_s=50, within_s=3,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    height = ramped(t, [0, 4, 14, 70, 84, 90], [0, 0, 12, 12, 0, 0])
    range_m = height + 0.1 + noise(random, t, 0.02)
    if faulty:
        for start_s in (50, 53, 55.5, 58, 61, 66):
            range_m[(t >= start_s) & (t < start_s + 0.25)] = 0.0
    flies = (t >= 4) & (t < 84)
    thrust = flies * np.where(t < 40, 0.71, 0.52)
    return {
        "position.x": 2 * np.clip(t - 16, 0, 20) + noise(random, t, 0.03),
        "position.y": noise(random, t, 0.03),
        "position.z": height + noise(random, t, 0.03),
        "attitude.roll": 0.02 * flies * np.sin(t) + noise(random, t, 0.005),
        "attitude.pitch": -0.1 * ((t > 16) & (t < 36)) + noise(random, t, 0.005),
        "range_down_m": range_m,
        "thrust": thrust + flies * noise(random, t, 0.004),
        "payload_attached": t < 40,
        "flight_mode": chosen(
            (t < 4, "idle"), (t < 70, "auto"), (t < 84, "land"), otherwise="idle"
        ),
    }


@robot(
    "cable-driven camera", 80, fault="its length sensor 2 becomes five times as noisy at 35 s",
    check="sensors keep their noise", kind="degradation", names="cables?.*2|length.*2", at_s=35,
    within_s=3,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    x, y, z = 6 * np.sin(TURN * t / 40), 4 * np.sin(TURN * t / 27), 5 + np.cos(TURN * t / 33)
    columns: dict[str, Any] = {"camera.x": x, "camera.y": y, "camera.z": z}
    for at, (ax, ay) in enumerate(((10, 8), (-10, 8), (-10, -8), (10, -8)), start=1):
        length = np.sqrt((x - ax) ** 2 + (y - ay) ** 2 + (z - 12) ** 2)
        grown = np.where(faulty & (at == 2) & (t >= 35), 5.0, 1.0)
        columns[f"cable{at}.distance_m"] = length + grown * noise(random, t, 0.002)
        columns[f"cable{at}.tension_n"] = 140 + 4 * length + noise(random, t, 1.5)
    return columns


@robot(
    "tracked excavator", 90, fault="its tracks slip from 30 to 50 s",
    check="wheels grip", kind="slip", names="roll|track|slip", at_s=30, within_s=3,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    step = t[1] - t[0]
    drives = ramped(t, [0, 4, 6, 58, 60, 90], [0, 0, 1, 1, 0, 0])
    slips = np.where(faulty & (t >= 30) & (t < 50), 0.2, 1.0)
    digs = (t >= 60) * 0.4 * np.sin(TURN * (t - 60) / 15)
    return {
        "position.x": np.cumsum(0.8 * drives * slips) * step + noise(random, t, 0.01),
        "position.y": noise(random, t, 0.01),
        "heading_rad": 0.3 + noise(random, t, 0.003),
        "wheels.left_track_rad_s": 2 * drives + noise(random, t, 0.02),
        "wheels.right_track_rad_s": 2 * drives + noise(random, t, 0.02),
        "boom_rad": 0.6 + digs + noise(random, t, 0.002),
        "stick_rad": -1.1 + digs + noise(random, t, 0.002),
        "pump_pressure_bar": 60 + 110 * np.abs(digs) + 40 * drives + noise(random, t, 1.5),
        "coolant_c": np.round(71 + 9 * (1 - np.exp(-t / 60)) + noise(random, t, 0.1), 1),
    }


@robot(
    "snake robot", 60, fault="the encoder of its joint 5 gives no number from 30 s on",
    check="sensors speak", kind="missing", names="joint5|joint.*5", at_s=30,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    columns: dict[str, Any] = {
        "head.x": 0.05 * t + 0.02 * np.sin(TURN * t / 2) + noise(random, t, 0.001),
        "head.y": 0.04 * np.sin(TURN * t / 2) + noise(random, t, 0.001),
    }
    for joint in range(1, 9):
        aim = 0.5 * np.sin(TURN * t / 2 - 0.7 * joint)
        at = np.interp(t - 0.05, t, aim) + noise(random, t, 0.003)
        columns[f"joint{joint}.target_rad"] = aim
        gone = faulty & (joint == 5) & (t >= 30)
        columns[f"joint{joint}.position_rad"] = np.where(gone, math.nan, at)
        columns[f"joint{joint}.temperature_c"] = np.round(
            30 + 4 * (1 - np.exp(-t / 90)) + noise(random, t, 0.15), 1
        )
    return columns


@robot(
    "blimp", 200, fault="its heading oscillates more and more from 60 s on",
    check="stays stable", kind="oscillation", names="heading|yaw|rudder", at_s=60, within_s=25,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    aim = ramped(t, [0, 5, 5.01, 110, 110.01, 200], [10, 10, 30, 30, 18, 18])
    tracked, value, step = list[float](), 10.0, float(t[1] - t[0])
    for wanted in aim.tolist():
        value += max(-0.5 * step, min(0.5 * step, (wanted - value) * 0.2 * step))
        tracked.append(value)
    size = 2.0 * np.exp(np.clip(t - 60, 0, 140) / 45) if faulty else 2.0
    swing = size * np.sin(TURN * t / 11)
    return {
        "gps.x": 1.5 * t + noise(random, t, 0.4),
        "gps.y": noise(random, t, 0.4),
        "height_m": np.array(tracked) + noise(random, t, 0.1),
        "height_target_m": aim,
        "heading_deg": 90 + swing + noise(random, t, 0.3),
        "rudder": -0.02 * swing + noise(random, t, 0.004),
        "envelope_pressure_pa": 420 + 6 * np.sin(t / 40) + noise(random, t, 2),
        "motors.left": 0.6 + noise(random, t, 0.005),
        "motors.right": 0.6 + noise(random, t, 0.005),
    }


@robot(
    "soccer robot", 80, fault="it pushes against another robot from 40 to 52 s and goes nowhere",
    check="moves when commanded", kind="stuck", names="stuck", at_s=40,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    step = t[1] - t[0]
    leg = (t // 10) % 2 == 0
    speed = np.where(leg, 0.7, -0.7) * (t % 10 < 9)
    held = faulty & (t >= 40) & (t < 52)
    x = np.cumsum(np.where(held, 0, speed)) * step
    seen = (t % 10 > 1.5) & (t % 10 < 8)
    ball = np.round(2.5 - 0.2 * (t % 10) + noise(random, t, 0.02), 3)
    return {
        "pose.x": x + noise(random, t, 0.004),
        "pose.y": noise(random, t, 0.004),
        "pose.theta": noise(random, t, 0.004),
        "cmd_vel.linear": speed,
        "cmd_vel.angular": 0 * t,
        "ball": [{"distance_m": each} if is_seen else None
                 for each, is_seen in zip(ball.tolist(), seen.tolist(), strict=True)],
        "kicker_v": 180 - 60 * np.exp(-(t % 10)) + noise(random, t, 0.5),
        "role": chosen((leg, "attacker"), otherwise="defender"),
    }  # fmt: skip


@robot(
    "self-balancing scooter", 60, fault="it falls over at 33 s",
    check="stays upright", kind="fall", names="fell|tilt", at_s=33,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    step = t[1] - t[0]
    drives = ramped(t, [0, 5, 8, 50, 53, 60], [0, 0, 1, 1, 0, 0])
    falls = np.clip((t - 33) / 0.8, 0, 1) if faulty else 0 * t
    speed = 0.9 * drives * (falls < 0.5)
    pitch = 0.05 * np.gradient(drives, t) + 0.015 * np.sin(TURN * t / 1.7)
    return {
        "pose.x": np.cumsum(speed) * step + noise(random, t, 0.003),
        "pose.y": noise(random, t, 0.003),
        "pitch_rad": pitch + 1.5 * falls + noise(random, t, 0.004),
        "roll_rad": noise(random, t, 0.004),
        "wheel_left_rad_s": speed / 0.15 + 0.4 * np.sin(TURN * t / 1.7) + noise(random, t, 0.05),
        "wheel_right_rad_s": speed / 0.15 + 0.4 * np.sin(TURN * t / 1.7) + noise(random, t, 0.05),
        "battery_v": 36.2 - 0.4 * drives + noise(random, t, 0.03),
    }


@robot(
    "planting robot", 100, fault="its position jumps by 3 m at 45 s",
    check="stays in place", kind="jump", names="position", at_s=45,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    step = t[1] - t[0]
    drives = (t % 12) < 8
    plants = ~drives & ((t % 12) > 9) & ((t % 12) < 11)
    jumped = 3.0 * (faulty & (t >= 45))
    tray = np.maximum(0, 20 - (t // 12)).astype(int)
    return {
        "rtk.x": np.cumsum(0.5 * drives) * step + jumped + noise(random, t, 0.008),
        "rtk.y": noise(random, t, 0.008),
        "commanded_m_s": 0.5 * drives,
        "auger.speed_rpm": 900 * plants + noise(random, t, 3) * plants,
        "auger.depth_mm": np.where(plants, 180, 0) + noise(random, t, 0.5),
        "tray_left": tray,
        "soil_moisture_pct": np.round(31 + 4 * np.sin(t / 30) + noise(random, t, 0.3), 1),
        "state": chosen((plants, "plant"), (drives, "drive"), otherwise="align"),
    }


@robot(
    "underwater glider", 300, fault="its compass is 1.2 rad off its gyro from 150 s on",
    check="estimates agree", kind="", names="heading", at_s=150, within_s=5,
)  # fmt: skip
def _(t: Array, random: Random, faulty: bool) -> Columns:
    depth = ramped(t, [0, 20, 80, 140, 170, 230, 280, 300], [0, 0, 25, 0, 0, 25, 0, 0])
    dives = np.sign(np.gradient(depth, t))
    heading = 1.1 + 0.2 * np.sin(TURN * t / 150)
    off = 1.2 * np.clip((t - 150) / 2, 0, 1) * faulty
    fix = [
        {"lat": 54.1 + 2e-6 * now, "lon": 7.9} if under < 0.2 else None
        for now, under in zip(t.tolist(), depth.tolist(), strict=True)
    ]
    return {
        "gps": fix,
        "depth_m": np.round(depth + noise(random, t, 0.02), 2),
        "pitch_rad": -0.45 * dives + noise(random, t, 0.005),
        "roll_rad": noise(random, t, 0.005),
        "heading_compass_rad": wrapped(heading + off + noise(random, t, 0.01)),
        "heading_gyro_rad": wrapped(heading + noise(random, t, 0.003)),
        "buoyancy_cc": 200 * -dives + noise(random, t, 0.4),
        "hull_temperature_c": np.round(12 - 0.2 * depth + noise(random, t, 0.05), 1),
    }


def situation_of(name: str, interval_s: float, *, faulty: bool) -> Situation:
    """Return the recording of a robot at a rate, healthy or with its fault."""
    robot = ROBOTS[name]

    def draw(t: Array, random: Random) -> Columns:
        return robot.draw(t, random, faulty)

    return Situation(f"{name} at {interval_s:g} s", draw, (), robot.lasts_s, interval_s)


def ask_healthy(name: str, interval_s: float) -> tuple[str, str]:
    """Return whether a healthy robot is quiet, and what was said."""
    with recorded(situation_of(name, interval_s, faulty=False)) as asked:
        alarms = [f"{each.name}: {each.evidence}" for each in asked.checked.of("warn", "fail")]
        return (FALSE if alarms else GOOD), "; ".join(alarms)


def ask_faulty(name: str) -> tuple[str, str]:
    """Return how a faulty robot is answered, and what was said."""
    robot = ROBOTS[name]
    with recorded(situation_of(name, FAULTY_INTERVAL_S, faulty=True)) as asked:
        return _judged(asked, robot)


def _judged(asked: Recording, robot: Robot) -> tuple[str, str]:
    alarms = asked.checked.of("warn", "fail")
    said = "; ".join(f"{each.name} @{each.since_s}: {each.evidence}" for each in alarms)
    for each in alarms:
        if each.name != robot.check or not re.search(robot.names, each.evidence, re.I):
            continue
        if each.since_s is not None and abs(each.since_s - robot.at_s) <= robot.within_s:
            return RIGHT, said
    if alarms and any(each.name == robot.check for each in alarms):
        return HELPFUL, said
    events = [each for each in asked.events().events if each.kind == robot.kind]
    if any(
        abs(each.start_s - robot.at_s) <= robot.within_s
        and (each.name is None or re.search(robot.names, each.name))
        for each in events
    ):
        return HELPFUL, f"event; {said}"
    (finding,) = (each for each in asked.checked.findings if each.name == robot.check)
    said = f"{finding.outcome}: {finding.evidence}; {said}"
    return (DENIED if finding.outcome == "pass" else NOT_JUDGED), said


def main() -> None:
    """Print how each robot is answered, and how many of each answer there are."""
    wanted = sys.argv[1:] or [*ROBOTS]
    counts: dict[str, int] = {}
    for name in wanted:
        answers = [(f"healthy, {each:g} s", *ask_healthy(name, each)) for each in INTERVALS_S]
        answers.append((f"faulty: {ROBOTS[name].fault}", *ask_faulty(name)))
        for what, answer, said in answers:
            counts[answer] = counts.get(answer, 0) + 1
            print(f"{answer:12} {name}, {what}\n             {said[:600]}", flush=True)
    print(counts)


if __name__ == "__main__":
    main()
