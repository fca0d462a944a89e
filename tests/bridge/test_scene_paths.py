"""Paths into the scene tree: where they lead, and what is said of those that lead nowhere."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.bridge.asking_the_scene import Scene
from tests.bridge.conftest import Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSimulation, InProcessSupervisor

CROWD = Path(__file__).parent / "worlds" / "crowd.wbt"


@pytest.fixture
def crowd(database: MemoryDatabase) -> Iterator[Scene]:
    """A referee that may look at a world of robots, some of them inside others."""
    robot = InProcessSupervisor("referee", world=InProcessSimulation(CROWD))
    with MCPBridge(robot, throttle_interval=1, database=database) as bridge:
        yield Scene(robot, bridge, Recording(database))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("ROVER.translation", [1.0, 2.0, 0.0]),
        ("rover.translation", [1.0, 2.0, 0.0]),
        ("DEF ROVER.translation", [1.0, 2.0, 0.0]),
        ("  ROVER . translation ", [1.0, 2.0, 0.0]),
        ("ROVER/translation", [1.0, 2.0, 0.0]),
        ("/ROVER/children/0/endPoint/name", "platform"),
        ("ROVER.children[0].endPoint.children[-1].name", "rider"),
        ("ROVER.RIDER.translation", [0.0, 0.0, 0.2]),
        ("rider.translation", [0.0, 0.0, 0.2]),
        ("turret.supervisor", False),
        ('"2nd.robot".translation', [2.0, -1.0, 0.0]),
        ("WorldInfo.title", "A crowd"),
        ("WorldInfo.randomSeed", 0),
        ("root.children[0].title", "A crowd"),
        ("children[0].basicTimeStep", 16.0),
        ("CRATE.mass", 1.0),
        ("E-puck.version", "1"),
        ("e-puck.version", "1"),
        ("ROVER.rotation", [0.0, 0.0, 1.0, 0.5]),
        ("ROVER.physics", None),
    ],
)
def test_a_path_leads_to_a_field_however_one_would_write_it(
    crowd: Scene, path: str, value: Any
) -> None:
    assert crowd.get(path) == value


def test_what_is_inside_a_proto_is_read_and_said_to_be_so(crowd: Scene) -> None:
    inside = crowd.ask("get_field", path="CRATE.boundingObject")
    assert inside["value"].endswith("Pose")
    assert inside["read_only"] == "it is inside a PROTO"
    assert "inside a PROTO" in crowd.fail("set_field", path="CRATE.boundingObject", value=1)
    assert "proto_of" in crowd.ask("get_field", path="CRATE")


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("ROVR.translation", "no node has the DEF name, name or type 'ROVR'"),
        ("ROVR.translation", "(the nearest first): ROVER"),
        ("ROVER.tranlation", "no field 'tranlation'; it has (the nearest first): translation"),
        ("ROVER.children[7]", "no entry 7: it has 1: [0] HingeJoint"),
        ("ROVER.children.name", "give an index, such as ROVER.children[0]"),
        ("ROVER.translation.x", "is of type SFVec3f: it has no fields"),
        ("ROVER.translation[0]", "one value of type SFVec3f"),
        ("ROVER.physics.mass", "ROVER.physics is NULL"),
        ("ROVER.controllerArgs[0]", "it has none"),
        ("ROVER[0]", "name one of its fields, such as ROVER.children[0]"),
        ("#99999.name", "there is no node #99999"),
        ("#-1", "there is no node #-1"),
        ("", "is not a path of the scene tree"),
        (7, "7 is not a path of the scene tree"),
        ("ROVER..name", "'..name' is invalid"),
        ("ROVER.name]", "']' is invalid"),
        ("x" * 1000, "is not a path of the scene tree"),
    ],
)
def test_a_path_that_leads_nowhere_is_answered_with_what_there_is(
    crowd: Scene, path: object, said: str
) -> None:
    assert said in crowd.fail("get_field", path=path)


def test_a_name_that_several_nodes_have_is_answered_with_their_numbers(crowd: Scene) -> None:
    for _ in range(2):
        crowd.ask("add_node", vrml='Solid { name "twin" }')
    said = crowd.fail("get_field", path="twin.name")
    assert said.startswith("2 nodes have the name 'twin': #")
    assert "give the number of one of them" in said


def test_a_long_field_is_read_in_parts(crowd: Scene) -> None:
    crowd.ask("set_field", path="WorldInfo.info", value=[f"line {i}" for i in range(120)])
    seen: list[str] = []
    start: int | None = 0
    while start is not None:
        part = crowd.ask("get_field", path="WorldInfo.info", start=start)
        assert part["count"] == 120
        seen += part["values"]
        start = part.get("next_start")
    assert seen == [f"line {i}" for i in range(120)]
    assert crowd.get("WorldInfo.info[-1]") == "line 119"


def test_the_scene_shows_what_stands_where_with_paths_that_lead_there(crowd: Scene) -> None:
    scene = crowd.ask("get_scene", depth=5, fields=["translation"])
    assert scene["columns"] == ["depth", "path", "type", "name", "translation"]
    rows = {row[1]: row for row in scene["rows"]}
    assert rows["ROVER"] == [2, "ROVER", "Robot", "rover", [1.0, 2.0, 0.0]]
    assert rows["CRATE"][2] == "WoodenBox (Solid)"
    paths = [row[1] for row in scene["rows"]]
    assert paths.index("ROVER") < paths.index("RIDER") < paths.index("CRATE"), "as in the tree"
    assert scene["also_at_the_top"] == ["WorldInfo", "Viewpoint"]
    for _, path, _, name, _ in scene["rows"]:
        if name:
            assert crowd.get(f"{path}.name") == name


def test_the_scene_is_asked_for_types_and_names_at_any_depth(crowd: Scene) -> None:
    robots = crowd.ask("get_scene", types=["Robot"])["rows"]
    assert {row[3] for row in robots} == {
        "rover", "rider", "2nd.robot", "e-puck", "turret", "referee",
    }  # fmt: skip
    named = crowd.ask("get_scene", names=["ro*", "RIDER"])["rows"]
    assert {row[3] for row in named} == {"rover", "rider"}
    inside = crowd.ask("get_scene", path="CRATE", types=["Box"])
    assert inside["below"] == "CRATE"
    assert inside["rows"][0][2] == "Box, inside a PROTO"


def test_types_and_names_are_found_whatever_their_case_and_else_the_nearest_are_told(
    crowd: Scene,
) -> None:
    assert crowd.ask("get_scene", types=["robot"])["rows"]
    assert crowd.ask("get_scene", names=["CRATE"]) == crowd.ask("get_scene", names=["crate"])
    mistyped = crowd.ask("get_scene", types=["Robto"])
    assert not mistyped["rows"] and mistyped["nearest"][0] == "Robot"
    assert crowd.ask("get_scene", names=["ridr"])["nearest"][0] in ("RIDER", "rider")
    assert "nearest" not in crowd.ask("get_scene", names=["rider"])


def test_the_name_of_a_node_is_shown_once(crowd: Scene) -> None:
    shown = crowd.ask("get_scene", types=["Robot"], fields=["name", "translation"])
    assert shown["columns"] == ["depth", "path", "type", "name", "translation"]
    assert all(len(row) == len(shown["columns"]) for row in shown["rows"])


@pytest.mark.slow
def test_a_scene_that_is_too_large_is_given_in_parts(crowd: Scene) -> None:
    for i in range(60):
        crowd.ask("add_node", vrml=f'DEF PIECE_{i:02} Solid {{ name "the piece number {i}" }}')
    seen: list[str] = []
    cursor: int | None = 0
    while cursor is not None:
        part = crowd.ask("get_scene", depth=1, cursor=cursor, fields=["translation", "rotation"])
        assert len(str(part)) < 4000
        seen += [row[1] for row in part["rows"]]
        cursor = part.get("cursor")
    assert [path for path in seen if path.startswith("PIECE")] == [
        f"PIECE_{i:02}" for i in range(60)
    ]
    assert len(seen) == len(set(seen))


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({"depth": 0}, "depth must be a whole number from 1"),
        ({"types": "Robot"}, 'types must be a list of texts, such as ["Robot"]'),
        ({"fields": [1]}, "fields must be a list of texts"),
        ({"names": ["x"] * 50}, "at most 20"),
        ({"path": "ROVER.translation"}, "is a field of type SFVec3f, not a node"),
    ],
)
def test_a_scene_that_is_asked_for_wrongly_is_refused(
    crowd: Scene, params: dict[str, object], said: str
) -> None:
    assert said in crowd.fail("get_scene", **params)


ODD = (
    *(None, True, 0, -1, 1.5, 10**30, "x", "#5", "#" + "9" * 30, '"', "[0]", ".", "..", "root"),
    *(
        "root.x",
        "root.children",
        [],
        ["a"],
        {},
        {"a": 1},
        "\0",
        "\u00e9.\u00fc",
        "DEF",
        "USE ",
        "{}",
    ),
    *("ROVER." + "a" * 400, "ROVER[", "ROVER]", "ROVER.children[-99]", "Solid { } }", float("nan")),
)


@pytest.mark.parametrize("action", ["get_scene", "get_field", "set_field", "add_node"])
def test_whatever_is_sent_is_answered_in_our_own_words(crowd: Scene, action: str) -> None:
    names = {"get_scene": "types", "get_field": "start", "set_field": "value", "add_node": "vrml"}
    for odd in ODD:
        for params in ({"path": odd}, {"path": "PILLAR.name", names[action]: odd}):
            status, _, error = crowd.fate(action, **params)
            told = (action, params, error)
            assert (status == "done") == (error is None), told
            assert error is None or not any(word in error for word in ("Error:", ".py, ")), told
