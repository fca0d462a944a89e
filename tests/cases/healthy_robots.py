"""Healthy robots of many kinds: an alarm about any of them is false."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from tests.cases.columns import TURN, Array, Random, chosen, noise, wrapped
from tests.cases.situations import HEALTHY, Columns, none_of, quiet, situation

_healthy = partial(situation, HEALTHY)


@_healthy(
    "a quadrotor hovers, flies a leg, hovers and lands",
    quiet,
    none_of("stuck"),
    lasts_s=70,
    interval_s=0.016,
    source="PX4 hover logs",
)
def _(t: Array, random: Random) -> Columns:
    height = np.where(t < 60, np.minimum(2, 0.5 * t), np.maximum(0, 2 - 0.4 * (t - 60)))
    return {
        "pose.x": np.clip(0.5 * (t - 30), 0, 3) + noise(random, t, 0.004),
        "pose.y": noise(random, t, 0.004),
        "pose.z": height + noise(random, t, 0.004),
        "attitude.roll": noise(random, t, 0.004),
        "attitude.pitch": noise(random, t, 0.004),
        "attitude.yaw": 0.3 + noise(random, t, 0.003),
        "motors": random.normal(68, 0.3, (len(t), 4)),
        "mode": chosen(
            (t < 5, "takeoff"), (t < 30, "hover"), (t <= 36, "mission"), (t < 60, "hover"),
            otherwise="land",
        ),
        "battery_v": 12.6 - 0.01 * t,
    }  # fmt: skip


@_healthy(
    "a drone whose z axis points down holds its place and flies",
    quiet,
    none_of("stuck"),
    lasts_s=60,
    source="PX4 logs in north-east-down frames",
)
def _(t: Array, random: Random) -> Columns:
    return {
        "pose.x": 0.8 * np.clip(t - 20, 0, 20) + noise(random, t, 0.005),
        "pose.y": noise(random, t, 0.005),
        "pose.z": -4.7 + noise(random, t, 0.01),
        "motors": random.normal(0.62, 0.004, (len(t), 4)),
        "mode": chosen((t < 20, "hold"), otherwise="position"),
    }


@_healthy("a robot charges for two minutes, cooled by a fan", quiet, none_of("stuck"), lasts_s=180)
def _(t: Array, random: Random) -> Columns:
    drives = t >= 120
    return {
        "pose.x": np.maximum(0, 0.2 * (t - 120)),
        "pose.y": 0 * t,
        "pose.yaw": 0 * t,
        "motors.fan": 40 + noise(random, t, 0.2),
        "wheels.left": 6.0 * drives,
        "wheels.right": 6.0 * drives,
        "mode": chosen((drives, "drive"), otherwise="charge"),
    }


@_healthy("the charge current is 0 once a robot has left its dock", quiet, lasts_s=120)
def _(t: Array, random: Random) -> Columns:
    docked = t < 60
    return {
        "pose.x": np.maximum(0, 0.2 * (t - 60)),
        "pose.y": 0 * t,
        "pose.yaw": 0 * t,
        "charge_current_a": docked * (2 + noise(random, t, 0.01)),
        "battery_percent": np.where(docked, 50 + t / 6, 70 - t / 6).round(),
        "cmd_vel": 0.2 * ~docked,
    }


@_healthy("a cleaning robot travels with its brush switched off", quiet, lasts_s=120)
def _(t: Array, random: Random) -> Columns:
    off = (t >= 40) & (t < 80)
    return {
        "pose.x": 0.2 * t,
        "pose.y": 0 * t,
        "pose.yaw": 0 * t,
        "brush_current_a": ~off * (0.8 + noise(random, t, 0.02)),
        "mode": chosen((off, "travel"), otherwise="clean"),
    }


@_healthy("a boat drifts in the waves with its engine off", quiet, lasts_s=120, interval_s=0.064)
def _(t: Array, random: Random) -> Columns:
    off = (t >= 20) & (t < 80)
    way = 1.5 * np.minimum(t, 20) + 0.15 * np.clip(t - 20, 0, 60) + 1.5 * np.maximum(0, t - 80)
    return {
        "gps.x": way + noise(random, t, 0.03),
        "gps.y": 0.05 * t + noise(random, t, 0.03),
        "heading_deg": (350 + 0.6 * t + 3 * np.sin(t / 6)) % 360,
        "roll": 0.15 * np.sin(0.2 * TURN * t) + noise(random, t, 0.002),
        "engine_rpm": ~off * (1800 + noise(random, t, 10)),
        "mode": chosen((off, "drift"), otherwise="cruise"),
    }


@_healthy("a suction gripper holds for 3 of every 8 s", quiet, lasts_s=120)
def _(t: Array, random: Random) -> Columns:
    holds = (t % 8 >= 2) & (t % 8 < 5)
    return {
        "suction_kpa": holds * (-60 + noise(random, t, 0.4)),
        "pump_current_a": holds * (1.2 + noise(random, t, 0.02)),
        "state": chosen((holds, "hold"), otherwise="free"),
    }


@_healthy("a conveyor runs for 20 s, stops for 5 s and counts parts", quiet, lasts_s=150)
def _(t: Array, random: Random) -> Columns:
    runs = t % 25 < 20
    return {
        "belt.speed_m_s": runs * (0.4 + noise(random, t, 0.003)),
        "belt.running": runs,
        "beam": runs & (t % 2 < 0.3),
        "items": (10 * (t // 25) + np.minimum(t % 25, 20) // 2).astype(int),
        "motor_temp_c": 35 + 5 * (1 - np.exp(-t / 60)),
    }


@_healthy("the feet of a walking robot carry its weight in turn", quiet, lasts_s=60)
def _(t: Array, random: Random) -> Columns:
    left = t % 1 < 0.6
    force = 20 + noise(random, t, 0.5)
    return {
        "pose.x": 0.3 * t,
        "pose.y": 0 * t,
        "pose.yaw": 0 * t,
        "foot_force_n": np.column_stack([left * force, ~left * force]),
        "imu.roll": 0.03 * np.sin(TURN * t),
        "imu.pitch": 0.02 * np.sin(2 * TURN * t),
        "mode": ["walk"] * len(t),
    }


@_healthy("a balancing robot sways by a centimetre on two wheels", quiet, lasts_s=60)
def _(t: Array, random: Random) -> Columns:
    hunting = 1.2 * np.cos(TURN * t)
    return {
        "pose.x": 0.01 * np.sin(TURN * t) + noise(random, t, 0.0003),
        "pose.y": 0 * t,
        "pose.yaw": 0 * t,
        "pitch": 0.02 * np.cos(TURN * t) + noise(random, t, 0.0005),
        "wheels.left": hunting,
        "wheels.right": hunting,
        "mode": ["balance"] * len(t),
    }


@_healthy("a light sensor reads 0 in three tunnels", quiet, lasts_s=120)
def _(t: Array, random: Random) -> Columns:
    dark = np.any([(t >= start) & (t < start + 4) for start in (20, 50, 90)], axis=0)
    return {
        "pose.x": 0.5 * t,
        "pose.y": 0 * t,
        "pose.yaw": 0 * t,
        "lux": ~dark * (300 + noise(random, t, 4)),
        "speed_m_s": 0 * t + 0.5,
    }


@_healthy("a car shifts through its gears and waits at a red light", quiet, lasts_s=120)
def _(t: Array, random: Random) -> Columns:
    pull = np.select([t < 10, t < 50, t < 60, t < 70, t < 80], [3.0, 0.0, -3.0, 0.0, 3.0], 0.0)
    speed = np.interp(t, [0, 10, 50, 60, 70, 80, 120], [0, 30, 30, 0, 0, 30, 30])
    way = np.cumsum(speed) * 0.032
    return {
        "gps": np.column_stack([way, 20 * np.sin(way / 300)]) + random.normal(0, 0.02, (len(t), 2)),
        "speed_m_s": speed + noise(random, t, 0.02),
        "throttle": np.maximum(0, pull / 3),
        "brake": np.maximum(0, -pull / 3),
        "gear": np.minimum(5, 1 + speed // 7).astype(int),
        "rpm": 900 + 500 * (speed % 7) + noise(random, t, 8),
        "state": chosen(((t >= 60) & (t < 70), "wait"), otherwise="drive"),
    }


@_healthy("encoder counters of 16 bits wrap around", quiet, none_of("jump"), lasts_s=90)
def _(t: Array, random: Random) -> Columns:
    way_mm = 200 * (np.minimum(t, 30) + np.maximum(0, t - 40))
    ticks = (4.2 * way_mm).astype(int) % 65536
    return {
        "x_mm": way_mm.round(),
        "y_mm": 0 * t,
        "heading_deg": 0 * t + 6,
        "enc_left": ticks,
        "enc_right": ticks,
        "cmd_mm_s": np.where((t >= 30) & (t < 40), 0, 200),
    }


@_healthy(
    "boxes pass the proximity sensors of a driving robot",
    quiet,
    lasts_s=90,
    source="the rover of the demo, and an e-puck",
)
def _(t: Array, random: Random) -> Columns:
    near = np.maximum(0, 1 - np.abs(t % 15 - 7) / 0.8)
    return {
        "pose.x": 0.1 * t,
        "pose.y": 0 * t,
        "pose.yaw": 0 * t,
        "distance_m.left": 1 - 0.65 * near + noise(random, t, 0.004),
        "distance_m.right": 1 + noise(random, t, 0.004),
        "mode": ["cruise"] * len(t),
    }


@_healthy(
    "a receiver counts the packets that wait",
    quiet,
    lasts_s=40,
    source="robocup-junior/rcj-soccersim",
)
def _(t: Array, random: Random) -> Columns:
    waiting = np.full(len(t), 2)
    waiting[::50] = random.choice((0, 3, 4), len(waiting[::50]))
    return {"radio.queue_length": waiting, "x": 0.1 * t, "y": 0 * t}


@_healthy(
    "a rounded tilt changes by one last digit and back",
    quiet,
    none_of("jump"),
    lasts_s=40,
    source="a public drone log",
)
def _(t: Array, random: Random) -> Columns:
    tilt = np.full(len(t), 0.0013)
    tilt[300:303] = 0.0012
    return {"tilt_x": tilt, "x": 0.1 * t, "y": 0 * t}


@_healthy("a heading of seven names crosses pi", quiet, none_of("jump"), lasts_s=40)
def _(t: Array, random: Random) -> Columns:
    angle = wrapped(np.where(t < 20, math.pi - 0.05, math.pi + 0.05) + noise(random, t, 0.002))
    row = np.column_stack([0 * t, 0 * t, angle])
    names = ("euler.z", "imu_z", "angle", "azimuth", "yaw")
    return {"imu": row, "rpy": row, **dict.fromkeys(names, angle)}


@_healthy("a referee puts a soccer robot back after each goal", none_of("stuck"), lasts_s=200)
def _(t: Array, random: Random) -> Columns:
    half, since = t // 40, t % 40
    return {
        "position.x": -2 + 0.12 * since,
        "position.y": 0.6 * np.sin(since / 3 + half),
        "yaw": wrapped(0.4 * np.cos(since / 3 + half)),
        "score": np.column_stack([half // 2, (half + 1) // 2]),
        "role": chosen((since < 20, "striker"), otherwise="defender"),
    }


@_healthy("a weather station measures and never moves", quiet, lasts_s=300, interval_s=0.1)
def _(t: Array, random: Random) -> Columns:
    return {
        "pose": np.zeros((len(t), 3)),
        "wind_m_s": 4 + noise(random, t, 0.4),
        "baro_pa": 101325 + noise(random, t, 3),
        "mag": random.normal((20, 3, -40), 0.4, (len(t), 3)),
    }


@_healthy("a camera on a post scans to and fro", quiet, none_of("stuck"), lasts_s=120)
def _(t: Array, random: Random) -> Columns:
    return {
        "pose": np.tile([2.0, 1.0, 0.0], (len(t), 1)),
        "pan_deg": 60 * np.sin(TURN * t / 20),
        "tilt_deg": np.where(t % 40 < 20, -10.0, 5.0),
        "target_visible": t % 15 < 5,
        "mode": ["scan"] * len(t),
    }


@_healthy("a robot waits a minute for its signal to start", quiet, none_of("stuck"), lasts_s=120)
def _(t: Array, random: Random) -> Columns:
    drives = t >= 60
    return {
        "pose.x": np.maximum(0, 0.3 * (t - 60)) + noise(random, t, 0.001),
        "pose.y": noise(random, t, 0.001),
        "pose.yaw": 0 * t,
        "commanded_speed_m_s": 0.3 * drives,
        "mode": chosen((drives, "drive"), otherwise="wait"),
    }
