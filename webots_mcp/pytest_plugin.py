"""Fixtures for testing a Webots controller by what it records; see docs/testing.md.

pytest loads this module whenever the package is installed: whatever costs time is imported by the
fixtures that use it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from webots_mcp import MCPBridge, MemoryDatabase
    from webots_mcp.standin import InProcessRobot, InProcessSupervisor
    from webots_mcp.testing import RecordedSimulation, Recording


@pytest.fixture
def webots_database(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryDatabase]:
    """A database in memory, empty.

    While it is there, a bridge in the test's process raises what it could not do, and each
    `get_command()` looks for commands (otherwise at most every 5 ms).
    """
    from webots_mcp import MemoryDatabase
    from webots_mcp.contract import STRICT_VARIABLE

    monkeypatch.setenv(STRICT_VARIABLE, "1")
    monkeypatch.setattr("webots_mcp.bridge.control.POLL_INTERVAL_S", 0.0)
    database = MemoryDatabase()
    yield database
    database.close()


@pytest.fixture
def webots_robot_factory() -> Callable[..., InProcessRobot]:
    """Makes robots of the stand-in, without a process.

    `webots_robot_factory(name=None, *, world=..., supervisor=True, duration_s=inf)`: a robot of a
    world, by name or the first. After `duration_s` of simulated time its `step` returns -1. Robots
    share a world when they are given the `simulation` of the first as `world`.
    """
    return _make_robot


@pytest.fixture
def webots_robot(
    webots_robot_factory: Callable[..., InProcessSupervisor],
) -> InProcessSupervisor:
    """The stand-in's rover, with a supervisor's rights, in a 4 m x 4 m arena with obstacles."""
    return webots_robot_factory("rover")


@pytest.fixture
def webots_bridge(
    webots_robot: InProcessSupervisor, webots_database: MemoryDatabase
) -> Iterator[MCPBridge]:
    """A bridge that records each `publish` of `webots_robot` into `webots_database`."""
    from webots_mcp import MCPBridge

    with MCPBridge(webots_robot, throttle_interval=1, database=webots_database) as bridge:
        yield bridge


@pytest.fixture
def recording(webots_database: MemoryDatabase) -> Recording:
    """What was recorded in `webots_database`, and the way to send commands."""
    from webots_mcp.testing import Recording

    return Recording(webots_database)


@pytest.fixture
def webots_simulation(tmp_path: Path) -> Iterator[Callable[..., RecordedSimulation]]:
    """Starts a world whose controllers are real processes that record into the test's folder.

    `webots_simulation(world=..., controllers={"rover": file}, environment={})`: paused before its
    first step; `run_for(duration_s)` lets it run, `recording` is what its controllers recorded.
    """
    from webots_mcp.testing import RecordedSimulation

    started: list[RecordedSimulation] = []

    def start(*arguments: Any, **options: Any) -> RecordedSimulation:
        options.setdefault("data_dir", tmp_path / f"mcp_data_{len(started) + 1}")
        simulation = RecordedSimulation(*arguments, **options)
        started.append(simulation)
        simulation.start()
        return simulation

    yield start
    for simulation in started:
        simulation.close()


def _make_robot(
    name: str | None = None,
    *,
    world: Any = None,
    supervisor: bool = True,
    duration_s: float = float("inf"),
) -> InProcessRobot:
    from webots_mcp.standin import InProcessRobot, InProcessSimulation, InProcessSupervisor
    from webots_mcp.standin.in_process import DEFAULT_WORLD
    from webots_mcp.testing import Rehearsal

    if not isinstance(world, InProcessSimulation):
        world = Rehearsal(DEFAULT_WORLD if world is None else world, duration_s=duration_s)
    kind = InProcessSupervisor if supervisor else InProcessRobot
    return kind(name, world=world)
