"""What a supervisor may look at and change, and when it takes effect."""

from __future__ import annotations

from math import isnan
from pathlib import Path

import pytest
from controller import Field, Node
from controller.surface import NotInStandInError

from tests.standin.placing import STEP_MS, drive, place
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.standin.in_process import DEFAULT_WORLD


@pytest.fixture
def robot() -> InProcessSupervisor:
    return InProcessSupervisor()


def test_the_scene_tree_can_be_walked(robot: InProcessSupervisor) -> None:
    children = robot.getRoot().getField("children")
    assert children is not None
    nodes = [children.getMFNode(i) for i in range(children.getCount())]
    assert [node.getDef() for node in nodes if node and node.getType() == Node.ROBOT] == ["ROVER"]
    last = children.getMFNode(-1)
    assert last is not None and last.getId() == robot.getSelf().getId()
    assert last.getTypeName() == last.getBaseTypeName() == "Robot"
    parent, again = last.getParentNode(), robot.getFromId(last.getId())
    assert parent is not None and parent.getId() == robot.getRoot().getId()
    assert again is not None and again.getDef() == "ROVER"
    assert again != last  # as in Webots: each call gives another object
    assert robot.getFromDef("NOBODY") is None


def test_fields_have_types_and_values(robot: InProcessSupervisor) -> None:
    node = robot.getSelf()
    name, place = node.getField("name"), node.getField("translation")
    assert name is not None and place is not None
    assert name.getSFString() == name.value == "rover"
    assert (place.getType(), place.getTypeName()) == (Field.SF_VEC3F, "SFVec3f")
    assert place.getSFVec3f() == [-1.2, 0.0, 0.04]
    assert place.getCount() == -1
    supervisor = node.getField("supervisor")
    assert supervisor is not None and supervisor.getSFBool() == 1
    assert node.getField("colour") is None
    assert node.getNumberOfFields() > 5


def test_a_pose_can_be_seen_from_another_node(robot: InProcessSupervisor) -> None:
    place(robot, 1.0, 0.5, 1.5707963)
    wheel = robot.getFromDef("ROVER.LEFT_WHEEL")
    assert wheel is not None
    pose = wheel.getPose(robot.getSelf())
    assert [pose[3], pose[7], pose[11]] == pytest.approx([0.0, 0.075, 0.0], abs=1e-6)
    back = robot.getSelf().getPose(robot.getSelf())
    assert back == pytest.approx([*(1, 0, 0, 0), *(0, 1, 0, 0), *(0, 0, 1, 0), *(0, 0, 0, 1)])


def test_a_box_whose_velocity_is_set_slides_until_friction_stops_it(
    robot: InProcessSupervisor,
) -> None:
    crate = robot.getFromDef("CRATE")
    assert crate is not None
    x, y, _ = crate.getPosition()
    crate.setVelocity([0.0, -1.0, 0.0, 0.0, 0.0, 0.0])
    robot.step(STEP_MS)
    assert crate.getVelocity()[1] == pytest.approx(-1.0 + 9.81 * 0.016)
    robot.step(100 * STEP_MS)
    assert crate.getVelocity() == [0.0] * 6
    # v²/2g, and half a step more: a step slides at the speed with which it begins
    assert crate.getPosition()[:2] == pytest.approx([x, y - 1.0 / 2.0 / 9.81 - 0.008], abs=0.002)


def test_a_field_that_was_set_reads_new_before_the_world_follows(
    robot: InProcessSupervisor,
) -> None:
    node = robot.getSelf()
    place = node.getField("translation")
    assert place is not None
    place.value = [1, 0, 0.04]
    assert place.getSFVec3f() == [1.0, 0.0, 0.04]
    assert node.getPosition() == [-1.2, 0.0, 0.04]
    robot.step(0)
    assert node.getPosition() == [1.0, 0.0, 0.04]


def test_a_node_tells_place_and_velocity(robot: InProcessSupervisor) -> None:
    drive(robot, 5.0, 5.0, 10)
    node = robot.getSelf()
    assert node.getVelocity() == pytest.approx([0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert node.getOrientation() == [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    assert node.getPose()[3] == node.getPosition()[0] == pytest.approx(-1.2 + 0.2 * 0.16)
    wheel = robot.getFromDef("ROVER.LEFT_WHEEL")
    assert wheel is not None and wheel.getPosition()[1] == pytest.approx(0.075)
    root = robot.getRoot()
    assert all(isnan(value) for value in root.getPosition() + root.getVelocity())


def test_a_reset_acts_at_the_end_of_the_next_step(robot: InProcessSupervisor) -> None:
    gps, wheel = robot.getDevice("gps"), robot.getDevice("left wheel sensor")
    gps.enable(4 * STEP_MS)
    wheel.enable(STEP_MS)
    drive(robot, 5.0, 5.0, 50)
    robot.simulationReset()
    assert robot.getTime() == pytest.approx(0.8)
    robot.step(STEP_MS)
    assert robot.getTime() == pytest.approx(0.016)
    assert gps.getValues()[0] == pytest.approx(-1.2)  # due at once
    robot.step(10 * STEP_MS)
    assert wheel.getValue() == 0.0  # the motors hold
    assert robot.getDevice("left wheel motor").getVelocity() == 5.0  # and report what was asked
    drive(robot, 5.0, 5.0, 10)
    assert wheel.getValue() == pytest.approx(0.8)


def test_nothing_is_reset_while_paused(robot: InProcessSupervisor) -> None:
    robot.step(STEP_MS)
    robot.simulationSetMode(robot.SIMULATION_MODE_PAUSE)
    robot.simulationReset()
    robot.step(0)
    assert robot.getTime() == pytest.approx(0.016)


def test_custom_data_written_by_the_field_reaches_the_robot(robot: InProcessSupervisor) -> None:
    robot.setCustomData("mine")
    field = robot.getSelf().getField("customData")
    assert field is not None and field.getSFString() == ""
    robot.step(STEP_MS)
    assert field.getSFString() == "mine"
    field.setSFString("yours")
    robot.step(STEP_MS)
    assert robot.getCustomData() == "yours"
    robot.setCustomData("ü" * 32_767)
    with pytest.raises(NotInStandInError, match="over 65,534 bytes"):
        robot.setCustomData("ü" * 32_768)


def test_a_tracked_field_comes_with_the_steps(robot: InProcessSupervisor) -> None:
    tracked, asked = (robot.getSelf().getField("customData") for _ in range(2))
    assert tracked is not None and asked is not None
    tracked.enableSFTracking(4 * STEP_MS)
    robot.setCustomData("1")
    robot.step(STEP_MS)
    robot.setCustomData("2")
    robot.step(STEP_MS)
    assert tracked.getSFString() == "1"  # until its period is over
    robot.step(3 * STEP_MS)
    assert tracked.getSFString() == "2"
    tracked.setSFString("3")
    assert tracked.getSFString() == "3"
    robot.step(STEP_MS)
    tracked.disableSFTracking()
    assert tracked.getSFString() == asked.getSFString() == "3"


def test_a_picture_is_written_with_the_next_step_or_at_once_when_paused(
    robot: InProcessSupervisor, tmp_path: Path
) -> None:
    running, paused = tmp_path / "running.png", tmp_path / "paused.jpg"
    robot.setLabel(1, "hello", 0.1, 0.1, 0.05, 0xFF0000)
    robot.exportImage(str(running), 90)
    assert not running.exists()
    robot.step(STEP_MS)
    assert running.read_bytes().startswith(b"\x89PNG")
    robot.simulationSetMode(robot.SIMULATION_MODE_PAUSE)
    robot.exportImage(str(paused), 90)
    assert paused.read_bytes().startswith(b"\xff\xd8")


def test_a_picture_that_fails_is_a_line_in_the_console_only(
    robot: InProcessSupervisor, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    robot.exportImage(str(tmp_path / "missing" / "x.png"), 90)
    robot.exportImage(str(tmp_path / "x.gif"), 90)
    assert robot.step(STEP_MS) == 0
    assert [line.startswith("ERROR: cannot export") for line in robot.simulation.console] == [
        True,
        True,
    ]
    robot.exportImage(str(tmp_path / "x.png"), 101)
    assert "quality 101" in capfd.readouterr().err


def test_between_the_halves_of_a_step_requests_are_refused(
    robot: InProcessSupervisor, capfd: pytest.CaptureFixture[str]
) -> None:
    robot.stepBegin(STEP_MS)
    assert robot.getFromDef("ROVER") is None
    assert "step_begin" in capfd.readouterr().err
    assert robot.stepEnd() == 0
    assert robot.getFromDef("ROVER") is not None


def test_without_rights_every_call_complains_and_gives_a_default(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    world = tmp_path / "plain.wbt"
    text = DEFAULT_WORLD.read_text(encoding="utf-8").replace("supervisor TRUE", "supervisor FALSE")
    world.write_text(text, encoding="utf-8")
    robot = InProcessSupervisor(world=world)
    assert robot.getSupervisor() is False
    assert robot.getFromDef("ROVER") is None
    assert capfd.readouterr().err.count("Error: ") == 2
    node = robot.getSelf()
    assert node
    assert all(isnan(value) for value in node.getPosition())
    robot.simulationSetMode(robot.SIMULATION_MODE_PAUSE)
    assert robot.simulationGetMode() == robot.SIMULATION_MODE_FAST
    assert robot.step(STEP_MS) == 0


def test_a_tracked_pose_comes_with_the_steps(robot: InProcessSupervisor) -> None:
    node, asked = robot.getSelf(), robot.getSelf()
    node.enablePoseTracking(4 * STEP_MS)
    robot.step(STEP_MS)
    at_first = node.getPose()
    assert at_first == asked.getPose()
    drive(robot, 5.0, 5.0, 2)
    assert node.getPose() == at_first  # until its period is over
    assert node.getPosition() != at_first[3:12:4]  # which is asked for
    robot.step(2 * STEP_MS)
    assert node.getPose()[3] == node.getPosition()[0]
    node.disablePoseTracking()
    robot.step(STEP_MS)
    assert node.getPose()[3] == node.getPosition()[0] > at_first[3]
