"""A hold outlives the controller that took it: its successor goes on with it, or time goes on."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from tests.bridge.conftest import STEP_MS, Recording, eager
from tests.bridge.test_registration import change
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSimulation, InProcessSupervisor, Mode


def ended_pid() -> int:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    return process.pid


def leave_held(simulation: InProcessSimulation, database: MemoryDatabase) -> None:
    """A controller ends while a command holds its loop, in a simulation that ran fast."""
    robot = InProcessSupervisor("rover", world=simulation)
    bridge = MCPBridge(robot, database=database)
    recording = Recording(database)
    robot.step(STEP_MS)
    bridge.register_command("end", lambda _: simulation.reset())
    recording.send("pause")
    recording.send("end")
    eager(bridge)
    bridge.close()


@pytest.fixture
def simulation() -> InProcessSimulation:
    return InProcessSimulation()


def succeed(simulation: InProcessSimulation, database: MemoryDatabase) -> MCPBridge:
    robot = InProcessSupervisor("rover", world=simulation)
    return MCPBridge(robot, throttle_interval=1, database=database)


def test_a_successor_is_held_in_its_first_step_until_a_resume(
    simulation: InProcessSimulation, database: MemoryDatabase, recording: Recording
) -> None:
    leave_held(simulation, database)
    assert simulation.mode is Mode.PAUSE
    with succeed(simulation, database) as bridge:
        assert recording.rows(
            "SELECT pause_state, mode_before_pause FROM session WHERE id = 2"
        ) == [("paused", "fast")]
        resume = recording.send("resume")
        assert bridge.robot.step(STEP_MS) == 0
        assert recording.fate(resume)[0] == "done"
        assert bridge.robot.step(STEP_MS) == 0
    assert recording.rows("SELECT pause_state FROM session WHERE id = 2") == [None]


def test_where_a_person_pressed_play_meanwhile_there_is_nothing_to_take_over(
    simulation: InProcessSimulation, database: MemoryDatabase, recording: Recording
) -> None:
    leave_held(simulation, database)
    simulation.resume()
    with succeed(simulation, database) as bridge:
        assert bridge.robot.step(STEP_MS) == 0
        assert recording.rows("SELECT pause_state FROM session WHERE id = 2") == [None]


def test_the_hold_of_a_controller_that_was_killed_is_taken_over_as_well(
    simulation: InProcessSimulation, database: MemoryDatabase, recording: Recording
) -> None:
    leave_held(simulation, database)
    change(
        recording,
        "UPDATE session SET ended_wall_time_s = NULL, end_reason = NULL, process = 'gone', pid = ?",
        ended_pid(),
    )
    with succeed(simulation, database) as bridge:
        assert recording.rows("SELECT end_reason FROM session WHERE id = 1") == ["crashed"]
        recording.send("resume")
        assert bridge.robot.step(STEP_MS) == 0


def test_a_person_pressing_play_lets_a_taken_over_loop_go(
    simulation: InProcessSimulation, database: MemoryDatabase
) -> None:
    leave_held(simulation, database)
    with succeed(simulation, database) as bridge:
        simulation.resume()
        assert bridge.robot.step(STEP_MS) == 0


def test_the_hold_of_another_simulator_is_not_taken_over(
    simulation: InProcessSimulation,
    database: MemoryDatabase,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("WEBOTS_CONTROLLER_URL", "ipc://1234/rover")
    leave_held(simulation, database)
    monkeypatch.setenv("WEBOTS_CONTROLLER_URL", "ipc://1235/rover")
    with succeed(simulation, database):
        assert recording.rows("SELECT pause_state FROM session WHERE id = 2") == [None]


def test_a_bridge_that_is_closed_while_it_holds_lets_time_go_on(
    simulation: InProcessSimulation, database: MemoryDatabase, recording: Recording
) -> None:
    bridge = succeed(simulation, database)

    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    bridge.register_command("interrupt", interrupt)
    recording.send("pause")
    recording.send("interrupt")
    with pytest.raises(KeyboardInterrupt), bridge:
        eager(bridge)
    assert simulation.mode is Mode.FAST
    assert bridge.robot.step(STEP_MS) == 0
    notes = recording.rows("SELECT data FROM event WHERE kind = 'resume'")
    assert "closed" in notes[0]


def test_a_loop_that_survives_an_interrupt_in_its_hold_is_held_in_its_next_step(
    simulation: InProcessSimulation, database: MemoryDatabase, recording: Recording
) -> None:
    with succeed(simulation, database) as bridge:

        def interrupt(_: object) -> None:
            raise KeyboardInterrupt

        bridge.register_command("interrupt", interrupt)
        recording.send("pause")
        recording.send("interrupt")
        with pytest.raises(KeyboardInterrupt):
            eager(bridge)
        resume = recording.send("resume")
        thread = threading.Thread(target=bridge.robot.step, args=(STEP_MS,))
        thread.start()
        thread.join(10)
        assert not thread.is_alive()
        assert recording.fate(resume)[0] == "done"
