"""Robots for unit tests: no process, no socket, and no waiting for ever."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from webots_mcp.standin import (
    ControllerEndedError,
    InProcessRobot,
    InProcessSimulation,
    InProcessSupervisor,
    Mode,
    StandInError,
    WorldError,
    WouldBlockError,
)
from webots_mcp.standin.in_process import DEFAULT_WORLD

STEP_MS = 16


def test_a_subclass_may_give_step_another_signature() -> None:
    class Environment(InProcessSupervisor):
        def step(self, action: float) -> tuple[float, bool]:  # type: ignore[override]
            over = super().step(STEP_MS) == -1
            return action + self.getTime(), over

    assert Environment().step(1.0) == (1.016, False)


def test_a_step_in_a_paused_simulation_raises_instead_of_waiting_for_ever() -> None:
    robot = InProcessRobot()
    robot.simulation.pause()
    with pytest.raises(WouldBlockError, match="resume"):
        robot.step(STEP_MS)
    with pytest.raises(WouldBlockError, match="negative"):
        robot.step(-1)
    assert robot.step(0) == 0
    robot.simulation.resume()
    assert robot.step(STEP_MS) == 0
    assert robot.getTime() == pytest.approx(0.016)


def test_another_thread_may_resume_a_waiting_step() -> None:
    simulation = InProcessSimulation(pause_timeout_s=10.0)
    robot = InProcessRobot(world=simulation)
    simulation.pause()
    threading.Timer(0.05, simulation.fast).start()
    assert robot.step(STEP_MS) == 0
    assert simulation.mode is Mode.FAST


def test_a_single_step_by_hand_lets_a_waiting_controller_go_on_once() -> None:
    simulation = InProcessSimulation(pause_timeout_s=10.0)
    robot = InProcessRobot(world=simulation)
    simulation.pause()
    threading.Timer(0.05, simulation.step).start()
    assert robot.step(STEP_MS) == 0
    assert simulation.mode is Mode.PAUSE
    assert simulation.time_s == pytest.approx(0.016)


def test_robots_that_share_a_simulation_keep_step(tmp_path: Path) -> None:
    world = tmp_path / "two.wbt"
    referee = 'Robot { name "referee" supervisor TRUE }'
    world.write_text(DEFAULT_WORLD.read_text(encoding="utf-8") + referee, encoding="utf-8")
    simulation = InProcessSimulation(world)
    rover = InProcessRobot("rover", world=simulation)
    watcher = InProcessSupervisor("referee", world=simulation)
    for _ in range(4):
        rover.step(STEP_MS)
    watcher.step(4 * STEP_MS)
    assert (rover.getTime(), watcher.getTime()) == (0.064, 0.064)
    with pytest.raises(StandInError, match="has a controller already"):
        InProcessRobot("rover", world=simulation)
    with pytest.raises(WorldError, match="no robot 'nobody'"):
        InProcessRobot("nobody", world=simulation)


def test_each_has_the_name_it_is_given_and_steps_are_whole_time_steps() -> None:
    robots = [InProcessRobot("rover"), InProcessRobot("rover2")]
    assert [robot.getName() for robot in robots] == ["rover", "rover2"]
    for duration_ms, time_s in ((1, 0.016), (20, 0.048)):
        for robot in robots:
            robot.step(duration_ms)
            assert robot.getTime() == pytest.approx(time_s)


def test_after_a_reload_step_ends_and_what_follows_is_an_error() -> None:
    robot = InProcessSupervisor()
    robot.step(STEP_MS)
    robot.worldReload()
    assert robot.getFromDef("WALL_EAST") is None
    assert robot.step(STEP_MS) == -1
    assert robot.getTime() == pytest.approx(0.016)
    with pytest.raises(ControllerEndedError, match="-1"):
        robot.step(STEP_MS)
    with pytest.raises(ControllerEndedError):
        robot.getFromDef("WALL_EAST")
    assert InProcessSupervisor(world=robot.simulation).getTime() == 0.0


def test_reset_and_quit_by_hand_end_the_controller() -> None:
    robot = InProcessSupervisor()
    robot.simulation.reset()
    assert robot.step(STEP_MS) == -1
    robot = InProcessSupervisor()
    robot.simulationQuit(3)
    assert robot.step(STEP_MS) == -1
    assert robot.simulation.exit_status == 3


def test_another_world_is_loaded_after_the_next_step(tmp_path: Path) -> None:
    other = tmp_path / "other.wbt"
    text = DEFAULT_WORLD.read_text(encoding="utf-8").replace("basicTimeStep 16", "basicTimeStep 8")
    other.write_text(text, encoding="utf-8")
    robot = InProcessSupervisor()
    robot.worldLoad(str(other))
    assert robot.step(0) == 0
    assert robot.step(STEP_MS) == 0
    assert robot.step(STEP_MS) == -1
    assert InProcessRobot(world=robot.simulation).getBasicTimeStep() == 8.0


def test_another_controller_package_in_the_process_is_refused(tmp_path: Path) -> None:
    (tmp_path / "controller.py").touch()
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import controller\n"
    done = subprocess.run(
        [sys.executable, "-c", code + "import webots_mcp.standin"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "another package named controller is loaded" in done.stderr
