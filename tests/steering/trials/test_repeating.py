"""The same run again: by reset, by reload and in simulators of their own, on the stand-in."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.steering.trials.conftest import CONTROLLER, rows
from webots_mcp.cli import main
from webots_mcp.contract import DATA_DIR_VARIABLE
from webots_mcp.standin import Simulation

pytestmark = pytest.mark.slow

Repeat = Callable[..., Any]
NOISY = (
    '"x": x',
    '"x": x, "noise": int.from_bytes(os.urandom(4), "big") * (robot.getTime() > 0.4)',
)


@pytest.fixture
def repeat(project: Path, capsys: pytest.CaptureFixture[str]) -> Repeat:
    def run(*options: str, status: int = 0) -> Any:
        code = main(["repeat", *options, "--data-dir", str(project / "data")])
        said = capsys.readouterr()
        assert code == status, said.err
        if status:
            return said.err
        assert "score" not in said.err and "best" not in said.err  # which rank trials
        return json.loads(said.out) if "--json" in options else said.out

    return run


@pytest.fixture
def live(project: Path) -> Iterator[Simulation]:
    """The project's world with its controller, whose variable `x` a reset does not put back."""
    world, data = project / "worlds" / "table.wbt", str(project / "data")
    with Simulation(world, mode="fast", environment={DATA_DIR_VARIABLE: data}) as simulation:
        made = "SELECT 1 FROM sqlite_master WHERE name = 'state'"
        simulation.wait_for(
            lambda: rows(project, made) and rows(project, "SELECT 1 FROM state LIMIT 1"), 60
        )
        yield simulation


def in_processes(project: Path) -> tuple[str, ...]:
    return (str(project / "worlds" / "table.wbt"), "--by", "process", "--stand-in")


def test_processes_of_their_own_repeat_to_the_last_digit(project: Path, repeat: Repeat) -> None:
    answer = repeat(*in_processes(project), "-n", "2", "--for", "1", "--json")
    found = answer["process"]
    assert (found["run_ids"], found["diverging"]) == ([1, 2], [])
    assert "2 runs: equal to the last digit in the 62 rows and 2 signals" in found["verdict"]


def test_noise_of_a_controller_is_found_in_processes_too(project: Path, repeat: Repeat) -> None:
    controller = project / "controllers" / "rover" / "rover.py"
    controller.write_text(CONTROLLER.replace(*NOISY))
    answer = repeat(*in_processes(project), "-n", "3", "--for", "1", "--json")
    assert answer["process"]["diverging"] == [2, 3]
    for each in answer["process"]["repeats"]:
        assert each["verdict"].startswith("equal to the last digit until 0.416 s; then noise by ")
        signal, *growth = each["growth"].values()
        assert (signal, growth[0]) == ("noise", 0.0) and growth[-1] > 0


@pytest.mark.slow
@pytest.mark.usefixtures("live")
def test_a_reset_that_leaves_something_is_to_blame_and_a_reload_is_not(
    project: Path, repeat: Repeat
) -> None:
    options = ("--by", "reset", "--by", "reload", "--by", "process", "-n", "2", "--for", "1")
    answer = repeat(*options, "--stand-in", "--json")
    assert [bool(answer[way]["parted"]) for way in ("reset", "reload", "process")] == [
        True,
        False,
        False,
    ]
    (reset,) = answer["reset"]["repeats"]
    assert reset["verdict"].startswith("unlike from the first row on, at 0.016 s: x by ")
    assert answer["verdict"].startswith("the reset is the cause: runs in processes of")

    said = repeat("--by", "reset", "-n", "3", "--for", "0.5")
    assert "reset:\n" in said and " and 2 of 2 others part; run " in said


def test_what_cannot_be_repeated_is_refused(project: Path, repeat: Repeat) -> None:
    assert "at least two runs are needed" in repeat("-n", "1", "--for", "1", status=2)
    assert "--for nan" in repeat(*in_processes(project), "--for", "nan", status=2)
    assert "apply only to processes" in repeat("--for", "1", "--stand-in", status=2)
    assert "no database" in repeat("--for", "1", status=2)
    refused = repeat("nowhere.wbt", "--by", "process", "--stand-in", "--for", "1", status=2)
    assert "no file " in refused
    repeat(*in_processes(project), "-n", "2", "--for", "0.1")
    assert "no live controller" in repeat("--for", "1", status=2)
