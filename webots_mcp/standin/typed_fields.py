"""From fields as they are written to values of the types that a node's type asks for."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any, cast

from webots_mcp.standin.nodes import NUMBERS_IN, FieldDefinition
from webots_mcp.standin.standin_errors import WorldError
from webots_mcp.standin.vrml import Node, Value


def give_types(node: Node, definitions: Mapping[str, FieldDefinition]) -> None:
    """Give a node all fields that its type has, with values of their types.

    Raises:
        WorldError: A value is of another type; names the field and the line.
    """
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
