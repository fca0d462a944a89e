"""Whether a session lives does not hang on the wall clock."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from tests.bridge.conftest import STEP_MS, Recording, eager, heartbeat_now
from tests.bridge.test_registration import change, start_again
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.database.connection import connect
from webots_mcp.database.processes import process_identity
from webots_mcp.database.session_cleanup import reap
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.recording import view_robot

HOUR_S = 3600.0

pytestmark = pytest.mark.skipif(
    process_identity(1) is None and sys.platform == "darwin",
    reason="macOS does not tell which process a pid names",
)


def set_clock(recording: Recording, by_s: float) -> None:
    """All that was stamped until now is as if the host's clock had been set forward by so much."""
    stamps = ("started_wall_time_s", "last_seen_wall_time_s", "moved_wall_time_s")
    moved = (f"{stamp} = {stamp} - ({by_s})" for stamp in (*stamps, "last_poll_wall_time_s"))
    change(recording, f"UPDATE session SET {', '.join(moved)}")


def judge_all(recording: Recording) -> None:
    connection = connect(recording.database, "writer")
    reap(connection, time.time())
    connection.close()


@pytest.mark.parametrize("by_s", [HOUR_S, -HOUR_S])
def test_a_session_lives_and_runs_whatever_the_clock_is_set_to(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording, by_s: float
) -> None:
    robot.step(STEP_MS)
    bridge.publish({"n": 1})
    heartbeat_now(bridge)
    set_clock(recording, by_s)
    judge_all(recording)
    assert recording.rows("SELECT end_reason FROM session") == [None]
    connection = connect(recording.database, "reader")
    view = view_robot(connection, "rover")
    assert view.robot.live
    assert view.status.text == "running"
    connection.close()


def test_another_process_of_the_same_pid_is_not_the_one_that_recorded(
    database: MemoryDatabase, recording: Recording
) -> None:
    MCPBridge(InProcessSupervisor("rover"), database=database).close()
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        change(
            recording,
            "UPDATE session SET ended_wall_time_s = NULL, end_reason = NULL, pid = ?, "
            "last_seen_wall_time_s = ?",
            process.pid,
            time.time() + HOUR_S,
        )
        assert start_again(database) == "rover"
        process.communicate(b"\n")


def test_a_session_that_writes_again_is_alive_again_and_takes_commands(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    robot.step(STEP_MS)
    bridge.publish({"n": 1})
    change(recording, "UPDATE session SET end_reason = 'crashed', ended_wall_time_s = 1e9")
    change(recording, "UPDATE run SET end_reason = 'crashed', ended_wall_time_s = 1e9")
    heartbeat_now(bridge)
    assert recording.rows("SELECT end_reason, ended_wall_time_s FROM session") == [(None, None)]
    assert recording.rows("SELECT end_reason, ended_wall_time_s FROM run") == [(None, None)]
    bridge.register_command("greet", lambda _: "hello")
    sent = recording.send("greet")
    eager(bridge)
    assert recording.fate(sent)[:2] == ("done", "hello")


def test_a_session_that_another_has_followed_stays_ended(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording, database: MemoryDatabase
) -> None:
    robot.step(STEP_MS)
    bridge.publish({"n": 1})
    change(recording, "UPDATE session SET end_reason = 'crashed', ended_wall_time_s = 1e9")
    start_again(database)
    heartbeat_now(bridge)
    assert recording.rows("SELECT end_reason FROM session WHERE id = 1") == ["crashed"]
