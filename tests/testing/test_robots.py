"""`webots_robot` and `webots_bridge`, used as a user's test uses them."""

from __future__ import annotations

from pathlib import Path

import pytest

from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.errors import (
    NothingRecordedError,
    UnknownRobotError,
    UnknownSignalError,
)
from webots_mcp.standin import InProcessSupervisor, WouldBlockError
from webots_mcp.testing import RobotFactory, RobotRecording


def test_a_command_is_followed_from_sending_to_its_answer(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: RobotRecording
) -> None:
    webots_bridge.register_command("aim", lambda command: command["angle"] * 2)
    sent = webots_recording.send("aim", angle=1.5)
    assert (sent.status, sent.is_final, sent.result) == ("pending", False, None)
    webots_robot.step(16)
    webots_bridge.get_command()
    assert (sent.action, sent.params) == ("aim", {"angle": 1.5})
    assert (sent.status, sent.is_final, sent.result, sent.error) == ("done", True, 3.0, None)
    assert [command.id for command in webots_recording.commands("aim")] == [sent.id]
    assert webots_recording.commands("pause") == []
    assert repr(sent) == '<command 1: aim {"angle": 1.5}, done, 3.0>'


def test_each_run_is_a_recording_of_its_own(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: RobotRecording
) -> None:
    for step in range(5):
        webots_robot.step(32)
        webots_bridge.publish({"n": step})
    webots_robot.simulationReset()
    webots_robot.step(32)
    webots_bridge.publish({"n": 100})
    first, second = webots_recording.runs()
    assert first.signal("n").values() == [0, 1, 2, 3, 4]
    assert second.signal("n").values() == webots_recording.signal("n").values() == [100]


def test_two_robots_share_a_world_and_a_database(
    webots_robot_factory: RobotFactory,
    webots_database: MemoryDatabase,
    webots_recording: RobotRecording,
) -> None:
    world = Path(__file__).parents[2] / "examples" / "worlds" / "arena_referee.wbt"
    rover = webots_robot_factory("rover", world=world, supervisor=False)
    referee = webots_robot_factory("referee", world=rover.simulation)
    assert not isinstance(rover, InProcessSupervisor)
    for robot in (rover, referee):
        bridge = MCPBridge(robot, throttle_interval=1, database=webots_database)
        robot.step(16)
        bridge.publish({"who": robot.getName()})
        bridge.close()
    assert webots_recording.robot("rover").signal("who").last == "rover"
    assert webots_recording.robot("referee").signal("who").last == "referee"
    with pytest.raises(UnknownRobotError, match="Did you mean 'rover'"):
        webots_recording.robot("rovr").signal("who")


def test_a_whole_loop_ends_after_the_time_that_it_was_given(
    webots_robot_factory: RobotFactory,
    webots_database: MemoryDatabase,
    webots_recording: RobotRecording,
) -> None:
    robot = webots_robot_factory(duration_s=1.0)
    with MCPBridge(robot, throttle_interval=1, database=webots_database) as bridge:
        while robot.step(100) != -1:
            bridge.publish({"time_s": robot.getTime()})
            bridge.get_command()
    assert webots_recording.signal("time_s").last == pytest.approx(1.008)


def test_a_pause_that_nobody_can_end_is_an_error_and_no_endless_wait(
    webots_robot: InProcessSupervisor,
    webots_bridge: MCPBridge,
    webots_recording: RobotRecording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("webots_mcp.testing.recorded_simulation.HOLD_LIMIT_S", 0.05)
    webots_recording.send("pause")
    webots_robot.step(16)
    with pytest.raises(WouldBlockError, match="send 'resume' before"):
        webots_bridge.get_command()


def test_what_a_bridge_cannot_record_is_raised(webots_bridge: MCPBridge) -> None:
    with pytest.raises(TypeError, match="publish"):
        webots_bridge.publish([1, 2, 3])  # type: ignore[arg-type]


def test_a_recording_without_a_bridge_says_what_to_do(webots_recording: RobotRecording) -> None:
    with pytest.raises(NothingRecordedError, match="make an MCPBridge on it"):
        webots_recording.signal("mode")
    with pytest.raises(NothingRecordedError, match="make an MCPBridge on it"):
        webots_recording.send("pause")


def test_a_bridge_that_published_nothing_is_told_as_such(
    webots_bridge: MCPBridge, webots_recording: RobotRecording
) -> None:
    with pytest.raises(UnknownSignalError, match="no values have been published"):
        webots_recording.signal("mode")


@pytest.mark.webots_parameters(kp=3.0)
def test_parameters_begin_as_the_marker_says_and_are_set_in_between(
    webots_bridge: MCPBridge, webots_recording: RobotRecording
) -> None:
    kp = webots_bridge.parameter("kp", 2.0, high=10)
    assert webots_recording.parameters() == {"kp": 3.0}
    good, bad = (webots_recording.set_parameters({"kp": value}) for value in (4.0, 11.0))
    for _ in range(2):
        webots_bridge.get_command()
    assert (good.status, bad.status, kp.value) == ("done", "failed", 4.0)
    assert webots_recording.parameters() == {"kp": 4.0}
