"""A world: the scene tree with typed fields, read from a .wbt file and written as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, cast

from webots_mcp.standin.node_types import NODE_TYPES
from webots_mcp.standin.protos import Protos
from webots_mcp.standin.standin_errors import WorldError
from webots_mcp.worlds.frames import CoordinateFrame, frame_of
from webots_mcp.worlds.vrml import (
    Parser,
    WorldNode,
    children_of,
    descendants_of,
    give_types,
    require_release,
)
from webots_mcp.worlds.world_errors import WorldFileError

_NAME_OF_MISSING: Final = {
    **{"Altimeter": "altimeter", "Brake": "brake", "Connector": "connector", "Pen": "pen"},
    **{"Display": "display", "Radar": "radar", "RangeFinder": "range-finder", "Skin": "skin"},
    **{"Speaker": "speaker", "VacuumGripper": "vacuum gripper"},
}
"""Default names of devices that the stand-in does not have, by node type."""
_UNSCALED: Final = [1.0, 1.0, 1.0]
_HEADER: Final = "#VRML_SIM R2023b utf8"


class World:
    """The scene tree of one world file.

    After loading, every node has all fields of its type as Python values: `float`, `int`, `bool`,
    `str`, a list of floats for vectors, rotations and colors, a `WorldNode` or None, and lists of
    those for MF fields.
    """

    def __init__(self, path: Path, top: list[WorldNode], protos: Protos) -> None:
        self.path = path
        self.protos = protos
        self.externproto = [*protos.urls.values()]
        """URLs of the PROTO files that the world itself declares."""
        self.root = WorldNode("Group", "", 1, {"children": [*top]})
        self.nodes: list[WorldNode] = []
        """Every node once, in the order of the scene tree. Nodes that were added come last."""
        self.left_out: list[WorldNode] = []
        """Nodes of the file whose type the stand-in does not know. The world omits them."""
        self._ids: dict[WorldNode, int] = {}
        self._by_id: dict[int, WorldNode] = {}
        self._next_id = 0
        self._parents: dict[WorldNode, WorldNode] = {}
        self._register(self.root, None)
        info = next((node for node in top if node.type_name == "WorldInfo"), None)
        if info is None:
            raise WorldError("the world has no WorldInfo node", 1)
        self.info = info
        self.basic_time_step_ms: float = info.fields["basicTimeStep"]
        if self.basic_time_step_ms <= 0:
            raise WorldError("basicTimeStep has to be positive", info.line)
        if info.fields["coordinateSystem"] != "ENU":
            raise WorldError("the stand-in has no coordinateSystem but ENU", info.line)

    def _register(self, node: WorldNode, parent: WorldNode | None) -> None:
        if node in self._ids:  # A USE stands where its DEF stands.
            return
        if node.type_name in NODE_TYPES:
            give_types(node, NODE_TYPES[node.type_name])
        else:
            self.protos.build(node)
        self._ids[node], self._by_id[self._next_id] = self._next_id, node
        self._next_id += 1
        self.nodes.append(node)
        if parent is not None:
            self._parents[node] = parent
        self._leave_out_unknown(node)
        for child in children_of(node):
            self._register(child, node)

    def _leave_out_unknown(self, node: WorldNode) -> None:
        for child in [*children_of(node)]:
            if not self._is_known(child):
                self._leave_out(child, node)

    def _is_known(self, node: WorldNode) -> bool:
        return node.type_name in NODE_TYPES or self.protos.find(node.type_name) is not None

    def _leave_out(self, child: WorldNode, parent: WorldNode) -> None:
        if child not in self.left_out:
            self.left_out.append(child)
            self._parents[child] = parent
        for name, value in parent.fields.items():
            if value is child:
                parent.fields[name] = None
            elif isinstance(value, list):
                parent.fields[name] = [
                    item for item in cast("list[Any]", value) if item is not child
                ]

    def warnings(self) -> list[str]:
        """Return one warning for each type of node that was left out, and for scaled nodes.

        A warning names the first node of its type in the file.
        """
        by_type: dict[str, list[WorldNode]] = {}
        for node in sorted(self.left_out, key=lambda node: node.line):
            by_type.setdefault(node.type_name, []).append(node)
        lines = [
            f"line {nodes[0].line}: the stand-in has no {type_name} nodes; "
            f"{'this one is' if len(nodes) == 1 else f'these {len(nodes)} are'} left out"
            f"{self.why_not(type_name)}."
            for type_name, nodes in by_type.items()
        ]
        scaled = [node for node in self.nodes if node.fields.get("scale", _UNSCALED) != _UNSCALED]
        if scaled:
            lines.append(
                f"line {scaled[0].line}: the stand-in scales nothing: what is in this "
                "Transform keeps its size."
            )
        return [f"WARNING: {self.path.name}, {line}" for line in lines]

    def why_not(self, type_name: str) -> str:
        """Return why the file of a PROTO cannot be used, in brackets, or an empty text."""
        why = self.protos.why_not.get(type_name)
        return f" ({why})" if why else ""

    def left_out_in(self, robot: WorldNode) -> dict[str, str]:
        """Return the devices of a robot that the stand-in left out: node types by names."""
        names: dict[str, str] = {}
        for node in self.left_out:
            if any(around is robot for around in self._around(node)):
                for device in (node, *descendants_of(node)):
                    name = device.fields.get("name", _NAME_OF_MISSING.get(device.type_name))
                    if isinstance(name, str):
                        names.setdefault(name, node.type_name)
        return names

    def _around(self, node: WorldNode) -> Iterator[WorldNode]:
        while (parent := self._parents.get(node)) is not None:
            yield parent
            node = parent

    @property
    def title(self) -> str:
        """Return the title in WorldInfo, which may be empty."""
        return str(self.info.fields["title"])

    def id_of(self, node: WorldNode) -> int:
        """Return the number that controllers know the node by."""
        return self._ids[node]

    def node(self, node_id: int) -> WorldNode | None:
        """Return the node with this number; None if it was removed."""
        return self._by_id.get(node_id)

    def add(self, node: WorldNode, parent: WorldNode, name: str, index: int | None) -> list[str]:
        """Put a parsed node into a field, or before one of its entries.

        Returns:
            The types of the nodes in it that the stand-in does not know and left out.

        Raises:
            WorldError: The node's type is unknown, a value in it has the wrong type, or it is or
                contains a robot, perhaps within a PROTO node.
        """
        if not self._is_known(node):
            raise WorldError(f"the stand-in has no {node.type_name} nodes")
        known, left_out = len(self.nodes), len(self.left_out)
        try:
            self._register(node, parent)
            if any(added.type_name == "Robot" for added in self.nodes[known:]):
                raise WorldError("the stand-in adds no robots")
        except WorldFileError:
            self._forget(self.nodes[known:])
            del self.left_out[left_out:]
            raise
        if index is None:
            parent.fields[name] = node
        else:
            parent.fields[name].insert(index, node)
        return [*dict.fromkeys(each.type_name for each in self.left_out[left_out:])]

    def remove(self, node: WorldNode) -> tuple[WorldNode, str] | None:
        """Remove a node from its field.

        Returns:
            The parent and the name of the field; None if the node has no parent.
        """
        parent = self._parents.get(node)
        if parent is None:
            return None
        for name, value in parent.fields.items():
            if value is node:
                parent.fields[name] = None
            elif isinstance(value, list) and any(item is node for item in cast("list[Any]", value)):
                items = cast("list[Any]", value)
                items[:] = [item for item in items if item is not node]
            else:
                continue
            self._forget_all_but_used(node)
            return parent, name
        return None

    def _forget_all_but_used(self, node: WorldNode) -> None:
        """Forget a node and everything in it, except nodes that a USE keeps elsewhere."""
        left = {self.root: None, **dict.fromkeys(descendants_of(self.root))}
        gone = {each for each in (node, *descendants_of(node)) if each not in left}
        self._forget([*gone])
        for parent in left:
            for child in children_of(parent):
                if self._parents.get(child) in gone:
                    self._parents[child] = parent

    def _forget(self, nodes: list[WorldNode]) -> None:
        gone = set(nodes)
        self.nodes = [node for node in self.nodes if node not in gone]
        for node in gone & self._ids.keys():
            del self._by_id[self._ids.pop(node)]
            self._parents.pop(node, None)

    def parent_of(self, node: WorldNode) -> WorldNode | None:
        """Return the parent of a node; None for the root."""
        return self._parents.get(node)

    def of_type(self, type_name: str) -> list[WorldNode]:
        """Return all nodes of one type, in the order of the scene tree."""
        return [node for node in self.nodes if node.type_name == type_name]

    def find(self, def_path: str) -> WorldNode | None:
        """Return the node with this DEF name; `A.B` is the B somewhere inside A."""
        found: WorldNode | None = self.root
        for name in def_path.split("."):
            found = next((n for n in descendants_of(found) if n.def_name == name), None)
            if found is None:
                return None
        return found

    def frame_of(self, node: WorldNode) -> CoordinateFrame | None:
        """Return the pose of a node in the world; None for nodes without a pose."""
        return self.frame_around(node).then(own_frame(node)) if "rotation" in node.fields else None

    def frame_around(self, node: WorldNode) -> CoordinateFrame:
        """Return the pose of a node's parent in the world."""
        frame = CoordinateFrame()
        for parent in self._around(node):
            frame = own_frame(parent).then(frame)
        return frame


def load_world(path: str | Path) -> World:
    """Read a .wbt file.

    Raises:
        WorldError: The file is missing, not text, or not a world that the stand-in can use.
    """
    try:
        path = Path(path).resolve()
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name, or no UTF-8
        raise WorldError(f"cannot read the world {str(path)!r}: {error}") from error
    try:
        require_release(text)
        parser = Parser(text)
        top = parser.nodes()
        return World(path, top, Protos(path, parser.urls))
    except WorldFileError as error:
        raise WorldError(f"{path.name}: {error}") from None
    except RecursionError:
        raise WorldError(f"{path.name}: its PROTO nodes hold each other without an end") from None


def own_frame(node: WorldNode) -> CoordinateFrame:
    """Return the pose of a node in its parent. Nodes without a pose do not move their children."""
    if "rotation" not in node.fields:
        return CoordinateFrame()
    return frame_of(node.fields["translation"], node.fields["rotation"])


HiddenState = Mapping[WorldNode, Mapping[str, Sequence[float]]]
"""The state that Webots saves in hidden fields: by node, numbers by the name of the field."""


def as_text(
    node: WorldNode,
    protos: Protos,
    state: HiddenState,
    written: set[WorldNode] | None = None,
) -> str:
    """Return a node and everything in it as in a world file, without fields that have defaults.

    Args:
        node: The node.
        protos: The PROTO nodes of its world.
        state: What is written in hidden fields.
        written: Nodes that the same file holds already, which are added to.
    """
    return _NodeWriter(protos, state, set() if written is None else written).node(node)


def world_text(world: World, state: HiddenState) -> str:
    """Return a world as a world file has it."""
    urls = [f'EXTERNPROTO "{url}"' for url in world.externproto]
    written = set[WorldNode]()
    nodes = [as_text(node, world.protos, state, written) for node in world.root.fields["children"]]
    return "\n".join([_HEADER, *urls, *nodes, ""])


class _NodeWriter:
    def __init__(self, protos: Protos, state: HiddenState, written: set[WorldNode]) -> None:
        self._protos = protos
        self._state = state
        self._written = written

    def node(self, node: WorldNode) -> str:
        if node.def_name and node in self._written:
            return f"USE {node.def_name}"
        self._written.add(node)
        hidden = [
            f"hidden {name} {' '.join(map(repr, numbers))}"
            for name, numbers in self._state.get(node, {}).items()
        ]
        fields = [
            f"{name} {self._value(node.fields[name], definition.type_name[2:])}"
            for name, definition in self._protos.visible_fields(node).items()
            if node.fields[name] != _typed_default(definition.default, definition.type_name)
        ]
        name = f"DEF {node.def_name} " if node.def_name else ""
        return f"{name}{node.proto_name or node.type_name} {{ {' '.join([*hidden, *fields])} }}"

    def _value(self, value: Any, kind: str) -> str:
        if isinstance(value, WorldNode):
            return self.node(value)
        if isinstance(value, str):
            quoted = value.replace("\\", "\\\\").replace('"', '\\"')
            return f'"{quoted}"'
        if value is None or isinstance(value, bool):
            return {None: "NULL", True: "TRUE", False: "FALSE"}[value]
        if not isinstance(value, list):
            return repr(value).removesuffix(".0")
        values = cast("list[Any]", value)
        texts = [self._value(each, kind) for each in values]
        is_single = kind in ("Vec2f", "Vec3f", "Rotation", "Color") and all(
            isinstance(each, float) for each in values
        )
        return " ".join(texts) if is_single else f"[ {' '.join(texts)} ]"


def _typed_default(default: Any, type_name: str) -> object:
    """Return a parsed default with its type; the parser gives numbers as lists."""
    if isinstance(default, list) and type_name in ("SFFloat", "SFInt32"):
        return cast("list[float]", default)[0]
    return cast("object", default)
