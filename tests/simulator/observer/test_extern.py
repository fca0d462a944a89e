"""`webots-mcp observe`: the observer as an extern controller of a running world."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from tests.simulator.observer.conftest import CROWD
from webots_mcp.setup.observer_edits import with_observer
from webots_mcp.standin import Simulation


@pytest.fixture
def extern_world(tmp_path: Path) -> Path:
    (tmp_path / "controllers").mkdir()
    world = tmp_path / "worlds" / "crowd.wbt"
    world.parent.mkdir()
    world.write_bytes(with_observer(CROWD.read_bytes(), extern=True))
    return world


def rows(file: Path) -> int:
    if not file.exists():
        return 0
    with closing(sqlite3.connect(file)) as connection:
        try:
            return connection.execute("SELECT count(*) FROM state").fetchone()[0]
        except sqlite3.OperationalError:  # it is being made
            return 0


@pytest.mark.slow
def test_it_records_a_running_world_and_ends_with_it(extern_world: Path, tmp_path: Path) -> None:
    where = ["--data-dir", str(tmp_path / "data")]
    line = [sys.executable, "-m", "webots_mcp", "observe", "--json", *where]
    with Simulation(extern_world) as simulation:
        environment = simulation.environment_of("mcp_observer")
        with subprocess.Popen(
            line, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            simulation.wait_for(lambda: rows(tmp_path / "data" / "webots.db") > 3, 60)
            simulation.quit()
            told, said = process.communicate(timeout=30)
    assert (process.returncode, said) == (0, "")
    assert json.loads(told)["data_dir"] == str(tmp_path / "data")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["--period-ms", "0"], "from 1 to 60000"), ([], "set WEBOTS_HOME to the folder of Webots")],
)
def test_what_cannot_be_is_refused(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("PATH", "")
    line = [sys.executable, "-m", "webots_mcp", "observe", *arguments]
    ended = subprocess.run(line, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert ended.returncode == 2
    assert said in ended.stderr
