"""Code of the user's that steps while a command holds the pause: time passes for those steps."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSupervisor


def stepping(robot: InProcessSupervisor, times: int) -> Callable[[dict[str, Any]], float]:
    def handler(_: dict[str, Any]) -> float:
        for _number in range(times):
            assert robot.step(STEP_MS) == 0
        return robot.getTime()

    return handler


def test_a_handler_that_steps_during_a_hold_makes_its_steps_and_it_is_paused_again(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    recording: Recording,
    drive: Callable[[int], None],
) -> None:
    bridge.register_command("go", stepping(robot, 3))
    bridge.register_command("mode", lambda _: robot.simulationGetMode())
    drive(2)
    pause, go, mode = (recording.send(action) for action in ("pause", "go", "mode"))
    step = recording.send("step", steps=2)
    eager(bridge)  # held, stepped inside the handler, then let go for two steps
    from_s = robot.getTime()
    assert recording.fate(pause)[0] == "done"
    assert recording.fate(go)[:2] == ("done", pytest.approx(5 * 0.016))
    assert from_s == pytest.approx(5 * 0.016)
    assert recording.fate(mode)[1] == robot.SIMULATION_MODE_PAUSE
    drive(1)
    resume = recording.send("resume")
    drive(1)  # the second: held, until the resume is found
    assert recording.fate(step)[1]["steps"] == 2
    assert recording.fate(resume)[0] == "done"
    assert robot.getTime() == pytest.approx(from_s + 2 * 0.016)


class Environment(InProcessSupervisor):
    """As reinforcement learning does it: another signature, and more than one step."""

    def step(self, action: object = None) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        if action is None:
            return 0
        return super().step(STEP_MS)


def test_both_halves_of_a_step_work_in_a_handler(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    def halves(_: object) -> int:
        robot.stepBegin(STEP_MS)
        return robot.stepEnd()

    bridge.register_command("halves", halves)
    recording.send("pause")
    sent = recording.send("halves")
    recording.send("resume")
    eager(bridge)
    assert recording.fate(sent) == ("done", 0, None)
    assert robot.getTime() == pytest.approx(0.016)


def test_a_handler_with_a_loop_of_its_own_is_held_in_it_and_resumed(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    seen: list[float] = []

    def drive_a_metre(_: object) -> int:
        for n in range(5):
            robot.step(STEP_MS)
            bridge.publish({"n": n})
            seen.append(robot.getTime())
            if n == 1:
                recording.send("resume")
            eager(bridge)
        return len(seen)

    bridge.register_command("drive_a_metre", drive_a_metre)
    recording.send("pause")
    sent = recording.send("drive_a_metre")
    step = recording.send("step", steps=1)
    eager(bridge)
    assert recording.fate(sent) == ("done", 5, None)
    assert recording.fate(step)[0] == "done"
    assert robot.getTime() == pytest.approx(5 * 0.016)


def test_steps_of_a_handler_go_on_where_a_person_pressed_play_meanwhile(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    def play_and_step(_: object) -> int:
        robot.simulation.resume()
        robot.step(STEP_MS)
        return robot.simulationGetMode()

    bridge.register_command("play_and_step", play_and_step)
    recording.send("pause")
    sent = recording.send("play_and_step")
    eager(bridge)
    assert recording.fate(sent)[1] == robot.SIMULATION_MODE_REAL_TIME


def test_an_error_of_a_step_in_a_handler_leaves_the_simulation_paused(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    steps: Any = 16.0
    bridge.register_command("typo", lambda _: robot.step(steps))
    bridge.register_command("mode", lambda _: robot.simulationGetMode())
    recording.send("pause")
    typo, mode, resume = (recording.send(action) for action in ("typo", "mode", "resume"))
    eager(bridge)
    assert recording.fate(typo)[0] == "failed"
    assert recording.fate(mode)[1] == robot.SIMULATION_MODE_PAUSE
    assert recording.fate(resume)[0] == "done"


@pytest.mark.parametrize("kind", [InProcessSupervisor, Environment])
def test_a_quit_reaches_the_handlers_step_and_the_loops(
    database: MemoryDatabase, recording: Recording, kind: type[InProcessSupervisor]
) -> None:
    robot = kind("rover")
    answers: list[int] = []

    def quit_and_step(_: object) -> None:
        robot.simulation.quit()
        answers.append(robot.step(STEP_MS))

    with MCPBridge(robot, database=database) as bridge:
        bridge.register_command("quit_and_step", quit_and_step)
        recording.send("pause")
        recording.send("quit_and_step")
        eager(bridge)
        answers.append(robot.step(STEP_MS))
        answers.append(robot.step(STEP_MS))
    assert answers == [-1, -1, -1]


def test_a_robot_without_a_bridge_steps_as_ever(bridge: MCPBridge, recording: Recording) -> None:
    other = InProcessSupervisor("rover")

    def step_other(_: object) -> int:
        return other.step(STEP_MS)

    bridge.register_command("step_other", step_other)
    recording.send("pause")
    sent = recording.send("step_other")
    recording.send("resume")
    thread = threading.Thread(target=lambda: eager(bridge))
    thread.start()
    thread.join(10)
    assert not thread.is_alive()
    assert recording.fate(sent) == ("done", 0, None)
