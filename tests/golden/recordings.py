"""The three recordings of which every question is asked.

A healthy drive, a story with faults, and six trials of an arm. The drive is recorded by the real
bridge, so that wall times are the machine's. The story and the arm are written row by row.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

from tests.bridge.conftest import eager, send
from tests.recordings.drawn import draw_story, sum_up, sum_up_file
from tests.recordings.rover import Recorder
from webots_mcp import MCPBridge
from webots_mcp.contract import INSPECT_VARIABLE, new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.trial_sets import TrialResult, create_trial_set, finish_trial, trials_of

STEP_MS: Final = 16
DRIVE_S: Final = 24.0
START_S: Final = 2.0  # then the mode changes
SPEED_M_S: Final = 0.2
RADIUS_M: Final = 1.0

ARM_S: Final = 12.0
ARM_STEP_S: Final = 0.05
TARGET_S: Final = 4.0  # each joint gets another target that often
DROPPED_S: Final = 7.0  # when the arm with the highest gain loses its part
SCORE: Final = "mean(shoulder.position_rad)"
TRIED: Final = (  # gain, grip; with the highest gain a loose grip loses the part
    (2.0, "firm"), (4.0, "firm"), (8.0, "firm"), (2.0, "loose"), (4.0, "loose"), (8.0, "loose"),
)  # fmt: skip


@dataclass(frozen=True)
class GoldenRecording:
    """One recording and what it is asked about.

    Attributes:
        draw: Fill a folder; the database in it is `webots.db`.
        has_own_clock: Whether wall times are drawn too, and the same each time.
        part: Start and end of an interval to ask about, simulated seconds.
        robot: The robot to ask about.
        x: The signal to ask a condition of.
        picture_s: When a picture was taken, simulated seconds.
        run_id: The run to ask about; None for the newest of the robot.
        is_healthy: Whether nothing is wrong in it, so that no answer may say so.
        untrue: Texts that answers give today although they are not true: they are not stored.
    """

    draw: Callable[[Path], None]
    has_own_clock: bool
    part: tuple[float, float]
    robot: str
    x: str
    picture_s: float
    run_id: int | None = None
    is_healthy: bool = False
    untrue: frozenset[str] = frozenset()


def draw_drive(folder: Path) -> None:
    """A rover that drives a circle and runs commands, recorded by the bridge."""
    with patch.dict("os.environ", {INSPECT_VARIABLE: "0"}):  # lines of this file are no answers
        _drive_circle(folder)
    _set_pace(folder / "webots.db")
    sum_up_file(folder)


def _set_pace(database: Path) -> None:
    """Give the rows twice the speed of real time, whatever the machine had: it ends as it did."""
    with closing(connect(database, "writer")) as connection, connection:
        (ended_s, last_s) = connection.execute(
            "SELECT max(wall_time_s), max(sim_time_s) FROM state"
        ).fetchone()
        wall_s = f"{ended_s!r} - ({last_s!r} - sim_time_s) / 2"
        for table in ("state", "kept_state", "event", "log"):
            connection.execute(f"UPDATE {table} SET wall_time_s = {wall_s}")
        connection.execute(f"UPDATE image SET wall_time_s = {wall_s}")
        sent_s = f"{wall_s} - 0.001".replace("sim_time_s", "claimed_sim_time_s")  # then a picture
        connection.execute(
            f"UPDATE command SET created_wall_time_s = {sent_s}, claimed_wall_time_s = {sent_s}, "
            f"finished_wall_time_s = {sent_s}"
        )
        began_s = ended_s - last_s / 2
        connection.execute("UPDATE run SET started_wall_time_s = ?", (began_s,))
        connection.execute("UPDATE session SET started_wall_time_s = ?", (began_s,))


def _drive_circle(folder: Path) -> None:
    robot = InProcessSupervisor("rover")
    bridge = MCPBridge(robot, throttle_interval=2, database=folder / "webots.db")
    camera = robot.getDevice("camera")
    camera.enable(STEP_MS)
    bridge.parameter("speed", SPEED_M_S, low=0.0, high=0.5, doc="cruising speed", unit="m/s")
    bridge.expect("commanded_m_s < 0.5", name="keeps the speed limit")
    bridge.breakpoint("pose.y > 1.9", action="log")

    def blink(command: dict[str, Any]) -> dict[str, Any]:
        """Blink the lamp."""
        return {"blinked": command["times"]}

    bridge.register_command("blink", blink)
    while robot.step(STEP_MS) != -1 and robot.getTime() < DRIVE_S:
        step = round(robot.getTime() * 1000 / STEP_MS)
        bridge.publish(_drive_state(robot.getTime()))
        if step == 500:
            with closing(connect(folder / "webots.db", "writer")) as connection:
                send(connection, "blink", {"times": 3})
            eager(bridge)
            bridge.log("blinked")
            bridge.save_camera_frame(camera)
        if step == 1000:
            bridge.keep("the far side of the circle")
    bridge.close()


def _drive_state(time_s: float) -> dict[str, Any]:
    heading = SPEED_M_S / RADIUS_M * time_s
    return {
        "pose": {"x": RADIUS_M * math.sin(heading), "y": RADIUS_M * (1 - math.cos(heading))},
        "heading_rad": math.atan2(math.sin(heading), math.cos(heading)),
        "mode": "cruise" if time_s > START_S else "start",
        "commanded_m_s": SPEED_M_S,
        "battery_v": 12.6 - 0.001 * time_s,
        "wall_distance_m": 1.5 + 0.3 * math.sin(heading),
    }


def draw_arm(folder: Path) -> None:
    """Six trials of an arm that reaches for targets, of which one loses its part."""
    with closing(connect(folder / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        recorder = Recorder(connection)
        robot_id = recorder.robot("arm")
        session_id = recorder.session(robot_id, "a" * 64)
        plan = json.dumps({"score": SCORE, "best": "highest", "for_s": ARM_S})
        values = [{"gain": gain, "grip": grip} for gain, grip in TRIED]
        set_id = create_trial_set(connection, plan, values, robot_id=robot_id)
        for trial, (gain, grip) in zip(trials_of(connection, set_id), TRIED, strict=True):
            loses = gain == 8.0 and grip == "loose"
            run_id, mean = _record_reaching(recorder, session_id, robot_id, gain, grip, loses)
            score, failed = (None, "ValueError: the part fell") if loses else (mean, None)
            finish_trial(connection, trial, TrialResult(run_id, score, failed, "for_s", ARM_S))
        connection.execute("UPDATE session SET ended_wall_time_s = 2e9, end_reason = 'finished'")
        sum_up(connection)


def _record_reaching(
    recorder: Recorder, session_id: int, robot_id: int, gain: float, grip: str, loses: bool
) -> tuple[int, float]:
    """Record one run; returns its id and the mean of the shoulder's position."""
    run_id = recorder.run(session_id, robot_id, "reset" if recorder.run_id else "start")
    for name, value in (("gain", gain), ("grip", grip)):
        recorder.insert(
            "parameter_value", **recorder.at(0.0), name=name, value=json.dumps(value),
            is_default=0, set_by="trial",
        )  # fmt: skip
    shoulder, elbow = 0.0, 0.5
    positions: list[float] = []
    for step in range(round((DROPPED_S + 1.0 if loses else ARM_S) / ARM_STEP_S)):
        time_s = round(step * ARM_STEP_S, 6)
        high = int(time_s // TARGET_S) % 2 == 1
        targets = (1.2 if high else 0.4, -0.3 if high else 0.8)
        shoulder += gain * ARM_STEP_S * (targets[0] - shoulder)
        elbow += gain * ARM_STEP_S * (targets[1] - elbow)
        positions.append(shoulder)
        state = {
            "shoulder": {"position_rad": shoulder, "target_rad": targets[0]},
            "elbow": {"position_rad": elbow, "target_rad": targets[1]},
            "gripper_m": 0.04 if loses and time_s >= DROPPED_S else 0.02,
            "mode": "dropped" if loses and time_s >= DROPPED_S else "reach",
        }
        recorder.publish(time_s, state)
    if loses:
        _record_loss(recorder, robot_id, session_id)
    recorder.at(DROPPED_S + 1.0 if loses else ARM_S)
    recorder.end_run("reset")
    return run_id, round(sum(positions) / len(positions), 6)


def _record_loss(recorder: Recorder, robot_id: int, session_id: int) -> None:
    """What the controller says of the part that it lost, and a command that it could not do."""
    at = recorder.at(DROPPED_S)
    recorder.insert("log", **at, level="error", source="controller", message="the part fell")
    frame = {"at": "arm.py:12", "function": "lift", "variables": {"grip": "loose", "part": None}}
    data = json.dumps({"cause": "error", "frames": [frame]})
    recorder.insert("event", **at, kind="inspection", name="the part fell", data=data)
    recorder.insert(
        "command", robot_id=robot_id, action="grasp", params="{}", status="failed",
        created_wall_time_s=at["wall_time_s"], expires_wall_time_s=at["wall_time_s"] + 10,
        claimed_wall_time_s=at["wall_time_s"] + 0.02, claimed_sim_time_s=DROPPED_S,
        session_id=session_id, finished_wall_time_s=at["wall_time_s"] + 0.05,
        finished_sim_time_s=DROPPED_S, error="RuntimeError: nothing to grasp",
    )  # fmt: skip
    recorder.insert(
        "kept_stretch", run_id=at["run_id"], uuid=new_uuid(), wall_time_s=at["wall_time_s"],
        start_sim_time_s=DROPPED_S - 1.0, end_sim_time_s=DROPPED_S + 1.0, reason="the part fell",
    )  # fmt: skip


RECORDINGS: Final[dict[str, GoldenRecording]] = {
    "drive": GoldenRecording(
        draw_drive, False, (5.0, 15.0), "rover", "pose.x", picture_s=8.0, is_healthy=True
    ),
    "story": GoldenRecording(
        draw_story,
        True,
        (45.0, 65.0),
        "rover",
        "pose.0",
        picture_s=30.0,
        run_id=1,
        untrue=frozenset({"at its limit of 3.14159 rad"}),  # of a heading that only stays at pi
    ),
    "arm": GoldenRecording(draw_arm, False, (2.0, 6.0), "arm", "shoulder.position_rad", 4.0),
}
