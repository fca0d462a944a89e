"""What is in the recording."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from tests.diagnosis.conftest import Look
from tests.older_recording import make_older
from tests.recordings.rows import Recorded, RecordedRobot
from webots_mcp.connection import OLDER_SCHEMA
from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.queue import CommandQueue
from webots_mcp.waiting_file import waiting_path

KILLED = """
import os, signal, sys
from pathlib import Path
from webots_mcp import MCPBridge
from webots_mcp.connection import connect
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


def test_a_newer_schema_asks_for_a_newer_version(
    look: Look, file: Path, recorded: Recorded
) -> None:
    recorded.connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    assert "upgrade" in (look("Schema").fix or "")


def test_a_file_that_is_no_database_is_wrong(look: Look, file: Path) -> None:
    file.write_bytes(b"a letter to a friend, in no format" * 99)
    database = look("Database")
    assert database.verdict == "wrong"
    assert "not a database" in database.seen


def test_a_database_that_is_damaged_in_its_middle_is_wrong(
    look: Look, file: Path, bridge_recording: Path
) -> None:
    content = bytearray(bridge_recording.read_bytes())
    content[4096 * 4 : 4096 * 12] = b"garbage!" * 4096
    file.write_bytes(content)
    rows = look("Recording now")
    assert (rows.verdict, "is damaged" in rows.seen) == ("wrong", True)
    assert ".recover" in (rows.fix or "")


def test_a_journal_that_is_no_wal_is_wrong(look: Look, file: Path, recorded: Recorded) -> None:
    recorded.close()
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")
    database = look("Database")
    assert (database.verdict, "journal mode delete" in database.seen) == ("wrong", True)


def test_who_records_is_named_with_its_process_and_python(look: Look, recorded: Recorded) -> None:
    robot = recorded.robot()
    (pid,) = robot.connection.execute("SELECT pid FROM session").fetchone()
    now = look("Recording now")
    assert now.verdict == "ok"
    assert f"rover (process {pid}, Python 3.11.7)" in now.seen


def test_where_nobody_records_it_is_said_since_when(look: Look, recorded: Recorded) -> None:
    gone(recorded)
    now = look("Recording now")
    assert now.verdict == "warning"
    assert "the last sign of life was 0." in now.seen


@pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")
def test_rows_that_wait_for_a_killed_writer_are_counted_and_named(look: Look, file: Path) -> None:
    line = [sys.executable, "-c", KILLED, str(file)]
    ended = subprocess.run(line, check=False, capture_output=True, text=True)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    rows = look("Rows")
    assert rows.verdict == "warning"
    assert "7 rows of a controller that is gone wait in webots.db-waiting-" in rows.seen
    assert "webots-mcp serve" in (rows.fix or "")


def test_where_not_even_a_waiting_file_could_be_begun_rows_may_be_lost(
    look: Look, recorded: Recorded, file: Path
) -> None:
    gone(recorded)
    waiting_path(file, "d3").touch()  # as a full disk leaves it
    rows = look("Rows")
    assert rows.verdict == "warning"
    assert "rows may be lost that nothing counts" in rows.seen


def test_dropped_rows_of_a_living_controller_are_wrong(look: Look, recorded: Recorded) -> None:
    recorded.robot(rows_dropped=3, last_error="disk full")
    rows = look("Rows")
    assert rows.verdict == "wrong"
    assert rows.seen == "3 rows of rover were dropped (disk full)"


def test_commands_that_are_not_overdue_are_counted(look: Look, recorded: Recorded) -> None:
    robot = recorded.robot()
    CommandQueue(robot.connection).enqueue(robot.id, "pause")
    assert look("Commands").seen == "1 queued, 0 claimed, none overdue"


def test_an_overdue_command_of_a_loop_that_never_asks_names_the_line_that_it_lacks(
    look: Look, recorded: Recorded
) -> None:
    overdue(recorded.robot(last_poll_wall_time_s=None))
    commands = look("Commands")
    assert commands.verdict == "wrong"
    assert "command 1 (pause) for rover waits since 60" in commands.seen
    assert "never calls get_command()" in commands.seen
    assert "bridge.get_command()" in (commands.fix or "")


def test_an_overdue_command_of_a_controller_that_is_gone_says_so(
    look: Look, recorded: Recorded
) -> None:
    overdue(gone(recorded))
    assert "its controller is gone" in look("Commands").seen


def test_a_command_that_a_dead_controller_has_claimed_is_lost(
    look: Look, recorded: Recorded
) -> None:
    robot = gone(recorded)
    CommandQueue(robot.connection).enqueue(robot.id, "aim")
    robot.connection.execute(
        "UPDATE command SET status = 'claimed', session_id = ?, claimed_wall_time_s = ?",
        (robot.session_id, time.time()),
    )
    commands = look("Commands")
    assert (commands.verdict, "it is lost" in commands.seen) == ("warning", True)


def test_a_loop_that_records_and_never_asks_for_commands_is_warned_of(
    look: Look, recorded: Recorded
) -> None:
    now = time.time()
    recorded.robot(last_poll_wall_time_s=None, started_wall_time_s=now - 60, now=now)
    assert "never called get_command()" in look("get_command").seen


def test_a_loop_that_has_ceased_to_ask_and_goes_on_is_warned_of(
    look: Look, recorded: Recorded
) -> None:
    now = time.time()
    recorded.robot(now=now, last_poll_wall_time_s=now - 40)
    polled = look("get_command")
    assert polled.verdict == "warning"
    assert "called get_command() last 4" in polled.seen


def test_a_loop_that_asks_is_well(look: Look, recorded: Recorded) -> None:
    recorded.robot()
    assert look("get_command").verdict == "ok"
