"""Schemas of the messages of an MCAP file, as JSON.

Viewers know the schemas called `foxglove.NAME` and draw their messages. The schema of states is
made of the values that the states hold. Foxglove and Lichtblick accept one type per field, and
arrays of one scalar type or of objects; anything else in a schema makes a whole topic unreadable.
What a state holds beyond that is in its messages but not in the schema: viewers show it, but do
not offer to plot it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, cast

FIXED: Final[dict[str, Schema]] = json.loads(
    Path(__file__).with_name("mcap_schemas.json").read_text("utf-8")
)
_SCALARS: Final = {bool: "boolean", int: "number", float: "number", str: "string"}
Schema = dict[str, Any]


def _object(**properties: Schema) -> Schema:
    return {"type": "object", "properties": properties}


@dataclass
class FieldShape:
    """The types of the values of one field, and of the values inside them."""

    types: set[str] = field(default_factory=set[str])
    fields: dict[str, FieldShape] = field(default_factory=dict[str, "FieldShape"])
    items: FieldShape | None = None

    def add(self, value: Any) -> None:
        """Add a value. Null has no type."""
        scalar = _SCALARS.get(cast("type[Any]", type(value)))
        if scalar is not None:
            self.types.add(scalar)
        elif isinstance(value, dict):
            self.types.add("object")
            for name, inner in cast("dict[str, Any]", value).items():
                shape = self.fields.get(name)
                if shape is None:
                    shape = self.fields[name] = FieldShape()
                shape.add(inner)
        elif isinstance(value, list):
            self.types.add("array")
            self.items = self.items or FieldShape()
            self.items.add_items(cast("list[Any]", value))

    def add_items(self, values: list[Any]) -> None:
        """Add the items of an array; of thousands of numbers only their types."""
        kinds = {cast("type[Any]", type(value)) for value in values}
        if kinds.isdisjoint((dict, list)):
            self.types.update(_SCALARS[kind] for kind in kinds & _SCALARS.keys())
        else:
            for value in values:
                self.add(value)

    def schema(self) -> Schema | None:
        """Return the schema; None if viewers cannot read it."""
        if len(self.types) != 1:
            return None
        (name,) = self.types
        if name == "object":
            inner = {key: shape.schema() for key, shape in self.fields.items()}
            return _object(**{key: schema for key, schema in inner.items() if schema is not None})
        if name == "array":
            items = self.items.schema() if self.items else None
            is_readable = items is not None and items["type"] != "array"
            return {"type": "array", "items": items} if is_readable else None
        return {"type": name}
