"""A database that somebody else has locked costs no row, and never holds the robot up."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.bridge.conftest import (
    Recording,
    catch_up,
    keep_in_memory,
    numbers,
    send,
    write_lock,
)
from webots_mcp import MCPBridge
from webots_mcp.bridge import backlog
from webots_mcp.connection import connect


def test_rows_that_meet_a_lock_wait_and_are_written_in_order(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    bridge.publish({"n": 0})
    with write_lock(file):
        started_s = time.perf_counter()
        for n in range(1, 100):
            bridge.publish({"n": n})
        assert time.perf_counter() - started_s < 1  # a single wait for the lock would be five
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
    bridge.publish({"n": 25})
    catch_up(bridge)
    assert numbers(filed) == list(range(15, 26))
    assert bridge.stats().rows_dropped == 15
    (told,) = filed.rows("SELECT data FROM event WHERE kind = 'dropped'")
    assert json.loads(told)["rows"] == 15
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


def test_rows_of_a_loop_that_stands_still_are_written_by_the_maintainer(
    bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    with write_lock(file):
        bridge.publish({"n": 1})
    deadline_s = time.monotonic() + 10
    while not numbers(filed):
        assert time.monotonic() < deadline_s
    assert numbers(filed) == [1]


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
    deadline_s = time.monotonic() + 5
    while not reached():
        bridge.get_command()
        assert time.monotonic() < deadline_s
