"""One line, `MCPBridge.attach(robot)`: each step publishes, however it is made."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import pytest

from tests.bridge.attaching.conftest import enable, times
from tests.bridge.conftest import STEP_MS, Recording, write_lock
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessRobot, InProcessSupervisor

pytestmark = pytest.mark.usefixtures("look_in_every_step")


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


class Driver(InProcessSupervisor):
    """As Webots' own for cars: its step is one call in C, which comes by no other method."""

    __module__ = "vehicle.driver"

    def step(self) -> int:  # type: ignore[override]
        return inspect.unwrap(InProcessSupervisor.step)(self, STEP_MS)


def test_each_step_of_a_vehicles_driver_is_published(
    database: MemoryDatabase, recording: Recording
) -> None:
    car = Driver("car")
    with MCPBridge.attach(car, database=database, throttle_interval=1):
        assert [car.step() for _ in range(3)] == [0, 0, 0]
    assert times(recording) == [0.016, 0.032, 0.048]


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
