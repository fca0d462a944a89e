"""A loop whose steps pass the bridge by is told so, once, with what mends it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.bridge.conftest import STEP_MS, Recording
from tests.waiting import wait_for
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge import session as session
from webots_mcp.contract import UNMOVED
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor

Loop = Callable[[], int]


def kept(robot: InProcessSupervisor) -> Loop:
    """`step = robot.step`, before any bridge was there."""
    own = inspect.unwrap(type(robot).step)
    return lambda: own(robot, STEP_MS)


def replaced(robot: InProcessSupervisor) -> Loop:
    """`robot.step = counted`, whose own call is one that was kept."""
    step = kept(robot)

    def counted(_: int) -> int:
        return step()

    vars(robot)["step"] = counted
    return lambda: robot.step(STEP_MS)


def warnings(recording: Recording) -> list[str]:
    return recording.rows("SELECT message FROM log WHERE level = 'warning' AND source = 'bridge'")


@pytest.mark.parametrize("way", [kept, replaced])
def test_steps_that_pass_an_attached_bridge_by_are_told_at_its_end(
    robot: InProcessSupervisor,
    database: MemoryDatabase,
    recording: Recording,
    way: Callable[[InProcessSupervisor], Loop],
    capsys: pytest.CaptureFixture[str],
) -> None:
    step = way(robot)
    with MCPBridge.attach(robot, database=database):
        for _ in range(600):
            assert step() == 0

    (told,) = warnings(recording)
    assert "so far it has missed 9.6 s of simulation time" in told
    assert "bridge.publish({...}) and bridge.get_command()" in told
    assert "MCPBridge.attach(robot) before anything takes or replaces robot.step" in told
    assert recording.rows("SELECT last_error FROM session") == [told]
    assert capsys.readouterr().err.count("9.6 s of simulation") == 1


def test_a_loop_that_asks_for_commands_is_told_once_and_not_at_each_step(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    with MCPBridge.attach(robot, database=database) as bridge:
        robot.step(STEP_MS)
        step = kept(robot)
        for _ in range(50):
            step()
        bridge.get_command()
        assert not warnings(recording)  # an interrupt may hide so much of a step that was seen
        for _ in range(50):
            step()
            bridge.get_command()
        assert len(warnings(recording)) == 1
    assert len(warnings(recording)) == 1


def test_steps_that_are_seen_are_no_cause_for_a_warning(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    step = kept(robot)
    for _ in range(100):
        step()
    with MCPBridge.attach(robot, database=database) as bridge:
        for _ in range(100):
            robot.step(STEP_MS)
            bridge.get_command()

    assert not warnings(recording)


def test_a_loop_that_steps_and_never_calls_its_bridge_is_told_at_the_end(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    with MCPBridge(robot, database=database):
        for _ in range(100):
            robot.step(STEP_MS)

    (told,) = warnings(recording)
    assert "so far it has missed 1.6 s of simulation time" in told


def test_while_no_call_comes_by_the_log_says_what_may_be_and_asks_webots_for_nothing(
    robot: InProcessSupervisor,
    file: Path,
    filed: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    step = kept(robot)
    with MCPBridge.attach(robot, data_dir=file.parent) as bridge:
        asked = vars(robot)["getTime"] = Asked()
        monkeypatch.setattr(session, "_UNMOVED_S", 0.0)
        for _ in range(100):
            step()
        wait_for(lambda: warnings(filed))
        assert not asked.calls
        del vars(robot)["getTime"]
        assert warnings(filed) == [UNMOVED]
        with closing(connect(file, "reader")) as connection:
            assert connection.execute("SELECT last_error FROM session").fetchone() == (None,)
        bridge.close()
    assert len(warnings(filed)) == 2  # and at the end, that it is certain


class Asked:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> float:
        self.calls += 1
        return 0.0
