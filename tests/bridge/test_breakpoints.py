"""Breakpoints are asked of every published state, and act at the very step."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.contract import MAX_BREAKPOINTS
from webots_mcp.database.connection import connect
from webots_mcp.errors import InvalidConditionError, InvalidInputError
from webots_mcp.standin import InProcessRobot, InProcessSupervisor


@pytest.fixture
def throttled(
    robot: InProcessSupervisor, database: MemoryDatabase, monkeypatch: pytest.MonkeyPatch
) -> MCPBridge:
    """A bridge that records one call in ten; strict, so that a test sees what went wrong."""
    monkeypatch.setenv("WEBOTS_MCP_STRICT", "1")
    return MCPBridge(robot, throttle_interval=10, database=database)


def drive(robot: Any, bridge: MCPBridge, states: list[dict[str, Any]]) -> None:
    """One round of the user's loop for each state."""
    for state in states:
        assert robot.step(STEP_MS) != -1
        bridge.publish(state)
        eager(bridge)


def counted(numbers: range) -> list[dict[str, Any]]:
    return [{"n": number, "mode": "drive"} for number in numbers]


def hits(recording: Recording) -> list[tuple[float, str, dict[str, Any]]]:
    """Simulation time, condition and data of each hit that was told."""
    sql = "SELECT sim_time_s, name, data FROM event WHERE kind = 'breakpoint' ORDER BY id"
    return [(time_s, name, json.loads(data)) for time_s, name, data in recording.rows(sql)]


def warnings(recording: Recording) -> list[str]:
    return recording.rows("SELECT message FROM log WHERE level = 'warning' ORDER BY id")


def store(database: MemoryDatabase, condition: str, action: str = "log") -> int:
    """A breakpoint as a server stores it."""
    connection = connect(database, "writer")
    try:
        cursor = connection.execute(
            "INSERT INTO breakpoint (robot_id, condition, action, created_wall_time_s, created_by) "
            "VALUES ((SELECT max(id) FROM robot), ?, ?, ?, 'mcp')",
            (condition, action, time.time()),
        )
        assert cursor.lastrowid is not None
        return cursor.lastrowid
    finally:
        connection.close()


def test_a_hit_tells_the_very_step_and_its_values_also_of_a_call_that_is_not_recorded(
    robot: InProcessSupervisor, throttled: MCPBridge, recording: Recording
) -> None:
    number = throttled.breakpoint("n > 12 and mode == 'drive'", "log")
    start_s = robot.getTime()

    drive(robot, throttled, counted(range(1, 16)))

    ((time_s, name, data),) = hits(recording)
    assert time_s == pytest.approx(start_s + 13 * STEP_MS / 1000)
    assert name == "n > 12 and mode == 'drive'"
    assert data == {
        "breakpoint_id": number, "action": "log", "hit_count": 1,
        "values": {"n": 13, "mode": "drive"},
    }  # fmt: skip
    assert [state["n"] for state in recording.states()] == [10, 13]
    assert recording.rows("SELECT id, hit_count, created_by FROM breakpoint") == [
        (number, 1, "controller")
    ]


def test_it_pauses_at_the_very_step_until_it_is_resumed(
    robot: InProcessSupervisor, throttled: MCPBridge, recording: Recording
) -> None:
    throttled.breakpoint("n == 3")
    drive(robot, throttled, counted(range(1, 3)))
    assert robot.step(STEP_MS) != -1
    at_s = robot.getTime()
    throttled.publish({"n": 3})
    assert robot.simulationGetMode() == robot.SIMULATION_MODE_PAUSE
    resume = recording.send("resume")

    throttled.get_command()  # at once, not only after the 5 ms in which it does not ask

    assert robot.getTime() == at_s
    assert recording.fate(resume)[0] == "done"
    assert [time_s for time_s, _, _ in hits(recording)] == [pytest.approx(at_s)]
    (data,) = recording.rows("SELECT data FROM event WHERE kind = 'pause'")
    assert json.loads(data)["condition"] == "n == 3"


def test_a_plain_robot_records_and_says_that_it_cannot_pause(
    database: MemoryDatabase, recording: Recording
) -> None:
    robot = InProcessRobot("plain")
    with MCPBridge(robot, throttle_interval=1, database=database) as bridge:
        bridge.breakpoint("n == 2", "pause")
        drive(robot, bridge, counted(range(5)))

    ((_, _, data),) = hits(recording)
    assert "supervisor" in data["not_paused"]


def test_it_is_hit_each_time_that_it_begins_to_hold(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    bridge.breakpoint("near", "log", after_hits=2)

    drive(robot, bridge, [{"near": near} for near in (True, True, False, True, False, True)])

    assert [data["hit_count"] for _, _, data in hits(recording)] == [2, 3]
    assert recording.rows("SELECT hit_count FROM breakpoint") == [3]


def test_a_stored_one_is_armed_by_command_and_goes_on_where_it_is_armed_already(
    robot: InProcessSupervisor, bridge: MCPBridge, database: MemoryDatabase, recording: Recording
) -> None:
    drive(robot, bridge, counted(range(1)))
    first = store(database, "n >= 0 for 0.08")
    drive(robot, bridge, counted(range(5)))
    assert not hits(recording)

    arm = recording.send("arm_breakpoints")
    drive(robot, bridge, counted(range(4)))
    second = store(database, "n == 100")
    again = recording.send("arm_breakpoints")
    drive(robot, bridge, counted(range(4)))

    assert recording.fate(arm)[1] == {"armed": [first]}
    assert recording.fate(again)[1] == {"armed": [first, second]}
    assert [data["breakpoint_id"] for _, _, data in hits(recording)] == [first]


def test_after_a_reset_it_is_armed_again_and_one_stored_meanwhile_too(
    robot: InProcessSupervisor, bridge: MCPBridge, database: MemoryDatabase, recording: Recording
) -> None:
    bridge.breakpoint("n == 1", "log")
    drive(robot, bridge, counted(range(3)))
    stored = store(database, "n == 2")
    robot.simulationReset()

    drive(robot, bridge, counted(range(4)))

    told = [(name, data["hit_count"]) for _, name, data in hits(recording)]
    assert told == [("n == 1", 1), ("n == 1", 1), ("n == 2", 1)]
    assert recording.rows("SELECT hit_count FROM breakpoint WHERE id = ?", stored) == [1]


def test_the_next_controller_arms_what_is_stored_and_not_what_the_code_of_the_last_one_set(
    database: MemoryDatabase, recording: Recording
) -> None:
    with MCPBridge(InProcessSupervisor("rover"), throttle_interval=1, database=database) as first:
        first.breakpoint("n == 1", "log")
        stored = store(database, "n == 2")
    robot = InProcessSupervisor("rover")
    with MCPBridge(robot, throttle_interval=1, database=database) as second:
        drive(robot, second, counted(range(4)))

    assert [name for _, name, _ in hits(recording)] == ["n == 2"]
    assert recording.rows("SELECT id FROM breakpoint") == [stored]


def test_a_condition_that_fails_is_told_once_and_off(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    bridge.breakpoint("mode < 3", "log")
    bridge.breakpoint("n == 2", "log")

    drive(robot, bridge, counted(range(4)))

    assert len(warnings(recording)) == 1
    assert "cannot compare the text 'drive' with the number 3 by <" in warnings(recording)[0]
    rows = recording.rows("SELECT enabled, error FROM breakpoint ORDER BY id")
    assert rows[0][0] == 0 and "column 1" in rows[0][1]
    assert rows[1] == (1, None)
    assert [name for _, name, _ in hits(recording)] == ["n == 2"]


def test_a_stored_one_that_cannot_be_read_is_off_and_keeps_no_other(
    robot: InProcessSupervisor, bridge: MCPBridge, database: MemoryDatabase, recording: Recording
) -> None:
    odd, good = store(database, "n = 1"), store(database, "n == 1")
    for column, value in (("after_hits", "'often'"), ("condition", "CAST(x'ff22' AS TEXT)")):
        number = store(database, "n == 1")
        with closing(connect(database, "writer")) as connection:
            connection.execute(f"UPDATE breakpoint SET {column} = {value} WHERE id = {number}")
    arm = recording.send("arm_breakpoints")

    drive(robot, bridge, counted(range(3)))

    result = recording.fate(arm)[1]
    assert result["armed"] == [good]
    assert "write ==" in result["off"][str(odd)]
    assert len(hits(recording)) == 1


def test_a_signal_that_is_never_published_is_told_once_with_the_nearest(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    bridge.breakpoint("fornt_m < 0.1", "log")

    drive(robot, bridge, [{"front_m": 1.0, "n": 1}] * 200)

    (told,) = warnings(recording)
    assert "No signal 'fornt_m' is published" in told and "front_m" in told


def test_what_cannot_be_set_is_refused_where_it_is_set(bridge: MCPBridge) -> None:
    with pytest.raises(InvalidConditionError, match="column 3"):
        bridge.breakpoint("n = 3")
    with pytest.raises(InvalidInputError, match="'pause' or 'log'"):
        bridge.breakpoint("n == 3", "stop")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InvalidInputError, match="at least 1: 0"):
        bridge.breakpoint("n == 3", after_hits=0)
    for number in range(MAX_BREAKPOINTS):
        bridge.breakpoint(f"n == {number}")
    assert bridge.breakpoint("n == 0") == bridge.breakpoint("n == 0", "pause")
    with pytest.raises(InvalidInputError, match="armed already"):
        bridge.breakpoint("n == 1000")


def test_whatever_is_published_reaches_the_loop_as_nothing(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    class Strange:
        def __float__(self) -> float:
            raise RuntimeError("broken")

        def keys(self) -> Callable[[], None]:
            raise RuntimeError("broken too")

    bridge.breakpoint("x.y < 1 or changed(z)", "log")

    drive(robot, bridge, [{"x": Strange(), "z": float("nan")}, {"x": {"y": Strange()}}, {}])

    assert not hits(recording)
