"""A database that somebody else has locked costs no row, and never holds the robot up."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.bridge.conftest import (
    STEP_MS,
    Recording,
    catch_up,
    keep_in_memory,
    numbers,
    send,
    write_lock,
)
from tests.waiting import wait_for
from webots_mcp import MCPBridge
from webots_mcp.bridge import backlog
from webots_mcp.bridge.claimed_commands import ClaimedCommand, Progress
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor


def test_a_row_is_there_for_others_when_publish_returns_and_no_disk_is_waited_for(
    bridge: MCPBridge, filed: Recording
) -> None:
    connection = bridge._session.recorder.connection  # pyright: ignore[reportPrivateUsage]
    assert connection is not None
    modes = [
        connection.execute(f"PRAGMA {name}").fetchone() for name in ("journal_mode", "synchronous")
    ]
    assert modes == [("wal",), (1,)]  # NORMAL: a commit is in the log, and the disk has it later
    for n in range(3):
        bridge.publish({"n": n})
        assert numbers(filed) == list(range(n + 1))


def test_rows_that_meet_a_lock_wait_and_are_written_in_order(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    bridge.publish({"n": 0})
    with write_lock(file):
        started_s = time.perf_counter()
        for n in range(1, 100):
            bridge.publish({"n": n})
        assert time.perf_counter() - started_s < 4  # a single wait for the lock would take 5 s
        assert bridge.stats().rows_waiting == 99
        assert numbers(filed) == [0]
    bridge.publish({"n": 100})
    catch_up(bridge)
    assert numbers(filed) == list(range(101))


def test_beyond_the_limit_the_oldest_rows_are_dropped_counted_and_told(
    bridge: MCPBridge,
    file: Path,
    filed: Recording,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(backlog, "MAX_WAITING_ROWS", 10)
    keep_in_memory(bridge)
    with write_lock(file):
        for n in range(25):
            bridge.publish({"n": n})
    catch_up(bridge)
    bridge.publish({"n": 25})
    catch_up(bridge)
    assert numbers(filed) == list(range(15, 26))
    assert bridge.stats().rows_dropped == 15
    (told,) = filed.rows("SELECT data FROM event WHERE kind = 'dropped'")
    assert json.loads(told)["row_count"] == 15
    assert capfd.readouterr().err.count("rows are being dropped") == 1


def test_a_command_that_meets_a_lock_is_claimed_with_the_next_call(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    bridge.register_command("greet", lambda _: "hello")
    with write_lock(file) as other:
        sent = send(other, "greet", {})
        assert bridge.get_command() is None
    poll_until(bridge, lambda: filed.fate(sent)[0] == "done")
    assert filed.fate(sent)[1] == "hello"


def test_an_answer_that_meets_a_lock_is_written_later(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    other = connect(file, "writer")

    def lock(_: object) -> str:
        other.execute("BEGIN IMMEDIATE")
        return "locked"

    bridge.register_command("lock", lock)
    sent = filed.send("lock")
    poll_until(bridge, lambda: other.in_transaction)
    assert filed.fate(sent)[0] == "claimed"
    other.execute("COMMIT")
    other.close()
    bridge.publish({"n": 1})
    catch_up(bridge)
    assert filed.fate(sent)[:2] == ("done", "locked")


def test_breakpoints_stay_armed_through_a_reset_at_which_they_cannot_be_read(
    robot: InProcessSupervisor, bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    bridge.breakpoint("n == 1", "log")
    robot.step(2 * STEP_MS)
    with write_lock(file) as other:
        _store_breakpoint(other, "n == 2")
        bridge.publish({"n": 0})  # it waits, and nothing is read before it is written
        robot.simulationReset()
        robot.step(STEP_MS)
        bridge.publish({"n": 1})
    catch_up(bridge)
    for n in (0, 2):
        robot.step(STEP_MS)
        bridge.publish({"n": n})
    catch_up(bridge)

    told = filed.rows("SELECT name FROM event WHERE kind = 'breakpoint' ORDER BY id")
    assert told == ["n == 1", "n == 2"]


def test_a_breakpoint_that_cannot_be_stored_is_stored_when_it_is_set_again_or_a_run_begins(
    robot: InProcessSupervisor, bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    with write_lock(file):
        assert [bridge.breakpoint(f"n == {n}", "log") for n in (1, 2)] == [None, None]
    assert bridge.breakpoint("n == 1", "log") is not None
    assert filed.rows("SELECT condition FROM breakpoint") == ["n == 1"]
    robot.step(2 * STEP_MS)
    bridge.publish({"n": 0})
    robot.simulationReset()
    robot.step(STEP_MS)
    bridge.publish({"n": 0})
    assert filed.rows("SELECT condition FROM breakpoint ORDER BY id") == ["n == 1", "n == 2"]


def test_arming_is_answered_once_the_breakpoints_could_be_read(
    bridge: MCPBridge, file: Path
) -> None:
    with write_lock(file) as other:
        _store_breakpoint(other, "n == 2")
        bridge.publish({"n": 0})
        progress = _arming(bridge)
        next(progress)
    catch_up(bridge)

    with pytest.raises(StopIteration) as answer:
        next(progress)
    assert answer.value.value == {"armed": [1]}


def _arming(bridge: MCPBridge) -> Progress:
    """Begin the action that reads the stored breakpoints again."""
    actions = bridge._session.control._actions  # pyright: ignore[reportPrivateUsage]
    return actions["arm_breakpoints"](ClaimedCommand(1, "arm_breakpoints", {}, 1))


def _store_breakpoint(connection: sqlite3.Connection, condition: str, by: str = "mcp") -> None:
    connection.execute(
        "INSERT INTO breakpoint (robot_id, condition, action, created_wall_time_s, created_by) "
        "SELECT max(id), ?, 'log', 0, ? FROM robot",
        (condition, by),
    )


@pytest.mark.slow
def test_rows_of_a_loop_that_stands_still_are_written_by_the_maintainer(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    with write_lock(file):
        bridge.publish({"n": 1})
    assert wait_for(lambda: numbers(filed)) == [1]


def test_the_log_begins_anew_while_a_controller_runs(bridge: MCPBridge, file: Path) -> None:
    padding = "x" * 1000
    deadline_s = time.monotonic() + 20
    begun = _header_of_log(file)
    while _header_of_log(file) == begun:
        bridge.publish({"padding": padding})
        assert time.monotonic() < deadline_s


def _header_of_log(file: Path) -> bytes:
    """Its checkpoint sequence number and salt, which are others when it begins anew."""
    with Path(f"{file}-wal").open("rb") as log:
        return log.read(24)[12:]


def poll_until(bridge: MCPBridge, reached: Callable[[], bool]) -> None:
    wait_for(lambda: (bridge.get_command(), reached())[1])
