"""What an assistant can ask of a simulation, a person can from a shell."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.bridge.conftest import Recording
from tests.recordings.rows import Recorded
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


def listed_in(table: dict[str, Any]) -> dict[str, Any]:
    """The only row of a table, by its columns."""
    (row,) = table["rows"]
    return dict(zip(table["columns"], row, strict=True))


def test_a_run_says_why_it_stopped_and_what_happened(
    file: Path, driver: Driver, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--database", str(file))
    assert main(["run", *where, "--for", "0.48", "--reset", "--until", "steps < 0"]) == 0
    said = capsys.readouterr().out
    assert "stopped simulation time reached" in said
    assert "ran: run_id 2, from_s 0, to_s 0.48, advanced_s 0.48" in said
    assert "mode pause" in said
    assert "\nrows:\n  sim_time_s  steps\n" in said
    assert main(["run", *where, "--for", "0.16", "--then", "go_on", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ran"]["advanced_s"] == pytest.approx(0.16)


def test_send_pause_step_and_resume(
    file: Path, driver: Driver, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--database", str(file))
    assert main(["send", *where, "set_speed", "speed=3.5", "--timeout", "3600"]) == 0
    assert driver.speed == 3.5
    assert "speed 3.5" in capsys.readouterr().out
    assert main(["pause", *where]) == 0
    assert main(["step", *where, "5"]) == 0
    assert "steps 5" in capsys.readouterr().out
    assert main(["resume", *where]) == 0
    assert main(["keep", *where, "7"]) == 0
    assert Recording(file).rows("SELECT reason FROM kept_stretch") == ["7"]
    assert main(["keep", *where, " "]) == 2
    assert "reason must be a text that is not empty" in capsys.readouterr().err
    assert main(["send", *where, "break_down"]) == 2
    assert "the gear is gone" in capsys.readouterr().err
    assert set(Recording(file).rows("SELECT requested_by FROM command")) == {"cli"}


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["run"], "(a condition), --for "),
        (["run", "--for", "nan"], "--for must be less than or equal to 1000000, not nan"),
        (["run", "--for", "0"], "--for must be greater than 0, not 0"),
        (["run", "--for", "inf"], "--for must be less than or equal to 1000000, not inf"),
        (["run", "--for", "1", "--timeout", "0"], "--timeout must be greater than or equal to 0.1"),
        (["run", "--for", "1", "--set", "kp"], "names no value"),
        (["run", "--for", "1", "--set", "kp=1"], "declares no parameters"),
        (["run", "--until", "stepz > 1000"], "steps"),
        (
            ["run", "--for", "900", "--pace", "real_time", "--timeout", "0.5"],
            "webots-mcp wait 1",
        ),
        (["step", "many"], "Invalid value for N: 'many' is no whole number"),
        (["breakpoint", "steps <"], "column"),
        (["breakpoint", "steps < 3", "--remove", "1"], "not both"),
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


def test_a_run_that_takes_longer_is_waited_for_or_ended_with_the_lines_that_it_names(
    file: Path, driver: Driver, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = Recording(file)
    wait_for(lambda: recording.states() != [])
    far = ("--for", "3", "--pace", "real_time", "--timeout", "0.3")
    assert main(["run", "--database", str(file), *far]) == 2
    said = map(shlex.split, capsys.readouterr().err.splitlines())
    (_, *line), (_, *end) = [words for words in said if words[:1] == ["webots-mcp"]]
    assert main([*line, "--timeout", "0.1"]) == 2
    assert "'webots-mcp" not in capsys.readouterr().out
    assert main(line) == 0
    assert "simulation time reached" in capsys.readouterr().out
    assert main([*line[:1], "999", *line[2:]]) == 2
    assert "no command 999" in capsys.readouterr().err
    capsys.readouterr()
    assert main(["run", "--database", str(file), *far, "--json"]) == 2
    told = json.loads(capsys.readouterr().out)
    assert (told["command_id"], told["outcome"]) == (2, "claimed")
    assert "webots-mcp wait 2" in told["error"]
    assert main(end) == 0
    assert recording.fate(2)[1]["ended"] == "interrupted"


def test_an_action_that_nobody_registered_is_no_success(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    silent = Driver(file, registers=False)
    silent.start()
    recording = Recording(file)
    wait_for(lambda: recording.states() != [])
    assert main(["send", "--database", str(file), "resett"]) == 2
    silent.stop()
    said = capsys.readouterr().err
    assert "no action 'resett'; this robot has reset, reset_state, " in said


def test_breakpoints_are_set_listed_hit_and_removed(
    file: Path, driver: Driver, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, where = Recording(file), ("--database", str(file))
    wait_for(lambda: recording.states() != [])
    assert main(["breakpoint", *where]) == 0
    assert "this robot has none: 'webots-mcp breakpoint' sets one" in capsys.readouterr().out
    assert main(["breakpoint", *where, "steps > 3", "--action", "log", "--after-hits", "1"]) == 0
    assert "breakpoint_id 1, condition steps > 3, action log, armed true" in capsys.readouterr().out
    wait_for(lambda: recording.rows("SELECT hit_count FROM breakpoint") == [1])
    assert main(["breakpoint", *where, "--json"]) == 0
    listed = listed_in(json.loads(capsys.readouterr().out)["breakpoints"])
    assert (listed["condition"], listed["hit_count"], listed["set_by"]) == ("steps > 3", 1, "cli")
    assert main(["breakpoint", *where]) == 0
    assert "steps > 3" in capsys.readouterr().out
    assert main(["breakpoint", *where, "--remove", "1"]) == 0
    assert "breakpoint_id 1, armed false" in capsys.readouterr().out
    assert main(["breakpoint", *where, "--remove", "1"]) == 2
    assert "no breakpoint 1; it has none" in capsys.readouterr().err


def test_a_breakpoint_of_a_robot_that_is_gone_is_stored_and_says_so(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gone = Driver(file)
    gone.start()
    recording = Recording(file)
    wait_for(lambda: recording.states() != [])
    gone.stop()
    assert main(["breakpoint", "--database", str(file), "stepz > 3"]) == 0
    said = capsys.readouterr().out
    said = " ".join(said.split())
    assert "breakpoint_id 1, condition stepz > 3, action pause, armed false" in said
    assert "it is stored, but not armed yet" in said
    assert "stepz is missing as long as it is not published; there is steps" in said
    assert "reads them when it starts" in said


def test_a_command_that_no_route_could_do_says_why_each_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    oldest = 1  # a process that began after a session was seen last is another one
    recorded.robot(supervisor=True, pid=oldest, last_seen_wall_time_s=time.time() - 30)
    assert main(["pause", "--timeout", "0.2", "--data-dir", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "pause is not done (cancelled)" in said
    assert "websocket: " in said
    assert "keyboard: not tried: it presses keys in Webots' window, which needs --force\n" in said
    recorded.close()


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
    _, said = process.communicate(timeout=60)
    assert process.returncode == 128 + number, said
    wait_for(lambda: recording.rows(wanted, "done") == [1])
    (result,) = recording.rows("SELECT result FROM command WHERE action = 'run'")
    assert json.loads(result)["why"] == "it was cancelled"
    assert recording.rows("SELECT pause_state FROM session") == ["paused"]


def test_ctrl_c_ends_steps_and_leaves_the_simulation_paused(file: Path, driver: Driver) -> None:
    recording = Recording(file)
    line = [sys.executable, "-m", "webots_mcp", "step", "--database", str(file), "5000"]
    process = subprocess.Popen(line, stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    wanted = "SELECT count(*) FROM command WHERE action = 'step' AND status = ?"
    wait_for(lambda: recording.rows(wanted, "claimed") == [1] or process.poll() is not None)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGINT, said
    wait_for(lambda: recording.rows(wanted, "done") == [1])
    (result,) = recording.rows("SELECT result FROM command WHERE action = 'step'")
    assert json.loads(result)["why"] == "it was cancelled before the last step"
    assert recording.rows("SELECT pause_state FROM session") == ["paused"]


def test_send_needs_an_action_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["send"]) == 2
    assert 'Command "send" parameter ACTION requires an argument' in capsys.readouterr().err
