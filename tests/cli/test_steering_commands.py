"""What an assistant can ask of a simulation, a person can from a shell."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.bridge.conftest import Recording
from tests.server.conftest import Driver
from webots_mcp.cli import main


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "webots.db"


@pytest.fixture
def driver(file: Path) -> Iterator[Driver]:
    driving = Driver(file)
    driving.start()
    yield driving
    driving.stop()


def wait_for(condition: Callable[[], bool]) -> None:
    """Leave the processor to the others in between."""
    deadline_s, moment = time.monotonic() + 60, threading.Event()
    while not condition():
        assert time.monotonic() < deadline_s
        moment.wait(0.02)


def test_a_run_says_why_it_stopped_and_what_happened(
    file: Path, driver: Driver, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--database", str(file))
    assert main(["run", *where, "--for", "0.48", "--reset", "--until", "steps < 0"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("time over at 0.48 s of run 2: 0.48 s simulated")
    assert "mode pause" in said
    assert "last rows:" in said
    assert main(["run", *where, "--for", "0.16", "--then", "go_on", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ran"]["advanced_s"] == pytest.approx(0.16)


def test_send_pause_step_and_resume(
    file: Path, driver: Driver, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--database", str(file))
    assert main(["send", *where, "set_speed", "speed=3.5"]) == 0
    assert driver.speed == 3.5
    assert "speed 3.5" in capsys.readouterr().out
    assert main(["pause", *where]) == 0
    assert main(["step", *where, "5"]) == 0
    assert "steps 5" in capsys.readouterr().out
    assert main(["resume", *where]) == 0
    assert main(["send", *where, "break_down"]) == 2
    assert "the gear is gone" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["run"], "give until"),
        (["run", "--for", "1", "--set", "kp"], "names no value"),
        (["run", "--for", "1", "--set", "kp=1"], "declares no parameters"),
        (["run", "--until", "stepz > 1000"], "steps"),
        (["run", "--for", "900", "--pace", "real_time", "--timeout", "0.5"], "'webots-mcp tail'"),
        (["step", "many"], "whole number"),
    ],
)
def test_what_makes_no_sense_is_refused(
    file: Path,
    driver: Driver,
    arguments: list[str],
    told: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name, *rest = arguments
    recording = Recording(file)
    wait_for(lambda: recording.states() != [])
    assert main([name, "--database", str(file), *rest]) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_leaves_the_simulation_as_then_says(
    file: Path, driver: Driver, number: signal.Signals
) -> None:
    recording = Recording(file)
    line = [sys.executable, "-m", "webots_mcp", "run", "--database", str(file), "--for", "900"]
    process = subprocess.Popen(line, stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    wanted = "SELECT count(*) FROM command WHERE action = 'run' AND status = ?"
    wait_for(lambda: recording.rows(wanted, "claimed") == [1] or process.poll() is not None)
    process.send_signal(number)
    _, said = process.communicate(timeout=20)
    assert process.returncode == 128 + number, said
    wait_for(lambda: recording.rows(wanted, "done") == [1])
    (result,) = recording.rows("SELECT result FROM command WHERE action = 'run'")
    assert json.loads(result)["why"] == "it was cancelled"
    assert recording.rows("SELECT hold FROM session") == ["paused"]
