"""JSON schemas of the messages in an MCAP file.

Viewers know the ones called `foxglove.NAME` and draw them; the schema of states is made of what
they hold. Foxglove's and Lichtblick's readers of schemas take one type per field, and arrays of one
scalar type or of objects; a schema with anything else makes a whole topic unreadable. What a state
holds besides is therefore in the messages, but not in the schema: it is shown, not offered to plot.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final, cast

Schema = dict[str, Any]

_NUMBER: Final[Schema] = {"type": "number"}
_INTEGER: Final[Schema] = {"type": "integer"}
_TEXT: Final[Schema] = {"type": "string"}


def _object(**properties: Schema) -> Schema:
    return {"type": "object", "properties": properties}


_TIME: Final = _object(sec=_INTEGER, nsec=_INTEGER)
_VECTOR: Final = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION: Final = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE: Final = _object(position=_VECTOR, orientation=_QUATERNION)

FIXED: Final[dict[str, Schema]] = {
    "foxglove.FrameTransform": _object(
        timestamp=_TIME,
        parent_frame_id=_TEXT,
        child_frame_id=_TEXT,
        translation=_VECTOR,
        rotation=_QUATERNION,
    ),
    "foxglove.PosesInFrame": _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        poses={"type": "array", "items": _POSE},
    ),
    "foxglove.CompressedImage": _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        data={"type": "string", "contentEncoding": "base64"},
        format=_TEXT,
    ),
    "foxglove.Log": _object(
        timestamp=_TIME,
        level=_INTEGER,
        message=_TEXT,
        name=_TEXT,
        file=_TEXT,
        line=_INTEGER,
    ),
    "webots_mcp.Event": _object(timestamp=_TIME, kind=_TEXT, name=_TEXT, data=_object()),
    "webots_mcp.Command": _object(
        timestamp=_TIME,
        id=_INTEGER,
        action=_TEXT,
        params=_object(),
        status=_TEXT,
        requested_by=_TEXT,
        finished_sim_time_s=_NUMBER,
        took_wall_s=_NUMBER,
        error=_TEXT,
    ),
}

_SCALARS: Final = {bool: "boolean", int: "number", float: "number", str: "string"}


@dataclass
class Shape:
    """What values of one field were seen to be: of which types, and what is inside of them."""

    types: set[str] = field(default_factory=set[str])
    fields: dict[str, Shape] = field(default_factory=dict[str, "Shape"])
    items: Shape | None = None

    def see(self, value: Any) -> None:
        """Take in a value; null says nothing."""
        scalar = _SCALARS.get(cast("type[Any]", type(value)))
        if scalar is not None:
            self.types.add(scalar)
        elif isinstance(value, dict):
            self.types.add("object")
            for name, inner in cast("dict[str, Any]", value).items():
                shape = self.fields.get(name)
                if shape is None:
                    shape = self.fields[name] = Shape()
                shape.see(inner)
        elif isinstance(value, list):
            self.types.add("array")
            self.items = self.items or Shape()
            self.items.see_each(cast("list[Any]", value))

    def see_each(self, values: list[Any]) -> None:
        """Take in the items of an array: of thousands of numbers only the types."""
        kinds = {cast("type[Any]", type(value)) for value in values}
        if kinds.isdisjoint((dict, list)):
            self.types.update(_SCALARS[kind] for kind in kinds & _SCALARS.keys())
        else:
            for value in values:
                self.see(value)

    def schema(self) -> Schema | None:
        """None where a schema cannot say it."""
        if len(self.types) != 1:
            return None
        (name,) = self.types
        if name == "object":
            inner = {key: shape.schema() for key, shape in self.fields.items()}
            return _object(**{key: schema for key, schema in inner.items() if schema is not None})
        if name == "array":
            items = self.items.schema() if self.items else None
            told = items is not None and items["type"] != "array"
            return {"type": "array", "items": items} if told else None
        return {"type": name}
