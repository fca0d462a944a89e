"""PROTO nodes that most worlds have: what they are made of.

Sizes and defaults are those of Webots; how they look is left out. Other PROTO nodes are not known
here, not even those of a project: their files are not read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import cos, pi, sin, tan
from typing import Any, Final

from webots_mcp.standin.e_puck import E_PUCK, e_puck
from webots_mcp.standin.nodes import NODE_TYPES, FieldDefinition, definitions_in
from webots_mcp.standin.typed_fields import give_types
from webots_mcp.standin.vrml import Node, Parser, descendants_of
from webots_mcp.standin.youbot import YOUBOT, youbot

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
