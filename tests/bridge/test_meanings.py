"""What a controller declares of its signals is recorded, whatever the database does meanwhile."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bridge.conftest import (
    Recording,
    catch_up,
    heartbeat_now,
    waiting_file,
    write_lock,
)
from tests.bridge.on_disk.conftest import adopt_into
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor

DECLARED = (
    "SELECT name, source, quantity, role, unit, target_of, side, low, high, set_by FROM meaning "
    "WHERE set_by = 'controller' ORDER BY id"
)


def test_a_declaration_is_recorded_with_all_that_it_says(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.describe("u", quantity="speed", role="commanded", unit="m/s", low=-1, high=1)
    bridge.describe("a.*", target_of="b", side="left")
    assert recording.rows(DECLARED) == [
        ("u", "declared", "speed", "commanded", "m/s", None, None, -1.0, 1.0, "controller"),
        ("a.*", "declared", None, None, None, "b", "left", None, None, "controller"),
    ]


def test_a_later_declaration_replaces_the_one_before(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.describe("u", quantity="speed", unit="m/s")
    bridge.describe("u", quantity="force")
    assert recording.rows("SELECT name, quantity, unit FROM meaning") == [("u", "force", None)]


def test_a_wrong_declaration_is_refused_where_it_stands_and_nothing_is_written(
    bridge: MCPBridge, recording: Recording
) -> None:
    with pytest.raises(ValueError, match="Use one of x, y, height"):
        bridge.describe("u", quantity="velocity")
    assert recording.rows(DECLARED) == []


def test_a_controller_may_describe_two_thousand_signals(
    bridge: MCPBridge, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webots_mcp.bridge.signal_meanings.MOST_DECLARED", 2)
    for name in ("a", "b", "a"):
        bridge.describe(name, unit=f"m{name}")
    with pytest.raises(ValueError, match="describe several at once with"):
        bridge.describe("c", unit="m")


def test_a_declaration_made_while_the_database_is_locked_comes_in_later(
    robot: InProcessSupervisor, file: Path, filed: Recording
) -> None:
    with MCPBridge(robot, data_dir=file.parent) as bridge:
        with write_lock(file):
            bridge.describe("u", quantity="speed")
            assert bridge.stats().rows_waiting
            assert '"meaning"' in waiting_file(bridge).read_text()
        catch_up(bridge)
        assert filed.rows(DECLARED) == [
            ("u", "declared", "speed", None, None, None, None, None, None, "controller")
        ]


@pytest.mark.slow
def test_what_waits_when_the_controller_ends_is_taken_in_by_the_next_process(
    robot: InProcessSupervisor, file: Path, filed: Recording
) -> None:
    bridge = MCPBridge(robot, data_dir=file.parent)
    with write_lock(file):
        bridge.describe("u", quantity="speed")
        bridge.close()
    assert adopt_into(file) > 0
    assert filed.rows("SELECT name, quantity FROM meaning") == [("u", "speed")]


def test_a_new_database_has_the_declarations_too(
    robot: InProcessSupervisor, file: Path, filed: Recording
) -> None:
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=1) as bridge:
        bridge.describe("u", quantity="speed")
        for each in file.parent.glob("webots.db*"):
            each.unlink()
        heartbeat_now(bridge)
        bridge.publish({"u": 1})
        catch_up(bridge)
        assert filed.rows("SELECT name, quantity FROM meaning") == [("u", "speed")]
