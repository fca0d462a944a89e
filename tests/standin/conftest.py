"""A project with the arena, and controllers that a test writes into it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import pytest

from webots_mcp.standin.in_process import DEFAULT_WORLD

STEP_MS = 16
START = """
from math import inf
from controller import Robot, Supervisor
robot = Supervisor()
def drive(left, right):
    for name, speed in (("left wheel motor", left), ("right wheel motor", right)):
        robot.getDevice(name).setPosition(inf)
        robot.getDevice(name).setVelocity(speed)
"""

WriteController = Callable[..., Path]


@pytest.fixture
def world(tmp_path: Path) -> Path:
    """The arena in a project of its own."""
    path = tmp_path / "worlds" / "arena.wbt"
    path.parent.mkdir()
    path.write_bytes(DEFAULT_WORLD.read_bytes())
    return path


@pytest.fixture
def write_controller(world: Path) -> WriteController:
    """Writes a controller of the project from pieces of code: what follows once `robot` is made."""

    def write(*code: str, name: str = "rover") -> Path:
        path = world.parent.parent / "controllers" / name / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(START + "\n".join(map(dedent, code)), encoding="utf-8")
        return path

    return write
