"""What is shown of a robot that stands still is its newest state, whatever the throttle."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.bridge.conftest import STEP_MS, Recording, eager, numbers
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSimulation, InProcessSupervisor


@pytest.fixture
def bridge(robot: InProcessSupervisor, database: MemoryDatabase) -> Iterator[MCPBridge]:
    """One that records every fifth call."""
    with MCPBridge(robot, database=database) as bridge:
        yield bridge


def come_round(robot: InProcessSupervisor, bridge: MCPBridge, n: int) -> None:
    robot.step(STEP_MS)
    bridge.publish({"n": n})
    eager(bridge)


def test_a_pause_shows_the_state_that_it_holds(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    for n in range(1, 8):
        come_round(robot, bridge, n)
    pause, resume = recording.send("pause"), recording.send("resume")
    come_round(robot, bridge, 8)
    come_round(robot, bridge, 9)
    status, result, _ = recording.fate(pause)
    assert (status, recording.fate(resume)[0]) == ("done", "done")
    (newest,) = recording.rows("SELECT max(sim_time_s) FROM state")
    assert newest == pytest.approx(result["sim_time_s"])
    assert numbers(recording)[-1] == 9


def test_every_state_of_single_steps_is_recorded(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    come_round(robot, bridge, 1)
    step = recording.send("step", steps=3)
    for n in range(2, 5):
        come_round(robot, bridge, n)
    recording.send("resume")
    come_round(robot, bridge, 5)
    assert recording.fate(step)[0] == "done"
    assert numbers(recording) == [3, 4, 5]


def test_a_loop_that_was_quit_while_held_may_say_its_last_words(
    database: MemoryDatabase, recording: Recording
) -> None:
    simulation = InProcessSimulation()
    robot = InProcessSupervisor("rover", world=simulation)
    bridge = MCPBridge(robot, throttle_interval=1, database=database)
    bridge.register_command("close_window", lambda _: simulation.quit())
    recording.send("pause")
    recording.send("close_window")
    come_round(robot, bridge, 1)
    assert recording.rows("SELECT end_reason FROM session") == ["finished"]
    assert recording.rows("SELECT end_reason FROM run") == ["finished"]
    assert robot.step(STEP_MS) == -1
    bridge.publish({"n": 2})
    bridge.log("last words")
    bridge.close()
    assert numbers(recording) == [1, 2]
    assert recording.rows("SELECT message FROM log WHERE source = 'controller'") == ["last words"]
    assert recording.rows("SELECT end_reason, row_count FROM run") == [("finished", 2)]
