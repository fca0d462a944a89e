"""Fields that are set, nodes that are added and removed, and what a reset makes of it."""

from __future__ import annotations

import json

import pytest

from tests.bridge.asking_the_scene import Scene
from tests.bridge.conftest import Recording, eager
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor

PILL = 'DEF PILL Solid { translation 1 0 0.1 name "pill" }'


def top_nodes(scene: Scene) -> list[str]:
    """The DEF names or types of the nodes at the top of the tree, in their order."""
    field = scene.robot.getRoot().getField("children")
    assert field is not None
    nodes = [field.getMFNode(index) for index in range(field.getCount())]
    return [node.getDef() or node.getTypeName() for node in nodes if node is not None]


@pytest.fixture
def scene(robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording) -> Scene:
    return Scene(robot, bridge, recording)


@pytest.mark.parametrize(
    ("path", "value", "held"),
    [
        ("ROVER.translation", [0, 1, 0.04], [0.0, 1.0, 0.04]),
        ("ROVER.rotation", [0, 0, 2, 1.5], [0.0, 0.0, 2.0, 1.5]),
        ("BALL.children[0].appearance.baseColor", [1, 0, 0], [1.0, 0.0, 0.0]),
        ("BALL.physics.mass", 2, 2.0),
        ("BALL.locked", True, True),
        ("BALL.children[0].geometry.subdivision", 3.0, 3),
        ("ROVER.customData", 'a "text"', 'a "text"'),
        ("FLOOR.children[0].geometry.size", [5, 6], [5.0, 6.0]),
        ("WorldInfo.contactProperties[0].coulombFriction[0]", 0.25, 0.25),
    ],
)
def test_a_field_of_any_type_is_set_and_read_back_after_a_step(
    scene: Scene, path: str, value: object, held: object
) -> None:
    before = scene.get(path)
    answer = scene.ask("set_field", path=path, value=value)
    assert (answer["from"], answer["to"]) == (before, held)
    assert "now" not in answer
    assert scene.get(path) == held
    ((name, data),) = scene.events("set_field")
    assert name == path
    told = json.loads(data)
    assert (told["from"], told["to"]) == (before, held)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("ROVER.translation", [1, 2], "type SFVec3f: give 3 finite numbers, such as [0, 0.5, 0.1]"),
        ("ROVER.translation", [1, 2, "x"], "got [1, 2, 'x']"),
        ("ROVER.translation", [1, 2, float("nan")], "finite"),
        ("ROVER.translation", [1, 2, 1e39], "finite"),
        ("ROVER.translation", "0 1 2", "3 finite numbers"),
        ("ROVER.rotation", [0, 0, 0, 1], "an axis (not 0 0 0)"),
        ("BALL.children[0].appearance.baseColor", [255, 0, 0], "each from 0 to 1"),
        ("BALL.physics.mass", True, "a finite number, such as 0.5; got True"),
        ("BALL.physics.mass", None, "a finite number"),
        ("BALL.physics.mass", float("inf"), "a finite number"),
        ("BALL.locked", 1, "true or false"),
        ("BALL.children[0].geometry.subdivision", 1.5, "a whole number"),
        ("BALL.name", 5, "a text of at most"),
        ("BALL.physics", 5, "BALL.physics.name"),
        ("BALL.children", [], "webots_add_node and webots_remove_node change them"),
        ("BALL", 5, "name the field to set, such as BALL.translation"),
        ("ROVER.controllerArgs", "x", "a list of at most 200"),
        ("ROVER.controller", "../../evil", "controller must be the name of a program"),
        ("ROVER.controller", "/tmp/evil", "not a path: '/tmp/evil'"),
        ("ROVER.window", "..\\evil", "window must be the name"),
        ("ROVER.supervisor", False, "this bridge needs the permission of a Supervisor itself"),
    ],
)
def test_a_value_that_a_field_cannot_have_is_refused_with_one_that_it_can(
    scene: Scene, path: str, value: object, said: str
) -> None:
    assert said in scene.fail("set_field", path=path, value=value)
    assert not scene.events("set_field")


def test_a_robot_that_drives_on_was_moved_all_the_same(scene: Scene) -> None:
    for name in ("left wheel motor", "right wheel motor"):
        motor = scene.robot.getDevice(name)
        motor.setPosition(float("inf"))
        motor.setVelocity(5.0)
    scene.rounds(5)
    answer = scene.ask("set_field", path="ROVER.translation", value=[0, 0.5, 0.04])
    assert answer["now"] == pytest.approx([0.0, 0.5, 0.04], abs=0.02)
    assert answer["now"] != answer["to"]


def test_a_body_is_put_somewhere_without_its_speed(scene: Scene) -> None:
    ball = scene.robot.getFromDef("BALL")
    assert ball is not None
    ball.setVelocity([2.0, 0, 0, 0, 0, 0])
    scene.ask("set_field", path="BALL.translation", value=[0, 1, 0.05], stop=True)
    assert scene.get("BALL.translation") == [0.0, 1.0, 0.05]
    assert ball.getVelocity()[:2] == [0.0, 0.0]


def test_while_it_is_paused_a_field_is_set_too(scene: Scene) -> None:
    sent = [
        scene.recording.send("pause"),
        scene.recording.send("set_field", path="BALL.physics.mass", value=3),
        scene.recording.send("get_field", path="BALL.physics.mass"),
        scene.recording.send("resume"),
    ]
    eager(scene.bridge)
    scene.rounds(1)
    fates = [scene.recording.fate(each) for each in sent]
    assert [status for status, _, _ in fates] == ["done"] * 4
    assert fates[1][1]["to"] == fates[2][1]["value"] == 3.0


def test_a_reset_puts_back_what_webots_does_not(scene: Scene) -> None:
    colour, friction = "BALL.children[0].appearance.baseColor", "WorldInfo.contactProperties[0]"
    friction += ".coulombFriction"
    before = (scene.get(colour), scene.ask("get_field", path=friction)["values"])
    for value in ([1, 0, 0], [0, 1, 0]):
        assert scene.ask("set_field", path=colour, value=value)["a_reset"] == "puts it back"
    scene.ask("set_field", path=friction, value=[0.5, 0.25])
    scene.ask("set_field", path="ROVER.translation", value=[0, 1, 0.04])
    scene.reset()
    assert (scene.get(colour), scene.ask("get_field", path=friction)["values"]) == before
    assert scene.get("ROVER.translation") == [-1.2, 0.0, 0.04]
    ((_, data),) = scene.events("put_back")
    told = json.loads(data)
    assert told == {"paths": [friction, colour]}


def test_a_reset_leaves_what_somebody_else_has_set_since(scene: Scene) -> None:
    scene.ask("set_field", path="BALL.physics.mass", value=2)
    ball = scene.robot.getFromDef("BALL")
    physics = ball.getField("physics") if ball else None
    node = physics.getSFNode() if physics else None
    mass = node.getField("mass") if node else None
    assert mass is not None
    mass.setSFFloat(7.0)
    scene.reset()
    assert scene.get("BALL.physics.mass") == 7.0


def test_the_pose_that_a_reset_brings_is_never_that_of_the_middle_of_a_run(scene: Scene) -> None:
    scene.ask("set_field", path="ROVER.translation", value=[1, 1, 0.04])
    scene.ask("set_field", path="ROVER.translation", value=[-1.2, 0, 0.04])
    scene.reset()
    assert scene.get("ROVER.translation") == [-1.2, 0.0, 0.04]


def test_a_node_is_added_with_a_path_that_leads_to_it_until_a_reset(scene: Scene) -> None:
    named = scene.ask("add_node", vrml=PILL)
    assert (named["path"], named["parent"], named["a_reset"]) == (
        "PILL",
        "root.children",
        "removes it",
    )
    second = scene.ask("add_node", vrml='Solid { name "second" }', path="FLOOR")
    assert second["path"].startswith("#")
    assert second["parent"] == "FLOOR.children"
    assert scene.get(f"{second['path']}.name") == "second"
    assert [name for name, _ in scene.events("add_node")] == ["PILL", second["path"]]
    scene.reset()
    assert "no node has the DEF name, name or type 'PILL'" in scene.fail("get_field", path="PILL")


def test_what_is_in_an_added_node_is_said_to_go_with_it_at_a_reset(scene: Scene) -> None:
    box = 'DEF BOX Solid { name "box" children [ DEF LID Solid { name "lid" } ] }'
    scene.ask("add_node", vrml=box)
    for path in ("BOX.translation", "LID.translation"):
        answer = scene.ask("set_field", path=path, value=[1, 0, 0])
        assert answer["a_reset"] == "removes the node: it was added in this run"
    removed = scene.ask("remove_node", path="LID")
    assert removed["a_reset"] == "does not bring it back: it was added in this run"
    scene.reset()
    assert scene.robot.getFromDef("BOX") is None
    assert not scene.events("put_back")


def test_a_field_that_is_null_takes_a_node(scene: Scene) -> None:
    answer = scene.ask("add_node", path="FLOOR.physics", vrml="Physics { mass 4 }")
    assert answer["parent"] == "FLOOR.physics"
    assert scene.get("FLOOR.physics.mass") == 4.0
    said = scene.fail("add_node", path="FLOOR.physics", vrml="Physics { mass 4 }")
    assert "FLOOR.physics already has a node (Physics): remove that one first" in said


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({"vrml": "Hologram { }"}, "Webots added nothing to root.children"),
        ({"vrml": "Hologram { }"}, "IMPORTABLE EXTERNPROTO"),
        ({"vrml": "Solid {"}, "give vrml as one node of a world file"),
        ({"vrml": "Solid { children [ }"}, "1 [ and 0 ]"),
        ({"vrml": ""}, "give vrml as one node"),
        ({"vrml": None}, "give vrml as one node"),
        ({"vrml": 'Robot { controller # it\n "../evil" }'}, "not a path: '../evil'"),
        (
            {"vrml": 'Group { children [ Robot { remoteControl"/evil" } ] }'},
            "remoteControl must be the name",
        ),
        ({"vrml": PILL, "path": "ROVER.translation"}, "which cannot contain nodes"),
        ({"vrml": PILL, "path": "WorldInfo"}, "has no field children"),
        ({"vrml": PILL, "path": "nowhere"}, "no node has the DEF name, name or type 'nowhere'"),
    ],
)
def test_a_node_that_cannot_be_added_is_said_to_be_none(
    scene: Scene, params: dict[str, object], said: str
) -> None:
    assert said in scene.fail("add_node", **params)
    assert not scene.events("add_node")


def test_brackets_in_texts_and_comments_are_no_brackets(scene: Scene) -> None:
    odd = 'DEF ODD Solid { # { in a comment\n name "a { and a \\" [" }'
    assert scene.ask("add_node", vrml=odd)["path"] == "ODD"
    assert scene.get("ODD.name") == 'a { and a " ['


def test_a_node_that_was_removed_is_brought_back_by_each_reset(scene: Scene) -> None:
    whole = scene.robot.getFromDef("CRATE")
    assert whole is not None
    written, around = whole.exportString(), top_nodes(scene)
    assert scene.ask("remove_node", path="CRATE")["a_reset"] == "puts it back"
    assert "no node has the DEF name, name or type 'CRATE'" in scene.fail("get_field", path="CRATE")
    for _ in range(2):
        scene.reset()
        again = scene.robot.getFromDef("CRATE")
        assert again is not None and again.exportString() == written
        assert top_nodes(scene) == around
    assert [json.loads(data) for _, data in scene.events("put_back")] == [{"nodes": ["CRATE"]}] * 2


def test_several_removed_nodes_come_back_in_their_order_also_one_in_another(scene: Scene) -> None:
    around = top_nodes(scene)
    for path in ("BALL.physics", "BALL", "CRATE"):
        scene.ask("remove_node", path=path)
    for _ in range(2):
        scene.reset()
        assert top_nodes(scene) == around
        assert scene.get("BALL.physics.mass") == 0.05
    told = [json.loads(data) for _, data in scene.events("put_back")]
    assert told == [{"nodes": ["CRATE", "BALL", "BALL.physics"]}] * 2


@pytest.mark.parametrize("path", ["BALL", "BALL.physics"])
def test_what_a_reset_has_put_back_can_be_removed_again_and_comes_back_once(
    scene: Scene, path: str
) -> None:
    around = top_nodes(scene)
    scene.ask("remove_node", path="BALL")
    scene.reset()
    assert scene.ask("remove_node", path=path)["a_reset"] == "puts it back"
    scene.reset()
    assert top_nodes(scene) == around
    assert scene.get("BALL.physics.mass") == 0.05


def test_a_node_without_its_parent_is_said_not_to_be_put_back(scene: Scene) -> None:
    scene.ask("remove_node", path="BALL.physics")
    ball = scene.robot.getFromDef("BALL")
    assert ball is not None
    ball.remove()  # by a controller, which nobody remembers
    scene.reset()
    ((_, data),) = scene.events("put_back")
    assert json.loads(data) == {"not": ["BALL.physics"]}


def test_a_node_that_is_too_long_to_be_remembered_is_said_to_stay_away(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webots_mcp.bridge.scene_edits._LONGEST_REMOVED", 20)
    removed = scene.ask("remove_node", path="CRATE")
    assert removed["a_reset"] == "does not bring it back; a reload does"
    scene.reset()
    assert scene.robot.getFromDef("CRATE") is None
    assert not scene.events("put_back")


def test_what_was_added_and_removed_again_stays_away(scene: Scene) -> None:
    scene.ask("add_node", vrml=PILL)
    removed = scene.ask("remove_node", path="PILL")
    assert removed["a_reset"] == "does not bring it back: it was added in this run"
    scene.reset()
    assert scene.robot.getFromDef("PILL") is None
    assert not scene.events("put_back")


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("ROVER", "contains the robot 'rover' and cannot be removed"),
        ("root", "cannot be removed from a world"),
        ("WorldInfo", "cannot be removed from a world"),
        ("Viewpoint", "cannot be removed from a world"),
        ("BALL.translation", "is a field of type SFVec3f, not a node"),
        ("FLOOR.physics", "FLOOR.physics is NULL"),
    ],
)
def test_what_the_world_needs_is_not_removed(scene: Scene, path: str, said: str) -> None:
    assert said in scene.fail("remove_node", path=path)
    assert not scene.events("remove_node")


@pytest.mark.slow
def test_more_changes_than_are_remembered_are_said_to_stay(scene: Scene) -> None:
    sent = [
        scene.recording.send("set_field", path="BALL.name", value=f"ball {i}") for i in range(3)
    ]
    scene.rounds(30)
    assert all(scene.recording.fate(each)[1]["a_reset"] == "puts it back" for each in sent)
    path = "WorldInfo.info"
    scene.ask("set_field", path=path, value=["x"] * 200)
    last = ""
    for i in range(199):
        last = scene.ask("set_field", path=f"{path}[{i}]", value="y")["a_reset"]
    assert last == "does not undo it: at most 200 changes are remembered"
