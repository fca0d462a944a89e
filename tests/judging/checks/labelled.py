"""Runs of a robot with wheels, an arm and many sensors: healthy ones, and with one fault each."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np

from tests.judging.detection import driving, sensing
from tests.judging.detection.labelled import Array, LabelledRun
from tests.judging.detection.writing import write_all

Fault = Callable[[np.random.Generator, LabelledRun], LabelledRun]
WHEEL_RADIUS_M: Final = 0.05
_GYRO_RANGE: Final = 2.0


def healthy(rng: np.random.Generator) -> LabelledRun:
    """A robot that drives, turns on the spot and stops as it was told, with sensors that work.

    Its odometry drifts by up to 2 % of the way; its arm follows its target with a lag, or slowly.
    """
    interval_s = float(rng.choice([0.032, 0.064, 0.1, 0.2]))
    speed_m_s, noise_m = float(rng.uniform(0.1, 0.4)), float(rng.choice([0.0, 0.002, 0.005, 0.01]))
    phases = driving.drive_of(rng, 15.0, speed_m_s, "cruise")
    while sum(each.duration_s for each in phases) < 90:
        rests = driving.phase(float(rng.uniform(2, 25)), 0.0, "idle")
        turns = driving.phase(float(rng.uniform(2, 6)), 0.0, "turn", float(rng.uniform(0.3, 1.2)))
        phases += [rests, turns][: int(rng.integers(0, 3))]
        phases += driving.drive_of(rng, float(rng.uniform(8, 25)), speed_m_s, "cruise")
    evidence = str(rng.choice(["wheels", "commanded"]))
    run = driving.driven(rng, phases, interval_s, noise_m, evidence, "gps")
    working = sensing.sensors(rng, interval_s, run.duration_s + interval_s)
    rows, times = len(run.times), run.times
    x, y, course, _ = driving.way_of(phases, times)
    drift = 1 + float(rng.uniform(-0.02, 0.02))
    turned = float(rng.uniform(-np.pi, np.pi))  # its frame begins where the robot began
    odometry = drift * (x + 1j * y) * np.exp(1j * turned)
    columns: dict[str, Any] = {name: values[:rows] for name, values in working.columns.items()}
    columns |= run.columns | _arm(rng, times)
    columns["odom"] = [[each.real, each.imag] for each in odometry.tolist()]
    yaw = np.angle(np.exp(1j * (course + turned))).tolist()
    columns["imu"] = [{"yaw": each} for each in yaw]
    gyro = np.clip(rng.normal(0, 0.3, rows), -_GYRO_RANGE, _GYRO_RANGE)
    columns["rate_rad_s"] = gyro.tolist()
    columns["ball_m"] = [None if rng.random() < 0.1 else float(rng.uniform(0, 3))] * rows
    return replace(run, columns=columns)


def _arm(rng: np.random.Generator, times: Array) -> dict[str, Any]:
    """A joint that goes to a target at its own speed, and one that follows a swinging target."""
    fastest_rad_s = float(rng.uniform(0.05, 2.0))
    goals = rng.uniform(-1.5, 1.5, len(times))
    target, position = list[float](), list[float]()
    goal, at = 0.0, 0.0
    for row, time_s in enumerate(times.tolist()):
        step_s = float(times[row] - times[row - 1]) if row else 0.0
        if int(time_s) % 20 == 0 and rng.random() < 0.05:
            goal = float(goals[row])
        at += float(np.clip(goal - at, -fastest_rad_s * step_s, fastest_rad_s * step_s))
        target.append(goal)
        position.append(at + float(rng.normal(0, 0.001)))
    swing, lag = 2 * np.pi / float(rng.uniform(1, 20)), float(rng.uniform(0, 0.2))
    return {
        "elbow": [{"target": a, "position": b} for a, b in zip(target, position, strict=True)],
        "knee_target": np.sin(swing * times).tolist(),
        "knee_position": np.sin(swing * (times - lag)).tolist(),
    }


# -- faults ----------------------------------------------------------------------------------------


def _span(
    rng: np.random.Generator, run: LabelledRun, lasts_s: tuple[float, float] = (8.0, 20.0)
) -> Any:
    """The rows of a stretch that begins in the first half."""
    start_s = float(rng.uniform(0.2, 0.5)) * run.duration_s
    return (run.times >= start_s) & (run.times <= start_s + float(rng.uniform(*lasts_s)))


def _changed(run: LabelledRun, name: str, rows: Any, change: Callable[[Any], Any]) -> LabelledRun:
    values = [
        change(value) if here else value
        for value, here in zip(run.columns[name], rows.tolist(), strict=True)
    ]
    return replace(run, columns={**run.columns, name: values})


def held(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """Something holds it while it is told to drive."""
    return _driven_with(rng, driving.held(float(rng.uniform(5, 20)), 0.25, "cruise"))


def slips(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """Its wheels turn, and it goes a tenth to a third as far."""
    share = float(rng.uniform(0.1, 0.33))
    slow = driving.Phase(float(rng.uniform(5, 20)), 0.25 * share, 0.0, "cruise", 0.25)
    return _driven_with(rng, slow)


def _driven_with(rng: np.random.Generator, fault: driving.Phase) -> LabelledRun:
    phases = driving.drive_of(rng, 30.0, 0.25, "cruise")
    phases += [fault, *driving.drive_of(rng, 30.0, 0.25, "cruise")]
    noise_m = float(rng.choice([0.0, 0.005]))
    return driving.driven(rng, phases, 0.064, noise_m, "wheels", "gps")


def jammed(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """From a moment on its knee stays where it is, whatever its target."""
    rows = run.times >= 0.4 * run.duration_s
    at = run.columns["knee_position"][int(np.argmax(rows))]
    run = _changed(run, "knee_position", rows, lambda value: at)
    slow = np.sign(np.sin(run.times / 15))  # a step now and then
    return replace(run, columns={**run.columns, "knee_target": (1.0 * slow).tolist()})


def drifts(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """Its odometry turns away from where it goes."""
    rate = float(rng.choice([-1, 1]) * rng.uniform(0.02, 0.05))
    places = np.array([x + 1j * y for x, y in run.columns["odom"]])
    steps = np.diff(places, prepend=places[:1]) * np.exp(1j * rate * run.times)
    odometry = np.cumsum(steps).tolist()
    return replace(run, columns={**run.columns, "odom": [[e.real, e.imag] for e in odometry]})


def silent(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    return _changed(run, "front", _span(rng, run), lambda value: float("nan"))


def null(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    return _changed(run, "front", _span(rng, run), lambda value: None)


def frozen(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    rows = _span(rng, run, (25.0, 40.0))
    at = run.columns["front"][int(np.argmax(rows))]
    return _changed(run, "front", rows, lambda value: at)


def saturated(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """Its gyro ends at a fifth of what it would have to show."""
    slow = 2 * np.sin(run.times / 1.5)
    rates = np.clip(np.array(run.columns["rate_rad_s"]) + slow, -1.0, 1.0)
    return replace(run, columns={**run.columns, "rate_rad_s": rates.tolist()})


def dropouts(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    rows = np.zeros(len(run.times), np.bool_)
    rows[rng.choice(np.arange(20, len(rows) - 20, 10), int(rng.integers(4, 12)), False)] = True
    return _changed(run, "front", rows, lambda value: 0.0)


def gaps(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    return run.kept(~_span(rng, run, (4.0, 9.0)))


def leaps(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    first = int(rng.integers(len(run.times) // 4, len(run.times) // 2))
    away = float(rng.uniform(1, 3))
    return driving.moved(run, first, (away, -away))


def falls(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """It tips over to one side within a second, and stays down where it is."""
    side = float(rng.choice([-1, 1]) * rng.uniform(1.2, 1.6))
    at_s = float(rng.uniform(0.3, 0.7)) * run.duration_s
    roll = side * np.clip(run.times - at_s, 0, 1) + rng.normal(0, 0.01, len(run.times))
    last = int(np.searchsorted(run.times, at_s + 1))
    lies = np.array(run.columns["gps"])
    lies[last:] = lies[last]
    lies[last:, :2] += rng.normal(0, run.noise_m, (len(lies) - last, 2))
    fallen = {"imu_roll_rad": roll.tolist(), "gps": lies.tolist()}
    return replace(run, columns={**run.columns, **fallen})


def grips_on_one_side(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """From some time on the wheels of one side grip half: it turns though both turn alike."""
    times = np.arange(0, 80, 0.064)
    weak = np.where(times > float(rng.uniform(30, 50)), float(rng.uniform(0.3, 0.6)), 1.0)
    speed_m_s, track_m = float(rng.uniform(0.1, 0.3)), float(rng.uniform(0.15, 0.4))
    left, right = speed_m_s * weak, speed_m_s
    yaw = rng.choice([-1, 1]) * np.cumsum((right - left) / track_m) * 0.064
    way = (left + right) / 2 * 0.064
    noise = rng.normal(0, float(rng.choice([0.0, 0.002])), (2, len(times)))
    x, y = np.cumsum(way * np.cos(yaw)) + noise[0], np.cumsum(way * np.sin(yaw)) + noise[1]
    columns = {
        "gps": np.column_stack([x, y]).tolist(),
        "heading": np.angle(np.exp(1j * yaw)).tolist(),
        "wheels": [{"left": speed_m_s / WHEEL_RADIUS_M, "right": speed_m_s / WHEEL_RADIUS_M}]
        * len(times),
    }
    return LabelledRun(times, columns, 0.064)


def blind_rays(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """A part of the items of an array never has a value."""
    count = int(rng.integers(60, 180))
    scan = rng.normal(2, 0.01, (len(run.times), count))
    first = int(rng.integers(0, count // 2))
    scan[:, first : first + int(rng.integers(count // 8, count // 2))] = np.nan
    return replace(run, columns={**run.columns, "scan_m": scan.tolist()})


def cut_off(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """A vibration drives an accelerometer from one of its limits to the other for a moment."""
    limit = float(rng.choice([19.6, 39.2, 156.9]))
    accel = rng.normal(0, 0.01 * limit, len(run.times))
    lasts_s = max(1.0, 30 * run.interval_s)
    at_s = float(rng.uniform(0.3, 0.7)) * run.duration_s
    shaken = (run.times >= at_s) & (run.times < at_s + lasts_s)
    accel[shaken] = rng.normal(0, 1.5 * limit, int(shaken.sum()))
    clipped = np.clip(accel, -limit, limit).tolist()
    return replace(run, columns={**run.columns, "accel_m_s2": clipped})


def disturbed_compass(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """For a part of the run a compass is off by more than half a radian; the gyro is not."""
    yaw = np.array([each["yaw"] for each in run.columns["imu"]])
    off = float(rng.uniform(0.6, 2.5)) * rng.choice([-1, 1]) * _span(rng, run)
    compass = np.angle(np.exp(1j * (yaw + off + rng.normal(0, 0.02, len(yaw)))))
    return replace(run, columns={**run.columns, "compass_heading": compass.tolist()})


def turns_instead(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """It is told to drive ahead, and turns in place."""
    times = np.arange(0, 60, 0.064)
    on = (times >= 15) & (times < float(rng.uniform(25, 45)))
    drives = (times < 15) | (times >= 50)
    way = np.cumsum(0.25 * drives) * 0.064
    yaw = np.cumsum(float(rng.uniform(0.5, 2.0)) * on) * 0.064
    columns = {
        "pose": [
            {"x": a, "y": 0.0, "yaw": b}
            for a, b in zip(way.tolist(), np.angle(np.exp(1j * yaw)).tolist(), strict=True)
        ],
        "cmd_vel": [{"linear": 0.25 * each, "angular": 0.0} for each in (on | drives).tolist()],
    }
    return LabelledRun(times, columns, 0.064)


def noisy(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """From the middle on a distance has ten times as much noise."""
    rows = len(run.times)
    noise = rng.normal(0, 0.005, rows) * np.where(np.arange(rows) < rows // 2, 1, 10)
    depth = 2 + 0.4 * np.sin(run.times / 9) + noise
    return replace(run, columns={**run.columns, "depth_m": depth.tolist()})


def creeps(rng: np.random.Generator, run: LabelledRun) -> LabelledRun:
    """It turns slowly while it stands, although no command says so."""
    phases = driving.drive_of(rng, 20.0, 0.25, "cruise")
    phases += [driving.phase(30.0, 0.0, "idle", 0.02), *driving.drive_of(rng, 20.0, 0.25, "cruise")]
    made = driving.driven(rng, phases, 0.064, 0.0, "commanded", "gps")
    course = driving.way_of(phases, made.times)[2]
    yaw = np.angle(np.exp(1j * course)).tolist()
    columns = {"imu": [{"yaw": each} for each in yaw], "cmd_turn_rad_s": [0.0] * len(made.times)}
    return replace(made, columns={**made.columns, **columns})


FAULTS: Final[dict[str, tuple[Fault, str]]] = {
    "held": (held, "moves when commanded"),
    "slips": (slips, "wheels grip"),
    "jammed": (jammed, "follows its targets"),
    "odometry drifts": (drifts, "estimates agree"),
    "leaps": (leaps, "stays in place"),
    "falls": (falls, "stays upright"),
    "noisy": (noisy, "sensors keep their noise"),
    "creeps": (creeps, "rests when commanded"),
    "NaN": (silent, "sensors speak"),
    "null": (null, "sensors speak"),
    "frozen": (frozen, "sensors live"),
    "saturated": (saturated, "sensors within limits"),
    "dropouts": (dropouts, "sensors drop nothing"),
    "gaps": (gaps, "misses no steps"),
    "turns instead": (turns_instead, "moves when commanded"),
    "one side slips": (grips_on_one_side, "wheels grip"),
    "blind rays": (blind_rays, "sensors speak"),
    "cut off": (cut_off, "sensors within limits"),
    "compass": (disturbed_compass, "estimates agree"),
}

# Faults of a run that is recorded: what is written beside its rows.

_WALL: Final = "UPDATE state SET wall_time_s = wall_time_s + 3 * sim_time_s WHERE run_id = :run"
_AT: Final = "(run_id, sim_time_s, wall_time_s"
WRITTEN: Final[dict[str, tuple[str, str]]] = {
    "slow": (_WALL, "keeps pace"),
    "error": (
        f"INSERT INTO log {_AT}, level, source, message) "
        "VALUES (:run, 9, 9, 'error', 'controller', 'boom')",
        "logs no errors",
    ),
    "warning": (
        f"INSERT INTO log {_AT}, level, source, message) "
        "VALUES (:run, 9, 9, 'warning', 'bridge', 'hm')",
        "logs no errors",
    ),
    "crashed": ("UPDATE run SET end_reason = 'crashed' WHERE id = :run", "ends well"),
    "reset": ("UPDATE run SET end_reason = 'reset' WHERE id = :run", "ends well"),
    "dropped": (
        f"INSERT INTO event {_AT}, kind, data) "
        """VALUES (:run, 9, 9, 'dropped', '{"row_count": 4, "why": "disk full"}')""",
        "loses no rows",
    ),
    "no goal": (
        "INSERT INTO command (robot_id, action, params, status, created_wall_time_s, "
        "expires_wall_time_s, result) VALUES (1, 'run', '{\"until\": \"x > 9\"}', 'done', 1, 2, "
        "json_object('ended', 'simulation time reached', 'run_id', :run, 'sim_time_s', 60.0, "
        "'advanced_s', 60.0))",
        "reaches its goal",
    ),
}


def record(connection: sqlite3.Connection, run: LabelledRun, written: str = "") -> int:
    """Write a run that ended by itself, and what is written beside its rows; its id."""
    (run_id,) = write_all(connection, [run])
    connection.execute("UPDATE run SET end_reason = 'finished' WHERE id = ?", (run_id,))
    if written:
        connection.execute(written, {"run": run_id} if ":run" in written else {})
    return run_id
