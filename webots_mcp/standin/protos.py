"""PROTO nodes: where their definitions come from, and the nodes that they are built of.

The PROTO nodes that most worlds have are built in, with the sizes and defaults of Webots and
without its meshes (`data/*.proto`). All others are read from files: those that the world names
by EXTERNPROTO, those in `protos/` of its project, and those of the Webots that WEBOTS_HOME names.
Files that are templates in JavaScript are not read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from math import cos, pi, sin, tan
from pathlib import Path
from typing import Any, Final

from webots_mcp.standin.node_types import DATA, NODE_TYPES
from webots_mcp.standin.standin_errors import WorldError
from webots_mcp.worlds.proto_files import ProtoFiles
from webots_mcp.worlds.vrml import (
    FieldDefinition,
    Parser,
    Token,
    WorldNode,
    give_types,
    require_release,
)
from webots_mcp.worlds.world_errors import WorldFileError

BUILT_IN: Final = sorted(file.stem for file in DATA.glob("*.proto"))


@dataclass(frozen=True)
class Proto:
    """The definition of a PROTO node."""

    file: Path
    fields: Mapping[str, FieldDefinition]
    body: Sequence[Token]

    @property
    def base_type(self) -> str:
        """Return the type of its base node."""
        words = [token.text for token in self.body[:3]]
        return words[2] if words[0] == "DEF" else words[0]

    @property
    def visible(self) -> dict[str, FieldDefinition]:
        """Return the fields that a world can set and a supervisor can see."""
        return {name: each for name, each in self.fields.items() if not each.is_hidden}


class Protos:
    """The PROTO nodes that a world can use."""

    def __init__(self, world: Path, urls: Mapping[str, str]) -> None:
        self._files = ProtoFiles(world, urls)
        self._known: dict[str, Proto | None] = {}
        self.why_not: dict[str, str] = {}
        """Why the file of a PROTO cannot be used, by its name."""

    @property
    def urls(self) -> dict[str, str]:
        """URLs of PROTOs by name, from EXTERNPROTO."""
        return self._files.urls

    def find(self, name: str) -> Proto | None:
        """Return the definition of a PROTO; None if there is none that the stand-in can use."""
        if name not in self._known:
            self._known[name] = None  # Ends the search if its base node is itself.
            self._known[name] = self._read(name)
        return self._known[name]

    def _read(self, name: str) -> Proto | None:
        file = self._file_of(name)
        if file is None:
            return None
        try:
            text = file.read_text(encoding="utf-8")
            require_release(text, "PROTO file")
            if re.search(r"%[<{]", text):
                raise WorldError("it is a template in JavaScript")
            parser = Parser(text)
            _, fields, body = parser.proto()
        except (OSError, ValueError, WorldFileError) as error:
            self.why_not[name] = f"{file.name}: {error}"
            return None
        self._files.note(parser.urls, file.parent)
        proto = Proto(file, fields, body)
        if proto.base_type in NODE_TYPES or self.find(proto.base_type):
            return proto
        self.why_not[name] = f"{file.name}: it is made of a {proto.base_type} node"
        return None

    def _file_of(self, name: str) -> Path | None:
        return DATA / f"{name}.proto" if name in BUILT_IN else self._files.file_of(name)

    def build(self, node: WorldNode) -> None:
        """Build a PROTO node: give it its own fields and the fields of its base node.

        Raises:
            WorldError: A field has a value of the wrong type, or the body cannot be parsed.
        """
        proto = self.find(node.type_name)
        assert proto is not None
        give_types(node, proto.visible)
        own = {name: each.default for name, each in proto.fields.items() if each.is_hidden}
        derive = _DERIVED.get(node.type_name) if proto.file.parent == DATA else None
        given = deepcopy(own) | node.fields | (derive(node.fields) if derive else {})
        try:
            (base,) = Parser(proto.body, given, node.line).nodes()
        except (WorldFileError, ValueError) as error:
            raise WorldError(f"{proto.file.name}: {error}", node.line) from None
        if base.type_name in NODE_TYPES:
            give_types(base, NODE_TYPES[base.type_name])
        else:
            self.build(base)
        node.parameters = frozenset(node.fields.keys() - base.fields.keys()) | base.parameters
        node.fields = node.fields | base.fields
        node.proto_name, node.type_name = node.type_name, base.type_name

    def visible_fields(self, node: WorldNode) -> Mapping[str, FieldDefinition]:
        """Return the fields of a node that a supervisor can see; of a PROTO node its own."""
        proto = self.find(node.proto_name) if node.proto_name else None
        return proto.visible if proto else NODE_TYPES[node.type_name]


def _e_puck(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of an E-puck that depend on its version."""
    is_second = fields["version"] == "2"
    return {
        "maxVelocity": 7.536 if is_second else 6.28,
        "mass": 0.13 if is_second else 0.15,
        "model": f"GCtronic e-puck{'2' if is_second else ''}",
    }


def _loose_box(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the physics of a box: none if its mass is 0."""
    physics = WorldNode("Physics", "", 0, {"density": [-1.0], "mass": [fields["mass"]]})
    return {"physics": physics if fields["mass"] > 0.0 else None}


def _rectangle_arena(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return positions and sizes of the four walls."""
    (x, y), thickness, height = fields["floorSize"], fields["wallThickness"], fields["wallHeight"]
    east, north, z = (x + thickness) / 2.0, (y + thickness) / 2.0, height / 2.0
    return {
        **{"east": [east, 0.0, z], "west": [-east, 0.0, z]},
        **{"north": [0.0, north, z], "south": [0.0, -north, z]},
        **{"alongX": [x + 2.0 * thickness, thickness, height], "alongY": [thickness, y, height]},
    }


def _circle_arena(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the walls of a circular arena, one for each subdivision."""
    radius, thickness, height = fields["radius"], fields["wallThickness"], fields["wallHeight"]
    count = max(fields["subdivision"], 8)
    middle_m = radius + thickness / 2.0
    length_m = 2.0 * (radius + thickness) * tan(pi / count)
    walls: list[WorldNode] = []
    for angle in (2.0 * pi * i / count for i in range(count)):
        place = [middle_m * cos(angle), middle_m * sin(angle), height / 2.0]
        wall: dict[str, Any] = {"translation": place, "rotation": [0.0, 0.0, 1.0, angle]}
        wall |= {"size": [thickness, length_m, height], "name": "wall"}
        wall["appearance"] = fields["wallAppearance"]
        walls.append(WorldNode("SolidBox", "", 0, wall))
    return {"floorSize": [2.0 * radius, 2.0 * radius], "walls": walls}


_DERIVED: Final[dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]]] = {
    "CardboardBox": _loose_box,
    "CircleArena": _circle_arena,
    "E-puck": _e_puck,
    "RectangleArena": _rectangle_arena,
    "Wall": lambda fields: {"middle": [0.0, 0.0, fields["size"][2] / 2.0]},
    "WoodenBox": _loose_box,
    "Youbot": lambda fields: {} if fields["numberOfArms"] else {"arm": []},
}
"""Functions that compute values of built-in PROTO nodes from their fields."""
