"""The steps of an attached robot serve commands, breakpoints and runs."""

from __future__ import annotations

import pytest

from tests.bridge.attaching.conftest import times
from tests.bridge.conftest import STEP_MS, Recording
from webots_mcp import MCPBridge
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
