"""Whose a command is: of the newest session of its robot, and of whoever can still answer it."""

from __future__ import annotations

import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from tests.bridge.conftest import Recording, eager, heartbeat_now
from webots_mcp import MCPBridge
from webots_mcp.bridge import control
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor

SUCCESSOR = (
    "INSERT INTO session (robot_id, pid, host, instance, supervisor, started_wall_time_s, "
    "last_seen_wall_time_s) SELECT robot_id, 4242, host, instance, 1, 0, 0 FROM session"
)


def write(recording: Recording, sql: str) -> None:
    with closing(connect(recording.database, "writer")) as connection:
        connection.execute(sql)


def test_a_session_that_was_judged_dead_leaves_commands_to_its_living_successor(
    robot: InProcessSupervisor, recording: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
    ran: list[Any] = []
    bridge = MCPBridge(robot, database=recording.database)
    bridge.register_command("dance", ran.append)
    write(recording, "UPDATE session SET ended_wall_time_s = 1, end_reason = 'crashed'")
    write(recording, SUCCESSOR)
    heartbeat_now(bridge)
    assert recording.rows("SELECT end_reason FROM session ORDER BY id") == ["crashed", None]
    sent = recording.send("dance")
    eager(bridge)
    assert (ran, recording.fate(sent)[0]) == ([], "pending")
    assert "go to process 4242" in capsys.readouterr().err
    write(recording, "UPDATE session SET ended_wall_time_s = 2 WHERE pid = 4242")
    eager(bridge)
    assert (len(ran), recording.fate(sent)[0]) == (1, "done")
    bridge.close()


def test_a_command_that_was_judged_lost_stays_lost(
    robot: InProcessSupervisor, recording: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
    bridge = MCPBridge(robot, database=recording.database)
    bridge.register_command(
        "dance", lambda _: write(recording, "UPDATE command SET status = 'lost'")
    )
    sent = recording.send("dance")
    eager(bridge)
    assert recording.fate(sent)[0] == "lost"
    assert "was declared lost before it was done" in capsys.readouterr().err
    bridge.close()


def test_an_interrupt_between_claim_and_start_leaves_no_command_claimed(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.register_command("dance", lambda _: None)
    eager(bridge)
    line = _line_after("queue.claim(")
    sent = recording.send("dance")

    def interrupt(frame: FrameType, event: str, _: object) -> Any:
        if frame.f_code.co_filename != control.__file__:
            return None
        if event == "line" and frame.f_lineno >= line and frame.f_locals.get("command"):
            sys.settrace(None)
            raise KeyboardInterrupt
        return interrupt

    sys.settrace(interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            eager(bridge)
    finally:
        sys.settrace(None)
    assert recording.fate(sent)[0] == "claimed"
    later = recording.send("dance")
    eager(bridge)
    assert recording.fate(sent)[0] == "failed"
    assert "it was not run" in (recording.fate(sent)[2] or "")
    assert recording.fate(later)[0] == "done"


def _line_after(code: str) -> int:
    lines = Path(control.__file__).read_text("utf-8").splitlines()
    return next(number for number, line in enumerate(lines, 1) if code in line) + 1


def test_moving_a_damaged_database_aside_takes_no_lock_from_another_connection(
    robot: InProcessSupervisor, tmp_path: Path
) -> None:
    file = tmp_path / "notes.sqlite"
    file.write_bytes(b"no database at all, but long enough to look like one" * 40)
    opened: list[str] = []

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        # Without a mode it is os.open, which only makes a file that is not there.
        if watching and event == "open" and arguments[0] == str(file) and arguments[1]:
            opened.append(event)

    watching = True
    sys.addaudithook(watch)
    try:
        MCPBridge(robot, database=file).close()
    finally:
        watching = False
    assert opened == []
    assert file.read_bytes().startswith(b"no database at all")
    with pytest.raises(sqlite3.DatabaseError), closing(sqlite3.connect(file)) as connection:
        connection.execute("SELECT 1 FROM sqlite_master").fetchall()
