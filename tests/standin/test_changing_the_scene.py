"""Nodes and entries of fields that a supervisor adds and removes."""

from __future__ import annotations

from pathlib import Path

import pytest
from controller import Field, Node

from tests.standin.placing import STEP_MS, drive
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.standin.in_process import DEFAULT_WORLD

PILLAR = """DEF PILLAR Solid {
  translation -0.9 0 0.1
  children [ DEF LOOK Shape { geometry Box { size 0.1 0.5 0.2 } } ]
  name "pillar"
  boundingObject USE LOOK
}"""


@pytest.fixture
def robot() -> InProcessSupervisor:
    return InProcessSupervisor()


def field(robot: InProcessSupervisor, definition: str, name: str) -> Field:
    node = robot.getRoot() if definition == "root" else robot.getFromDef(definition)
    found = node.getField(name) if node else None
    assert found is not None
    return found


def node(robot: InProcessSupervisor, definition: str) -> Node:
    found = robot.getFromDef(definition)
    assert found is not None
    return found


def test_a_node_that_is_added_stands_in_the_way_until_a_reset_removes_it(
    robot: InProcessSupervisor,
) -> None:
    children = field(robot, "root", "children")
    count = children.getCount()
    children.importMFNodeFromString(-1, PILLAR)
    assert children.getCount() == count + 1
    assert node(robot, "PILLAR").getPosition() == [-0.9, 0.0, 0.1]
    drive(robot, 8.0, 8.0, 100)
    assert robot.simulation.robot("rover").is_touching
    robot.simulationReset()
    robot.step(STEP_MS)
    assert robot.getFromDef("PILLAR") is None
    assert field(robot, "root", "children").getCount() == count


def test_a_node_that_is_removed_is_gone_for_good(robot: InProcessSupervisor) -> None:
    ball, children = node(robot, "BALL"), field(robot, "root", "children")
    count, ball_id = children.getCount(), ball.getId()
    ball.remove()
    assert robot.getFromId(ball_id) is None
    assert children.getCount() == count - 1
    assert field(robot, "root", "children").getCount() == count - 1
    assert ball.getField("name") is None
    robot.simulationReset()
    robot.step(STEP_MS)
    assert robot.getFromDef("BALL") is None


def test_what_is_used_elsewhere_too_stays_when_the_node_that_defines_it_is_removed(
    robot: InProcessSupervisor,
) -> None:
    wall = node(robot, "WALL_EAST")
    shape_id = node(robot, "WALL_X_SHAPE").getId()
    wall.remove()
    children = field(robot, "WALL_WEST", "children")
    shape = children.getMFNode(0)
    assert shape is not None and shape.getId() == shape_id
    around = shape.getParentNode()
    assert around is not None and around.getDef() == "WALL_WEST"


def test_what_a_node_says_of_itself_makes_the_same_node_again(robot: InProcessSupervisor) -> None:
    for definition in ("BALL", "CRATE", "OBSTACLE_PILLAR"):
        written = node(robot, definition).exportString()
        node(robot, definition).remove()
        field(robot, "root", "children").importMFNodeFromString(2, written)
        assert node(robot, definition).exportString() == written
        third = field(robot, "root", "children").getMFNode(2)
        assert third is not None and third.getDef() == definition
    assert node(robot, "ROVER").exportString().startswith("DEF ROVER Robot { translation -1.2 0")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("Solid {", "ends in the middle of a node"),
        ("Hologram { }", "the stand-in has no Hologram nodes"),
        ("Solid { translation 1 }", "Solid.translation has to be SFVec3f"),
        ('Robot { name "second" }', "the stand-in adds no robots"),
        ('E-puck { name "second" }', "the stand-in adds no robots"),
        ("Group { children [ Pose { children [ E-puck { } ] } ] }", "the stand-in adds no robots"),
        ("Solid { } Solid { }", "one node is to be given"),
    ],
)
def test_what_cannot_be_added_is_a_line_in_the_console_and_changes_nothing(
    robot: InProcessSupervisor, text: str, said: str
) -> None:
    children = field(robot, "root", "children")
    count = children.getCount()
    children.importMFNodeFromString(-1, text)
    assert children.getCount() == count
    assert said in robot.simulation.console[-1]


def test_a_robot_within_a_proto_of_the_project_is_not_added_in_silence(tmp_path: Path) -> None:
    world = tmp_path / "worlds" / "arena.wbt"
    (tmp_path / "protos").mkdir()
    world.parent.mkdir()
    world.write_bytes(DEFAULT_WORLD.read_bytes())
    (tmp_path / "protos" / "Team.proto").write_text(
        "#VRML_SIM R2023b utf8\nPROTO Team [ field SFVec3f translation 0 0 0 ]\n"
        '{ Pose { translation IS translation children [ Robot { name "inner" } ] } }\n',
        encoding="utf-8",
    )
    robot = InProcessSupervisor(world=world)
    children = field(robot, "root", "children")
    count = children.getCount()
    children.importMFNodeFromString(-1, "DEF TEAM Team { }")
    assert (children.getCount(), robot.getFromDef("TEAM")) == (count, None)
    assert "the stand-in adds no robots" in robot.simulation.console[-1]
    children.importMFNodeFromString(-1, "DEF HOLDER Solid { }")
    shape = field(robot, "HOLDER", "boundingObject")
    shape.importSFNodeFromString("Team { }")
    assert shape.getSFNode() is None
    assert "the stand-in adds no robots" in robot.simulation.console[-1]


def test_what_is_left_out_of_a_node_that_is_added_is_named(robot: InProcessSupervisor) -> None:
    children = field(robot, "root", "children")
    count = children.getCount()
    children.importMFNodeFromString(-1, 'Group { children [ Nao { controller "other" } ] }')
    assert children.getCount() == count + 1
    assert "has no Nao nodes; what is one is left out" in robot.simulation.console[-1]


def test_the_robot_and_the_world_itself_stay(robot: InProcessSupervisor) -> None:
    for place in (0, 1):
        top = field(robot, "root", "children").getMFNode(place)
        assert top is not None
        top.remove()
        assert "cannot be removed" in robot.simulation.console[-1]
    robot.getSelf().remove()
    assert "the stand-in removes no robots" in robot.simulation.console[-1]


def test_entries_are_inserted_and_removed_at_once(
    robot: InProcessSupervisor, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = field(robot, "ROVER", "controllerArgs")
    arguments.removeMF(0)
    for index, text in ((0, "b"), (-1, "c"), (0, "a")):
        arguments.insertMFString(index, text)
    arguments.insertMFString(9, "x")
    arguments.insertMFFloat(0, 1.0)
    assert [arguments.getMFString(i) for i in range(3)] == ["a", "b", "c"]
    arguments.setMFString(0, "first")
    arguments.removeMF(1)  # what was set and not sent yet goes first
    assert [arguments.getMFString(i) for i in range(arguments.getCount())] == ["first", "c"]
    said = capfd.readouterr().err.splitlines()
    assert said[0] == "Error: wb_supervisor_field_remove_mf() called for an empty field."
    assert "out-of-bound index: 9 (should be between -4 and 3)" in said[1]
    assert "insert_mf_float() called with a field of type MFString" in said[2]
