"""What is said about a robot's time: running, paused, stopped or never seen."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rows import Recorded, RecordedRobot
from webots_mcp import MCPBridge
from webots_mcp.contract import UNSEEN
from webots_mcp.database.connection import connect
from webots_mcp.database.queue import CommandQueue
from webots_mcp.database.waiting_file import waiting_paths
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.recording import view_robot
from webots_mcp.store.robot_status import Status, decide_status
from webots_mcp.store.run_rows import current_run
from webots_mcp.store.sessions import newest_session

NOW = 4_000_000_000.0  # later than this process, whose sessions these are


def status_of(robot: RecordedRobot, after_s: float = 0.0) -> Status:
    session = newest_session(robot.connection, robot.id)
    return decide_status(
        robot.connection, session, current_run(robot.connection, robot.id), NOW + after_s
    )


def dead_pid() -> int:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    return process.pid


HELD = {"pause_state": "paused", "moved_wall_time_s": NOW - 100}
UNMOVED = {"moved_wall_time_s": None}
NEVER_STEPPED = UNMOVED | {"last_poll_wall_time_s": None}
ELSEWHERE = {"host": "elsewhere", "pid": 1}
STOOD = {"moved_wall_time_s": NOW - 25}


def rows(*times: tuple[float, float]) -> dict[str, Any]:
    """States at simulation times, so long before now or after it."""
    return {"rows": times}


def ended(reason: str) -> dict[str, Any]:
    return {"ended_wall_time_s": NOW, "end_reason": reason}


# Columns of its session, with rows and events; how long after its heartbeat it is asked about; what
# is said of it, and why.
SAID: dict[str, tuple[dict[str, Any], float, str, tuple[str, ...]]] = {
    "its time moves": ({}, 0.6, "running", ()),
    "between two heartbeats": ({}, 1.4, "running", ()),
    "it steps under command": ({"pause_state": "stepping"}, 0.0, "running", ()),
    "it is held": (HELD, 0.5, "paused", ()),
    "a pause since the heartbeat": ({"events": ("pause",)}, 0.0, "paused", ()),
    "a resume since the heartbeat": (
        HELD | {"events": ("pause", "resume")}, 0.0, "running", ()),
    "a hold whose heartbeat stopped": (
        HELD | {"moved_wall_time_s": NOW - 5}, 30.0, "stopped 35 s ago", ("loop is silent",)),
    "a silent loop": (
        {}, 42.0, "stopped 42 s ago",
        ("paused by hand", "breakpoint", "another controller", "extern controller")),
    "silent since its time stopped": ({}, 1.8, "stopped 1.8 s ago", ("loop is silent",)),
    "alive without moving time": (
        {"moved_wall_time_s": NOW - 20}, 0.0, "stopped 20 s ago", ("stands still",)),
    "just started": (UNMOVED, 1.0, "starting", ("just started",)),
    "started a while ago": (
        UNMOVED | {"last_seen_wall_time_s": NOW + 5}, 5.0, "stopped 5.0 s ago",
        ("not moved since",)),
    "no step was ever seen": (
        NEVER_STEPPED, 42.0, "not seen moving for 42 s",
        ("paused in Webots", "not reached its loop", "bridge.get_command()", "attach")),
    "publishes nothing": (
        rows(*((i * 0.5, i * 0.5 - 20) for i in range(4))) | {"sim_time_s": 20.0}, 0.6, "running",
        ("for 18.5 s of simulation time it recorded no state",)),
    "publishes now and then": (
        rows(*((i * 5.0, i * 5 - 20) for i in range(4))) | {"sim_time_s": 20.0}, 0.6, "running",
        ()),
    "steps unseen": (
        rows((0.0, -20)) | {"sim_time_s": 20.0, "last_error": f"{UNSEEN}; 1.0 s so far"}, 0.6,
        "running", (UNSEEN,)),
    "stepped unseen": (
        {"last_error": f"{UNSEEN}; 1.0 s so far"} | ended("finished"), 0.6, "stopped 0.6 s ago",
        (UNSEEN,)),
    "slow rows": (rows(*((i * 0.016, 3 * i - 9) for i in range(4))), 8.0, "running", ()),
    "later than slow rows": (
        rows(*((i * 0.016, 3 * i - 9) for i in range(4))), 12.0, "stopped 12 s ago", ("silent",)),
    "one long pause among its rows": (
        rows(*((0.016, at_s) for at_s in (-60.2, -60.1, -0.2, -0.1, 0))), 2.0, "stopped 2.0 s ago",
        ("silent",)),
    "a row beyond the heartbeat": (
        STOOD | rows((36.72, 0.1)) | {"sim_time_s": 36.7}, 0.2, "running", ()),
    "long after that row": (
        STOOD | rows((36.72, 0.1)) | {"sim_time_s": 36.7}, 9.0, "stopped 8.9 s ago", ("silent",)),
    "a row while time stood still": (
        STOOD | rows((36.72, 0.1)) | {"sim_time_s": 36.72}, 0.2, "stopped 25 s ago", ("still",)),
    "finished": (ended("finished"), 7.0, "stopped 7.0 s ago", ("finished",)),
    "reloaded": (ended("reload"), 7.0, "stopped 7.0 s ago", ("reloaded",)),
    "crashed": (ended("crashed"), 7.0, "stopped 7.0 s ago", ("killed or crashed",)),
    "a process that is gone": ({"pid": 2**30}, 0.0, "stopped 0.0 s ago", ("gone",)),
    "on another host": (ELSEWHERE, 0.0, "running", ()),
    "silent on another host": (ELSEWHERE, 60.0, "stopped 60 s ago", ("gone",)),
}  # fmt: skip


@pytest.mark.parametrize("case", SAID)
def test_what_is_said_of_a_robots_time_and_why(recorded: Recorded, case: str) -> None:
    session, after_s, text, why = SAID[case]
    columns = {k: v for k, v in session.items() if k not in ("rows", "events")}
    events = session.get("events", ())
    robot = recorded.robot(now=NOW - 0.2 * bool(events), **columns)
    robot.now = NOW
    for number, kind in enumerate(events, 1):
        robot.event(1.0, kind, None, {"command_id": number})
    for sim_time_s, at_s in session.get("rows", ()):
        robot.state(sim_time_s, {"x": 1}, at=NOW + at_s)
    status = status_of(robot, after_s)
    assert status.text == text
    assert all(part in (status.why or "") for part in why)
    assert why or status.why is None


def test_a_robot_is_paused_while_another_holds_the_same_simulation(recorded: Recorded) -> None:
    robot = recorded.robot("rover", now=NOW, last_seen_wall_time_s=NOW - 60)
    recorded.robot("referee", now=NOW, pause_state="paused")
    assert status_of(robot).text == "paused"
    assert "'referee'" in (status_of(robot).why or "")


def test_a_hold_in_another_simulation_says_nothing_about_this_one(recorded: Recorded) -> None:
    robot = recorded.robot("rover", now=NOW)
    recorded.robot("referee", now=NOW, pause_state="paused", instance="webots-2")
    assert status_of(robot).text == "running"


@pytest.mark.parametrize(("mode", "why"), [("fast", "does not see"), ("pause", "paused in Webots")])
def test_that_an_observer_sees_time_go_on_does_not_make_an_unseen_loop_hang(
    recorded: Recorded, mode: str, why: str
) -> None:
    instance = "webots 1"
    observer = recorded.robot("observer", now=NOW, instance=instance)
    observer.event(0.0, "mode", None, {"mode": mode})
    robot = recorded.robot(
        now=NOW, instance=instance, moved_wall_time_s=None, last_poll_wall_time_s=None
    )
    status = status_of(robot, after_s=1.9)
    assert why in (status.why or "") and "hangs" not in (status.why or "")


def claimed(robot: RecordedRobot, action: str, at: float) -> int:
    command = CommandQueue(robot.connection).enqueue(robot.id, action)
    robot.connection.execute(
        "UPDATE command SET status = 'claimed', session_id = ?, claimed_wall_time_s = ?",
        (robot.session_id, at),
    )
    return command.id


def test_a_loop_that_is_inside_a_handler_says_in_which(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW)
    command_id = claimed(robot, "slow", NOW)
    status = status_of(robot, after_s=42)
    assert status.text == "stopped 42 s ago"
    assert status.why == f"its loop is inside the handler of command {command_id} (slow) for 42.0 s"


def test_a_built_in_action_that_is_under_way_is_no_reason_to_stand(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW)
    claimed(robot, "screenshot", NOW)
    assert "loop is silent" in (status_of(robot, after_s=42).why or "")


@pytest.mark.parametrize("managed", [True, False])
def test_a_controller_that_an_exception_ended_names_it(tmp_path: Path, managed: bool) -> None:
    loop = "with bridge:\n    {}['speed']" if managed else "{}['speed']"
    program = (
        "import sys\n"
        "from webots_mcp import MCPBridge\n"
        "from webots_mcp.standin import InProcessSupervisor\n"
        "bridge = MCPBridge(InProcessSupervisor('rover'), database=sys.argv[1])\n"
        f"bridge.publish({{'n': 1}})\n{loop}\n"
    )
    file = tmp_path / "webots.db"
    command = [sys.executable, "-c", program, str(file)]
    subprocess.run(command, stderr=subprocess.DEVNULL, check=False)
    with closing(connect(file, "reader")) as connection:
        status = decide_status(connection, newest_session(connection, 1), None, time.time())
    assert "its controller ended by KeyError: 'speed'" in (status.why or "")


@pytest.mark.slow
def test_where_the_database_takes_no_rows_it_says_in_which_file_they_wait_and_since_when(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "webots.db"
    with MCPBridge(InProcessSupervisor("rover"), database=file, throttle_interval=1) as bridge:
        writer = bridge._session.recorder.connection  # pyright: ignore[reportPrivateUsage]
        assert writer is not None
        (pages,) = writer.execute("PRAGMA page_count").fetchone()
        writer.execute(f"PRAGMA max_page_count={pages}")
        began_s = time.time()
        while not bridge.stats().rows_waiting:
            bridge.publish({"padding": "x" * 1000})
        (waiting,) = waiting_paths(file)
        os.utime(waiting, (began_s + 30, began_s + 30))
        with closing(connect(file, "writer")) as connection:
            connection.execute("UPDATE session SET last_seen_monotonic_s = NULL")
            session = newest_session(connection, 1)
            going, gone = (
                decide_status(connection, session, None, began_s + s) for s in (30.5, 60)
            )
    assert going.text == "running"
    assert f"wait in {waiting.name} next to it, for 30 s now" in (going.why or "")
    assert gone.text == "stopped 30 s ago"
    assert waiting.name in (gone.why or "")
    assert "database or disk is full" in capfd.readouterr().err


def test_without_a_session_a_robot_was_never_seen(recorded: Recorded) -> None:
    assert decide_status(recorded.connection, None, None, NOW).text == "never seen"


def test_an_answer_tells_one_moment_whatever_is_recorded_while_it_is_put_together(
    recorded: Recorded,
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    view = view_robot(recorded.connection, "rover")
    robot.state(2.0, {"x": 2})
    robot.event(2.0, "pause", None, {"command_id": 1})
    header = view.header()
    assert (header["sim_time_s"], header["status"]) == (1.0, "running")
