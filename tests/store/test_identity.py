"""Every recording, session and run has a UUID, so that those of many machines can be pooled."""

from __future__ import annotations

import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
import uuid
from contextlib import closing
from pathlib import Path

import pytest

from tests.bridge.conftest import heartbeat_now
from webots_mcp import MCPBridge
from webots_mcp.database.connection import connect
from webots_mcp.database.processes import has_lost_simulator, process_identity, signal_process
from webots_mcp.database.schema import create_schema
from webots_mcp.database.thread_stacks import SIGNAL
from webots_mcp.standin import InProcessSupervisor


def is_random_uuid(text: str) -> bool:
    return str(uuid.UUID(text)) == text and uuid.UUID(text).version == 4


def uuids(connection: sqlite3.Connection, table: str) -> list[str]:
    found = [text for (text,) in connection.execute(f"SELECT uuid FROM {table}")]
    assert all(map(is_random_uuid, found)), found
    return found


def test_starters_at_once_make_one_recording(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with (
        closing(connect(file, "writer", create=True)) as first,
        closing(connect(file, "writer", create=True)) as second,
    ):
        create_schema(first)
        create_schema(second)
        assert len(uuids(second, "recording")) == 1


def test_a_bridge_names_its_session_and_each_of_its_runs(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    robot = InProcessSupervisor()
    bridge = MCPBridge(robot, database=file, throttle_interval=1)
    robot.step(160)
    bridge.publish({"x": 1})
    robot.simulationReset()
    robot.step(16)
    bridge.publish({"x": 2})
    bridge.close()
    with closing(connect(file, "reader")) as connection:
        assert len(uuids(connection, "recording")) == 1
        assert len(uuids(connection, "session")) == 1
        assert len(set(uuids(connection, "run"))) == 2


@pytest.mark.skipif(sys.platform == "win32", reason="an open file cannot be moved there")
def test_a_run_that_goes_on_in_a_new_database_is_another_one_there(tmp_path: Path) -> None:
    file, moved = tmp_path / "webots.db", tmp_path / "moved.db"
    bridge = MCPBridge(InProcessSupervisor(), database=file)
    bridge.publish({"x": 1})
    for suffix in ("", "-wal", "-shm"):
        file.with_name(f"{file.name}{suffix}").rename(f"{moved}{suffix}")
    heartbeat_now(bridge)
    bridge.close()
    runs: list[str] = []
    for database in (file, moved):
        with closing(connect(database, "reader")) as connection:
            runs += uuids(connection, "run")
    assert len(set(runs)) == 2


def test_a_bridge_says_when_it_was_last_seen_by_a_clock_that_nobody_sets(tmp_path: Path) -> None:
    before_s = time.monotonic()
    bridge = MCPBridge(InProcessSupervisor(), database=tmp_path / "webots.db")
    bridge.get_command()
    bridge.close()
    with closing(connect(tmp_path / "webots.db", "reader")) as connection:
        (seen_s,) = connection.execute("SELECT last_seen_monotonic_s FROM session").fetchone()
    assert before_s < seen_s < time.monotonic()


@pytest.mark.parametrize(
    ("variables", "extern"),
    [
        ({}, 0),
        ({"WEBOTS_CONTROLLER_URL": "tcp://here:1234/rover"}, 1),
        ({"WEBOTS_ROBOT_NAME": "rover", "WEBOTS_INSTANCE_PATH": "/tmp/webots/ada/1234/"}, 0),
    ],
)
def test_a_session_says_whether_anybody_starts_its_controller_again(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    variables: dict[str, str],
    extern: int,
) -> None:
    for name in ("WEBOTS_CONTROLLER_URL", "WEBOTS_INSTANCE_PATH", "WEBOTS_ROBOT_NAME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    MCPBridge(InProcessSupervisor(), database=tmp_path / "webots.db").close()
    with closing(connect(tmp_path / "webots.db", "reader")) as connection:
        assert connection.execute("SELECT extern FROM session").fetchall() == [(extern,)]


def test_a_session_says_which_process_of_its_pid_it_is(tmp_path: Path) -> None:
    MCPBridge(InProcessSupervisor(), database=tmp_path / "webots.db").close()
    with closing(connect(tmp_path / "webots.db", "reader")) as connection:
        (process,) = connection.execute("SELECT process FROM session").fetchone()
    assert process == process_identity(os.getpid())


@pytest.mark.skipif(not sys.platform.startswith(("linux", "win")), reason="not told there")
def test_two_processes_are_told_apart_and_one_that_ended_is_none() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        told = process_identity(other.pid)
        assert told == process_identity(other.pid)
        assert None is not told != process_identity(os.getpid())
        other.communicate(b"\n")
    assert process_identity(other.pid) is None


@pytest.mark.skipif(sys.platform != "linux", reason="is sent on Linux only")
def test_a_signal_reaches_the_process_that_expects_it_and_no_other_of_its_pid() -> None:
    waits = "import signal; signal.signal({}, lambda *_: print('caught')); print(signal.pause())"
    for number, is_that_process, is_sent in (
        (SIGNAL, True, True),
        (SIGNAL, False, False),
        (signal.SIGUSR1, True, False),  # what another program expects, begun by exec in its place
    ):
        command = [sys.executable, "-uc", f"print(0); {waits.format(int(number))}"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdout is not None and other.stdout.readline() == "0\n"
            while (state := _caught(other.pid)) >> number - 1 & 1 == 0:
                assert other.poll() is None, state
            identity = process_identity(other.pid if is_that_process else os.getpid())
            signal_process(other.pid, identity, SIGNAL)
            if not is_sent:
                other.kill()
            said = other.stdout.read()
        assert (other.returncode, said) == ((0, "caught\nNone\n") if is_sent else (-9, ""))


def _caught(pid: int) -> int:
    return int(Path(f"/proc/{pid}/status").read_text().partition("SigCgt:")[2].split()[0], 16)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux shows it")
def test_a_connection_that_webots_has_closed_is_told_from_one_that_stands() -> None:
    with socket.create_server(("127.0.0.1", 0)) as webots:
        port = webots.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as controller:
            accepted, _ = webots.accept()
            instance, pid = f"host:{port}", os.getpid()
            assert not has_lost_simulator(pid, instance)
            accepted.close()
            assert controller.recv(1) == b""
            assert has_lost_simulator(pid, instance)
            assert not has_lost_simulator(pid, f"host:{port + 1}")
            assert not has_lost_simulator(pid, "host process 7")
        assert not has_lost_simulator(pid, instance)
        assert not has_lost_simulator(2**22 + 1, instance)
