"""What each check finds in recordings that are not as they should be, and in some that are."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.older_recording import OLDER_SCHEMA, make_older
from tests.recordings.rows import Recorded, RecordedRobot
from tests.setup.doctor.conftest import Look
from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.database.queue import CommandQueue
from webots_mcp.database.waiting_file import waiting_path

KILLED = """
import os, signal, sys
from pathlib import Path
from webots_mcp import MCPBridge
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor

file = Path(sys.argv[1])
robot = InProcessSupervisor("rover")
bridge = MCPBridge(robot, throttle_interval=1, database=file)
other = connect(file, "writer")
other.execute("BEGIN IMMEDIATE")
for n in range(7):
    robot.step(16)
    bridge.publish({"n": n})
os.kill(os.getpid(), signal.SIGKILL)
"""


def gone(recorded: Recorded) -> RecordedRobot:
    """A robot whose controller was killed."""
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    return recorded.robot(pid=process.pid)


def overdue(robot: RecordedRobot) -> None:
    queue = CommandQueue(robot.connection, clock=lambda: time.time() - 60)
    queue.enqueue(robot.id, "pause")


def without_wal(recorded: Recorded) -> None:
    recorded.close()
    with closing(sqlite3.connect(str(recorded.database))) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")


def waiting_file_that_was_not_begun(recorded: Recorded) -> None:
    gone(recorded)
    waiting_path(Path(str(recorded.database)), "d3").touch()  # as a full disk leaves it


def claimed_by_a_dead_controller(recorded: Recorded) -> None:
    robot = gone(recorded)
    CommandQueue(robot.connection).enqueue(robot.id, "aim")
    robot.connection.execute(
        "UPDATE command SET status = 'claimed', session_id = ?, claimed_wall_time_s = ?",
        (robot.session_id, time.time()),
    )


def never_polled(recorded: Recorded) -> None:
    now = time.time()
    recorded.robot(last_poll_wall_time_s=None, started_wall_time_s=now - 60, now=now)


def no_longer_polled(recorded: Recorded) -> None:
    now = time.time()
    recorded.robot(now=now, last_poll_wall_time_s=now - 40)


def queued(recorded: Recorded) -> None:
    robot = recorded.robot()
    CommandQueue(robot.connection).enqueue(robot.id, "pause")


Arrange = Callable[[Recorded], object]

# What is arranged; the check, its verdict, what is seen, and what mends it.
SCENARIOS: dict[str, tuple[Arrange, str, str, str, str]] = {
    "a newer schema asks for a newer version": (
        lambda r: r.connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}"),
        "Schema", "wrong", f"{SCHEMA_VERSION + 1}, this", "upgrade"),
    "a journal that is no wal": (
        without_wal, "Database", "wrong", "journal mode delete", "local disk"),
    "nobody records any more": (
        gone, "Recording now", "warning", "the last sign of life was 0.", "start the simulation"),
    "not even a waiting file could be begun": (
        waiting_file_that_was_not_begun,
        "Rows", "warning", "rows may be lost that nothing counts", "free space"),
    "a living controller drops rows": (
        lambda r: r.robot(rows_dropped=3, last_error="disk full"),
        "Rows", "wrong", "3 rows of rover were dropped (disk full)", "what was dropped is lost"),
    "commands that are not overdue are counted": (
        queued, "Commands", "ok", "1 queued, 0 claimed, none overdue", ""),
    "an overdue command of a loop that never asks": (
        lambda r: overdue(r.robot(last_poll_wall_time_s=None)),
        "Commands", "wrong", "command 1 (pause) for rover waits since 60", "bridge.get_command()"),
    "an overdue command of a controller that is gone": (
        lambda r: overdue(gone(r)), "Commands", "wrong", "its controller is gone", "start"),
    "a command that a dead controller has claimed": (
        claimed_by_a_dead_controller, "Commands", "warning", "it is lost", "ask again"),
    "a loop that records and never asks": (
        never_polled, "get_command", "warning", "never called get_command()", "attach(robot)"),
    "a loop that has ceased to ask and goes on": (
        no_longer_polled, "get_command", "warning", "called get_command() last 4", "attach(robot)"),
    "a loop that asks": (
        lambda r: r.robot(), "get_command", "ok", "rover's loop asks for commands", ""),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_check_finds_it_and_what_mends_it(look: Look, recorded: Recorded, name: str) -> None:
    arrange, check, verdict, seen, fix = SCENARIOS[name]
    arrange(recorded)
    found = look(check)
    assert found.verdict == verdict, found
    assert seen in found.seen
    assert fix in (found.fix or "")


def test_where_nothing_was_recorded_the_lines_that_record_are_shown(look: Look) -> None:
    database = look("Database")
    assert (database.verdict, "nothing was recorded" in database.seen) == ("warning", True)
    assert "MCPBridge.attach(robot)" in (database.fix or "")
    assert look("Rows").verdict == look("Schema").verdict == "not checked"


def test_an_older_schema_says_what_to_do_with_the_recording(look: Look, file: Path) -> None:
    make_older(file)
    schema = look("Schema")
    assert schema.verdict == "wrong"
    assert schema.seen == f"{OLDER_SCHEMA}, this webots-mcp needs {SCHEMA_VERSION}"
    assert "move it aside" in (schema.fix or "")
    assert look("Database").verdict == "ok"


def test_a_file_that_is_no_database_or_is_damaged_is_wrong(
    look: Look, file: Path, bridge_recording: Path
) -> None:
    file.write_bytes(b"a letter to a friend, in no format" * 99)
    database = look("Database")
    assert (database.verdict, "not a database" in database.seen) == ("wrong", True)
    content = bytearray(bridge_recording.read_bytes())
    content[4096 * 4 : 4096 * 12] = b"garbage!" * 4096
    file.write_bytes(content)
    rows = look("Recording now")
    assert (rows.verdict, "is damaged" in rows.seen) == ("wrong", True)
    assert ".recover" in (rows.fix or "")


def test_who_records_is_named_with_its_process_and_python(look: Look, recorded: Recorded) -> None:
    robot = recorded.robot()
    (pid,) = robot.connection.execute("SELECT pid FROM session").fetchone()
    now = look("Recording now")
    assert now.verdict == "ok"
    assert f"rover (process {pid}, Python 3.11.7)" in now.seen


@pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")
def test_rows_that_wait_for_a_killed_writer_are_counted_and_named(look: Look, file: Path) -> None:
    line = [sys.executable, "-c", KILLED, str(file)]
    ended = subprocess.run(line, check=False, capture_output=True, text=True)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    rows = look("Rows")
    assert rows.verdict == "warning"
    assert "7 rows of a controller that is gone wait in webots.db-waiting-" in rows.seen
    assert "webots-mcp serve" in (rows.fix or "")
