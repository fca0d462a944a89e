"""`webots_simulation` with real processes, used as a user's test uses it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.errors import (
    NoDatabaseError,
)
from webots_mcp.standin import StandInError
from webots_mcp.testing import RobotFactory, RobotRecording, SimulationFactory

CONTROLLER = """
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot, throttle_interval=1)
n = 0
while robot.step(16) != -1:
    bridge.publish({"n": n})
    bridge.get_command()
    n += 1
"""


@pytest.fixture
def controller(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        file = tmp_path / "counter.py"
        file.write_text(text)
        return file

    return write


def test_a_process_runs_for_exactly_the_time_that_was_asked_for(
    webots_simulation: SimulationFactory, controller: Callable[[str], Path]
) -> None:
    simulation = webots_simulation(controllers={"rover": controller(CONTROLLER)})
    simulation.run_for(0.8)
    assert simulation.time_s == pytest.approx(0.8)
    counted = simulation.recording.signal("n")
    assert counted.values() == list(range(50))
    assert counted.times_s()[-1] == pytest.approx(0.8)
    simulation.run_for(0.1)
    assert simulation.time_s == pytest.approx(0.912)  # whole steps
    assert simulation.recording.signal("n").last == 56


def test_a_paused_controller_stays_paused_until_somebody_presses_play(
    webots_simulation: SimulationFactory, controller: Callable[[str], Path]
) -> None:
    simulation = webots_simulation(controllers={"rover": controller(CONTROLLER)})
    simulation.run_for(0.8)
    pause = simulation.recording.send("pause")
    simulation.run_for(60)
    assert pause.status == "done"
    stopped_s = simulation.time_s
    assert stopped_s == pytest.approx(0.816, abs=0.3)  # the loop looks for commands every 5 ms
    simulation.run_for(0.8)
    assert simulation.time_s == pytest.approx(stopped_s + 0.8)
    kinds = [event.kind for event in simulation.recording.events()]
    assert kinds == ["start", "pause", "resume"]


def test_a_reset_in_the_middle_does_not_lengthen_the_run(
    webots_simulation: SimulationFactory, controller: Callable[[str], Path]
) -> None:
    simulation = webots_simulation(controllers={"rover": controller(CONTROLLER)})
    simulation.run_for(0.8)
    reset = simulation.recording.send("reset")
    simulation.run_for(0.8)
    assert reset.status == "done"
    before, after = simulation.recording.runs()
    assert before.signal("n").times_s()[-1] <= 0.832
    assert len(before.signal("n").values()) + len(after.signal("n").values()) == 100


def test_a_controller_that_fails_fails_the_test_with_its_traceback(
    webots_simulation: SimulationFactory, controller: Callable[[str], Path]
) -> None:
    file = controller(CONTROLLER.replace("n += 1", "n += 1 if n < 10 else 1 / 0"))
    simulation = webots_simulation(controllers={"rover": file})
    with pytest.raises(
        AssertionError, match=r"'rover' ended with status 1(?s:.*)ZeroDivisionError"
    ):
        simulation.run_for(5)


@pytest.mark.slow
def test_two_simulations_of_a_test_do_not_share_their_recordings(
    webots_simulation: SimulationFactory, controller: Callable[[str], Path], tmp_path: Path
) -> None:
    file = controller(CONTROLLER)
    first = webots_simulation(controllers={"rover": file})
    second = webots_simulation(controllers={"rover": file})
    first.run_for(0.16)
    second.run_for(0.32)
    assert len(first.recording.states()) == 10
    assert len(second.recording.states()) == 20
    found = {path.parent.name for path in tmp_path.rglob(DATABASE_NAME)}
    assert found == {"mcp_data_1", "mcp_data_2"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"controllers": {"rover": "nowhere.py"}},
            "the controller of 'rover' is missing: .*nowhere",
        ),
        ({"controllers": {"rovr": "nowhere.py"}}, "no robot 'rovr'"),
    ],
)
def test_a_controller_that_cannot_be_meant_is_refused_at_once(
    webots_simulation: SimulationFactory, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(StandInError, match=message):
        webots_simulation(**options)


def test_a_simulation_that_never_ran_has_no_recording(webots_simulation: SimulationFactory) -> None:
    simulation = webots_simulation()
    with pytest.raises(NoDatabaseError, match="there is no folder"):
        simulation.recording.states()
    assert simulation.time_s == 0.0


def test_a_robot_without_rights_cannot_pause(
    webots_robot_factory: RobotFactory,
    webots_database: MemoryDatabase,
    webots_recording: RobotRecording,
) -> None:
    robot = webots_robot_factory(supervisor=False)
    with MCPBridge(robot, throttle_interval=1, database=webots_database) as bridge:
        pause = webots_recording.send("pause")
        robot.step(16)
        bridge.get_command()
    assert pause.status == "failed"
    assert pause.error is not None and "pause needs a Supervisor" in pause.error


TUNABLE = """
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot)
kp = bridge.parameter("kp", 2.0)
while robot.step(16) != -1:
    bridge.publish({"kp": kp.value})
    bridge.get_command()
"""


def test_a_simulation_begins_with_the_parameters_of_the_test(
    webots_simulation: SimulationFactory, tmp_path: Path
) -> None:
    controller = tmp_path / "tunable.py"
    controller.write_text(TUNABLE)
    simulation = webots_simulation(controllers={"rover": controller}, parameters={"kp": 5.0})
    simulation.run_for(0.16)
    assert simulation.recording.signal("kp").changes() == [5.0]
    waiting = simulation.recording.set_parameters({"kp": 6.0}, when="reset")
    reset = simulation.recording.send("reset")
    simulation.run_for(0.32)
    assert (waiting.status, reset.status) == ("done", "done")
    before, after = simulation.recording.runs()
    assert (before.parameters(), after.parameters()) == ({"kp": 5.0}, {"kp": 6.0})


SWAYING = """
import math
from pathlib import Path
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot, throttle_interval=1)
count = Path(__file__).with_suffix(".count")
starts = int(count.read_text()) if count.exists() else 0
count.write_text(str(starts + 1))
while robot.step(16) != -1:
    time_s = robot.getTime()
    off = 1e-6 * starts * (time_s > 0.5) + 0.01 * (starts > 1) * (time_s > 0.7)
    bridge.publish({"sway_m": math.sin(time_s) + off, "mode": "sway"})
    bridge.get_command()
"""


@pytest.mark.slow
def test_runs_that_do_not_repeat_fail_with_where_they_part(
    webots_simulation: SimulationFactory, controller: Callable[[str], Path]
) -> None:
    files = {"rover": controller(SWAYING)}
    simulation = webots_simulation(controllers=files)
    recording = simulation.recording
    simulation.run_for(1)
    with pytest.raises(AssertionError, match=r"run 1 is the only one: reset\(\) begins another"):
        recording.assert_repeats()
    simulation.reset()
    simulation.run_for(0.48)
    recording.assert_repeats(until_s=0.48)
    with pytest.raises(AssertionError, match=r"(?s)until 0.480 s;.*  a run ends before 1 s"):
        recording.assert_repeats(until_s=1)
    simulation.run_for(0.52)
    with pytest.raises(
        AssertionError,
        match=r"run 2 does not repeat run 1: equal to the last digit until 0.512 s; then sway_m by "
        r"1e-06 m; sway_m beyond 0 m from 0.512 s on",
    ):
        recording.assert_repeats(until_s=1)
    recording.assert_repeats(until_s=1, within=0.001)
    recording.assert_repeats(until_s=1, signals=["mode"])
    simulation.reset()
    simulation.run_for(1)
    with pytest.raises(AssertionError, match=r"run 3 does not .*beyond 0.001 m from 0.704 s on"):
        recording.assert_repeats(until_s=1, within=0.001)
