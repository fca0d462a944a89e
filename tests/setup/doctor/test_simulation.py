"""Why time stands still: told apart by what the machine shows besides."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rows import Recorded, RecordedRobot
from tests.setup.doctor.conftest import Look, found
from tests.simulator.conftest import (
    StartWebots,
    free_port,
    start_webots,
    wait_for_line,
    webots,
    world,
    write_project,
)
from tests.waiting import wait_for
from webots_mcp.contract import ENDED_BY, SEE_STEPS, UNMOVED, UNSEEN, host_name
from webots_mcp.database.processes import process_identity
from webots_mcp.setup.doctor import Diagnosis

WAITS = "import sys; print('ready', flush=True); sys.stdin.read()"
COMPUTES = "print('ready', flush=True)\nwhile True: pass"
SPINS = """
from controller import Robot

robot = Robot()
robot.step(16)
robot.step(16)
while True:
    pass
"""
__all__ = ["start_webots", "webots", "world"]  # fixtures

Start = Callable[[str], "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Start]:
    """Start a process that takes a controller's place."""
    running: list[subprocess.Popen[str]] = []

    def run(program: str) -> subprocess.Popen[str]:
        line = [sys.executable, "-c", program]
        pipe = subprocess.PIPE
        running.append(process := subprocess.Popen(line, stdin=pipe, stdout=pipe, text=True))
        wait_for_line(process, "ready")
        return process

    yield run
    for process in running:
        process.kill()
        process.communicate()


def silent(
    recorded: Recorded, process: subprocess.Popen[str], name: str = "rover", **session: object
) -> RecordedRobot:
    """A robot whose controller lives and was not heard of for a minute."""
    identity = process_identity(process.pid)
    began_s = time.time() - 60
    return recorded.robot(name, now=began_s, pid=process.pid, process=identity, **session)


def computes(finding: Diagnosis) -> bool:
    return "another controller computes" in finding.seen


@pytest.mark.parametrize(
    ("session", "verdict", "seen", "fix"),
    [
        ({}, "ok", "rover: running", None),
        ({"end_reason": "finished", "ended_wall_time_s": time.time()}, "ok", "finished", None),
        ({"pause_state": "paused"}, "warning", "paused", "webots-mcp resume --robot rover"),
    ],
)
def test_what_the_recording_shows_is_told(
    look: Look, recorded: Recorded, session: dict[str, Any], verdict: str, seen: str, fix: str
) -> None:
    recorded.robot(**session)
    found = look("Simulation")
    assert (found.verdict, found.fix, seen in found.seen) == (verdict, fix, True), found


def test_where_nobody_computes_it_was_most_likely_paused_by_hand(
    look: Look, recorded: Recorded, start: Start
) -> None:
    silent(recorded, start(WAITS))
    found = look("Simulation")
    assert found.verdict == "wrong"
    assert "paused by hand" in found.seen
    assert found.fix == "press play in Webots"


def test_a_robot_that_crashed_is_named_also_where_another_ran_on(
    look: Look, recorded: Recorded
) -> None:
    now_s = time.time()
    ended = {"end_reason": "crashed", "ended_wall_time_s": now_s - 20}
    crashed = recorded.robot("rover", now=now_s - 20, **ended)
    why = f"{ENDED_BY} ValueError: boom (rover.py, line 12)"
    crashed.log(1.0, why, "error")
    recorded.robot("beside", now=now_s, end_reason="finished", ended_wall_time_s=now_s)
    found = look("Simulation")
    assert found.verdict == "wrong"
    assert "rover.py, line 12" in found.seen


def test_it_is_said_where_only_controllers_that_record_were_looked_at(
    look: Look, recorded: Recorded, start: Start
) -> None:
    """The simulator is not seen: nobody knows which other controllers it has."""
    silent(recorded, start(WAITS))
    seen = look("Simulation").seen
    assert "Others of this simulation were not looked at" in seen
    assert "no controller computes" not in seen


@pytest.mark.slow
@pytest.mark.parametrize(
    ("neighbour", "said"),
    [
        (COMPUTES, "another controller computes and holds the step up: beta: "),
        (WAITS, "no controller computes, but beta: "),
        (None, "no controller computes and none is known to be missing"),
    ],
)
def test_controllers_that_record_nothing_are_found_by_their_simulator(
    look: Look,
    recorded: Recorded,
    start: Start,
    monkeypatch: pytest.MonkeyPatch,
    neighbour: str | None,
    said: str,
) -> None:
    """Also where the simulator is no Webots: extern controllers, and those of the stand-in."""
    monkeypatch.setenv("WEBOTS_INSTANCE_PATH", "/tmp/webots/ada/4711/")
    instance = f"{host_name()}:4711"
    monkeypatch.setenv("WEBOTS_ROBOT_NAME", "alpha")
    silent(recorded, start(WAITS), instance=instance)
    monkeypatch.setenv("WEBOTS_ROBOT_NAME", "beta")
    process = None if neighbour is None else start(neighbour)
    finding = look("Simulation")
    assert said in finding.seen
    assert process is None or f"(process {process.pid})" in finding.seen
    recorded.connection.execute("UPDATE session SET instance = ?", (f"{host_name()}:4712",))
    assert "were not looked at" in look("Simulation").seen


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--stream", "--mode=realtime")])
def test_that_webots_obeys_by_its_websocket_is_named_where_it_does(
    look: Look,
    recorded: Recorded,
    start: Start,
    start_webots: StartWebots,
    world: Path,
    options: tuple[str, ...],
) -> None:
    port = free_port()
    wait_for_line(start_webots("--stdout", *options, f"--port={port}", world), "ready")
    silent(recorded, start(WAITS), instance=f"{host_name()}:{port}")
    recorded.connection.execute("UPDATE run SET world = '/nowhere.wbt'")
    obeys = "; or webots_simulation_control('resume'): this Webots obeys it by its WebSocket"
    found = wait_for(lambda: look("Simulation"), lambda it: not computes(it))  # once it has started
    assert found.fix is not None
    assert found.fix.startswith("press play in Webots" + obeys * bool(options))
    assert ("WebSocket" in found.fix) == bool(options)
    running = look("Running Webots").seen
    assert f"port {port} (process " in running
    assert ("arena.wbt, mode realtime) obeys orders" in running) == bool(options)


def test_a_controller_that_computes_holds_itself_up(
    look: Look, recorded: Recorded, start: Start
) -> None:
    silent(recorded, start(COMPUTES))
    assert "its own process computes" in look("Simulation").seen


def test_another_controller_that_computes_is_named(
    look: Look, recorded: Recorded, start: Start
) -> None:
    busy = start(COMPUTES)
    silent(recorded, start(WAITS))
    silent(recorded, busy, "referee")
    seen = look("Simulation").seen
    assert "another controller computes and holds the step up: python" in seen
    assert f"(process {busy.pid})" in seen


def test_an_extern_controller_that_nobody_has_started_is_missed(
    look: Look, recorded: Recorded, start: Start, tmp_path: Path
) -> None:
    world = tmp_path / "arena.wbt"
    robots = 'Robot {\n  controller "<extern>"\n}\n'
    world.write_text(f'#VRML_SIM R2025a utf8\n{robots * 2}Robot {{\n  controller "rover"\n}}\n')
    silent(recorded, start(WAITS), extern=1)
    recorded.connection.execute("UPDATE run SET world = ?", (str(world),))
    found = look("Simulation")
    assert "2 robots of arena.wbt have the controller <extern> and 1 record here" in found.seen
    assert "webots-controller" in (found.fix or "")


def test_a_controller_on_another_machine_is_told_of_as_far_as_it_is_known(
    look: Look, recorded: Recorded
) -> None:
    recorded.robot(now=time.time() - 5, host="another-machine", moved_wall_time_s=None)
    assert look("Simulation").verdict == "wrong"


def test_an_exception_that_ended_a_controller_is_named(look: Look, recorded: Recorded) -> None:
    robot = recorded.robot()
    robot.log(1.0, f"{ENDED_BY} ValueError: no such wheel", "error")
    robot.beat(ended_wall_time_s=robot.now, end_reason="crashed")
    found = look("Simulation")
    assert found.verdict == "wrong"
    assert "ValueError: no such wheel" in found.seen
    assert "webots-mcp logs" in (found.fix or "")


def test_a_controller_whose_steps_no_bridge_saw_is_told_of_while_it_lives_and_when_it_has_finished(
    look: Look, recorded: Recorded
) -> None:
    began_s = time.time() - 20
    robot = recorded.robot(
        now=began_s,
        moved_wall_time_s=None,
        last_poll_wall_time_s=None,
        process=process_identity(os.getpid()),  # which may be younger than 20 s
    )
    lives = look("Simulation")
    robot.beat(
        ended_wall_time_s=robot.now,
        end_reason="finished",
        last_error=f"{UNSEEN}; 9.6 s so far",
    )
    ended = look("Simulation")

    assert lives.verdict == "wrong" and UNMOVED in lives.seen
    assert ended.verdict == "warning" and UNSEEN in ended.seen
    assert all(
        SEE_STEPS in found.seen and "help troubleshooting simulation" in (found.fix or "")
        for found in (lives, ended)
    )


@pytest.mark.slow
def test_a_controller_that_records_nothing_and_hangs_is_found_as_a_child_of_its_webots(
    start_webots: StartWebots, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEBOTS_MCP_DATA_DIR", str(tmp_path / "data"))
    world = write_project(tmp_path / "project")
    world.write_text(
        world.read_text("utf-8") + 'Robot {\n  name "spinner"\n  controller "spinner"\n}\n', "utf-8"
    )
    folder = world.parents[1] / "controllers" / "spinner"
    folder.mkdir()
    (folder / "spinner.py").write_text(SPINS, "utf-8")
    port = free_port()
    wait_for_line(start_webots("--stdout", f"--port={port}", world), "ready")
    file = tmp_path / "data" / "webots.db"
    told = wait_for(lambda: found(file, "Simulation"), computes)
    assert "spinner.py (process " in told.seen
    assert "reload the world" in (told.fix or "")
    running = found(file, "Running Webots")
    assert f"port {port}" in running.seen
    assert "was started without --stream and does not obey" in running.seen


@pytest.mark.slow
def test_many_that_stand_in_one_simulation_are_told_once(
    look: Look, recorded: Recorded, start: Start
) -> None:
    process = start(WAITS)
    for n in range(40):
        silent(recorded, process, f"robot{n}")
    assert look("Simulation").seen.count("paused by hand") == 1
