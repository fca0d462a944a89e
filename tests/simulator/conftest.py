"""A project of worlds and controllers, and a program `webots` on the PATH that runs them."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.simulator.webots_program import put_on_path
from webots_mcp.standin.in_process import DEFAULT_WORLD

CONTROLLER = """
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot, throttle_interval=1)
print("ready", flush=True)
while robot.step(16) != -1:
    bridge.publish({"time_s": robot.getTime()})
    bridge.get_command()
"""

StartWebots = Callable[..., "subprocess.Popen[str]"]


def free_port() -> int:
    """A port after which ten more are most likely free as well."""
    with socket.create_server(("127.0.0.1", 0)) as door:
        return int(door.getsockname()[1])


def write_project(folder: Path, controller: str = CONTROLLER) -> Path:
    """A project whose world is the stand-in's arena; returns the world's file."""
    world = folder / "worlds" / "arena.wbt"
    world.parent.mkdir(parents=True)
    shutil.copy(DEFAULT_WORLD, world)
    (folder / "controllers" / "rover").mkdir(parents=True)
    (folder / "controllers" / "rover" / "rover.py").write_text(controller, "utf-8")
    return world


@pytest.fixture
def world(tmp_path: Path) -> Path:
    return write_project(tmp_path / "project")


@pytest.fixture
def webots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The program `webots`, which is found on the PATH and nowhere else."""
    program = put_on_path(tmp_path / "bin")
    monkeypatch.setenv("PATH", os.pathsep.join((str(program.parent), os.environ["PATH"])))
    for variable in ("WEBOTS_HOME", "WEBOTS_MCP_DATA_DIR"):
        monkeypatch.delenv(variable, raising=False)
    return program


@pytest.fixture
def start_webots(webots: Path) -> Iterator[StartWebots]:
    """Start the program `webots` with arguments."""
    with started(webots) as start:
        yield start


@contextmanager
def started(*program: object, end: signal.Signals = signal.SIGTERM) -> Generator[StartWebots]:
    """Start a program with arguments; all that were started end with the block.

    Args:
        program: With its first arguments.
        end: How they are ended.
    """
    running: list[subprocess.Popen[str]] = []

    def start(*arguments: object) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [str(each) for each in (*program, *arguments)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        running.append(process)
        return process

    yield start
    for process in running:
        process.send_signal(end)
    for process in running:
        process.communicate(timeout=30)


def wait_for_line(process: subprocess.Popen[str], text: str) -> str:
    """The first line of its stdout with a text in it."""
    assert process.stdout is not None
    for line in process.stdout:
        if text in line:
            return line
    raise AssertionError(f"{text!r} never came")
