"""What `webots_recording` answers, asked as a user's test asks it."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from webots_mcp import MCPBridge
from webots_mcp.database.connection import connect
from webots_mcp.errors import (
    InvalidInputError,
    NothingRecordedError,
    UnknownSignalError,
)
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.purge import prune
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.testing import RobotRecording


@pytest.fixture
def story(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: RobotRecording
) -> RobotRecording:
    """Ten rows, 0.1 s apart: front sinks from 0.9 to 0.0 m, the mode changes twice."""
    modes = ["cruise"] * 4 + ["turn"] * 3 + ["cruise"] * 3
    for step, mode in enumerate(modes):
        webots_robot.step(96)
        front_m = float("nan") if step == 2 else round(0.9 - 0.1 * step, 6)
        webots_bridge.publish({"mode": mode, "sensors": {"front_m": front_m}, "blind": step == 2})
        webots_bridge.log(f"step {step}", level="warning" if step > 7 else "info")
    return webots_recording


def test_a_signal_gives_all_its_values_and_their_times(story: RobotRecording) -> None:
    front = story.signal("sensors.front_m")
    assert front.values() == pytest.approx([0.9, 0.8, None, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.0])
    assert front.times_s() == pytest.approx([0.096 * (step + 1) for step in range(10)])
    assert (front.first, front.last, front.min(), front.max()) == (0.9, 0.0, 0.0, 0.9)
    assert front.at(0.2) == 0.8
    assert front.at(0.3) is None


def test_a_condition_is_asked_of_the_run_and_of_the_running_robot(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: RobotRecording
) -> None:
    webots_bridge.breakpoint("front_m < 0.5 for 0.2", action="log")
    for step in range(10):
        webots_robot.step(96)
        webots_bridge.publish({"front_m": 0.9 - 0.1 * step})

    (held,) = webots_recording.held("front_m < 0.5 for 0.2")
    (hit,) = webots_recording.events("breakpoint")
    assert held.start_s == hit.sim_time_s == pytest.approx(9 * 0.096)
    assert webots_recording.held("front_m > 2") == []
    with pytest.raises(UnknownSignalError, match="front_m"):
        webots_recording.held("fornt_m > 2")


def test_changes_leave_repetitions_out(story: RobotRecording) -> None:
    mode = story.signal("mode")
    assert mode.changes() == ["cruise", "turn", "cruise"]
    assert mode.first_time_s("turn") == pytest.approx(5 * 0.096)
    assert mode.duration_s("turn") == pytest.approx(3 * 0.096)
    assert story.signal("blind").changes() == [False, True, False]


def test_a_broken_limit_says_when_how_often_how_far_and_where(story: RobotRecording) -> None:
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


def test_a_kept_limit_is_silent(story: RobotRecording) -> None:
    front = story.signal("sensors.front_m")
    front.assert_never_below(0.0)
    front.assert_never_above(0.9)
    story.signal("mode").assert_never("stuck")


def test_a_limit_on_a_signal_without_numbers_proves_nothing_and_fails(
    story: RobotRecording,
) -> None:
    with pytest.raises(AssertionError, match=r"mode holds no number in the 10 rows .* nothing sho"):
        story.signal("mode").assert_never_below(1)
    with pytest.raises(NothingRecordedError, match="mode holds no number"):
        story.signal("mode").min()


def test_a_value_that_never_came_is_told_with_those_that_did(story: RobotRecording) -> None:
    with pytest.raises(NothingRecordedError, match=r"never 'back_up' in the 10 .*'cruise', 'turn'"):
        story.signal("mode").first_time_s("back_up")
    with pytest.raises(
        NothingRecordedError, match=r"has no row up to 0 s: the first is at 0.096 s"
    ):
        story.signal("mode").at(0)


def test_an_unknown_signal_is_told_with_near_names(story: RobotRecording) -> None:
    with pytest.raises(UnknownSignalError, match=r"No signal 'sensors.frnt'.* sensors.front_m"):
        story.signal("sensors.frnt")


def test_a_name_that_means_several_signals_is_refused_by_signal_and_taken_by_signals(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: RobotRecording
) -> None:
    webots_robot.step(16)
    webots_bridge.publish({"pose": [1.0, 2.0]})
    with pytest.raises(InvalidInputError, match=r"'pose' means 2 signals: pose.0, pose.1"):
        webots_recording.signal("pose")
    assert [signal.last for signal in webots_recording.signals("pose.*")] == [1.0, 2.0]


def test_states_come_as_they_were_published(story: RobotRecording) -> None:
    states = story.states()
    assert len(states) == 10
    assert states[2] == {"mode": "cruise", "sensors": {"front_m": "nan"}, "blind": True}


def test_states_and_signals_are_the_same_once_their_rows_are_deleted(
    story: RobotRecording, tmp_path: Path
) -> None:
    states, front = story.states(), story.signal("sensors.front_m").values()
    with closing(connect(story.database, "writer")) as connection:
        prune(connection, tmp_path, Retention(state=Limit(rows=0)), rest=False)
        assert connection.execute("SELECT count(*) FROM state").fetchone() == (0,)
    assert story.states() == states
    assert story.signal("sensors.front_m").values() == front
    with pytest.raises(AssertionError, match=r'the state at 0.384 s: {"mode":"cruise"'):
        story.signal("sensors.front_m").assert_never_below(0.65)


@pytest.mark.parametrize("loss", ["UPDATE chunk SET numbers = x'00'", "DELETE FROM row_group"])
def test_what_was_lost_of_a_run_fails_a_test_that_asks_for_it(
    story: RobotRecording, tmp_path: Path, loss: str
) -> None:
    """Limits held, conditions never did, and minima were those of what was left."""
    with closing(connect(story.database, "writer")) as connection:
        prune(connection, tmp_path, Retention(state=Limit(rows=0)), rest=False)
        connection.execute(loss)
        connection.execute(
            "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) "
            """SELECT id, 9.0, 2e9, '{"sensors": {"front_m": 1.0}, "mode": "turn"}' FROM run"""
        )
    for ask in (
        lambda: story.signal("sensors.front_m").assert_never_below(0.65),
        lambda: story.signal("sensors.front_m").min(),
        lambda: story.held("sensors.front_m < 0.65"),
        lambda: story.find_events("jump"),
        story.states,
    ):
        told = (NothingRecordedError, AssertionError)
        with pytest.raises(told, match=r"not read from .* (damaged|deleted)"):
            ask()


def test_events_and_logs_come_in_order_and_by_kind(story: RobotRecording) -> None:
    assert [event.kind for event in story.events()] == ["start"] + ["change"] * 4
    changed = [event.details()["to"] for event in story.events("change") if event.name == "mode"]
    assert changed == ["turn", "cruise"]
    assert [line.message for line in story.logs("warning")] == ["step 8", "step 9"]
    assert [line.message for line in story.logs(text="STEP 3")] == ["step 3"]
    with pytest.raises(InvalidInputError, match="no log level 'loud'; there is debug, info"):
        story.logs("loud")


def test_what_the_values_show_can_be_asked_for(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: RobotRecording
) -> None:
    for step in range(120):
        webots_robot.step(96)
        webots_bridge.publish({"pose": [min(step, 60) * 0.1, 0.0], "commanded_m_s": 1.0})
    (stuck,) = webots_recording.find_events("stuck", stuck_s=4.0)
    assert (stuck.start_s, stuck.end_s) == pytest.approx((61 * 0.096, 120 * 0.096), abs=0.1)
    assert stuck.ongoing
    assert webots_recording.find_events("jump", "missing") == []
    with pytest.raises(InvalidInputError, match="Unknown kind 'stucked'"):
        webots_recording.find_events("stucked")


def test_what_could_not_be_looked_for_is_not_told_to_be_absent(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge, webots_recording: RobotRecording
) -> None:
    for step in range(20):
        webots_robot.step(96)
        webots_bridge.publish({"mode": "cruise", "step": step})
    with pytest.raises(NothingRecordedError, match="stuck could not be looked for: no position"):
        webots_recording.find_events("stuck")
