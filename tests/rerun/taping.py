"""Records controllers with a tape, on the stand-in."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, cast

from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.tapes.tape import Tape, open_tape
from webots_mcp.rerun.running import (
    Rerun,
    TapedRun,
    find_taped_run,
    newest_taped_run,
    rerun,
)
from webots_mcp.testing import RecordedSimulation

EXAMPLES = Path(__file__).parents[2] / "examples"
WORLD = EXAMPLES / "worlds" / "arena.wbt"

AVOID = """\
from math import inf

from controller import Robot

from webots_mcp import MCPBridge

NEAR_M = 0.35
SPEED = 5.0

robot = Robot()
bridge = MCPBridge.attach(robot)
step_ms = int(robot.getBasicTimeStep())
motors = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
eyes = [robot.getDevice(f"ds_{side}") for side in ("left", "right")]
for eye in eyes:
    eye.enable(step_ms)
for motor in motors:
    motor.setPosition(inf)
    motor.setVelocity(0.0)
turning = 0
while robot.step(step_ms) != -1:
    left_m, right_m = (eye.getValue() for eye in eyes)
    if turning > 0:
        turning -= 1
    elif min(left_m, right_m) < NEAR_M:
        turning = 20
    speeds = (-3.0, 3.0) if turning else (SPEED, SPEED)
    for motor, speed in zip(motors, speeds):
        motor.setVelocity(speed)
"""
"""A controller of a project of its own, that drives until it is near and then turns."""


def project(folder: Path, code: str = AVOID) -> Path:
    """Make a project with one controller for the rover; return the controller."""
    (folder / "worlds").mkdir(parents=True)
    shutil.copy(WORLD, folder / "worlds")
    controller = folder / "controllers" / "rover" / "rover.py"
    controller.parent.mkdir(parents=True)
    controller.write_text(code, "utf-8")
    return controller


def record(
    world: Path, data_dir: Path, duration_s: float, *, tape: str = "1", **options: Any
) -> None:
    """Run a world whose controllers record a tape."""
    environment = {"WEBOTS_MCP_TAPE": tape} if tape else {}
    with RecordedSimulation(
        world, data_dir=data_dir, environment=environment, **options
    ) as simulation:
        cast("RecordedSimulation", simulation).run_for(duration_s)


def recorded(folder: Path, code: str = AVOID, duration_s: float = 8.0, **options: Any) -> Path:
    """Record a project's controller with a tape; return the controller."""
    controller = project(folder, code)
    record(folder / "worlds" / WORLD.name, data_dir_of(folder), duration_s, **options)
    return controller


def data_dir_of(folder: Path) -> Path:
    """Return the data folder of a project."""
    return folder / "mcp_data"


def taped_run(folder: Path, run_id: int | None = None) -> TapedRun:
    """Return a run of a project with its tape; by default the newest one."""
    data_dir = data_dir_of(folder)
    database = data_dir / DATABASE_NAME
    return find_taped_run(database, data_dir, run_id or newest_taped_run(database, data_dir))


def tapes(folder: Path) -> list[Tape]:
    """Return all tapes of a project."""
    return [open_tape(file) for file in sorted((data_dir_of(folder) / "tapes").iterdir())]


def rerun_of(folder: Path, file: Path, **options: Any) -> Rerun:
    """Run a file on the newest run of a project."""
    return rerun(taped_run(folder), file, **options)
