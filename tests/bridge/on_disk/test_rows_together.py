"""Lines that are written together: each once, in their order, whatever the database does."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from tests.bridge.conftest import (
    STEP_MS,
    Recording,
    catch_up,
    heartbeat_now,
    numbers,
    write_lock,
)
from webots_mcp import MCPBridge
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor

LINES = (
    "SELECT log.message, log.run_id, session.id FROM log JOIN run ON run.id = log.run_id "
    "JOIN session ON session.id = run.session_id ORDER BY log.id"
)


def printed(bridge: MCPBridge, *lines: str) -> None:
    """Record lines as the bridge does that a controller has printed."""
    bridge._session.journal.output("stdout", lines)  # pyright: ignore[reportPrivateUsage]


def test_each_line_is_written_once_in_one_transaction_with_its_run_and_counted(
    bridge: MCPBridge, filed: Recording
) -> None:
    before = bridge.stats().rows_written
    connection = bridge._session.recorder.connection  # pyright: ignore[reportPrivateUsage]
    assert connection is not None
    done = list[str]()
    connection.set_trace_callback(done.append)
    printed(bridge, "one", "two", "three")
    connection.set_trace_callback(None)
    assert filed.rows(LINES) == [("one", 1, 1), ("two", 1, 1), ("three", 1, 1)]
    assert bridge.stats().rows_written == before + 3
    assert [each.split()[0] for each in done] == ["BEGIN", *["INSERT"] * 3, "COMMIT"]


def test_lines_of_the_run_before_stay_there(
    robot: InProcessSupervisor, bridge: MCPBridge, filed: Recording
) -> None:
    for n in range(3):
        robot.step(STEP_MS)
        bridge.publish({"n": n})
    printed(bridge, "first run")
    robot.simulationReset()
    robot.step(STEP_MS)
    bridge.publish({"n": 3})
    printed(bridge, "second run")
    assert filed.rows(LINES) == [("first run", 1, 1), ("second run", 2, 1)]


def test_lines_that_meet_a_lock_are_written_once_when_it_is_gone(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    with write_lock(file):
        printed(bridge, "one", "two")
        printed(bridge, "three")
    catch_up(bridge)
    assert [row[0] for row in filed.rows(LINES)] == ["one", "two", "three"]
    assert bridge.stats().rows_dropped == 0


def test_a_line_that_the_database_refuses_costs_no_other_line(
    bridge: MCPBridge, filed: Recording, file: Path
) -> None:
    with write_lock(file) as other:
        other.execute(
            "CREATE TRIGGER no BEFORE INSERT ON log WHEN new.message = 'two' "
            "BEGIN SELECT raise(ABORT, 'never'); END"
        )
    printed(bridge, "one", "two", "three")
    catch_up(bridge)
    with closing(sqlite3.connect(file)) as other:
        other.execute("DROP TRIGGER no")
    assert [row[0] for row in filed.rows(LINES)] == ["one", "three"]


def test_the_heartbeat_carries_the_last_error(bridge: MCPBridge, filed: Recording) -> None:
    bridge.log("text", level="loud")
    heartbeat_now(bridge)
    (told,) = filed.rows("SELECT last_error FROM session")
    assert "loud" in told
    assert told == bridge.stats().last_error


@pytest.mark.usefixtures("retry_at_once")
def test_a_damaged_database_moves_with_its_log_and_its_name_says_when(
    robot: InProcessSupervisor, bridge: MCPBridge, file: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bridge.publish({"n": 0})
    log = file.with_name(f"{DATABASE_NAME}-wal")
    assert log.exists()
    before = {path.name: path.stat().st_ino for path in (file, log)}
    recorder = bridge._session.recorder  # pyright: ignore[reportPrivateUsage]
    with closing(connect(file, "reader")) as reader:  # SQLite keeps the log for it
        reader.execute("SELECT count(*) FROM state").fetchall()
        recorder._put_off(sqlite3.DatabaseError("database disk image is malformed"))  # pyright: ignore[reportPrivateUsage]
    robot.step(STEP_MS)
    bridge.publish({"n": 1})
    catch_up(bridge)
    moved = {path.name: path.stat().st_ino for path in file.parent.glob("*.damaged-*")}
    names = [name for name in moved if not name.endswith("-shm")]
    stamps = {name.partition(".damaged-")[2].removesuffix("-wal") for name in names}
    assert {before[DATABASE_NAME], before[log.name]} <= {*moved.values()}
    (stamp,) = stamps
    day, _, clock = stamp.partition("-")
    assert (len(day), len(clock)) == (8, 6)
    assert (day + clock).isdigit()
    assert "malformed" in capfd.readouterr().err


@pytest.mark.usefixtures("retry_at_once")
def test_a_damaged_database_that_cannot_be_moved_is_said_once_and_takes_rows_when_it_can(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    file: Path,
    filed: Recording,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("it is in use")

    recorder = bridge._session.recorder  # pyright: ignore[reportPrivateUsage]
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", refuse)
        for _ in range(3):
            recorder._put_off(sqlite3.DatabaseError("database disk image is malformed"))  # pyright: ignore[reportPrivateUsage]
    said = capfd.readouterr().err
    assert said.count("is damaged and cannot be renamed: it is in use; move it away by hand") == 1
    robot.step(STEP_MS)
    bridge.publish({"n": 1})
    catch_up(bridge)
    assert numbers(filed) == [1]
