"""The command that shows and sets parameters."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.server.test_parameters import TunableDriver
from webots_mcp.cli import main


@pytest.fixture
def database(tmp_path: Path) -> Path:
    return tmp_path / "webots.db"


@pytest.fixture
def tunable(database: Path) -> Iterator[TunableDriver]:
    driving = TunableDriver(database)
    driving.start()
    yield driving
    driving.stop()


def test_parameters_are_shown_and_set(
    tunable: TunableDriver, database: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["parameters", "--database", str(database)]
    assert main([*line, "kp=3.5", "gait=walk"]) == 0
    out = capsys.readouterr().out
    assert "gait: old trot, new walk\n    kp: old 2, new 3.5\n  since_sim_time_s 0." in out
    assert (tunable.kp.value, tunable.gait.value) == (3.5, "walk")
    assert main(line) == 0
    rows = capsys.readouterr().out.splitlines()
    assert rows[2].split()[:4] == ["name", "value", "unit", "default"]
    assert rows[3].split()[:4] == ["kp", "3.5", "1/s", "2"]
    assert main([*line, "laps=4", "--from-reset"]) == 0
    assert "laps: now 3, next 4\n  since the next reset\n" in capsys.readouterr().out
    assert main([*line, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["parameters"]
    assert told["rows"][1][told["columns"].index("next")] == 4


def test_a_text_that_looks_like_a_number_stays_a_text(
    tunable: TunableDriver, database: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--database", str(database))
    tag = tunable.bridge.parameter("tag", "none")
    ran = ["run", *where, "--for", "0.1", "--then", "go_on"]
    assert main([*ran, "--set", "tag=7", "--set", "kp=3"]) == 0
    assert (tag.value, tunable.kp.value) == ("7", 3.0)
    assert main(["parameters", *where, "tag=true"]) == 0
    assert tag.value == "true"
    capsys.readouterr()
    assert main(["runs", *where, "--parameter", "tag=7", "--parameter", "kp=3", "--json"]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert [row[runs["columns"].index("run_id")] for row in runs["rows"]] == [1]


@pytest.mark.usefixtures("tunable")
@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["kp=fast"], "'kp' is a number from 0 up to 10, not 'fast'"),
        (["kp"], "'kp' names no value: write kp=VALUE"),
        (["kq=1"], "no parameter 'kq'"),
        (["gait=1"], "one of 'trot', 'walk', not '1'"),
        (["kp=1", "--run", "1"], "parameters are set in the current one"),
    ],
)
def test_a_wrong_setting_is_one_line_and_exit_code_2(
    database: Path, capsys: pytest.CaptureFixture[str], settings: list[str], said: str
) -> None:
    assert main(["parameters", "--database", str(database), *settings]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
