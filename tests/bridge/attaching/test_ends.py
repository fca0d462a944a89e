"""A robot is attached once, detached whole, and loses nothing where its loop ends."""

from __future__ import annotations

import math

import pytest

from tests.bridge.attaching.conftest import times
from tests.bridge.conftest import STEP_MS, Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge import devices
from webots_mcp.standin import InProcessSupervisor

pytestmark = pytest.mark.usefixtures("look_in_every_step")


class Watched(InProcessSupervisor):
    """Notes what is asked of the devices and of Webots."""

    def getTime(self) -> float:
        calls.append("getTime")
        return super().getTime()


calls: list[str] = []


def test_after_a_quit_all_is_written_and_nothing_is_asked_any_more(
    database: MemoryDatabase,
    recording: Recording,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(devices, "MOST_READING_US", math.inf)  # read for the ring in each call
    robot = Watched("rover")
    bridge = MCPBridge.attach(robot, database=database)
    for _ in range(7):
        robot.step(STEP_MS)
    bridge.keep("the end")
    robot.simulation.quit()
    calls.clear()
    assert robot.step(STEP_MS) == -1
    assert not calls[1:]  # one look before the step
    asked = len(calls)
    assert recording.rows("SELECT end_reason FROM session") == ["finished"]
    assert len(recording.rows("SELECT id FROM kept_state")) == 6
    assert [robot.step(STEP_MS), robot.step(0)] == [-1, -1]
    bridge.publish({"last": "words"}, force=True)
    bridge.close()
    assert recording.states()[-1] == {"last": "words", "time": pytest.approx(7 * 0.016)}
    assert "failed" not in capsys.readouterr().err
    assert len(calls) <= asked + 2  # the time, as the library knows it


def test_detach_leaves_nothing_on_the_robot(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    MCPBridge(robot, database=database, throttle_interval=1)
    before = set(vars(robot))
    bridge = MCPBridge.attach(robot)
    robot.step(STEP_MS)
    bridge.detach()
    bridge.detach()
    assert set(vars(robot)) == before
    robot.step(STEP_MS)
    assert len(times(recording)) == 1
    bridge.publish({"n": 1})
    assert recording.states()[-1] == {"n": 1}
    bridge.close()


def test_a_handler_may_detach_or_close(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    attached.register_command("end", lambda _: attached.close())
    sent = recording.send("end")
    for _ in range(2):
        assert robot.step(STEP_MS) == 0
    assert recording.fate(sent)[0] == "done"
    assert not times(recording)


def test_attaching_twice_gives_the_same_bridge(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    assert MCPBridge.attach(robot) is attached
    robot.step(STEP_MS)
    assert len(times(recording)) == 1
    with pytest.raises(ValueError, match="so throttle_interval cannot be set"):
        MCPBridge.attach(robot, throttle_interval=3)


def test_an_interrupt_in_the_bridges_part_of_a_step_ends_the_loop_and_loses_nothing(
    robot: InProcessSupervisor,
    attached: MCPBridge,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot.step(STEP_MS)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(type(robot.devices["gps"]), "getValues", interrupt)
        robot.step(STEP_MS)
    robot.step(STEP_MS)
    attached.close()
    assert times(recording) == [0.016, 0.048]
    assert recording.rows("SELECT end_reason FROM session") == ["finished"]


def interrupt(_: object) -> None:
    raise KeyboardInterrupt
