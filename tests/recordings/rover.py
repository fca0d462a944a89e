"""A recording whose story is known: what `rover` did, second by second.

Run 1 (controller a...), one row each 0.1 s, half a second of wall time per simulated second:

    0 to 40 s     cruise, x grows by 0.2 m/s
    40 to 52 s    still "cruise" and commanded, but stuck at x = 8; bumper true
    52 to 60 s    back_up, x shrinks by 0.1 m/s
    60 to 90 s    avoid: heading swings by 0.5 rad around pi with a period of 2 s
    70 s          one spike in `ir`
    90 to 95 s    no rows
    95 to 120 s   cruise again, heading pi; 100 to 104 s the front sensor gives NaN
    110 s         y jumps by 1 m

Run 2 (after a reset, same session): 30 s of cruise. Run 3 (controller b...): 60 s of cruise at
0.3 m/s. The battery falls by 0.001 V/s throughout; `target` never changes.
"""

from __future__ import annotations

import json
import math
import sqlite3
from typing import Any

from tests.recordings.rows import insert

WALL_START_S = 1_700_000_000.0
INTERVAL_S = 0.1
WALL_PER_SIM = 0.5
GAP_S = (90.0, 95.0)
STUCK_S = (40.0, 52.0)
NAN_S = (100.0, 104.0)


class Recorder:
    """Writes rows as a bridge does, by plain SQL."""

    def __init__(self, connection: sqlite3.Connection, wall_start_s: float = WALL_START_S) -> None:
        self.connection = connection
        self.wall_s = wall_start_s
        self.run_id = 0

    def insert(self, table: str, **values: Any) -> int:
        return insert(self.connection, table, values)

    def robot(self, name: str) -> int:
        seen = {"first_seen_wall_time_s": self.wall_s, "last_seen_wall_time_s": self.wall_s}
        return self.insert("robot", name=name, kind="Robot", **seen)

    def session(self, robot_id: int, sha256: str, commit: str | None = None) -> int:
        return self.insert(
            "session",
            robot_id=robot_id,
            pid=1,
            host="nowhere",
            instance="i",
            controller="/project/controllers/rover/rover.py",
            controller_sha256=sha256,
            git_commit=commit,
            supervisor=1,
            started_wall_time_s=self.wall_s,
            last_seen_wall_time_s=self.wall_s,
        )

    def run(self, session_id: int, robot_id: int, reason: str = "start") -> int:
        self.run_id = self.insert(
            "run",
            session_id=session_id,
            robot_id=robot_id,
            world="/project/worlds/arena.wbt",
            basic_time_step_ms=16,
            start_reason=reason,
            started_wall_time_s=self.wall_s,
            started_sim_time_s=0.0,
            last_wall_time_s=self.wall_s,
            last_sim_time_s=0.0,
        )
        self.run_start_s = self.wall_s
        return self.run_id

    def at(self, time_s: float) -> dict[str, Any]:
        self.wall_s = self.run_start_s + time_s * WALL_PER_SIM
        return {"run_id": self.run_id, "sim_time_s": time_s, "wall_time_s": self.wall_s}

    def publish(self, time_s: float, state: dict[str, Any], replaced: dict[str, str] | None = None):
        text = json.dumps(state, allow_nan=False, ensure_ascii=False)
        self.insert(
            "state",
            **self.at(time_s),
            data=text,
            replaced=json.dumps(replaced) if replaced else None,
        )

    def end_run(self, reason: str) -> None:
        self.connection.execute(
            "UPDATE run SET end_reason = ?, ended_wall_time_s = ?, last_wall_time_s = ?, "
            "last_sim_time_s = (SELECT max(sim_time_s) FROM state WHERE run_id = run.id), "
            "row_count = (SELECT count(*) FROM state WHERE run_id = run.id) WHERE id = ?",
            (reason, self.wall_s, self.wall_s, self.run_id),
        )


def start_run(connection: sqlite3.Connection, robot: str = "rover") -> Recorder:
    """A recorder that writes into the first run of a robot."""
    recorder = Recorder(connection)
    robot_id = recorder.robot(robot)
    recorder.run(recorder.session(robot_id, "a" * 64), robot_id)
    return recorder


def record_rover(connection: sqlite3.Connection) -> None:
    """Write the whole story: robot 1, runs 1 to 3."""
    recorder = Recorder(connection)
    connection.execute("BEGIN IMMEDIATE")
    robot_id = recorder.robot("rover")
    session_id = recorder.session(robot_id, "a" * 64, "c0ffee")
    recorder.run(session_id, robot_id)
    for step in range(1200):
        time_s = round(step * INTERVAL_S, 6)
        if not GAP_S[0] <= time_s < GAP_S[1]:
            recorder.publish(time_s, *rover_state(time_s))
    _record_incidents(recorder, robot_id, session_id)
    recorder.at(120.0)
    recorder.end_run("reset")
    recorder.run(session_id, robot_id, "reset")
    _record_cruise(recorder, 30.0, 0.2)
    recorder.end_run("crashed")
    recorder.wall_s += 100
    recorder.run(recorder.session(robot_id, "b" * 64, "beef"), robot_id)
    _record_cruise(recorder, 60.0, 0.3)
    recorder.end_run("finished")
    connection.execute("COMMIT")


def _record_cruise(recorder: Recorder, duration_s: float, speed_m_s: float) -> None:
    recorder.insert("event", **recorder.at(0.0), kind="start")
    for step in range(round(duration_s / INTERVAL_S)):
        time_s = round(step * INTERVAL_S, 6)
        state, replaced = rover_state(0.0)
        state |= {"pose": [speed_m_s * time_s, 0.0], "commanded_m_s": speed_m_s}
        recorder.publish(time_s, state | {"battery_v": 12.6 - 0.001 * time_s}, replaced)


def _record_incidents(recorder: Recorder, robot_id: int, session_id: int) -> None:
    for time_s, level, message in (
        (10.0, "info", "cruising"),
        (45.0, "warning", "wheels turn, position does not"),
        (104.0, "error", "front sensor was silent"),
    ):
        source = "controller"
        recorder.insert("log", **recorder.at(time_s), level=level, source=source, message=message)
    recorder.insert("event", **recorder.at(0.0), kind="start")
    recorder.insert("event", **recorder.at(61.0), kind="dropped", data='{"row_count": 3}')
    recorder.insert(
        "image", **recorder.at(30.0), kind="camera", device="cam", path="camera/1.png",
        width=160, height=120, size_bytes=999,
    )  # fmt: skip
    wall_s = recorder.at(20.0)["wall_time_s"]
    recorder.insert(
        "command", robot_id=robot_id, action="set_speed", params='{"value": 0.2}', status="done",
        created_wall_time_s=wall_s - 0.1, expires_wall_time_s=wall_s + 10,
        claimed_wall_time_s=wall_s, claimed_sim_time_s=20.0, session_id=session_id,
        finished_wall_time_s=wall_s + 0.05, finished_sim_time_s=20.1, result="0.2",
    )  # fmt: skip


def rover_state(time_s: float) -> tuple[dict[str, Any], dict[str, str] | None]:
    """What the rover of run 1 publishes at that time, and what was replaced in it."""
    mode = rover_mode(time_s)
    blind = NAN_S[0] <= time_s < NAN_S[1]
    front = None if blind else 1.0 + 0.01 * math.sin(time_s * 7)
    state: dict[str, Any] = {
        "mode": mode,
        "pose": [rover_x(time_s), 1.0 if time_s >= 110 else 0.0],
        "heading": rover_heading(time_s),
        "commanded_m_s": {"cruise": 0.2, "back_up": -0.1}.get(mode, 0.0),
        "sensors": {"front": front, "bumper": STUCK_S[0] <= time_s < STUCK_S[1]},
        "ir": 5.0 if abs(time_s - 70) < 1e-6 else 0.01 * math.sin(time_s * 3),
        "lidar": [2.0] * 7 + [1.5 + 0.001 * time_s] + [3.0] * 24,
        "battery_v": 12.6 - 0.001 * time_s,
        "target": 3,
    }
    return state, {"sensors.front": "nan"} if blind else None


def rover_mode(time_s: float) -> str:
    starts = ((0.0, "cruise"), (52.0, "back_up"), (60.0, "avoid"), (90.0, "cruise"))
    return next(mode for start_s, mode in reversed(starts) if time_s >= start_s)


def rover_x(time_s: float) -> float:
    if time_s < 40:
        return 0.2 * time_s
    if time_s < 52:
        return 8.0
    if time_s < 60:
        return 8.0 - 0.1 * (time_s - 52)
    if time_s < 90:
        return 7.2 + 0.02 * (time_s - 60)
    return 7.8 + 0.2 * (time_s - 95)


def rover_heading(time_s: float) -> float:
    swing = 0.5 * math.sin(math.pi * time_s) if 60 <= time_s < 90 else 0.0
    angle = math.pi + swing
    return angle - 2 * math.pi if angle > math.pi else angle
