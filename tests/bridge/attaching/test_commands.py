"""The steps of an attached robot serve commands, breakpoints and runs."""

from __future__ import annotations

import pytest

from tests.bridge.attaching.conftest import enable, times
from tests.bridge.conftest import STEP_MS, Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSupervisor

pytestmark = pytest.mark.usefixtures("look_in_every_step")


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
