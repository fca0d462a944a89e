"""What an assistant can ask of a simulation, a person can from a shell."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bridge.conftest import Recording
from tests.cli.conftest import Cli
from tests.recordings.rows import Recorded
from tests.server.conftest import Driver
from tests.server.test_parameters import TunableDriver
from tests.waiting import wait_for


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return Recording(tmp_path / "webots.db")


@pytest.fixture
def tunable(tmp_path: Path) -> Iterator[TunableDriver]:
    driving = TunableDriver(tmp_path / "webots.db")
    driving.start()
    yield driving
    driving.stop()


@pytest.mark.slow
@pytest.mark.usefixtures("driver")
def test_a_run_says_why_it_stopped_and_what_happened(cli: Cli) -> None:
    said = cli("run --for 0.48 --reset --until 'steps < 0'")
    assert "stopped simulation time reached" in said
    assert "ran: run_id 2, start_s 0, end_s 0.48, advanced_s 0.48" in said
    assert "mode pause" in said
    assert "\nrows:\n  sim_time_s  steps\n" in said
    ran = cli.json("run --for 0.16 --then go_on")["ran"]
    assert ran["advanced_s"] == pytest.approx(0.16)


@pytest.mark.slow
def test_send_pause_step_resume_and_keep(cli: Cli, driver: Driver, recording: Recording) -> None:
    assert "speed 3.5" in cli("send set_speed speed=3.5 --timeout 3600")
    assert driver.speed == 3.5
    cli("pause")
    assert "steps 5" in cli("step 5")
    cli("resume")
    cli("keep 7")
    assert recording.rows("SELECT reason FROM kept_stretch") == ["7"]
    assert "reason must be a text that is not empty" in cli.refused("keep ' '")
    assert "the gear is gone" in cli.refused("send break_down")
    assert set(recording.rows("SELECT requested_by FROM command")) == {"cli"}


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("run", "Give --for 10 "),
        ("run --for nan", "--for must be less than or equal to 1000000, not nan"),
        ("run --for 0", "--for must be greater than 0, not 0"),
        ("run --for inf", "--for must be less than or equal to 1000000, not inf"),
        ("run --for 1 --timeout 0", "--timeout must be greater than or equal to 0.1"),
        ("run --for 1 --set kp", "has no value"),
        ("run --for 1 --set kp=1", "declares no parameters"),
        ("run --until 'stepz > 1000'", "steps"),
        ("run --for 900 --pace real_time --timeout 0.5", "webots-mcp wait 1"),
        ("step many", "Invalid value for N: 'many' is not a whole number"),
        ("breakpoint 'steps <'", "column"),
        ("breakpoint 'steps < 3' --remove 1", "exclude each other"),
        ("breakpoint --remove 1", "no breakpoint 1. It has no breakpoints."),
        ("wait 999", "no command 999"),
        ("field ROVER.nothing", "has no field 'nothing'"),
        ("field ROVER.translation '[NaN,0,0]'", "such as [0, 0.5, 0.1]; got '[NaN,0,0]'"),
    ],
)
def test_what_makes_no_sense_is_refused(
    recording: Recording, cli: Cli, typed: str, words: str
) -> None:
    wait_for(lambda: recording.states() != [])
    assert words in cli.refused(typed)


@pytest.mark.slow
@pytest.mark.usefixtures("driver")
def test_a_run_that_takes_longer_is_waited_for_or_ended_with_the_lines_that_it_names(
    recording: Recording, cli: Cli
) -> None:
    wait_for(lambda: recording.states() != [])
    far = "run --for 3 --pace real_time --timeout 0.3"
    said = map(shlex.split, cli.refused(far).splitlines())
    (_, *line), (_, *end) = [words for words in said if words[:1] == ["webots-mcp"]]
    here = cli.on()
    here.refused([*line, "--timeout", "0.1"])
    assert "simulation time reached" in here(line)
    code, out, _ = cli.ended(f"{far} --json")
    told = json.loads(out)
    assert (code, told["command_id"], told["outcome"]) == (2, 2, "claimed")
    assert "webots-mcp wait 2" in told["error"]
    here(end)
    assert recording.fate(2)[1]["ended"] == "interrupted"


@pytest.mark.usefixtures("driver")
def test_breakpoints_are_set_listed_hit_and_removed(recording: Recording, cli: Cli) -> None:
    wait_for(lambda: recording.states() != [])
    assert "this robot has none: 'webots-mcp breakpoint' sets one" in cli("breakpoint")
    said = cli("breakpoint 'steps > 3' --action log --after-hits 1")
    assert "breakpoint_id 1, condition steps > 3, action log, armed true" in said
    wait_for(lambda: recording.rows("SELECT hit_count FROM breakpoint") == [1])
    listed = cli.json("breakpoint")["breakpoints"]
    row = dict(zip(listed["columns"], listed["rows"][0], strict=True))
    assert (row["condition"], row["hit_count"], row["set_by"]) == ("steps > 3", 1, "cli")
    assert "breakpoint_id 1, armed false" in cli("breakpoint --remove 1")


@pytest.mark.slow
@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize(
    ("typed", "number", "why"),
    [
        ("run --for 900", signal.SIGINT, "it was cancelled"),
        ("run --for 900", signal.SIGTERM, "it was cancelled"),
        ("step 5000", signal.SIGINT, "it was cancelled before the last step"),
    ],
)
def test_ctrl_c_ends_what_the_loop_does_and_leaves_the_simulation_paused(
    cli: Cli, recording: Recording, typed: str, number: signal.Signals, why: str
) -> None:
    line = [sys.executable, "-m", "webots_mcp", *typed.split(), *cli.where]
    process = subprocess.Popen(line, stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    wanted = "SELECT count(*) FROM command WHERE action IN ('run', 'step') AND status = ?"
    wait_for(lambda: recording.rows(wanted, "claimed") == [1] or process.poll() is not None)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 128 + number, said
    wait_for(lambda: recording.rows(wanted, "done") == [1])
    (result,) = recording.rows("SELECT result FROM command WHERE action IN ('run', 'step')")
    assert json.loads(result)["why"] == why
    assert recording.rows("SELECT pause_state FROM session") == ["paused"]


@pytest.mark.usefixtures("driver")
def test_the_scene_is_a_table(cli: Cli) -> None:
    lines = cli("scene --depth 1 --field translation").splitlines()
    assert lines[4].split() == ["depth", "path", "type", "name", "translation"]
    assert "[-1.2, 0.0, 0.04]" in next(line for line in lines if "ROVER" in line)
    rows = cli.json("scene --type Robot")["result"]["rows"]
    assert rows == [[1, "ROVER", "Robot", "rover"]]


@pytest.mark.slow
@pytest.mark.usefixtures("driver")
def test_a_field_is_shown_and_set(cli: Cli) -> None:
    assert "value 0.05" in cli("field BALL.physics.mass")
    assert "to [0.0, 1.0, 0.04]" in cli("field ROVER.translation '[0, 1, 0.04]' --stop")
    cli("field ROVER.customData 'a text'")
    rows = cli.json("field ROVER")["result"]["rows"]
    assert ["customData", "SFString", "a text"] in rows
    assert 'lidar"]' in cli("field ROVER.children"), "all entries"
    assert "to NaN" in cli("field ROVER.customData NaN")


def test_parameters_are_shown_and_set(tunable: TunableDriver, cli: Cli) -> None:
    out = cli("parameters kp=3.5 gait=walk")
    assert "gait: old trot, new walk\n    kp: old 2, new 3.5\n  since_sim_time_s 0." in out
    assert (tunable.kp.value, tunable.gait.value) == (3.5, "walk")
    rows = cli("parameters").splitlines()
    assert rows[3].split()[:4] == ["name", "value", "unit", "default"]
    assert rows[4].split()[:4] == ["kp", "3.5", "1/s", "2"]
    assert "laps: now 3, next 4\n  since the next reset\n" in cli("parameters laps=4 --from-reset")
    told = cli.json("parameters")["parameters"]
    assert told["rows"][1][told["columns"].index("next")] == 4


def test_a_text_that_looks_like_a_number_stays_a_text(tunable: TunableDriver, cli: Cli) -> None:
    tag = tunable.bridge.parameter("tag", "none")
    cli("run --for 0.1 --then go_on --set tag=7 --set kp=3")
    assert (tag.value, tunable.kp.value) == ("7", 3.0)
    cli("parameters tag=true")
    assert tag.value == "true"
    runs = cli.json("runs --parameter tag=7 --parameter kp=3")["runs"]
    assert [row[runs["columns"].index("run_id")] for row in runs["rows"]] == [1]


def test_a_command_that_no_route_could_do_says_why_each_failed(tmp_path: Path, cli: Cli) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    oldest = 1  # a process that began after a session was seen last is another one
    recorded.robot(supervisor=True, pid=oldest, last_seen_wall_time_s=time.time() - 30)
    said = cli.refused("pause --timeout 0.2")
    assert "pause is not done (cancelled)" in said
    assert "websocket: " in said
    assert "keyboard: not tried: it presses keys in Webots' window, which needs --force\n" in said
    recorded.close()
