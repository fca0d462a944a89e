"""Branches from a moment of a live run, with real simulators and controllers."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Generator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from mcp import Client

from tests.server.conftest import ask, fail
from tests.waiting import until, wait_for
from webots_mcp.cli import main
from webots_mcp.server.mcp_server import create_server
from webots_mcp.standin import Simulation
from webots_mcp.standin.in_process import DEFAULT_WORLD

pytestmark = pytest.mark.slow

# It steers by a sequence that no sensor shows, so that only its own variables tell how it goes on.
CONTROLLER = """
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot, throttle_interval=3)
speed = bridge.parameter("speed", 3.0, low=0.0, high=10.0)
motors = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
for motor in motors:
    motor.setPosition(float("inf"))
rounds, turn = 0, 0.3
RESTORE
while True:
    turn = 3.7 * turn * (1 - turn)
    motors[0].setVelocity(speed.value)
    motors[1].setVelocity(speed.value * turn)
    if robot.step(16) == -1:
        break
    rounds += 1
    x, y, _ = robot.getSelf().getPosition()
    state = {"rounds": rounds, "turn": turn, "x": x, "y": y, "clock_s": robot.getTime()}
    bridge.publish(state)
    bridge.get_command()
"""
RESTORE = """
if bridge.restored is not None:
    rounds, turn = bridge.restored.state["rounds"], bridge.restored.state["turn"]
"""
SCORE = ["--for", "1", "--score", "max(x) - min(x)", "--stand-in"]


class Project:
    """A Webots project whose rover records into its folder `data`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.data = folder / "data"
        self.world = folder / "worlds" / "arena.wbt"
        self.controller = folder / "controllers" / "rover" / "rover.py"
        self.world.parent.mkdir()
        self.controller.parent.mkdir(parents=True)
        shutil.copy(DEFAULT_WORLD, self.world)
        self.controller.write_text(CONTROLLER.replace("RESTORE", RESTORE))

    @contextmanager
    def simulated(self, mode: str = "realtime") -> Generator[Simulation]:
        """Run it until its rover has driven for two seconds, and then in a mode."""
        environment = {"WEBOTS_MCP_DATA_DIR": str(self.data)}
        with Simulation(self.world, mode="fast", environment=environment) as simulation:
            simulation.wait_for(lambda: simulation.time_s > 2.0, 60.0)
            if mode == "realtime":
                simulation.resume()
            wait_for(lambda: self.data.exists() and self.rows("SELECT 1 FROM state"))
            yield simulation

    def rows(self, sql: str) -> list[Any]:
        with closing(sqlite3.connect(self.data / "webots.db")) as connection:
            return connection.execute(sql).fetchall()

    def options(self, *words: str) -> list[str]:
        return ["branch", *words, "--data-dir", str(self.data)]

    def branch(self, capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
        capsys.readouterr()
        assert main([*self.options(*words), *SCORE, "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    def refused(self, capsys: pytest.CaptureFixture[str], *words: str) -> str:
        """What a command is refused with; nothing is left behind."""
        capsys.readouterr()
        assert main(self.options(*words)) == 2
        assert self.saved() == []
        return capsys.readouterr().err

    def saved(self) -> list[Path]:
        """What a save leaves in the folder of the world, and in that of the trials."""
        worlds = [each for each in self.world.parent.iterdir() if each != self.world]
        return [*worlds, *self.data.glob("trials/*")]


@pytest.fixture
def project(tmp_path: Path) -> Project:
    return Project(tmp_path)


def scores(answer: dict[str, Any]) -> dict[float, float]:
    """Of each speed."""
    columns = answer["ranked"]["columns"]
    rows = [dict(zip(columns, row, strict=True)) for row in answer["ranked"]["rows"]]
    return {row["speed"]: row["score"] for row in rows}


@pytest.mark.slow
def test_an_unchanged_branch_equals_what_the_run_itself_did_to_the_last_digit(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    before = project.world.read_bytes()
    with project.simulated("fast") as simulation:
        answer = project.branch(capsys, "speed=1.0,9.0")
        went_on_s = simulation.time_s
        simulation.wait_for(lambda: simulation.time_s > went_on_s, 60.0)  # it was only held

    assert answer["notes"][0].startswith(
        "branch 0 (unchanged: speed 3.0) equals what run 1 itself did to the last digit in the 2"
    )
    assert answer["notes"][0].endswith("their scores are equal")
    assert not any("began anew" in note for note in answer["notes"])
    assert set(scores(answer)) == {1.0, 3.0, 9.0}
    assert (project.world.read_bytes(), project.saved()) == (before, [])
    (at_s,) = project.rows("SELECT json_extract(plan, '$.moment.sim_time_s') FROM trial_set")[0]
    (paused_s,) = project.rows("SELECT sim_time_s FROM event WHERE kind = 'pause'")[0]
    assert at_s == paused_s
    worlds = project.rows("SELECT DISTINCT world FROM run")
    assert worlds == [(str(project.world),)], "branches are comparable with their run"
    assert project.rows("SELECT run_id, kind FROM event WHERE kind = 'restored'") == [
        (2, "restored"), (3, "restored"), (4, "restored"),
    ]  # fmt: skip
    assert main(["runs", "--data-dir", str(project.data), "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["runs"]
    found = [dict(zip(listed["columns"], row, strict=True)) for row in listed["rows"]]
    assert [each["branched_from"] for each in found] == [f"run 1 at {at_s:.3f} s"] * 3 + [None]
    assert found[0]["label"] == f"branch of run 1 at {at_s:.3f} s: speed 9.0"


@pytest.mark.slow
def test_where_the_run_stays_paused_a_second_unchanged_branch_is_the_measure(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    with project.simulated() as simulation:
        assert main(["pause", "--data-dir", str(project.data)]) == 0
        held_s = simulation.time_s
        answer = project.branch(capsys, "speed=9.0", "--jobs", "2")
        assert simulation.time_s == held_s, "it was paused before"

    assert answer["trials"] == 3
    first, second, *_ = answer["notes"]
    assert "equals a second unchanged branch (run " in first
    assert "did not go on undisturbed" in second
    assert "not what the saved world and the controller lost" in second


@pytest.mark.slow
def test_a_controller_that_restores_nothing_parts_and_small_differences_show_nothing(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    project.controller.write_text(CONTROLLER.replace("RESTORE", ""))
    with project.simulated():
        answer = project.branch(capsys, "speed=3.0001")

    first = answer["notes"][0]
    assert "parted from what run 1 itself did after 0.0" in first
    assert "rounds by " in first or "turn by " in first
    assert "a smaller difference of two branches shows nothing: speed 3.0001 may be" in first
    assert any("did not read bridge.restored" in note for note in answer["notes"])


@pytest.mark.slow
def test_a_run_that_was_steered_afterwards_is_no_measure(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    data = ["--data-dir", str(project.data)]
    with project.simulated() as simulation:
        assert main(["pause", *data]) == 0
        process = subprocess.Popen(
            [sys.executable, "-m", "webots_mcp", *project.options("speed=9.0"), *SCORE, "--json"],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        wait_for(lambda: project.rows("SELECT 1 FROM trial"))
        held_s = simulation.time_s
        assert main(["parameters", "speed=5.0", *data]) == main(["fast", *data]) == 0
        answer = json.loads(process.communicate(timeout=120)[0])
        assert simulation.time_s > held_s + 1.0

    assert "equals a second unchanged branch" in answer["notes"][0]


@pytest.mark.slow
def test_ctrl_c_ends_the_branches_and_removes_the_saved_world(project: Project) -> None:
    with project.simulated():
        words = project.options("speed=9.0", "--until", "x > 1e6", "--score", "max(x)")
        line = [sys.executable, "-m", "webots_mcp", *words, "--stand-in"]
        process = subprocess.Popen(line, stderr=subprocess.PIPE)
        wait_for(lambda: project.rows("SELECT 1 FROM trial WHERE status = 'running'"))
        assert len(project.saved()) > 1
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)

    assert project.saved() == []
    assert project.rows("SELECT stop_reason FROM trial_set") == [("it was cancelled",)]


NON_FINITE = """
if bridge.restored is not None:
    assert bridge.restored.state["distance_m"] == [float("inf"), 1.0]
    rounds, turn = bridge.restored.state["rounds"], bridge.restored.state["turn"]
"""


@pytest.mark.slow
def test_numbers_that_are_not_finite_come_back(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    text = CONTROLLER.replace("RESTORE", NON_FINITE)
    text = text.replace('"x": x,', '"x": x, "distance_m": [float("inf"), 1.0],')
    project.controller.write_text(text)
    with project.simulated():
        answer = project.branch(capsys, "speed=1.0")
    assert set(scores(answer)) == {1.0, 3.0}, answer


@pytest.mark.slow
def test_a_robot_whose_own_name_ends_with_a_number_is_continued(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    world = project.world.read_text("utf-8")
    assert 'name "rover"' in world
    project.world.write_text(world.replace('name "rover"', 'name "rôver #2"'), "utf-8")
    with project.simulated():
        answer = project.branch(capsys, "speed=1.0")
    assert set(scores(answer)) == {1.0, 3.0}
    assert "equals what run 1 itself did to the last digit" in answer["notes"][0]
    project.world.write_text(world.replace('name "rover"', 'name "rover#2"'), "utf-8")
    with project.simulated():
        answer = project.branch(capsys, "speed=1.0", "--robot", "rover#2")
    assert set(scores(answer)) == {1.0, 3.0}, answer


def test_a_controller_that_asks_for_no_command_is_told_what_to_add(
    project: Project, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webots_mcp.steering.branches._COMMAND_S", 1.0)
    text = CONTROLLER.replace("RESTORE", "").replace("    bridge.get_command()\n", "")
    project.controller.write_text(text)
    with project.simulated():
        refused = project.refused(capsys, "speed=2.0", *SCORE)
    assert "never calls bridge.get_command(): add that line to its loop" in refused


@pytest.mark.slow
def test_a_name_that_is_given_twice_has_all_its_values(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    with project.simulated():
        answer = project.branch(capsys, "speed=1.0", "speed=9.0", "--jobs", "3")
    assert set(scores(answer)) == {1.0, 3.0, 9.0}


def _interrupted_when(project: Project, sql: str, number: signal.Signals) -> None:
    """Begin branches, and end the command at once when there is such a row."""
    words = project.options("speed=9.0", "--until", "x > 1e6", "--score", "max(x)")
    line = [sys.executable, "-m", "webots_mcp", *words, "--stand-in"]
    process = subprocess.Popen(line, stderr=subprocess.DEVNULL)
    try:
        wait_for(lambda: project.rows(sql))
        process.send_signal(number)
        process.wait(60)
    finally:
        process.kill()
        process.wait(60)


@pytest.mark.slow
def test_an_interrupt_while_the_world_is_saved_resumes_the_simulation_in_its_mode(
    project: Project,
) -> None:
    slow = "import time\n" + CONTROLLER.replace("RESTORE", "").replace(
        "robot = Supervisor()",
        "class Slow(Supervisor):\n"
        "    def getRoot(self):\n"
        "        if bridge.stats().rows_written > 9:\n"
        "            time.sleep(1.0)  # as long as a large world takes\n"
        "        return super().getRoot()\n"
        "robot = Slow()",
    )
    project.controller.write_text(slow)
    saving = "SELECT 1 FROM command WHERE action = 'save_world' AND status = 'claimed'"
    with project.simulated("fast") as simulation:
        _interrupted_when(project, saving, signal.SIGTERM)
        held_s = simulation.time_s
        simulation.wait_for(lambda: simulation.time_s > held_s, 60.0)
        assert project.saved() == []
        resuming = "SELECT action FROM command WHERE action IN ('resume', 'fast')"
        assert project.rows(resuming) == [("fast",)]


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
@pytest.mark.slow
def test_the_next_branches_remove_what_a_killed_command_has_left(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    with project.simulated():
        running = "SELECT 1 FROM trial WHERE status = 'running'"
        _interrupted_when(project, running, signal.SIGKILL)
        assert len(project.saved()) > 1
        project.branch(capsys, "speed=9.0")
    assert project.saved() == []
    reasons = project.rows("SELECT stop_reason FROM trial_set ORDER BY id")
    assert reasons == [("its process ended, and its moment is over",), (None,)]


@pytest.mark.slow
def test_a_simulation_that_could_not_be_resumed_is_never_paused(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    (project.folder / "webots-mcp.toml").write_text('[allow]\nactions = ["*", "!resume"]\n')
    with project.simulated():
        refused = project.refused(capsys, "speed=9.0", *SCORE)
        assert "resume" in refused
        assert project.rows("SELECT action FROM command WHERE action = 'pause'") == []


def test_what_cannot_branch_is_refused_before_anything_is_saved(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    with project.simulated():
        assert "speed=2,4" in project.refused(capsys, "speed", *SCORE)
        assert "Give NAME=V1,V2" in project.refused(capsys, *SCORE)
        assert "sped" in project.refused(capsys, "sped=2.0", *SCORE)
        assert "change nothing" in project.refused(capsys, "speed=3.0", *SCORE)
        without_end = project.refused(capsys, "speed=2.0", "--score", "max(x)", "--stand-in")
        assert "Give for_s, until or both" in without_end or "--for" in without_end
        line = [sys.executable, "-m", "webots_mcp", "run", "--until", "x > 1e6"]
        running = subprocess.Popen(
            [*line, "--data-dir", str(project.data)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        wait_for(lambda: project.rows("SELECT 1 FROM command WHERE status = 'claimed'"))
        assert "(run) of robot 'rover' is under way" in project.refused(capsys, "speed=2", *SCORE)
        running.send_signal(signal.SIGINT)
        running.wait(60)
        unknown = project.refused(capsys, "speed=2.0", "--for", "1", "--score", "max(z)")
        assert "'z'" in unknown
        for word in ("--until", "--prune"):
            unknown = project.refused(capsys, "speed=2.0", *SCORE, word, "nosuch > 1")
            assert "nosuch" in unknown
        paused = project.rows("SELECT count(*) FROM trial_set")
    assert paused == [(0,)]


def test_a_robot_that_is_no_supervisor_is_told_what_to_change(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    world = project.world.read_text()
    assert "supervisor TRUE" in world
    project.world.write_text(world.replace("supervisor TRUE", "supervisor FALSE"))
    driving = CONTROLLER.replace("RESTORE", "").replace("robot.getSelf().getPosition()", "0, 0, 0")
    project.controller.write_text(driving)
    with project.simulated():
        refused = project.refused(capsys, "speed=2.0", *SCORE)

    assert "save_world needs a Supervisor" in refused
    assert "set the field 'supervisor' of its Robot node to TRUE" in refused


@pytest.mark.slow
@pytest.mark.anyio
async def test_an_assistant_waits_for_branches_cancels_them_and_begins_new_ones(
    project: Project,
) -> None:
    asked = {"parameters": {"speed": [9.0]}, "score": "max(x)", "stand_in": True}
    data = Path(os.path.relpath(project.data))  # as `serve --data-dir mcp_data` gives it
    with project.simulated():
        async with Client(create_server(data / "webots.db", data)) as client:
            begun = await ask(client, "webots_branch_run", **asked, for_s=0.5, timeout_wall_s=0.1)
            assert (begun["state"], begun["trials"]) == ("under way", 2)
            done = await until(
                lambda: ask(client, "webots_run_trials", trial_set=begun["trial_set"]),
                lambda found: found["state"] == "done",
            )
            assert done["notes"][0].startswith("branch 0 (unchanged: speed 3.0) equals")
            endless = await ask(
                client, "webots_branch_run", **asked, until="x > 1e6", timeout_wall_s=0.1
            )
            number = endless["trial_set"]
            await until(lambda: project.rows("SELECT 1 FROM trial WHERE status = 'running'"))
            ended = await ask(client, "webots_run_trials", trial_set=number, cancel=True)
            assert ended["state"] == "stopped: it was cancelled"
            assert "begin new branches" in ended["hint"]
            refused = await fail(client, "webots_run_trials", trial_set=number)
            assert "branched off a moment that is over" in refused
            await until(lambda: project.saved() == [])
