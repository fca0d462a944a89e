"""What the rover does, read from what it recorded. Run with `pytest examples/tests`."""

from math import pi
from pathlib import Path
from runpy import run_path

import pytest

from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.testing import RecordedSimulation, SimulationFactory

PROJECT = Path(__file__).parent.parent


@pytest.fixture
def simulation(webots_simulation: SimulationFactory) -> RecordedSimulation:
    """The arena with the rover, as Webots would start it; paused before the first step."""
    return webots_simulation(PROJECT / "worlds" / "arena.wbt")


def test_the_rover_wanders_and_keeps_its_distance(simulation: RecordedSimulation) -> None:
    simulation.run_for(20)
    recording = simulation.recording
    mode = recording.signal("mode")
    assert mode.changes()[:3] == ["cruise", "turn", "cruise"]
    assert mode.duration_s("cruise") > 10
    recording.signal("stuck").assert_never(True)
    recording.signal("lidar.nearest_m").assert_never_below(0.1)
    assert not recording.logs(level="warning")


def test_it_drives_as_fast_as_it_is_told(simulation: RecordedSimulation) -> None:
    simulation.run_for(1)
    sent = simulation.recording.send("set_speed", speed=2.0)
    simulation.run_for(1)
    assert (sent.status, sent.result) == ("done", {"speed_radps": 2.0})
    assert simulation.recording.signal("wheel_radps.left").last == pytest.approx(2.0, abs=0.01)


def test_a_speed_that_is_no_number_is_refused(simulation: RecordedSimulation) -> None:
    simulation.run_for(1)
    sent = simulation.recording.send("set_speed", speed="fast")
    simulation.run_for(1)
    assert sent.status == "failed"
    assert "could not convert string to float" in (sent.error or "")


def test_after_a_reset_it_begins_anew(simulation: RecordedSimulation) -> None:
    simulation.run_for(12)
    reset = simulation.recording.send("reset")
    simulation.run_for(1)
    assert reset.status == "done"
    before, after = simulation.recording.runs()
    assert before.signal("pose.x").last > 0
    assert after.signal("pose.x").first == pytest.approx(-1.2, abs=0.02)
    assert after.signal("mode").changes() == ["cruise"]


def test_it_drives_as_fast_as_its_parameter_says(simulation: RecordedSimulation) -> None:
    simulation.run_for(1)
    sent = simulation.recording.set_parameters({"speed": 2.0})
    simulation.run_for(1)
    assert sent.status == "done"
    assert simulation.recording.signal("wheel_radps.left").last == pytest.approx(2.0, abs=0.01)
    assert simulation.recording.parameters() == {"speed": 2.0, "near": 0.35}


def test_it_turns_the_short_way_round(
    webots_robot: InProcessSupervisor, webots_bridge: MCPBridge
) -> None:
    """A part of the controller by itself, without a process."""
    controller = run_path(str(PROJECT / "controllers" / "rover" / "rover.py"))
    rover = controller["Rover"](webots_robot, webots_bridge)
    webots_robot.step(rover.time_step)
    rover.sense()
    assert rover.turn_to({"heading": -1.0})["to_turn_rad"] == pytest.approx(-1.0)
    assert rover.turn_to({"heading": 6.0})["to_turn_rad"] == pytest.approx(6.0 - 2 * pi)
