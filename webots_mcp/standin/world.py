"""A world: the scene tree with typed fields, read from a .wbt file."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, cast

from webots_mcp.standin.errors import WorldError
from webots_mcp.standin.frame import Frame, frame_of
from webots_mcp.standin.nodes import NODE_TYPES, NUMBERS_IN, FieldDefinition
from webots_mcp.standin.vrml import Node, Value, parse


class World:
    """The scene tree of one world file.

    After loading, every node has all fields that its type has, as Python values: `float`, `int`,
    `bool`, `str`, a list of floats for vectors, rotations and colors, a `Node` or None, and lists
    of those for MF fields.
    """

    def __init__(self, path: Path, top: list[Node]) -> None:
        self.path = path
        self.root = Node("Group", "", 1, {"children": [*top]})
        self.nodes: list[Node] = []
        """Every node once, in the order of the scene tree; a node's id is its index here."""
        self._ids: dict[Node, int] = {}
        self._parents: dict[Node, Node] = {}
        self._register(self.root, None)
        info = next((node for node in top if node.type_name == "WorldInfo"), None)
        if info is None:
            raise WorldError("the world has no WorldInfo node", 1)
        self.info = info
        self.basic_time_step_ms: float = info.fields["basicTimeStep"]
        if self.basic_time_step_ms <= 0:
            raise WorldError("basicTimeStep has to be positive", info.line)

    def _register(self, node: Node, parent: Node | None) -> None:
        if node in self._ids:  # a USE: stands where its DEF stands
            return
        _give_types(node)
        self._ids[node] = len(self.nodes)
        self.nodes.append(node)
        if parent is not None:
            self._parents[node] = parent
        for child in children_of(node):
            self._register(child, node)

    @property
    def title(self) -> str:
        """The title that WorldInfo gives, empty if none."""
        return str(self.info.fields["title"])

    def id_of(self, node: Node) -> int:
        """The number that a controller knows the node by."""
        return self._ids[node]

    def parent_of(self, node: Node) -> Node | None:
        """The node around this one; None for the root."""
        return self._parents.get(node)

    def of_type(self, type_name: str) -> list[Node]:
        """All nodes of one type, in the order of the scene tree."""
        return [node for node in self.nodes if node.type_name == type_name]

    def find(self, def_path: str) -> Node | None:
        """The node with this DEF name; `A.B` is the B somewhere inside A."""
        found: Node | None = self.root
        for name in def_path.split("."):
            found = next((n for n in descendants_of(found) if n.def_name == name), None)
            if found is None:
                return None
        return found

    def frame_of(self, node: Node) -> Frame | None:
        """Where a node stands in the world; None for nodes that have no place of their own."""
        if "rotation" not in node.fields:
            return None
        frame = own_frame(node)
        while (parent := self._parents.get(node)) is not None:
            frame = own_frame(parent).then(frame)
            node = parent
        return frame


def load_world(path: str | Path) -> World:
    """Read a .wbt file.

    Raises:
        WorldError: The file is missing, not text, or not a world that the stand-in can use.
    """
    path = Path(path).resolve()
    try:
        return World(path, parse(path.read_text(encoding="utf-8")))
    except WorldError as error:
        raise WorldError(f"{path.name}: {error}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise WorldError(f"cannot read the world {path}: {error}") from error


def own_frame(node: Node) -> Frame:
    """Where a node stands in its parent; nodes without a place do not move what is inside."""
    if "rotation" not in node.fields:
        return Frame()
    return frame_of(node.fields["translation"], node.fields["rotation"])


def children_of(node: Node) -> Iterator[Node]:
    """The nodes in the fields of a node, in the order of the file."""
    for value in node.fields.values():
        if isinstance(value, Node):
            yield value
        elif isinstance(value, list):
            items = cast("list[Any]", value)
            yield from (item for item in items if isinstance(item, Node))


def descendants_of(node: Node) -> Iterator[Node]:
    """Everything inside a node, from the top of the file to the bottom."""
    for child in children_of(node):
        yield child
        yield from descendants_of(child)


def _give_types(node: Node) -> None:
    definitions = NODE_TYPES.get(node.type_name)
    if definitions is None:
        raise WorldError(
            f"the stand-in does not know {node.type_name} nodes; it knows {', '.join(NODE_TYPES)}",
            node.line,
        )
    written = node.fields
    node.fields = {}
    for name, definition in definitions.items():
        value = written[name] if name in written else deepcopy(definition.default)
        node.fields[name] = _typed(value, name, definition, node)


def _typed(value: Value, name: str, definition: FieldDefinition, node: Node) -> Value:
    many, kind = definition.type_name[:2] == "MF", definition.type_name[2:]
    try:
        if not many:
            return _single(value, kind)
        if kind in ("String", "Node"):
            values: list[Any] = value if isinstance(value, list) else [value]
            return [_single(item, kind) for item in values]
        return _several_numbers(value, kind)
    except (TypeError, ValueError):
        raise WorldError(
            f"{node.type_name}.{name} has to be {definition.type_name}, not {_shown(value)}",
            node.line,
        ) from None


def _single(value: Value, kind: str) -> Any:
    if kind in ("Bool", "String", "Node"):
        expected = {"Bool": bool, "String": str, "Node": (Node, type(None))}[kind]
        if not isinstance(value, expected):
            raise TypeError(kind)
        return value
    numbers = _numbers(value)
    if len(numbers) != NUMBERS_IN.get(kind, 1):
        raise ValueError(kind)
    if kind in NUMBERS_IN:
        return numbers
    return int(numbers[0]) if kind == "Int32" else numbers[0]


def _several_numbers(value: Value, kind: str) -> Value:
    numbers = _numbers(value)
    size = NUMBERS_IN.get(kind, 1)
    if len(numbers) % size:
        raise ValueError(kind)
    if size == 1:
        return numbers
    return [numbers[i : i + size] for i in range(0, len(numbers), size)]


def _numbers(value: Value) -> list[float]:
    if not isinstance(value, list) or not all(isinstance(item, float) for item in value):
        raise TypeError("numbers")
    return [*cast("list[float]", value)]


def _shown(value: Value) -> str:
    return f"a {value.type_name} node" if isinstance(value, Node) else repr(value)
