"""The pytest plugin: fixtures for testing a controller by what it records.

See 'webots-mcp help testing'.

pytest loads this module whenever the package is installed. Slow imports are therefore in the
fixtures that use them.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from webots_mcp import MCPBridge, MemoryDatabase
    from webots_mcp.database.location import Database
    from webots_mcp.standin import InProcessSupervisor
    from webots_mcp.testing import RobotFactory, RobotRecording, SimulationFactory

_TESTING = str(Path(__file__).parent) + os.sep
_PACKAGE = str(Path(__file__).parents[1]) + os.sep


@pytest.fixture
def webots_parameters(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> dict[str, Any]:
    """Start values of the parameters, from `@pytest.mark.webots_parameters(kp=3.0)`."""
    from webots_mcp.contract import PARAMETERS_VARIABLE

    marker = request.node.get_closest_marker("webots_parameters")
    values: dict[str, Any] = dict(marker.kwargs) if marker else {}
    if marker:
        if marker.args:
            raise pytest.UsageError("webots_parameters takes names: webots_parameters(kp=3.0)")
        monkeypatch.setenv(PARAMETERS_VARIABLE, json.dumps(values))
    return values


def _require_declared(values: dict[str, Any], databases: Iterable[Database]) -> None:
    """Fail a test whose marker names a parameter that no controller has declared."""
    from webots_mcp.database.connection import connect

    declared = set[str]()
    for database in databases:
        with closing(connect(database, "reader")) as connection:
            declared |= {name for (name,) in connection.execute("SELECT name FROM parameter")}
    named = (
        name for name, value in values.items() if not isinstance(value, dict)
    )  # Values of one robot.
    lacking = [name for name in named if name not in declared]
    if lacking:
        pytest.fail(
            f"webots_parameters: no controller declared {', '.join(lacking)}", pytrace=False
        )


@pytest.fixture
def webots_database(
    webots_parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> Iterator[MemoryDatabase]:
    """Yield a database in memory, empty.

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
def webots_robot_factory(pytestconfig: pytest.Config) -> RobotFactory:
    """Makes robots of the stand-in, without a process.

    `webots_robot_factory(name=None, *, world=..., supervisor=True, duration_s=inf)`: a robot of a
    world, by name or the first. A world's path is one in pytest's rootdir. After `duration_s` of
    simulated time its `step` returns -1. Robots share a world when they are given the `simulation`
    of the first as `world`.
    """
    from webots_mcp.testing import RobotFactory

    return RobotFactory(pytestconfig.rootpath)


@pytest.fixture
def webots_robot(webots_robot_factory: RobotFactory) -> InProcessSupervisor:
    """The stand-in's rover, with a supervisor's rights, in a 4 m x 4 m arena with obstacles."""
    return webots_robot_factory("rover")


@pytest.fixture
def webots_bridge(
    webots_robot: InProcessSupervisor,
    webots_database: MemoryDatabase,
    webots_parameters: dict[str, Any],
) -> Iterator[MCPBridge]:
    """Yield a bridge that records each `publish` of `webots_robot` into `webots_database`."""
    from webots_mcp import MCPBridge

    with MCPBridge(webots_robot, throttle_interval=1, database=webots_database) as bridge:
        yield bridge
    if webots_parameters:
        _require_declared(webots_parameters, [webots_database])


@pytest.fixture
def webots_recording(webots_database: MemoryDatabase) -> RobotRecording:
    """Return the recording in `webots_database`, with functions to send commands."""
    from webots_mcp.testing import RobotRecording

    return RobotRecording(webots_database)


@pytest.fixture
def webots_simulation(
    tmp_path: Path, request: pytest.FixtureRequest, webots_parameters: dict[str, Any]
) -> Iterator[SimulationFactory]:
    """Starts a world whose controllers are real processes that record into the test's folder.

    `webots_simulation(world=..., controllers={"rover": file}, environment={}, parameters={})`:
    paused before its first step; `run_for(duration_s)` lets it run, `recording` is what its
    controllers recorded. Paths are those in pytest's rootdir. A failure shows in which
    file the recording is.
    """
    from webots_mcp.testing import RecordedSimulation, SimulationFactory

    def report(simulation: RecordedSimulation) -> None:
        node: pytest.Item = request.node
        node.add_report_section("call", "recording", f"{simulation.recording.database}\n")

    factory = SimulationFactory(tmp_path, request.config.rootpath, report)
    yield factory
    factory.close()
    if webots_parameters and (databases := factory.databases):
        _require_declared(webots_parameters, databases)


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    config.addinivalue_line(
        "markers", "webots_parameters(**values): start values of the controllers' parameters"
    )


def pytest_assertrepr_compare(op: str, left: object, right: object) -> list[str] | None:
    """Show a command's status with its reason, which pytest itself would cut off."""
    asked = sys.modules.get("webots_mcp.testing.recorded_command")
    if asked is None or not isinstance(left, asked.CommandStatus):
        return None
    return [f"{left!r} {op} {right!r}"]


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> None:
    """End the traceback at the test's own line if an error of this package explains a failure.

    Any other exception within the package is a defect of the package, and keeps its frames. With
    `--full-trace` or `--pdb`, every exception does.
    """
    failure = call.excinfo
    if failure is None or item.config.getoption("fulltrace") or item.config.getoption("usepdb"):
        return
    error = failure.value
    own_frames = _TESTING if isinstance(error, (AssertionError, TimeoutError)) else _PACKAGE
    is_own = own_frames == _TESTING or type(error).__module__.startswith("webots_mcp.")
    entry, line = failure.tb, failure.tb  # The innermost frame, and the innermost one of the user.
    while entry.tb_next is not None:
        entry = entry.tb_next
        if not entry.tb_frame.f_code.co_filename.startswith((_PACKAGE, contextlib.__file__)):
            line = entry
    if is_own and entry.tb_frame.f_code.co_filename.startswith(own_frames):
        line.tb_next = None
        error.__cause__, error.__suppress_context__ = None, True  # The message includes it.
