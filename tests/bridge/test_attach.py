"""One line, `MCPBridge.attach(robot)`: each step publishes and serves, however it is made."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording, write_lock
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge import control
from webots_mcp.standin import InProcessRobot, InProcessSupervisor

pytestmark = pytest.mark.usefixtures("look_in_every_step")


@pytest.fixture
def look_in_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step looks into the queue, not only one in 5 ms."""
    monkeypatch.setattr(control, "POLL_INTERVAL_S", 0.0)
    monkeypatch.setenv("WEBOTS_MCP_STRICT", "1")


@pytest.fixture
def attached(robot: InProcessSupervisor, database: MemoryDatabase) -> Iterator[MCPBridge]:
    enable(robot)
    with MCPBridge.attach(robot, database=database, throttle_interval=1) as bridge:
        yield bridge


def enable(robot: Any) -> None:
    for name in ("gps", "imu", "front"):
        if device := robot.devices.get(name):
            device.enable(STEP_MS)


def times(recording: Recording) -> list[float]:
    return [round(t, 3) for t in recording.rows("SELECT sim_time_s FROM state ORDER BY id")]


def test_each_step_of_a_plain_loop_is_published(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    for _ in range(3):
        assert robot.step(STEP_MS) == 0
    assert times(recording) == [0.016, 0.032, 0.048]
    assert all(state["sensors"] for state in recording.states())


def in_halves(robot: InProcessSupervisor) -> int:
    assert robot.stepBegin(STEP_MS) == 0
    return robot.stepEnd()


WAYS: dict[str, Callable[[InProcessSupervisor], int]] = {
    "positional": lambda robot: robot.step(STEP_MS),
    "by keyword": lambda robot: robot.step(time_step=STEP_MS),
    "of the basic length": lambda robot: robot.step(),
    "in halves": in_halves,
}


@pytest.mark.parametrize("way", WAYS)
def test_a_step_is_published_however_it_is_asked_for(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording, way: str
) -> None:
    assert [WAYS[way](robot), WAYS[way](robot)] == [0, 0]
    assert times(recording) == [0.016, 0.032]


def test_a_step_of_no_time_serves_commands_and_publishes_nothing(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    attached.register_command("beep", lambda _: "beeped")
    sent = recording.send("beep")
    assert robot.step(0) == 0
    assert recording.fate(sent) == ("done", "beeped", None)
    assert not times(recording)


class Environment(InProcessSupervisor):
    """As reinforcement learning does it: a step of its own makes four of Webots'."""

    def step(self, action: object = None) -> tuple[str, bool]:  # type: ignore[override]
        done = [super(Environment, self).step(STEP_MS) for _ in range(4)]
        return "observation", -1 in done


def test_a_subclass_with_a_step_of_its_own_keeps_what_it_returns(
    database: MemoryDatabase, recording: Recording
) -> None:
    robot = Environment("rover")
    with MCPBridge.attach(robot, database=database, throttle_interval=1):
        assert robot.step("left") == ("observation", False)
    assert times(recording) == [0.016, 0.032, 0.048, 0.064]


class Owner:
    """An environment that has the robot."""

    def __init__(self, robot: InProcessRobot) -> None:
        self.robot = robot

    def wait(self, steps: int) -> None:
        for _ in range(steps):
            self.robot.step(STEP_MS)


def test_a_robot_that_is_no_supervisor_is_attached_through_its_owner(
    database: MemoryDatabase, recording: Recording
) -> None:
    owner = Owner(InProcessRobot("rover"))
    with MCPBridge.attach(owner.robot, database=database, throttle_interval=1) as bridge:
        bridge.register_command("name", lambda _: owner.robot.getName())
        owner.wait(1)
        sent, refused = recording.send("name"), recording.send("pause")
        owner.wait(2)
    assert len(times(recording)) == 3
    assert recording.fate(sent)[:2] == ("done", "rover")
    assert "needs a Supervisor" in str(recording.fate(refused)[2])


# -- commands ----------------------------------------------------------------------------------


def test_pause_steps_and_resume_work_without_a_call_of_get_command(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    robot.step(STEP_MS)
    pause, step, resume = (
        recording.send("pause"),
        recording.send("step", steps=2),
        recording.send("resume"),
    )
    for _ in range(4):
        robot.step(STEP_MS)
    assert [recording.fate(sent)[0] for sent in (pause, step)] == ["done", "failed"]
    assert "interrupted by command" in str(recording.fate(step)[2])
    assert recording.fate(resume)[0] == "done"


def test_single_steps_are_the_loops_own_and_each_is_recorded(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    with MCPBridge.attach(robot, database=database) as bridge:
        sent: list[int] = []
        bridge.register_command("go on", lambda _: sent.append(recording.send("resume")))
        robot.step(STEP_MS)
        recording.send("pause")
        robot.step(STEP_MS)  # the state of this moment was throttled: one more round
        step = recording.send("step", steps=3)
        for _ in range(3):
            robot.step(STEP_MS)
        recording.send("go on")
        robot.step(STEP_MS)
    assert recording.fate(step)[1]["steps"] == 3
    assert recording.fate(sent[0])[0] == "done"
    assert times(recording) == [0.032, 0.048, 0.064, 0.08]


def test_a_reset_begins_a_run_and_is_answered(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    for _ in range(3):
        robot.step(STEP_MS)
    sent = recording.send("reset")
    for _ in range(2):
        robot.step(STEP_MS)
    assert recording.fate(sent)[0] == "done"
    assert recording.rows("SELECT start_reason FROM run ORDER BY id") == ["start", "reset"]


def test_the_steps_of_a_handler_are_published_and_serve_nothing_else(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    fates: list[str] = []

    def drive(_: object) -> int:
        for _step in range(3):
            robot.step(STEP_MS)
        fates.append(recording.fate(second)[0])
        return 3

    attached.register_command("drive", drive)
    first, second = recording.send("drive"), recording.send("drive")
    robot.step(STEP_MS)
    assert recording.fate(first)[:2] == ("done", 3)
    assert fates == ["pending"]
    assert len(times(recording)) == 4


def test_an_action_that_nobody_registered_fails_and_no_loop_is_said_to_have_seen_it(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    sent = recording.send("dance")
    robot.step(STEP_MS)
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert "no action 'dance'" in str(error)
    assert "register_command" in str(error)
    assert "get_command" not in str(error)


def test_a_loop_that_asks_for_commands_all_the_same_gets_those_that_a_step_served(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    attached.get_command()
    sent = recording.send("dance", tempo=2)
    robot.step(STEP_MS)
    command = attached.get_command()
    assert command is not None
    assert (command["id"], command["tempo"]) == (sent, 2)
    assert attached.get_command() is None
    assert "get_command() returned the command" in str(recording.fate(sent)[2])


# -- a controller that publishes by itself -------------------------------------------------------


def test_what_the_controller_publishes_is_in_one_row_with_what_the_devices_say(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    for n in range(4):
        robot.step(STEP_MS)
        attached.publish({"n": n})
    robot.step(STEP_MS)
    rows = recording.states()[2:]
    assert [(row["n"], "gps" in row["sensors"]) for row in rows] == [
        (1, True),
        (2, True),
        (3, True),
    ]
    assert times(recording)[2:] == [0.032, 0.048, 0.064]


def test_a_round_in_which_the_controller_did_not_publish_is_published_by_the_step(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    robot.step(STEP_MS)
    attached.publish({"n": 0})
    robot.step(STEP_MS)
    robot.step(STEP_MS)
    robot.step(STEP_MS)
    assert times(recording) == [0.016, 0.016, 0.032, 0.048, 0.064]


def test_the_round_that_ends_the_controller_is_published_though_it_came_to_no_publish(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    with (
        pytest.raises(ZeroDivisionError),
        MCPBridge.attach(robot, database=database, throttle_interval=1) as bridge,
    ):
        for n in (1, 0):
            robot.step(STEP_MS)
            bridge.publish({"share": 1 / n})
    assert times(recording) == [0.016, 0.016, 0.032]


# -- the end -------------------------------------------------------------------------------------


class Watched(InProcessSupervisor):
    """Notes what is asked of the devices and of Webots."""

    def getTime(self) -> float:
        calls.append("getTime")
        return super().getTime()


calls: list[str] = []


def test_after_a_quit_all_is_written_and_nothing_is_asked_any_more(
    database: MemoryDatabase, recording: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
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
    before = set(vars(robot))
    bridge = MCPBridge.attach(robot, database=database, throttle_interval=1)
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
    with pytest.raises(ValueError, match="throttle_interval cannot be set any more"):
        MCPBridge.attach(robot, throttle_interval=3)


def test_a_bridge_that_was_open_is_attached(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    assert MCPBridge.attach(robot) is bridge
    robot.step(STEP_MS)
    assert len(times(recording)) == 1


def fail(_: object) -> float:
    return 1 / 0


def test_what_fails_in_a_step_is_counted_and_the_step_is_made(
    robot: InProcessSupervisor,
    database: MemoryDatabase,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("WEBOTS_MCP_STRICT")
    enable(robot)
    with MCPBridge.attach(robot, database=database) as bridge:
        monkeypatch.setattr(type(robot.devices["gps"]), "getValues", fail)
        for _ in range(6):
            assert robot.step(STEP_MS) == 0
        assert bridge.stats().failures
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_an_error_of_the_step_itself_reaches_the_loop(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    steps: Any = 16.5
    with pytest.raises(Exception, match="convert"):
        robot.step(steps)
    assert robot.step(STEP_MS) == 0
    assert times(recording) == [0.016]


def test_a_locked_database_holds_no_step_up(
    robot: InProcessSupervisor, filed: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not isinstance(filed.database, MemoryDatabase)
    with MCPBridge.attach(robot, database=filed.database, throttle_interval=1) as bridge:
        robot.step(STEP_MS)
        with write_lock(filed.database):
            assert robot.step(STEP_MS) == 0
            assert bridge.stats().rows_waiting >= 1
        robot.step(STEP_MS)
    assert times(filed) == [0.016, 0.032, 0.048]


# -- what else happens at a step -------------------------------------------------------------------


def test_a_run_until_a_condition_pauses_at_the_step_at_which_the_devices_say_it(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    attached.register_command("let it be", lambda _: recording.send("resume"))
    robot.step(STEP_MS)
    sent = recording.send("run", until="time >= 0.09", for_s=5)
    for _ in range(5):
        robot.step(STEP_MS)
    recording.send("let it be")
    robot.step(STEP_MS)
    result = recording.fate(sent)[1]
    assert result["ended"] == "condition held"
    assert result["sim_time_s"] == pytest.approx(0.096)


def test_a_breakpoint_is_asked_of_what_the_devices_say_and_holds_the_next_step(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    enable(robot)
    held: list[float] = []
    with MCPBridge.attach(robot, database=database) as bridge:  # of which most are throttled
        bridge.breakpoint("time >= 0.05")
        bridge.register_command("look", lambda _: held.append(robot.getTime()))
        for _ in range(4):
            robot.step(STEP_MS)
        assert robot.simulationGetMode() == robot.SIMULATION_MODE_PAUSE
        recording.send("look")
        recording.send("resume")
        robot.step(STEP_MS)
    assert held == [pytest.approx(0.064)]
    assert recording.rows("SELECT sim_time_s FROM event WHERE kind = 'breakpoint'") == held


def test_a_callback_of_a_reset_may_step(
    robot: InProcessSupervisor, attached: MCPBridge, recording: Recording
) -> None:
    answers: list[int] = []
    attached.on_reload(lambda: answers.append(robot.step(STEP_MS)))
    for _ in range(3):
        robot.step(STEP_MS)
    robot.simulationReset()
    for _ in range(3):
        robot.step(STEP_MS)
    assert answers == [0]
    newest = recording.rows("SELECT sim_time_s FROM state WHERE run_id = 2 ORDER BY id")
    assert newest[-1] == pytest.approx(0.064)
    assert newest == sorted(newest)


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
