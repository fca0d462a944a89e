"""The scene and its fields from a shell."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.server.conftest import Driver
from webots_mcp.cli import main


@pytest.fixture
def database(tmp_path: Path) -> Path:
    return tmp_path / "webots.db"


@pytest.fixture
def driver(database: Path) -> Iterator[Driver]:
    driving = Driver(database)
    driving.start()
    yield driving
    driving.stop()


@pytest.mark.usefixtures("driver")
def test_the_scene_is_a_table(database: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = ["--database", str(database)]
    assert main(["scene", *where, "--depth", "1", "--field", "translation"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[3].split() == ["depth", "path", "type", "name", "translation"]
    assert "[-1.2, 0.0, 0.04]" in next(line for line in lines if "ROVER" in line)
    assert main(["scene", *where, "--type", "Robot", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["result"]["rows"] == [[1, "ROVER", "Robot", "rover"]]


@pytest.mark.usefixtures("driver")
def test_a_field_is_shown_and_set(database: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = ["--database", str(database)]
    assert main(["field", *where, "BALL.physics.mass"]) == 0
    assert "value 0.05" in capsys.readouterr().out
    assert main(["field", *where, "ROVER.translation", "[0, 1, 0.04]", "--stop"]) == 0
    assert "to [0.0, 1.0, 0.04]" in capsys.readouterr().out
    assert main(["field", *where, "ROVER.customData", "a text"]) == 0
    assert main(["field", *where, "ROVER", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["result"]["rows"]
    assert ["customData", "SFString", "a text"] in rows
    assert main(["field", *where, "ROVER.children"]) == 0
    assert 'lidar"]' in capsys.readouterr().out, "all entries"
    capsys.readouterr()
    assert main(["field", *where, "ROVER.translation", "[NaN,0,0]"]) != 0
    assert "give 3 finite numbers, such as [0, 0.5, 0.1]; got '[NaN,0,0]'" in str(
        capsys.readouterr()
    )
    assert main(["field", *where, "ROVER.customData", "NaN"]) == 0
    assert "to NaN" in capsys.readouterr().out
    assert main(["field", *where, "ROVER.nothing"]) == 2
    assert "has no field 'nothing'" in capsys.readouterr().err
