"""What a new controller process takes over from the one before it, and what it does not."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.bridge.conftest import Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.recording import view_robot

DAY_S = 86_400.0


def change(recording: Recording, sql: str, *values: object) -> None:
    connection = connect(recording.database, "writer")
    connection.execute(sql, values)
    connection.close()


def leave_open(database: MemoryDatabase, recording: Recording, pid: int, seen_s: float) -> None:
    """A session that never ended, of a process with that pid, last seen then."""
    MCPBridge(InProcessSupervisor("rover"), database=database).close()
    change(
        recording,
        "UPDATE session SET ended_wall_time_s = NULL, end_reason = NULL, pid = ?, process = NULL, "
        "started_wall_time_s = ?, last_seen_wall_time_s = ?",
        pid,
        seen_s - 60,
        seen_s,
    )
    change(recording, "UPDATE run SET ended_wall_time_s = NULL, end_reason = NULL")


@pytest.fixture
def another_process() -> Iterator[int]:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        yield process.pid


def start_again(database: MemoryDatabase) -> str:
    with MCPBridge(InProcessSupervisor("rover"), database=database) as bridge:
        return bridge.robot_name


@pytest.mark.skipif(sys.platform == "darwin", reason="macOS does not tell when a process started")
def test_a_crashed_session_whose_pid_another_process_has_by_now_frees_its_name(
    database: MemoryDatabase, recording: Recording, another_process: int
) -> None:
    leave_open(database, recording, another_process, time.time() - DAY_S)
    assert start_again(database) == "rover"
    assert recording.rows("SELECT end_reason FROM session ORDER BY id") == ["crashed", "finished"]


def test_a_controller_that_lives_keeps_its_name_however_it_is_called_by_others(
    database: MemoryDatabase, recording: Recording, another_process: int
) -> None:
    leave_open(database, recording, another_process, time.time())
    assert start_again(database) == "rover#2"


@pytest.mark.skipif(not Path("/proc/1/stat").exists(), reason="needs a process of long ago")
def test_a_controller_that_was_silent_for_long_but_lives_keeps_its_name(
    database: MemoryDatabase, recording: Recording
) -> None:
    since_boot_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    leave_open(database, recording, 1, time.time() - min(since_boot_s / 100, DAY_S))
    assert start_again(database) == "rover#2"


def begun(recording: Recording) -> list[str]:
    return recording.rows("SELECT start_reason FROM run ORDER BY id")


def test_a_start_a_day_later_is_no_reload(database: MemoryDatabase, recording: Recording) -> None:
    start_again(database)
    change(
        recording,
        "UPDATE session SET ended_wall_time_s = ended_wall_time_s - ?, "
        "last_seen_wall_time_s = last_seen_wall_time_s - ?",
        *(DAY_S, DAY_S),
    )
    start_again(database)
    assert begun(recording) == ["start", "start"]


@pytest.mark.parametrize(("instance", "told"), [(None, "start"), ("webots-1", "reload")])
def test_a_start_after_a_kill_is_a_reload_only_where_webots_may_have_killed(
    database: MemoryDatabase,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
    instance: str | None,
    told: str,
) -> None:
    if instance is None:
        monkeypatch.delenv("WEBOTS_INSTANCE_PATH", raising=False)
    else:
        monkeypatch.setenv("WEBOTS_INSTANCE_PATH", instance)
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    leave_open(database, recording, ended.pid, time.time())
    start_again(database)
    assert begun(recording) == ["start", told]
    assert recording.rows("SELECT end_reason FROM session ORDER BY id") == ["crashed", "finished"]


def test_a_run_that_ends_by_a_crash_lasts_until_its_last_row(
    database: MemoryDatabase, recording: Recording
) -> None:
    bridge = MCPBridge(InProcessSupervisor("rover"), throttle_interval=1, database=database)
    for _ in range(50):
        bridge.robot.step(16)
        bridge.publish({"x": 1})
    bridge.close()
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    now_s = time.time()
    change(
        recording,
        "UPDATE session SET ended_wall_time_s = NULL, end_reason = NULL, pid = ?, process = NULL",
        ended.pid,
    )
    change(
        recording,
        "UPDATE run SET ended_wall_time_s = NULL, last_wall_time_s = ?, last_sim_time_s = 0.1",
        now_s - 60,
    )
    start_again(database)
    sql = (
        "SELECT ended_wall_time_s = s.wall_time_s, last_wall_time_s = s.wall_time_s, "
        "last_sim_time_s FROM run JOIN (SELECT run_id, max(wall_time_s) AS wall_time_s FROM state "
        "GROUP BY run_id) s ON s.run_id = run.id WHERE run.id = 1"
    )
    assert recording.rows(sql) == [(1, 1, pytest.approx(0.8))]


def test_long_names_that_begin_alike_differ_and_are_found_by_all_of_them(
    database: MemoryDatabase, recording: Recording
) -> None:
    names = ["r" * 250 + end for end in ("left", "right")]
    bridges = [MCPBridge(InProcessSupervisor(name), database=database) for name in names]
    recorded = [bridge.robot_name for bridge in bridges]
    assert len(set(recorded)) == 2
    assert all(len(name) == 200 and name.startswith("r" * 150) for name in recorded)
    with closing(connect(database, "reader")) as connection:
        assert [view_robot(connection, name).robot.name for name in names] == recorded
        assert [view_robot(connection, name).robot.name for name in recorded] == recorded
    for bridge in bridges:
        bridge.close()
    assert sorted(recording.rows("SELECT name FROM robot")) == sorted(recorded)


class Slotted:
    """A robot that has no place for an attribute of others."""

    __slots__ = ("_time_s",)

    def __init__(self) -> None:
        self._time_s = 0.0

    def step(self, duration_ms: int) -> int:
        self._time_s += duration_ms / 1000
        return 0

    def getTime(self) -> float:
        return self._time_s

    def getName(self) -> str:
        return "slotted"

    def getBasicTimeStep(self) -> float:
        return 16.0

    def getSynchronization(self) -> bool:
        return True


def test_a_robot_with_slots_is_attached_and_another_of_its_class_is_left_alone(
    database: MemoryDatabase, recording: Recording
) -> None:
    robot, other = Slotted(), Slotted()
    bridge = MCPBridge.attach(robot, database=database, throttle_interval=1)
    for _ in range(3):
        assert robot.step(16) == other.step(16) == 0
    bridge.close()
    assert [state["time"] for state in recording.states()] == pytest.approx([0.016, 0.032, 0.048])
