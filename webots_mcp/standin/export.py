"""Nodes as text, as they would stand in a world file."""

from __future__ import annotations

from typing import Any, cast

from webots_mcp.standin.protos import shown_definitions
from webots_mcp.standin.vrml import Node


def as_text(node: Node) -> str:
    """A node and all in it, without the fields that have their default values."""
    return _node(node, set())


def _node(node: Node, written: set[Node]) -> str:
    if node.def_name and node in written:
        return f"USE {node.def_name}"
    written.add(node)
    fields = [
        f"{name} {_value(node.fields[name], definition.type_name[2:], written)}"
        for name, definition in shown_definitions(node).items()
        if node.fields[name] != _typed_default(definition.default, definition.type_name)
    ]
    name = f"DEF {node.def_name} " if node.def_name else ""
    return f"{name}{node.proto_name or node.type_name} {{ {' '.join(fields)} }}"


def _typed_default(default: Any, type_name: str) -> object:
    """A default as the parser gives it, where numbers are always a list."""
    if isinstance(default, list) and type_name in ("SFFloat", "SFInt32"):
        return cast("list[float]", default)[0]
    return cast("object", default)


def _value(value: Any, kind: str, written: set[Node]) -> str:
    if isinstance(value, Node):
        return _node(value, written)
    if isinstance(value, str):
        quoted = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{quoted}"'
    if value is None or isinstance(value, bool):
        return {None: "NULL", True: "TRUE", False: "FALSE"}[value]
    if not isinstance(value, list):
        return repr(value).removesuffix(".0")
    values = cast("list[Any]", value)
    texts = [_value(each, kind, written) for each in values]
    is_single = kind in ("Vec2f", "Vec3f", "Rotation", "Color") and all(
        isinstance(each, float) for each in values
    )
    return " ".join(texts) if is_single else f"[ {' '.join(texts)} ]"
