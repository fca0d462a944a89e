"""PROTO nodes that most worlds have: what they are made of.

Sizes and defaults are those of Webots; how they look is left out. Other PROTO nodes are not known
here, not even those of a project: their files are not read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import cos, pi, sin, tan
from typing import Any, Final

from webots_mcp.standin.vrml import (
    NODE_TYPES,
    FieldDefinition,
    Node,
    Parser,
    definitions_in,
    descendants_of,
    give_types,
)

# The e-puck: the sizes, places and lookup tables of Webots' PROTO, as boxes and cylinders.


E_PUCK: Final = """
E-puck {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  SFString name "e-puck"
  SFString controller "e-puck_avoid_obstacles"  MFString controllerArgs []
  SFString window "e-puck"  SFString customData ""  SFBool supervisor FALSE
  SFBool synchronization TRUE  MFFloat battery []  SFString version "1"
  SFFloat camera_fieldOfView 0.84  SFInt32 camera_width 52  SFInt32 camera_height 39
  SFBool camera_antiAliasing FALSE  SFRotation camera_rotation 0 0 1 0  SFFloat camera_noise 0
  SFFloat camera_motionBlur 0  SFInt32 distance_sensor_numberOfRays 1
  SFInt32 emitter_channel 1  SFInt32 receiver_channel 1  MFNode turretSlot []
  MFNode groundSensorsSlot []  SFBool kinematic FALSE
}
"""
"""The fields of the PROTO."""

_WHEELS: Final = (("left", 0.026), ("right", -0.026))
_EYES: Final = (  # ahead and to the left, metres; heading, radians
    *((0.03, -0.01, -0.30), (0.022, -0.025, -0.80), (0.0, -0.031, -1.571)),
    *((-0.03, -0.015, -2.64), (-0.03, 0.015, 2.64), (0.0, 0.031, 1.571)),
    *((0.022, 0.025, 0.80), (0.03, 0.01, 0.30)),
)
_PROXIMITY: Final = """0 4095 0.002 0.005 2133.33 0.003 0.01 1465.73 0.007 0.015 601.46 0.0406
    0.02 383.84 0.01472 0.03 234.93 0.0241 0.04 158.03 0.0287 0.05 120 0.04225
    0.06 104.09 0.03065 0.07 67.19 0.04897"""


def e_puck(fields: Mapping[str, Any]) -> str:
    """What an e-puck is made of, written as in a world file, from its fields."""
    is_second = fields["version"] == "2"
    max_radps, mass_kg = (7.536, 0.13) if is_second else (6.28, 0.15)
    rotation = " ".join(map(str, fields["camera_rotation"]))
    wheels = " ".join(_wheel(side, left_m, max_radps) for side, left_m in _WHEELS)
    eyes = " ".join(_eye(number, *place) for number, place in enumerate(_EYES))
    lamps = " ".join(f'LED {{ name "led{number}" }}' for number in range(10))
    return f"""Robot {{ children [ {wheels} {eyes} {lamps}
        Camera {{ translation 0.03 0 0.028 rotation {rotation} near 0.0055 zoom Zoom {{ }}
          fieldOfView {fields["camera_fieldOfView"]}
          width {fields["camera_width"]} height {fields["camera_height"]} }}
        Accelerometer {{ lookupTable [ -100 -100 0.003 100 100 0.003 ] }}
        Gyro {{ lookupTable [ -13.315805 -100000 0.003 13.315805 100000 0.003 ] }}
        Receiver {{ channel {fields["receiver_channel"]} }}
        Emitter {{ channel {fields["emitter_channel"]} }} Speaker {{ }}
        DEF turretSlot Pose {{ translation -0.0095 0 0.0486 }}
        DEF groundSensorsSlot Pose {{ translation 0.03 0 0.0003 }}
        Pose {{ translation 0 0 0.025 children Shape {{
          appearance PBRAppearance {{ baseColor 0.18 0.64 0.18 }}
          geometry Cylinder {{ height 0.045 radius 0.037 }} }} }}
      ]
      model "GCtronic e-puck{"2" if is_second else ""}"
      boundingObject Pose {{
        translation 0 0 0.025 children Cylinder {{ height 0.045 radius 0.037 }} }}
      physics Physics {{ density -1 mass {mass_kg} }} }}"""


def _wheel(side: str, left_m: float, max_radps: float) -> str:
    return f"""HingeJoint {{
        jointParameters HingeJointParameters {{ axis 0 1 0 anchor 0 0 0.02 }}
        device [
          RotationalMotor {{ name "{side} wheel motor" maxVelocity {max_radps} }}
          PositionSensor {{ name "{side} wheel sensor" resolution 0.00628 }} ]
        endPoint Solid {{ translation 0 {left_m} 0.02 name "{side} wheel"
          boundingObject Pose {{
            rotation 1 0 0 1.570796 children Cylinder {{ height 0.005 radius 0.02 }} }}
          physics Physics {{ density -1 mass 0.005 }} }} }}"""


def _eye(number: int, ahead_m: float, left_m: float, heading_rad: float) -> str:
    turned = f"rotation 0 0 1 {heading_rad}"
    return f"""DistanceSensor {{ translation {ahead_m} {left_m} 0.033 {turned} name "ps{number}"
        lookupTable [ {_PROXIMITY} ] type "infra-red" aperture 0.1 }}
      LightSensor {{ translation {ahead_m} {left_m} 0.0329 {turned} name "ls{number}"
        lookupTable [ 1 4095 0.01 2 0 0.01 ] }}"""


# The youBot: where its wheels and joints are and how far they turn, as boxes and cylinders.
#
# Its wheels drive ahead and turn; they do not drive sideways as Mecanum wheels do. What the arm and
# the fingers hold is not modelled: they move, and touch nothing.


YOUBOT: Final = """
Youbot {
  SFVec3f translation 0 0 0.102  SFRotation rotation 0 0 1 0  SFString name "youBot"
  SFString controller "youbot"  MFString controllerArgs []  SFString window "<generic>"
  SFString customData ""  SFBool supervisor FALSE  SFBool synchronization TRUE
  MFNode bodySlot []  SFInt32 numberOfArms 1
}
"""
"""The fields of the PROTO."""

_WHEELS_youbot: Final = ((0.228, -0.158), (0.228, 0.158), (-0.228, -0.158), (-0.228, 0.158))
_ARM: Final = (  # axis, anchor in metres from the joint before, lowest and highest angle
    ("0 0 1", "0 0 0.077", -2.9496, 2.9496),
    ("0 -1 0", "0.033 0 0.07", -1.13446, 1.5708),
    ("0 -1 0", "0 0 0.155", -2.63545, 2.54818),
    ("0 -1 0", "0 0 0.135", -1.78024, 1.78024),
    ("0 0 1", "0 0 0.081", -2.92343, 2.92343),
)


def youbot(fields: Mapping[str, Any]) -> str:
    """What a youBot is made of, written as in a world file, from its fields."""
    wheels = " ".join(
        _wheel_youbot(number, *place) for number, place in enumerate(_WHEELS_youbot, 1)
    )
    arm = f'Solid {{ translation 0.156 0 0 name "arm" children {_arm()} }}'
    return f"""Robot {{ children [ {wheels}
        {arm if fields["numberOfArms"] else ""}
        DEF bodySlot Group {{ }}
        Pose {{ translation 0 0 -0.02 children Shape {{
          appearance PBRAppearance {{ baseColor 0.95 0.5 0.1 }}
          geometry Box {{ size 0.58 0.38 0.08 }} }} }}
      ]
      model "KUKA youBot"
      boundingObject Pose {{
        translation 0 0 -0.045 children Box {{ size 0.56 0.34 0.09 }} }}
      physics Physics {{ density -1 mass 22 }} }}"""


def _wheel_youbot(number: int, ahead_m: float, left_m: float) -> str:
    place = f"{ahead_m} {left_m} -0.055"
    return f"""HingeJoint {{
        jointParameters HingeJointParameters {{ axis 0 1 0 anchor {place} }}
        device [
          RotationalMotor {{ name "wheel{number}" maxVelocity 14.81 }}
          PositionSensor {{ name "wheel{number}sensor" }} ]
        endPoint Solid {{ translation {place} name "wheel{number}"
          boundingObject Pose {{
            rotation 1 0 0 1.570796 children Cylinder {{ height 0.05 radius 0.05 }} }}
          physics Physics {{ density -1 mass 1.4 }} }} }}"""


def _arm(number: int = 1) -> str:
    """The joint `number` and all behind it; the last carries the two fingers."""
    axis, anchor, low_rad, high_rad = _ARM[number - 1]
    behind = _arm(number + 1) if number < len(_ARM) else f"[ {_finger('left')} {_finger('right')} ]"
    return f"""HingeJoint {{
        jointParameters HingeJointParameters {{ axis {axis} anchor {anchor} }}
        device [
          RotationalMotor {{ name "arm{number}" maxVelocity 1.5708
            minPosition {low_rad} maxPosition {high_rad} }}
          PositionSensor {{ name "arm{number}sensor" }} ]
        endPoint Solid {{ translation {anchor} name "arm{number}" children {behind} }} }}"""


def _finger(side: str) -> str:
    axis = "0 1 0" if side == "left" else "0 -1 0"
    return f"""SliderJoint {{
        jointParameters JointParameters {{ axis {axis} }}
        device [
          LinearMotor {{ name "finger::{side}" minPosition 0 maxPosition 0.025 }}
          PositionSensor {{ name "finger::{side}sensor" }} ]
        endPoint Solid {{ translation 0 0 0.09 name "finger {side}" }} }}"""


_DEFINITIONS: Final = definitions_in(
    E_PUCK
    + YOUBOT
    + """
CircleArena {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  SFString name "circle arena"
  SFFloat radius 1  SFString contactMaterial "default"  SFNode floorAppearance NULL
  SFVec2f floorTileSize 0.5 0.5  SFFloat wallThickness 0.01  SFFloat wallHeight 0.1
  SFNode wallAppearance NULL  SFInt32 subdivision 48
}
Floor {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  SFString name "floor"
  SFString contactMaterial "default"  SFVec2f size 10 10  SFVec2f tileSize 0.5 0.5
  SFNode appearance NULL
}
RectangleArena {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  SFString name "rectangle arena"
  SFString contactMaterial "default"  SFVec2f floorSize 1 1  SFVec2f floorTileSize 0.5 0.5
  SFNode floorAppearance NULL  SFFloat wallThickness 0.01  SFFloat wallHeight 0.1
  SFNode wallAppearance NULL
}
SolidBox {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  SFString name "box"
  SFVec3f size 2 2 2  SFString contactMaterial "default"  SFNode appearance NULL
  SFNode physics NULL
}
Wall {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  SFString name "wall"
  SFVec3f size 0.5 5 2.4  SFNode appearance NULL
}
WoodenBox {
  SFVec3f translation 0 0 0.3  SFRotation rotation 0 0 1 0  SFString name "wooden box"
  SFVec3f size 0.6 0.6 0.6  SFFloat mass 0  SFBool locked FALSE
}
CardboardBox {
  SFVec3f translation 0 0 0.3  SFRotation rotation 0 0 1 0  SFString name "cardboard box"
  SFVec3f size 0.6 0.6 0.6  SFFloat mass 0  SFBool locked FALSE
}
"""
)


def _floor(fields: Mapping[str, Any]) -> str:
    x, y = fields["size"]
    plane = f"geometry Plane {{ size {x} {y} }}"
    return f"""Solid {{
        children Shape {{ appearance PBRAppearance {{ baseColor 0.75 0.72 0.65 }} {plane} }}
        boundingObject Plane {{ size {x} {y} }} }}"""


def _rectangle_arena(fields: Mapping[str, Any]) -> str:
    (x, y), thickness, height = fields["floorSize"], fields["wallThickness"], fields["wallHeight"]
    east, north, z = (x + thickness) / 2.0, (y + thickness) / 2.0, height / 2.0
    along_x, along_y = f"{x + 2.0 * thickness} {thickness}", f"{thickness} {y}"
    walls = ((east, 0.0, along_y), (-east, 0.0, along_y), (0.0, north, along_x))
    looks = f'{_look(fields["wallAppearance"])} name "wall"'
    boxes = " ".join(
        f"SolidBox {{ translation {at_x} {at_y} {z} size {size} {height} {looks} }}"
        for at_x, at_y, size in (*walls, (0.0, -north, along_x))
    )
    floor = f"Floor {{ size {x} {y} {_look(fields['floorAppearance'])} }}"
    return f"Solid {{ children [ {floor} {boxes} ] }}"


def _circle_arena(fields: Mapping[str, Any]) -> str:
    radius, thickness, height = fields["radius"], fields["wallThickness"], fields["wallHeight"]
    count = max(fields["subdivision"], 8)
    middle_m, z = radius + thickness / 2.0, height / 2.0
    length_m = 2.0 * (radius + thickness) * tan(pi / count)
    look = f'{_look(fields["wallAppearance"])} name "wall"'
    boxes = " ".join(
        f"SolidBox {{ translation {middle_m * cos(angle)} {middle_m * sin(angle)} {z} "
        f"rotation 0 0 1 {angle} size {thickness} {length_m} {height} {look} }}"
        for angle in (2.0 * pi * i / count for i in range(count))
    )
    floor = f"Floor {{ size {2 * radius} {2 * radius} {_look(fields['floorAppearance'])} }}"
    return f"Solid {{ children [ {floor} {boxes} ] }}"


def _look(appearance: Node | None) -> str:
    """An appearance of the same color, if it says which."""
    color: list[float] | None = appearance.fields.get("baseColor") if appearance else None
    numbers = " ".join(map(str, color or ()))
    return f"appearance PBRAppearance {{ baseColor {numbers} }}" if numbers else ""


def _box(fields: Mapping[str, Any], color: str, middle_z_m: float = 0.0) -> str:
    x, y, z = fields["size"]
    look = f"appearance PBRAppearance {{ baseColor {color} }}"
    mass_kg: float = fields.get("mass", 0.0)
    physics = f"physics Physics {{ density -1 mass {mass_kg} }}" if mass_kg > 0.0 else ""
    pose, box = f"Pose {{ translation 0 0 {middle_z_m} children", f"Box {{ size {x} {y} {z} }}"
    return f"""Solid {{
        children {pose} Shape {{ {look} geometry {box} }} }}
        boundingObject {pose} {box} }} {physics} }}"""


PROTOS: Final[dict[str, Callable[[Mapping[str, Any]], str]]] = {
    "CircleArena": _circle_arena,
    "Floor": _floor,
    "RectangleArena": _rectangle_arena,
    "SolidBox": lambda fields: _box(fields, "0.6 0.6 0.6"),
    "Wall": lambda fields: _box(fields, "0.8 0.8 0.75", middle_z_m=fields["size"][2] / 2.0),
    "WoodenBox": lambda fields: _box(fields, "0.6 0.45 0.3"),
    "E-puck": e_puck,
    "Youbot": youbot,
    "CardboardBox": lambda fields: _box(fields, "0.7 0.55 0.4"),
}
"""What a PROTO node is made of, written as in a world file, by its name and from its fields."""


def build(node: Node) -> None:
    """Make a PROTO node what it stands for; its own fields and those of its base node are there.

    Raises:
        WorldError: A field has a value of another type.
    """
    give_types(node, _DEFINITIONS[node.type_name])
    (base,) = Parser(PROTOS[node.type_name](node.fields)).nodes()
    give_types(base, NODE_TYPES[base.type_name])
    for part in [*descendants_of(base)]:
        part.line = node.line
        if part.def_name in node.fields:  # a slot: what the world puts in stands there
            part.fields["children"], node.fields[part.def_name] = node.fields[part.def_name], []
        part.def_name = ""  # what is inside a PROTO node cannot be found from outside
    node.fields = {**node.fields, **base.fields, **node.fields}  # its own colors come first
    node.proto_name, node.type_name = node.type_name, base.type_name


def shown_definitions(node: Node) -> Mapping[str, FieldDefinition]:
    """The fields that a supervisor sees of a node: of a PROTO node its own."""
    return _DEFINITIONS[node.proto_name] if node.proto_name else NODE_TYPES[node.type_name]
