"""Controllers as real processes, in the stand-in's arena or on their own."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest

from tests.bridge.conftest import Recording
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.standin import Simulation
from webots_mcp.standin.in_process import DEFAULT_WORLD

Start = Callable[..., Simulation]
T = TypeVar("T")

CONTROLLER = """
import sys
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot, throttle_interval=1)
"""


class PatientSimulation(Simulation):
    """Waits long for what does come about, however busy the machine is."""

    def wait_for(self, condition: Callable[[], T], timeout_s: float = 60.0) -> T:
        return super().wait_for(condition, max(timeout_s, 60.0))


@pytest.fixture
def data_dir(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def filed(data_dir: Path) -> Recording:
    return Recording(data_dir / DATABASE_NAME)


@pytest.fixture
def start(tmp_path: Path, data_dir: Path) -> Iterator[Start]:
    """Start the arena with a controller whose text follows on `CONTROLLER`."""
    running: list[Simulation] = []

    def run(loop: str, mode: str = "fast") -> Simulation:
        controller = tmp_path / "rover.py"
        controller.write_text(CONTROLLER + loop)
        simulation = PatientSimulation(
            DEFAULT_WORLD,
            mode=mode,
            controllers={"rover": controller},
            environment={"WEBOTS_MCP_DATA_DIR": str(data_dir)},
        )
        running.append(simulation.start())
        return simulation

    yield run
    for simulation in running:
        simulation.close()


@pytest.fixture
def script(tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """Start a Python program, from a file of its own: others may start at the same time."""
    numbers = itertools.count()

    def run(program: str, *arguments: object) -> subprocess.Popen[str]:
        file = tmp_path / f"program-{next(numbers)}.py"
        file.write_text(program)
        return subprocess.Popen(
            [sys.executable, str(file), *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return run


def last_numbers(simulation: Simulation) -> tuple[int, int]:
    """The newest two numbers that a controller printed; -1 before the first."""
    lines = (line.split()[-2:] for line in reversed(simulation.console))
    numbers = (tuple(map(int, words)) for words in lines if "".join(words).isdigit())
    return next((pair for pair in numbers if len(pair) == 2), (-1, -1))


def last_number(simulation: Simulation) -> int:
    """The newest number that a controller printed; -1 before the first."""
    return last_numbers(simulation)[1]


def has_states(recording: Recording) -> bool:
    """Whether a controller has made the database and published into it."""
    assert isinstance(recording.database, Path)
    tables = "SELECT count(*) FROM sqlite_master WHERE name = 'state'"
    return (
        recording.database.exists() and recording.rows(tables) == [1] and recording.states() != []
    )
