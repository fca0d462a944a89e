"""The walk over the scene tree finds what stands in it, however deep, and asks for little."""

from __future__ import annotations

from pathlib import Path

import pytest

from webots_mcp.bridge.scene_nodes import SceneNode, find_field, find_inner_field, read_value, walk
from webots_mcp.standin import InProcessSupervisor

CROWD = Path(__file__).parent / "worlds" / "crowd.wbt"


@pytest.fixture
def referee() -> InProcessSupervisor:
    return InProcessSupervisor("referee", world=CROWD)


def robots(nodes: list[SceneNode]) -> list[str]:
    return [node.name for node in nodes if node.base_type == "Robot"]


def test_robots_are_found_in_groups_on_other_robots_and_in_the_slots_of_proto_nodes(
    referee: InProcessSupervisor,
) -> None:
    nodes = [*walk(referee.getRoot())]
    assert robots(nodes) == ["2nd.robot", "e-puck", "referee", "rover", "turret", "rider"]
    by_name = {node.name: node for node in nodes}
    assert (by_name["e-puck"].type_name, by_name["e-puck"].is_proto) == ("E-puck", True)
    assert (by_name["turret"].hidden, by_name["rider"].hidden) == (False, False)
    assert by_name["rider"].parent is not None
    assert (by_name["rider"].parent.name, by_name["rider"].definition) == ("platform", "RIDER")


def test_a_walk_is_bounded_and_gives_what_is_near_the_root_first(
    referee: InProcessSupervisor,
) -> None:
    root = referee.getRoot()
    assert len([*walk(root, most=4)]) == 4
    assert robots([*walk(root, deepest=1)]) == ["2nd.robot", "e-puck", "referee"]
    hidden = {node.id for node in walk(root) if node.hidden}
    assert hidden and not hidden & {node.id for node in walk(root, inside=False)}


def test_shapes_and_appearances_are_given_only_where_they_are_asked_for(
    referee: InProcessSupervisor,
) -> None:
    types = {node.base_type for node in walk(referee.getRoot())}
    assert not types & {"Shape", "PBRAppearance", "Box", "WorldInfo"}
    everything = {node.base_type for node in walk(referee.getRoot(), everything=True)}
    assert everything >= {"WorldInfo", "Viewpoint", "HingeJointParameters"} | types


def test_the_inside_of_a_proto_node_is_read_by_either_name_of_its_method(
    referee: InProcessSupervisor,
) -> None:
    crate = referee.getFromDef("CRATE")
    assert crate is not None and crate.getField("children") is None
    inner = find_inner_field(crate, "children")
    assert inner is not None and inner.getCount() > 0

    class OfR2023b:
        isProto = crate.isProto  # noqa: N815
        getField = crate.getField  # noqa: N815
        getProtoField = crate.getBaseNodeField  # noqa: N815

    found = find_field(OfR2023b(), "children")
    assert found is not None and found.getCount() == inner.getCount()
    assert find_inner_field(referee.getSelf(), "children") is None  # no PROTO node: nothing inside
    assert read_value(crate, "name") == "wooden box"
    assert read_value(crate, "nothing") is None


def test_a_field_inside_a_proto_node_cannot_be_set(
    referee: InProcessSupervisor, capfd: pytest.CaptureFixture[str]
) -> None:
    crate = referee.getFromDef("CRATE")
    assert crate is not None
    field = find_inner_field(crate, "locked")
    assert field is not None
    field.setSFBool(True)
    assert "read-only" in capfd.readouterr().err
    assert field.getSFBool() == 0
