"""What the fixtures offer, used as a user's test uses them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.errors import (
    InvalidInputError,
    NoDatabaseError,
    NothingRecordedError,
    UnknownRobotError,
    UnknownSignalError,
)
from webots_mcp.standin import InProcessSupervisor, StandInError, WouldBlockError
from webots_mcp.testing import Recording, RobotFactory, SimulationFactory

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
def story(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: Recording
) -> Recording:
    """Ten rows, 0.1 s apart: front sinks from 0.9 to 0.0 m, the mode changes twice."""
    modes = ["cruise"] * 4 + ["turn"] * 3 + ["cruise"] * 3
    for step, mode in enumerate(modes):
        webots_robot.step(96)
        front_m = float("nan") if step == 2 else round(0.9 - 0.1 * step, 6)
        webots_bridge.publish({"mode": mode, "sensors": {"front_m": front_m}, "blind": step == 2})
        webots_bridge.log(f"step {step}", level="warning" if step > 7 else "info")
    return webots_recording


def test_a_signal_gives_all_its_values_and_their_times(story: Recording) -> None:
    front = story.signal("sensors.front_m")
    assert front.values() == pytest.approx([0.9, 0.8, None, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.0])
    assert front.times_s() == pytest.approx([0.096 * (step + 1) for step in range(10)])
    assert (front.first, front.last, front.min(), front.max()) == (0.9, 0.0, 0.0, 0.9)
    assert front.at(0.2) == 0.8
    assert front.at(0.3) is None


def test_a_condition_is_asked_of_the_run_and_of_the_running_robot(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: Recording
) -> None:
    webots_bridge.breakpoint("front_m < 0.5 for 0.2", action="log")
    for step in range(10):
        webots_robot.step(96)
        webots_bridge.publish({"front_m": 0.9 - 0.1 * step})

    (held,) = webots_recording.held("front_m < 0.5 for 0.2")
    (hit,) = webots_recording.events("breakpoint")
    assert held.start_s == hit.sim_time_s == pytest.approx(9 * 0.096)
    assert webots_recording.held("front_m > 2") == []
    with pytest.raises(UnknownSignalError, match="there is front_m"):
        webots_recording.held("fornt_m > 2")


def test_changes_leave_repetitions_out(story: Recording) -> None:
    mode = story.signal("mode")
    assert mode.changes() == ["cruise", "turn", "cruise"]
    assert mode.first_time_s("turn") == pytest.approx(5 * 0.096)
    assert mode.duration_s("turn") == pytest.approx(3 * 0.096)
    assert story.signal("blind").changes() == [False, True, False]


def test_a_broken_limit_says_when_how_often_how_far_and_where(story: Recording) -> None:
    front = story.signal("sensors.front_m")
    with pytest.raises(AssertionError) as failure:
        front.assert_never_below(0.25)
    assert str(failure.value).splitlines() == [
        "sensors.front_m fell below 0.25 in 3 of 10 rows of run 1 of robot 'rover'",
        "  first at 0.768 s: 0.2",
        "  furthest at 0.96 s: 0",
        '  the state at 0.768 s: {"mode":"cruise","sensors":{"front_m":0.2},"blind":false}',
    ]
    with pytest.raises(AssertionError, match=r"rose above 0.85 in 1 of 10 rows"):
        front.assert_never_above(0.85)
    with pytest.raises(AssertionError, match="mode was 'turn' in 3 of 10 rows"):
        story.signal("mode").assert_never("turn")


def test_a_kept_limit_is_silent(story: Recording) -> None:
    front = story.signal("sensors.front_m")
    front.assert_never_below(0.0)
    front.assert_never_above(0.9)
    story.signal("mode").assert_never("stuck")


def test_a_limit_on_a_signal_without_numbers_proves_nothing_and_fails(story: Recording) -> None:
    with pytest.raises(AssertionError, match=r"mode holds no number in the 10 rows .* nothing sho"):
        story.signal("mode").assert_never_below(1)
    with pytest.raises(NothingRecordedError, match="mode holds no number"):
        story.signal("mode").min()


def test_a_value_that_never_came_is_told_with_those_that_did(story: Recording) -> None:
    with pytest.raises(NothingRecordedError, match=r"never 'back_up' in the 10 .*'cruise', 'turn'"):
        story.signal("mode").first_time_s("back_up")
    with pytest.raises(
        NothingRecordedError, match=r"has no row up to 0 s: the first is at 0.096 s"
    ):
        story.signal("mode").at(0)


def test_an_unknown_signal_is_told_with_near_names(story: Recording) -> None:
    with pytest.raises(UnknownSignalError, match=r"no signal 'sensors.frnt'.* sensors.front_m"):
        story.signal("sensors.frnt")


def test_a_signal_seen_only_at_the_beginning_is_known(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: Recording
) -> None:
    for step in range(300):
        webots_robot.step(16)
        webots_bridge.publish({"booting": True} if step == 0 else {"n": step})
    assert webots_recording.signal("booting").values() == [True] + [None] * 299


def test_a_name_that_means_several_signals_is_refused_by_signal_and_taken_by_signals(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: Recording
) -> None:
    webots_robot.step(16)
    webots_bridge.publish({"pose": [1.0, 2.0]})
    with pytest.raises(InvalidInputError, match=r"'pose' means 2 signals: pose.0, pose.1"):
        webots_recording.signal("pose")
    assert [signal.last for signal in webots_recording.signals("pose.*")] == [1.0, 2.0]


def test_states_come_as_they_were_published(story: Recording) -> None:
    states = story.states()
    assert len(states) == 10
    assert states[2] == {"mode": "cruise", "sensors": {"front_m": "nan"}, "blind": True}


def test_events_and_logs_come_in_order_and_by_kind(story: Recording) -> None:
    assert [event.kind for event in story.events()] == ["start"] + ["change"] * 4
    changed = [event.details()["to"] for event in story.events("change") if event.name == "mode"]
    assert changed == ["turn", "cruise"]
    assert [line.message for line in story.logs("warning")] == ["step 8", "step 9"]
    assert [line.message for line in story.logs(text="STEP 3")] == ["step 3"]
    with pytest.raises(InvalidInputError, match="no log level 'loud'; there is debug, info"):
        story.logs("loud")


def test_what_the_values_show_can_be_asked_for(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: Recording
) -> None:
    for step in range(120):
        webots_robot.step(96)
        webots_bridge.publish({"pose": [min(step, 60) * 0.1, 0.0], "mode": "cruise"})
    (stuck,) = webots_recording.find_events("stuck", stuck_s=4.0)
    assert (stuck.start_s, stuck.end_s) == pytest.approx((61 * 0.096, 120 * 0.096), abs=0.1)
    assert stuck.ongoing
    assert webots_recording.find_events("jump", "silent") == []
    with pytest.raises(InvalidInputError, match="unknown kind 'stucked'"):
        webots_recording.find_events("stucked")


def test_what_could_not_be_looked_for_is_not_told_to_be_absent(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: Recording
) -> None:
    for step in range(20):
        webots_robot.step(96)
        webots_bridge.publish({"mode": "cruise", "step": step})
    with pytest.raises(NothingRecordedError, match="stuck could not be looked for: no position"):
        webots_recording.find_events("stuck")


def test_a_command_is_followed_from_sending_to_its_answer(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: Recording
) -> None:
    webots_bridge.register_command("aim", lambda command: command["angle"] * 2)
    sent = webots_recording.send("aim", angle=1.5)
    assert (sent.status, sent.is_final, sent.result) == ("pending", False, None)
    webots_robot.step(16)
    webots_bridge.get_command()
    assert (sent.action, sent.params) == ("aim", {"angle": 1.5})
    assert (sent.status, sent.is_final, sent.result, sent.error) == ("done", True, 3.0, None)
    assert [command.id for command in webots_recording.commands("aim")] == [sent.id]
    assert webots_recording.commands("pause") == []
    assert repr(sent) == '<command 1: aim {"angle": 1.5}, done, 3.0>'


def test_each_run_is_a_recording_of_its_own(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: Recording
) -> None:
    for step in range(5):
        webots_robot.step(32)
        webots_bridge.publish({"n": step})
    webots_robot.simulationReset()
    webots_robot.step(32)
    webots_bridge.publish({"n": 100})
    first, second = webots_recording.runs()
    assert first.signal("n").values() == [0, 1, 2, 3, 4]
    assert second.signal("n").values() == webots_recording.signal("n").values() == [100]


def test_two_robots_share_a_world_and_a_database(
    webots_robot_factory: RobotFactory, webots_database: MemoryDatabase, webots_recording: Recording
) -> None:
    world = Path(__file__).parents[2] / "examples" / "worlds" / "arena_referee.wbt"
    rover = webots_robot_factory("rover", world=world, supervisor=False)
    referee = webots_robot_factory("referee", world=rover.simulation)
    assert not isinstance(rover, InProcessSupervisor)
    for robot in (rover, referee):
        bridge = MCPBridge(robot, throttle_interval=1, database=webots_database)
        robot.step(16)
        bridge.publish({"who": robot.getName()})
        bridge.close()
    assert webots_recording.robot("rover").signal("who").last == "rover"
    assert webots_recording.robot("referee").signal("who").last == "referee"
    with pytest.raises(UnknownRobotError, match="did you mean 'rover'"):
        webots_recording.robot("rovr").signal("who")


def test_a_whole_loop_ends_after_the_time_that_it_was_given(
    webots_robot_factory: RobotFactory, webots_database: MemoryDatabase, webots_recording: Recording
) -> None:
    robot = webots_robot_factory(duration_s=1.0)
    with MCPBridge(robot, throttle_interval=1, database=webots_database) as bridge:
        while robot.step(100) != -1:
            bridge.publish({"time_s": robot.getTime()})
            bridge.get_command()
    assert webots_recording.signal("time_s").last == pytest.approx(1.008)


def test_a_pause_that_nobody_can_end_is_an_error_and_no_endless_wait(
    webots_robot: InProcessSupervisor,
    webots_bridge: MCPBridge,
    webots_recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("webots_mcp.testing.rehearsal.HOLD_LIMIT_S", 0.05)
    webots_recording.send("pause")
    webots_robot.step(16)
    with pytest.raises(WouldBlockError, match="send 'resume' before"):
        webots_bridge.get_command()


def test_what_a_bridge_cannot_record_is_raised(webots_bridge: MCPBridge) -> None:
    with pytest.raises(TypeError, match="publish"):
        webots_bridge.publish([1, 2, 3])  # type: ignore[arg-type]


def test_a_recording_without_a_bridge_says_what_to_do(webots_recording: Recording) -> None:
    with pytest.raises(NothingRecordedError, match="make an MCPBridge on it"):
        webots_recording.signal("mode")
    with pytest.raises(NothingRecordedError, match="make an MCPBridge on it"):
        webots_recording.send("pause")


def test_a_bridge_that_published_nothing_is_told_as_such(
    webots_bridge: MCPBridge, webots_recording: Recording
) -> None:
    with pytest.raises(UnknownSignalError, match="no state row with values"):
        webots_recording.signal("mode")


# Real processes -----------------------------------------------------------------------------------


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
    assert simulation.time_s == pytest.approx(0.816)
    simulation.run_for(0.8)
    assert simulation.time_s == pytest.approx(1.616)
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
    webots_recording: Recording,
) -> None:
    robot = webots_robot_factory(supervisor=False)
    with MCPBridge(robot, throttle_interval=1, database=webots_database) as bridge:
        pause = webots_recording.send("pause")
        robot.step(16)
        bridge.get_command()
    assert pause.status == "failed"
    assert pause.error is not None and "pause needs a Supervisor" in pause.error


@pytest.mark.webots_parameters(kp=3.0)
def test_parameters_begin_as_the_marker_says_and_are_set_in_between(
    webots_bridge: MCPBridge, webots_recording: Recording
) -> None:
    kp = webots_bridge.parameter("kp", 2.0, high=10)
    assert webots_recording.parameters() == {"kp": 3.0}
    good, bad = (webots_recording.set_parameters({"kp": value}) for value in (4.0, 11.0))
    for _ in range(2):
        webots_bridge.get_command()
    assert (good.status, bad.status, kp.value) == ("done", "failed", 4.0)
    assert webots_recording.parameters() == {"kp": 4.0}


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
