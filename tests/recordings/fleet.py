"""Robots that dock again and again, with 100 signals and 20 modes: all that swells answers."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from tests.recordings.rows import Recorded, RecordedRobot, insert
from webots_mcp.store.chunk_making import make_chunks

CYCLE_S: Final = 40.0  # 32 s on the way, 8 s at a dock
STAND_S: Final = 8.0
SPEED_M_S: Final = 0.2
DROPOUT_EACH_S: Final = 97.0
LINE_EACH_S: Final = 6.0
COMMAND_EACH_S: Final = 20.0
STARTED_WALL_S: Final = 1_700_000_000.0
STATIONS: Final = 18  # a mode for the way to each, besides docking and leaving
JOINTS: Final = 40  # two signals each
_INSERT: Final = "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) VALUES (?, ?, ?, ?)"


def build_fleet(file: Path, robots: int, seconds: float, interval_s: float) -> None:
    """Record so many robots (`rover0`, ...) for so long each, all of it in chunks."""
    recorded = Recorded(file)
    with closing(recorded.connection) as connection:
        connection.execute("BEGIN IMMEDIATE")
        for number in range(robots):
            robot = recorded.robot(f"rover{number}", STARTED_WALL_S)
            connection.executemany(_INSERT, _rows(robot.run_id, number, seconds, interval_s))
            _note(robot, seconds)
            _end(robot, seconds, round(seconds / interval_s))
        connection.execute("COMMIT")
        while not make_chunks(connection, 100_000).done:
            pass


def _rows(run_id: int, seed: int, seconds: float, interval_s: float) -> Iterator[tuple[Any, ...]]:
    noise = random.Random(seed)
    travelled_m = 0.0
    for step in range(round(seconds / interval_s)):
        time_s = round(step * interval_s, 3)
        is_standing = time_s % CYCLE_S >= CYCLE_S - STAND_S
        travelled_m += 0.0 if is_standing else SPEED_M_S * interval_s
        state = _state(time_s, travelled_m, is_standing, noise)
        yield run_id, time_s, STARTED_WALL_S + time_s, json.dumps(state, separators=(",", ":"))


def _state(
    time_s: float, travelled_m: float, is_standing: bool, noise: random.Random
) -> dict[str, Any]:
    cycle, phase_s = divmod(time_s, CYCLE_S)
    speed_m_s = 0.0 if is_standing else SPEED_M_S
    return {
        "mode": _mode(int(cycle), phase_s, is_standing),
        "pose": {"x": travelled_m, "y": math.sin(travelled_m), "heading": 0.3 * math.sin(time_s)},
        "commanded_m_s": speed_m_s,
        "near_wall": noise.random() < 0.3,  # a flag that flickers
        "gripper": "closed" if cycle % 2 else "open",
        "front_m": 0.0 if time_s % DROPOUT_EACH_S < 0.3 else 1.5 + noise.gauss(0, 0.01),
        "lidar": {"min": 0.4 + noise.gauss(0, 0.02), "argmin": noise.randrange(100)},
        "battery_v": 12.6 - 1e-4 * time_s,
        "imu": {axis: noise.gauss(0, 0.1) for axis in ("roll", "pitch", "yaw", "ax", "ay", "az")},
        "gains": {"p": 1.2, "i": 0.1, "d": 0.05},
        "joints": {
            f"joint_{number}": {
                "angle_rad": math.sin(0.05 * (1 + number) * time_s),
                "torque_nm": 0.5 * speed_m_s + noise.gauss(0, 0.05),
            }
            for number in range(JOINTS)
        },
    }


def _mode(cycle: int, phase_s: float, is_standing: bool) -> str:
    if is_standing:
        return "docking"
    return "leaving" if phase_s < 2 else f"go_to_station_{cycle % STATIONS}"


def _note(robot: RecordedRobot, seconds: float) -> None:
    """Log lines, commands, pictures and kept stretches from time to time."""
    for step in range(round(seconds / LINE_EACH_S)):
        time_s = step * LINE_EACH_S
        robot.now = STARTED_WALL_S + time_s
        level = "warning" if step % 2 else "info"
        robot.log(time_s, f"station {step % 7}: the estimate and the odometry differ", level)
        robot.image(time_s, f"camera/{robot.name}_{step:06}.jpg")
    for step in range(round(seconds / COMMAND_EACH_S)):
        time_s = step * COMMAND_EACH_S
        robot.now = STARTED_WALL_S + time_s
        _command(robot, time_s, {"station": step % STATIONS, "force_n": 2.5})
    for step in range(round(seconds / DROPOUT_EACH_S)):
        time_s = step * DROPOUT_EACH_S
        robot.now = STARTED_WALL_S + time_s
        robot.kept(time_s, time_s + 3, f"breakpoint {step}: front_m < 0.1")
        what = {"breakpoint": 1, "condition": "front_m < 0.1"}
        robot.event(time_s, "breakpoint", "front_m < 0.1", what)


def _command(robot: RecordedRobot, time_s: float, params: dict[str, Any]) -> None:
    insert(
        robot.connection,
        "command",
        {
            "robot_id": robot.id,
            "session_id": robot.session_id,
            "action": "grasp",
            "params": json.dumps(params),
            "status": "done",
            "created_wall_time_s": robot.now,
            "expires_wall_time_s": robot.now + 10,
            "claimed_wall_time_s": robot.now + 0.01,
            "claimed_sim_time_s": time_s,
            "finished_wall_time_s": robot.now + 0.5,
            "finished_sim_time_s": time_s + 0.5,
            "result": json.dumps({"grasped": True}),
        },
    )


def _end(robot: RecordedRobot, seconds: float, rows: int) -> None:
    robot.now = STARTED_WALL_S + seconds
    robot.end_run("finished")
    robot.connection.execute(
        "UPDATE run SET last_sim_time_s = ?, last_wall_time_s = ?, row_count = ? WHERE id = ?",
        (seconds, robot.now, rows, robot.run_id),
    )
    robot.beat(ended_wall_time_s=robot.now, end_reason="finished", sim_time_s=seconds)
