"""Whoever runs trials may be ended at any moment: nothing is left over, lost or doubled."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.bridge.processes.stopping import stop_between_writes
from tests.steering.trials.conftest import Run, command, rows, wait_for_trial
from tests.waiting import wait_for
from webots_mcp.database.processes import process_identity
from webots_mcp.simulator.starting import CommandLine
from webots_mcp.steering.trial_run import TrialSimulator

Write = Callable[[str], Path]

pytestmark = [pytest.mark.skipif(os.name != "posix", reason="signals"), pytest.mark.slow]

# It tells of itself, then is deaf to everything that can be ignored.
SIMULATOR = """
import os, pathlib, signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN) if {deaf} else None
pathlib.Path("simulator.txt").write_text(str(os.getpid()))
time.sleep(600)
"""

# Dies between the start of the simulator's process and the note of its pid, or after that.
RUNNER = """
import os, pathlib, signal, sys, time
from webots_mcp.steering.trial_run import TrialSimulator
from webots_mcp.simulator.starting import CommandLine
command = CommandLine([sys.executable, "simulator.py"], [])
simulator = TrialSimulator(command, pathlib.Path(), {})
print(simulator.pid, flush=True)
if "start" in sys.argv:
    simulator.start()
    while not pathlib.Path("simulator.txt").exists():
        time.sleep(0.01)
os.kill(os.getpid(), signal.SIGKILL)
"""


def is_gone(pid: int) -> bool:
    return process_identity(pid) is None


def killed(folder: Path, *arguments: str, deaf: bool = False) -> int:
    """The process of a simulator whose runner was killed."""
    (folder / "simulator.py").write_text(SIMULATOR.format(deaf=deaf))
    line = [sys.executable, "-c", RUNNER, *arguments]
    ended = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    return int(ended.stdout)


def test_a_runner_that_is_killed_before_it_noted_a_simulator_has_started_none(
    tmp_path: Path,
) -> None:
    pid = killed(tmp_path)

    wait_for(lambda: is_gone(pid))
    assert not (tmp_path / "simulator.txt").exists()


@pytest.mark.parametrize("deaf", [False, True])
def test_a_simulator_ends_with_its_runner(tmp_path: Path, deaf: bool) -> None:
    pid = killed(tmp_path, "start", deaf=deaf)

    wait_for(lambda: is_gone(pid))
    simulator = int((tmp_path / "simulator.txt").read_text())
    wait_for(lambda: is_gone(simulator))


@pytest.mark.parametrize("deaf", [False, True])
def test_a_simulator_whose_keeper_is_killed_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, deaf: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "simulator.py").write_text(SIMULATOR.format(deaf=deaf))
    simulator, told = (
        TrialSimulator(CommandLine([sys.executable, "simulator.py"], []), tmp_path, {}),
        Path("simulator.txt"),
    )
    simulator.start()
    wait_for(lambda: told.exists() and told.read_text() != "")
    os.kill(simulator.pid, signal.SIGKILL)

    if sys.platform == "linux" and not deaf:  # by itself
        wait_for(lambda: is_gone(int(told.read_text())))
    wait_for(lambda: simulator.is_over)
    simulator.end()
    assert is_gone(int(told.read_text()))


@pytest.mark.parametrize(
    ("numbers", "codes"),
    [
        ([signal.SIGKILL], {-signal.SIGKILL}),
        ([signal.SIGTERM], {128 + signal.SIGTERM}),
        ([signal.SIGINT], {128 + signal.SIGINT}),
        ([signal.SIGINT, signal.SIGTERM], {128 + signal.SIGINT, 128 + signal.SIGTERM}),
        ([signal.SIGTERM, signal.SIGKILL], {-signal.SIGKILL}),
    ],
)
def test_who_is_ended_in_the_middle_is_gone_on_from(
    project: Path, plan: Write, run: Run, numbers: list[signal.Signals], codes: set[int]
) -> None:
    plan('score = "last(x)"\nfor_s = 3\nrepeats = 2\n[grid]\nspeed = [1.0, 2.0]')
    process = subprocess.Popen(
        command(project, "--jobs", "2"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    pid = wait_for_trial(project, 2, process)
    for number in numbers:
        process.send_signal(number)
    _, said = process.communicate(timeout=30)

    assert process.returncode in codes, said
    assert "Traceback" not in said
    wait_for(lambda: is_gone(pid))
    if codes == {128 + numbers[0]}:
        assert said.endswith(("ended by Ctrl-C\n", "ended by SIGTERM\n"))
        assert rows(project, "SELECT count(*) FROM trial WHERE status = 'running'") == [(0,)]
    answer = json.loads(run("--jobs", "2", "--json").stdout)

    assert [len(each["scores"]) for each in answer["sets"]] == [2, 2]
    assert rows(project, "SELECT count(*), count(DISTINCT uuid) FROM run") == [(4, 4)]
    assert rows(project, "SELECT count(*) FROM trial_set") == [(1,)]
    assert list((project / "data" / "trials").iterdir()) == []


def test_who_was_stopped_until_another_took_over_writes_nothing_more(
    project: Path, plan: Write, run: Run
) -> None:
    plan('score = "last(x)"\nfor_s = 3\nrepeats = 2\n[grid]\nspeed = [1.0, 2.0]')
    process = subprocess.Popen(
        command(project, "--jobs", "2"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_for_trial(project, 2, process)
    stop_between_writes(process.pid, project / "data" / "webots.db")
    refused = run("--jobs", "2")
    assert f"Process {process.pid} on " in refused.stderr
    with closing(sqlite3.connect(project / "data" / "webots.db")) as connection, connection:
        connection.execute("UPDATE lease SET until_wall_time_s = 1.0")
    answer = json.loads(run("--jobs", "2", "--json").stdout)
    process.send_signal(signal.SIGCONT)
    _, said = process.communicate(timeout=30)

    assert process.returncode == 2, said
    assert "trial set 1 was taken over by another process, since this one" in said
    assert [len(each["scores"]) for each in answer["sets"]] == [2, 2]
    done = "SELECT count(*), count(DISTINCT run_id) FROM trial WHERE status = 'done'"
    assert rows(project, done) == [(4, 4)]
    assert rows(project, "SELECT count(*) FROM run") == [(4,)]
