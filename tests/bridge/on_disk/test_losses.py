"""Rows that are lost are counted and told, and cost no other row."""

from __future__ import annotations

import json
import math
import os
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path

import pytest

from tests.bridge.conftest import (
    STEP_MS,
    Recording,
    catch_up,
    heartbeat_now,
    keep_in_memory,
    numbers,
    write_lock,
)
from webots_mcp import MCPBridge
from webots_mcp.bridge import backlog
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.waiting_file import adopt
from webots_mcp.standin import InProcessSupervisor

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="an open file cannot be deleted there")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_stderr_that_takes_nothing_does_not_end_the_robot(tmp_path: Path) -> None:
    program = (
        "import sys\n"
        "from webots_mcp import MCPBridge, MemoryDatabase\n"
        "from webots_mcp.standin import InProcessSupervisor\n"
        "bridge = MCPBridge(InProcessSupervisor('rover'), database=MemoryDatabase())\n"
        "bridge.publish([1], force=True)\n"
        "sys.stderr = None\n"
        "bridge.log('text', level='loud')\n"
        "print('drove on')\n"
    )
    with Path("/dev/full").open("w") as full:
        line = [sys.executable, "-c", program]
        done = subprocess.run(
            line, stdout=subprocess.PIPE, stderr=full, cwd=tmp_path, text=True, check=False
        )
    assert done.stdout == "drove on\n"


def test_the_last_error_stays_short_however_many_rows_are_dropped(
    bridge: MCPBridge, file: Path, filed: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backlog, "MAX_WAITING_ROWS", 1)
    keep_in_memory(bridge)
    with write_lock(file):
        for n in range(50):
            bridge.publish({"n": n})
        assert bridge.stats().last_error == "rows are being dropped: database is locked"
    bridge.publish({"n": 50})
    catch_up(bridge)
    (told,) = filed.rows("SELECT data FROM event WHERE kind = 'dropped'")
    assert json.loads(told)["why"] == "database is locked"


@POSIX
@pytest.mark.usefixtures("retry_at_once")
def test_rows_that_went_into_a_deleted_file_are_counted_as_dropped(
    robot: InProcessSupervisor, bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    for n in range(3):
        bridge.publish({"n": n})
    heartbeat_now(bridge)
    for part in file.parent.glob(f"{DATABASE_NAME}*"):
        part.unlink()
    robot.step(STEP_MS)
    for n in range(3, 7):
        bridge.publish({"n": n})
    heartbeat_now(bridge)
    bridge.publish({"n": 7})
    catch_up(bridge)
    heartbeat_now(bridge)
    assert numbers(filed) == [7]
    assert bridge.stats().rows_dropped == 4
    assert filed.rows("SELECT row_count FROM run") == [1]
    told = filed.rows(
        "SELECT sim_time_s, json_extract(data, '$.row_count') FROM event WHERE name IS NULL"
    )
    assert (pytest.approx(STEP_MS / 1000), 4) in told


@POSIX
def test_rows_of_a_file_that_was_deleted_just_before_the_end_are_counted_as_dropped(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    heartbeat_now(bridge)
    for n in range(3):
        bridge.publish({"n": n})
    for part in file.parent.glob(f"{DATABASE_NAME}*"):
        part.unlink()
    bridge.close()
    assert bridge.stats().rows_dropped == 3
    assert filed.rows("SELECT json_extract(data, '$.row_count') FROM event WHERE name IS NULL") == [
        None,
        3,
    ]


@POSIX
@pytest.mark.usefixtures("retry_at_once")
def test_recording_goes_on_after_the_write_ahead_log_was_deleted(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    bridge.publish({"n": 0})
    Path(f"{file}-wal").unlink()
    bridge.publish({"n": 1})
    heartbeat_now(bridge)
    assert bridge.stats().rows_dropped == 1  # at the most: the maintainer may save it
    catch_up(bridge)
    bridge.publish({"n": 2})
    assert numbers(filed)[-1] == 2


@pytest.mark.usefixtures("retry_at_once")
def test_a_row_that_the_database_refuses_is_dropped_and_stops_no_other(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    with closing(connect(file, "writer")) as other:
        other.execute(
            "CREATE TRIGGER refuse BEFORE INSERT ON state WHEN json_extract(NEW.data, '$.n') = 1 "
            "BEGIN SELECT RAISE(ABORT, 'refused'); END"
        )
    for n in range(3):
        bridge.publish({"n": n})
    catch_up(bridge)
    with closing(sqlite3.connect(file)) as other:  # past our refusal of a file with a trigger
        other.execute("DROP TRIGGER refuse")
    assert numbers(filed) == [0, 2]
    assert bridge.stats().rows_waiting == 0
    assert bridge.stats().rows_dropped > 0


def test_a_row_that_waits_with_a_lone_surrogate_is_dropped_and_stops_no_other(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    bridge.publish({"n": 0, "\ud800": "a"})
    with write_lock(file):
        bridge.publish({"n": 1, "\ud800": "b"})
    bridge.publish({"n": 2, "\ud800": "c"})
    catch_up(bridge)
    assert numbers(filed) == [0, 1, 2]
    assert bridge.stats().rows_waiting == 0


def test_what_is_published_after_the_end_is_counted_and_said(
    bridge: MCPBridge, capfd: pytest.CaptureFixture[str]
) -> None:
    bridge.close()
    dropped = bridge.stats().rows_dropped
    bridge.publish({"n": 1})
    bridge.log("late")
    assert bridge.stats().rows_dropped == dropped + 2
    assert capfd.readouterr().err.count("the bridge is closed") == 1


def test_rows_of_several_threads_are_all_written(bridge: MCPBridge, filed: Recording) -> None:
    def write(thread: int) -> None:
        for n in range(200):
            bridge.log(f"{thread} {n}")

    threads = [threading.Thread(target=write, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        heartbeat_now(bridge)
        threads[0].join(0.001)  # a loop that never waits would take the threads their turns
    catch_up(bridge)
    assert filed.rows("SELECT count(*) FROM log WHERE source = 'controller'") == [800]
    assert bridge.stats().rows_dropped == 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_that_ends_leaves_the_session_of_its_parent_alone(tmp_path: Path) -> None:
    program = (
        "import os, sys\n"
        "from webots_mcp import MCPBridge\n"
        "from webots_mcp.standin import InProcessSupervisor\n"
        f"bridge = MCPBridge(InProcessSupervisor('rover'), {str(tmp_path)!r}, 1)\n"
        "bridge.publish({'n': 0})\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    bridge.publish({'n': 'child'})\n"
        "    bridge.get_command()\n"
        "    sys.exit(0)\n"
        "os.waitpid(child, 0)\n"
        "bridge.publish({'n': 1})\n"
        "os._exit(0)\n"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", program], check=True)
    recording = Recording(tmp_path / DATABASE_NAME)
    assert recording.rows("SELECT end_reason FROM session") == [None]
    assert numbers(recording) == [0, 1]


FORKED = """
import os, sys
from pathlib import Path
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor

def record(bridge, name):
    for n in range(100):
        bridge.publish({name: n})

folder = Path(sys.argv[1])
bridge = MCPBridge(InProcessSupervisor("parent"), folder, 1)
record(bridge, "n")
wait, go = os.pipe()
child = os.fork()
if child == 0:
    own = MCPBridge(InProcessSupervisor("child"), folder, 1)
    record(own, "c")
    os.read(wait, 1)
    record(own, "c")
    print(own.stats().rows_dropped, own.stats().last_error)
    sys.stdout.flush()
    os._exit(0)
record(bridge, "n")
bridge.close()
os.write(go, b"x")
os.waitpid(child, 0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_bridge_in_a_forked_child_does_not_destroy_the_database_of_its_parent(
    tmp_path: Path,
) -> None:
    line = [sys.executable, "-c", FORKED, str(tmp_path)]
    told = subprocess.run(line, stdout=subprocess.PIPE, check=True, text=True).stdout
    recording = Recording(tmp_path / DATABASE_NAME)
    assert recording.rows("PRAGMA integrity_check") == ["ok"]
    assert numbers(recording) == [*range(100), *range(100)]
    dropped, _, why = told.partition(" ")
    assert int(dropped) >= 200
    assert "forked from" in why
    assert "spawn" in why


@pytest.mark.parametrize("answer", [math.nan, math.inf])
def test_a_time_that_is_none_begins_no_run_and_holds_no_row_back(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    filed: Recording,
    answer: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for n in range(3):
        robot.step(STEP_MS)
        with monkeypatch.context() as patch:
            if n == 1:
                patch.setattr(robot, "getTime", lambda: answer)
            bridge.publish({"n": n})
        assert numbers(filed) == list(range(n + 1))
    assert filed.rows("SELECT count(*) FROM run") == [1]


_WITHOUT_FILES = """
import os, resource, sys
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor

resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
robot = InProcessSupervisor("rover")
bridge = MCPBridge(robot, sys.argv[1])
robot.step(16)
bridge.publish({"n": 0}, force=True)
try:
    while True:
        os.open(os.devnull, os.O_RDONLY)
except OSError:
    pass
"""


@POSIX
def test_a_controller_without_a_file_descriptor_left_ends_its_session_in_silence(
    file: Path, filed: Recording
) -> None:
    line = [sys.executable, "-c", _WITHOUT_FILES, str(file.parent)]
    ended = subprocess.run(line, capture_output=True, text=True, check=True)
    assert ended.stderr == ""
    assert filed.rows("SELECT end_reason FROM session") == ["finished"]
    assert numbers(filed) == [0]


_LOGS_WHILE_IT_CLOSES = """
import sys, threading
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor

def log(said):
    while not over.is_set():
        bridge.log("a line")
        said.append(1)

robot = InProcessSupervisor("rover")
for _ in range(10):
    bridge, over, said = MCPBridge(robot, sys.argv[1]), threading.Event(), [[] for _ in range(6)]
    threads = [threading.Thread(target=log, args=(each,)) for each in said]
    for thread in threads:
        thread.start()
    try:
        while sum(map(len, said)) < 200:
            pass
        bridge.close()
    finally:
        over.set()
    for thread in threads:
        thread.join()
    print(sum(map(len, said)), bridge.stats().rows_dropped)
"""


@pytest.mark.slow
def test_threads_may_log_while_the_bridge_closes(file: Path, filed: Recording) -> None:
    line = [sys.executable, "-c", _LOGS_WHILE_IT_CLOSES, str(file.parent)]
    ended = subprocess.run(line, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]
    counts = [tuple(map(int, told.split())) for told in ended.stdout.splitlines()]
    assert len(counts) == 10
    with closing(connect(file, "writer")) as connection:
        adopt(connection, file)  # what the last moment has left in files
    recorded = filed.rows("SELECT count(*) FROM log WHERE message = 'a line'")[0]
    assert recorded == sum(said - dropped for said, dropped in counts)
