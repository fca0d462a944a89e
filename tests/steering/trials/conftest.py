"""A Webots project with a robot whose speed is a parameter, and plans to try."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.waiting import wait_for
from webots_mcp.cli import main
from webots_mcp.standin.in_process import DEFAULT_WORLD

# It drives off a table at speed 3, and ends by itself at speed 4.
CONTROLLER = """
import os
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot, throttle_interval=1)
speed = bridge.parameter("speed", 1.0, low=0.0, high=10.0)
x = 0.0
while robot.step(16) != -1:
    x += 0.016 * speed.value
    bridge.publish({"x": x, "on_table": x < 20})
    bridge.get_command()
    if speed.value == 3.0 and x > 1.0:
        os._exit(1)
    if speed.value == 4.0 and x > 1.0:
        break
"""

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """With a data folder `data` in it."""
    (tmp_path / "worlds").mkdir()
    (tmp_path / "controllers" / "rover").mkdir(parents=True)
    shutil.copy(DEFAULT_WORLD, tmp_path / "worlds" / "table.wbt")
    (tmp_path / "controllers" / "rover" / "rover.py").write_text(CONTROLLER)
    return tmp_path


@pytest.fixture
def plan(project: Path) -> Callable[[str], Path]:
    """Write a plan for the project's world."""

    def write(text: str) -> Path:
        file = project / "plan.toml"
        file.write_text(f'world = "worlds/table.wbt"\n{text}')
        return file

    return write


def command(project: Path, *options: str) -> list[str]:
    program = [sys.executable, "-m", "webots_mcp", "trials", str(project / "plan.toml")]
    return [*program, "--stand-in", "--data-dir", str(project / "data"), *options]


def rows(project: Path, sql: str) -> list[Any]:
    """Of the recording that takes in the trials; none before there is one."""
    file = project / "data" / "webots.db"
    if not file.exists():
        return []
    with closing(sqlite3.connect(file)) as connection:
        return connection.execute(sql).fetchall()


def wait_for_trial(project: Path, number: int, runner: subprocess.Popen[Any]) -> int:
    """The process of a trial's simulator, once it runs; who runs it must not have ended before."""
    tables = "SELECT 1 FROM sqlite_master WHERE name = 'trial'"
    sql = f"SELECT pid FROM trial WHERE number = {number} AND status = 'running'"

    def look() -> list[Any]:
        found = rows(project, tables) and rows(project, sql)
        assert found or runner.poll() is None, runner.communicate()[1]
        return found

    return int(wait_for(look)[0][0])


@pytest.fixture
def refused(project: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What a plan that cannot be run is refused with, in this process: nothing is started."""

    def run_plan(*options: str) -> str:
        assert main(command(project, *options)[3:]) == 2
        said = capsys.readouterr()
        assert said.out == ""
        return said.err

    return run_plan


@pytest.fixture
def run(project: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the plan on the stand-in: in this process, or in one with an environment of its own."""

    def run_plan(
        *options: str, env: dict[str, str] | None = None
    ) -> subprocess.CompletedProcess[str]:
        line = command(project, *options)
        if env is not None:
            return subprocess.run(
                line, capture_output=True, text=True, timeout=120, check=False, env=env
            )
        capsys.readouterr()
        code = main(line[3:])
        said = capsys.readouterr()
        return subprocess.CompletedProcess(line, code, said.out, said.err)

    return run_plan
