"""Worlds that are saved in motion, and continued."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.standin.placing import STEP_MS
from webots_mcp.standin import InProcessSimulation, InProcessSupervisor
from webots_mcp.standin.in_process import DEFAULT_WORLD


@pytest.fixture
def world(tmp_path: Path) -> Path:
    (tmp_path / "worlds").mkdir()
    return Path(shutil.copy(DEFAULT_WORLD, tmp_path / "worlds"))


def driven(world: Path, steps: int, fast: float = 4.0) -> tuple[InProcessSimulation, Any]:
    """A simulation whose rover drives a curve, and a ball that rolls."""
    simulation = InProcessSimulation(world)
    robot: Any = InProcessSupervisor(world=simulation)
    for side, speed in (("left", fast), ("right", 0.5)):
        motor = robot.getDevice(f"{side} wheel motor")
        motor.setAcceleration(3.0)
        motor.setPosition(float("inf"))
        motor.setVelocity(speed)
    drive(robot, steps)
    return simulation, robot


def drive(robot: Any, steps: int) -> None:
    for _ in range(steps):
        assert robot.step(STEP_MS) != -1


def places(simulation: InProcessSimulation) -> list[tuple[float, ...]]:
    bodies = simulation.simulator.arena.bodies
    return [(each.x, each.y, each.yaw_rad, *each.velocity_mps) for each in bodies]


@pytest.mark.parametrize("steps", [7, 300])  # while it speeds up; after more than a whole turn
def test_a_world_that_was_saved_in_motion_continues_with_all_digits(
    world: Path, steps: int
) -> None:
    simulation, robot = driven(world, steps)
    copy = world.with_name("copy.wbt")
    robot.getFromDef("BALL").setVelocity([0.7, 0.3, 0.0, 0.0, 0.0, 0.1])
    drive(robot, 1)
    assert robot.worldSave(str(copy)) == 1
    again, other = driven(copy, 0)
    assert places(again) == places(simulation)
    drive(robot, 50)
    drive(other, 50)
    assert places(again) == places(simulation)
    assert "hidden angularVelocity_1 " in copy.read_text("utf-8")


def test_the_saved_file_is_the_world_from_then_on_and_a_reset_returns_to_the_moment(
    world: Path,
) -> None:
    simulation, robot = driven(world, 40)
    before = world.read_bytes()
    assert robot.worldSave(str(world.with_name("copy.wbt"))) == 1
    saved = places(simulation)
    drive(robot, 40)
    assert places(simulation) != saved
    simulation.reset()
    assert places(simulation) == saved
    assert (simulation.time_s, world.read_bytes()) == (0.0, before)
    assert simulation.simulator.world.path.name == "copy.wbt"


def test_a_file_that_is_no_world_or_cannot_be_written_gives_0(
    world: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    simulation, robot = driven(world, 1)
    assert robot.worldSave("copy.txt") == 0
    assert "should have the '.wbt' extension" in capfd.readouterr().err
    assert robot.worldSave(str(world.parent / "nowhere" / "copy.wbt")) == 0
    assert any("cannot save the world" in line for line in simulation.console)


def test_without_a_name_the_world_itself_is_written(world: Path) -> None:
    simulation, robot = driven(world, 20)
    assert robot.worldSave() == 1
    assert places(InProcessSimulation(world)) == places(simulation)
