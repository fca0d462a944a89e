"""PROTO files of a project and of an installed Webots are read as far as they are no templates."""

from __future__ import annotations

from math import inf
from pathlib import Path

import pytest

from webots_mcp.standin import InProcessSimulation, InProcessSupervisor, WorldError
from webots_mcp.standin.world import load_world

CART = """#VRML_SIM R2023b utf8
# A cart with a wheel at each side.
EXTERNPROTO "CartWheel.proto"
PROTO Cart [
  field SFVec3f translation 0 0 0.05
  field SFRotation rotation 0 0 1 0
  field SFString{"plain", "fast"} kind "plain"
  field SFString name "cart"
  field SFString controller "void"
  field SFBool supervisor FALSE
  unconnectedField SFFloat unused 3
  field SFFloat maxVelocity 10
  field MFNode{Pose{}, GPS{}} extensionSlot [ GPS { } ]
  hiddenField SFVec2f wheels 0.1 -0.1
]
{
  Robot {
    translation IS translation
    rotation IS rotation
    name IS name
    controller IS controller
    supervisor IS supervisor
    children [
      DEF SLOT Group { children IS extensionSlot }
      CartWheel { place 0 0.1 0 name "left" maxVelocity IS maxVelocity }
      CartWheel { place 0 -0.1 0 name "right" maxVelocity IS maxVelocity }
      Shape { geometry Mesh { url "cart.stl" } }
    ]
    boundingObject Box { size 0.2 0.2 0.1 }
  }
}
"""
WHEEL = """#VRML_SIM R2023b utf8
PROTO CartWheel [
  field SFVec3f place 0 0 0
  field SFString name "wheel"
  field SFFloat maxVelocity 1
]
{
  HingeJoint {
    jointParameters HingeJointParameters { axis 0 1 0 anchor IS place }
    device RotationalMotor { name IS name maxVelocity IS maxVelocity }
    endPoint Solid { translation IS place children Shape { geometry Cylinder { radius 0.05 } } }
  }
}
"""


def write_cart(folder: Path) -> None:
    """The files of the cart."""
    folder.mkdir(parents=True)
    (folder / "Cart.proto").write_text(CART)
    (folder / "CartWheel.proto").write_text(WHEEL)


def world_of(tmp_path: Path, node: str, extern: str = "") -> Path:
    path = tmp_path / "worlds" / "own.wbt"
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"#VRML_SIM R2025a utf8\n{extern}\nWorldInfo {{ basicTimeStep 10 }}\n{node}\n")
    return path


def drive(world: Path) -> InProcessSupervisor:
    """Both wheels at full speed for a second."""
    robot = InProcessSupervisor(world=world)
    for name in ("left", "right"):
        robot.getDevice(name).setPosition(inf)
        robot.getDevice(name).setVelocity(100.0)
    robot.step(1000)
    return robot


@pytest.mark.parametrize("place", ["by EXTERNPROTO", "in protos/", "of Webots", "of old Webots"])
def test_a_robot_of_a_proto_file_drives(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, extern = tmp_path / "webots", ""
    monkeypatch.delenv("WEBOTS_HOME", raising=False)
    if place == "by EXTERNPROTO":
        write_cart(tmp_path / "robots")
        extern = 'EXTERNPROTO "../robots/Cart.proto"'
    elif place == "in protos/":
        write_cart(tmp_path / "protos")
    else:
        write_cart(home / "projects" / "robots" / "cart" / "protos")
        monkeypatch.setenv("WEBOTS_HOME", str(home))
        if place == "of Webots":
            url = "https://raw.githubusercontent.com/cyberbotics/webots/R2025a/projects/robots/cart"
            extern = f'EXTERNPROTO "{url}/protos/Cart.proto"'
    robot = drive(world_of(tmp_path, 'Cart { name "mine" maxVelocity 4 supervisor TRUE }', extern))
    assert robot.getName() == "mine"
    assert robot.simulation.robot("mine").position[0] == pytest.approx(4.0 * 0.05)
    assert robot.simulation.console == [
        "WARNING: own.wbt, line 4: the stand-in has no Mesh nodes; this one is left out."
    ]
    node = robot.getSelf()
    assert (node.getTypeName(), node.getBaseTypeName()) == ("Cart", "Robot")
    assert node.getField("wheels") is None  # it is hidden
    unused = node.getField("unused")
    assert unused is not None and unused.value == 3.0
    assert robot.getFromDef("SLOT") is None  # what is inside is not found from outside


def test_what_a_world_puts_into_a_slot_stands_there_once(tmp_path: Path) -> None:
    write_cart(tmp_path / "protos")
    slot = 'extensionSlot [ DEF MINE Pose { translation 0 0 1 children GPS { name "top" } } ]'
    robot = InProcessSupervisor(world=world_of(tmp_path, f"Cart {{ supervisor TRUE {slot} }}"))
    assert [*robot.devices] == ["top", "left", "right"]
    assert robot.getNumberOfDevices() == 3
    gps = robot.getDevice("top")
    gps.enable(10)
    robot.step(10)
    assert gps.getValues() == pytest.approx([0.0, 0.0, 1.05])
    assert robot.getFromDef("MINE") is not None
    assert "DEF MINE Pose" in robot.getSelf().exportString()


def test_two_of_a_kind_share_nothing(tmp_path: Path) -> None:
    write_cart(tmp_path / "protos")
    simulation = InProcessSimulation(
        world_of(tmp_path, 'Cart { name "a" } Cart { name "b" translation 0 5 0 }')
    )
    one, other = (InProcessSupervisor(name, world=simulation) for name in ("a", "b"))
    for robot in (one, other):
        assert [*robot.devices] == ["gps", "left", "right"]
        robot.getDevice("gps").enable(10)
    for _ in range(2):
        one.step(10)
        other.step(10)
    assert one.getDevice("gps").getValues() != other.getDevice("gps").getValues()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("#VRML_SIM R2025a utf8\nPROTO Odd [ ] { %< if (1) { >% Robot { } %< } >% }", "a template"),
        ("#VRML_SIM R2021b utf8\nPROTO Odd [ ] { Robot { } }", "PROTO files of R2021 have other"),
        ("#VRML_SIM R2025a utf8\nRobot { }", "there is no PROTO definition"),
        ("#VRML_SIM R2025a utf8\nPROTO Odd [ ] { Hologram { } }", "made of a Hologram node"),
        ("#VRML_SIM R2025a utf8\nPROTO Odd [ ] { Odd { } }", "made of a Odd node"),
        ("#VRML_SIM R2025a utf8\nPROTO Odd [ field", "ends in the middle"),
    ],
)
def test_a_proto_file_that_cannot_be_used_says_why(text: str, why: str, tmp_path: Path) -> None:
    (tmp_path / "protos").mkdir()
    (tmp_path / "protos" / "Odd.proto").write_text(text)
    world = world_of(tmp_path, 'Odd { controller "x" }')
    with pytest.raises(WorldError, match=rf"no Odd nodes \(Odd\.proto: .*{why}"):
        InProcessSimulation(world)


def test_an_error_in_a_body_names_the_file_and_the_node(tmp_path: Path) -> None:
    (tmp_path / "protos").mkdir()
    file = tmp_path / "protos" / "Odd.proto"
    file.write_text("#VRML_SIM R2025a utf8\nPROTO Odd [ ]\n{ Solid { name IS nothing } }")
    with pytest.raises(WorldError, match=r"line 4: Odd\.proto: line 3: the PROTO has no field no"):
        load_world(world_of(tmp_path, "Odd { }"))
    file.write_text("#VRML_SIM R2025a utf8\nPROTO Odd [ ]\n{ Solid { children Odd { } } }")
    with pytest.raises(WorldError, match=r"one in the other|hold each other"):
        load_world(world_of(tmp_path, "Odd { }"))
