"""`profile`: which lines take a controller's time, by a real sampler where there is one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import Start, data_dir, filed, has_states, start
from tests.cli.conftest import Cli

__all__ = ["data_dir", "filed", "start"]  # fixtures

SLOW = """
import time
def crunch():
    until_s = time.perf_counter() + 0.02
    while time.perf_counter() < until_s:
        pass
bridge.attach(robot)
while robot.step(16) != -1:
    crunch()
    time.sleep(0.01)
"""


def test_the_lines_of_the_controllers_own_files_are_shown_with_their_share(
    cli: Cli, start: Start, filed: Recording, data_dir: Path
) -> None:
    if not shutil.which("py-spy"):
        pytest.skip("py-spy is not installed")
    start(SLOW).wait_for(lambda: has_states(filed))
    here = cli.on("--data-dir", data_dir)
    code, out, err = here.ended("profile rover --for 2 --json")
    if "may not look into" in err:
        pytest.skip(err)
    assert code == 0, err
    lines = {line for _, line, _, _ in json.loads(out)["rows"]}
    assert "rover.py:17" in lines  # asleep
    assert lines & {"rover.py:12", "rover.py:13"}  # in crunch()
    assert all(line.startswith(("rover.py", "waiting", "in ")) for line in lines)


def test_without_the_sampler_or_a_controller_it_is_said_what_to_do(
    cli: Cli, start: Start, filed: Recording, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulation = start(SLOW)
    simulation.wait_for(lambda: has_states(filed))
    monkeypatch.setattr(shutil, "which", dict[object, str]().get)
    here = cli.on("--data-dir", data_dir)
    missing = here.ended("profile")[2]
    simulation.close()
    gone = here.ended("profile")[2]
    assert "webots-mcp profile needs" in missing and "install" in missing
    assert "No controller of rover is running on this machine" in gone
