"""Fields of nodes."""

# ruff: noqa: N802, N803 - the names are those of Webots

from __future__ import annotations

from math import nan
from typing import TYPE_CHECKING, Any, Final, cast

from .arguments import integer, number, numbers, text
from .console import say
from .lacking import lacking, lacks
from .node_types import FIELD_NUMBER_OF
from .session import Session

if TYPE_CHECKING:
    from .node import Node

_LENGTHS: Final = {"Vec2f": 2, "Vec3f": 3, "Color": 3, "Rotation": 4}
_TYPES: Final[dict[str, type]] = {"Bool": bool, "Int32": int, "Float": float, "String": str}
_READ_ONLY: Final = "Error: a field inside a PROTO node is read-only."
_BEYOND_THE_END: Final[dict[str, Any]] = {
    **{"Bool": False, "Int32": 0, "Float": nan, "String": "", "Node": None},
    **{kind: [nan] * length for kind, length in _LENGTHS.items()},
}


@lacks("disableSFTracking enableSFTracking getActualField")
class Field:
    """A field of a node. Reads are answered at once, writes go out with the next step."""

    SF_BOOL, SF_INT32, SF_FLOAT, SF_VEC2F, SF_VEC3F = range(1, 6)
    SF_ROTATION, SF_COLOR, SF_STRING, SF_NODE = range(6, 10)
    MF_BOOL, MF_INT32, MF_FLOAT, MF_VEC2F, MF_VEC3F = range(17, 22)
    MF_ROTATION, MF_COLOR, MF_STRING, MF_NODE = range(22, 26)

    type: int | None
    """The number of the type, as `Field.SF_VEC3F`."""
    _session: Session
    _key: tuple[int, str]
    _type_name: str
    _is_inner: bool

    def __init__(self, ref: Any) -> None:
        raise lacking("Field(...); ask a node for its fields")

    @classmethod
    def _of(
        cls,
        session: Session,
        node_id: int,
        name: str,
        found: tuple[str, int],
        *,
        is_inner: bool = False,
    ) -> Field:
        field = cls.__new__(cls)
        field._is_inner = is_inner
        field._session, field._key = session, (node_id, name)
        field._type_name, session.counts[field._key] = found
        field.type = FIELD_NUMBER_OF[field._type_name]
        return field

    def getName(self) -> str:
        """The name of the field."""
        return self._key[1]

    @property
    def name(self) -> str:
        """The name of the field."""
        return self.getName()

    def getType(self) -> int | None:
        """The number of the type, as `Field.SF_VEC3F`."""
        return self.type

    def getTypeName(self) -> str:
        """The type as text, as `SFVec3f`."""
        return self._type_name

    @property
    def type_name(self) -> str:
        """The type as text, as `SFVec3f`."""
        return self.getTypeName()

    def getCount(self) -> int:
        """The number of entries; -1 for a single field."""
        return self._count

    @property
    def _count(self) -> int:
        return self._session.counts[self._key]

    @property
    def count(self) -> int:
        """The number of entries; -1 for a single field."""
        return self.getCount()

    # Single fields -------------------------------------------------------------------------------

    @property
    def value(self) -> Any:
        """The value of a single field; None for a field with entries."""
        if self._count >= 0:
            return None
        return self._as_given(self._session.read_field(self._key, None))

    @value.setter
    def value(self, value: Any) -> None:
        if self._is_inner:
            say(_READ_ONLY)
        elif self._count >= 0 or not _fits(self._type_name[2:], value):
            say("Error: new field value has wrong type or length.")
        else:
            self._session.set_field(self._key, None, _as_sent(value))

    def _as_given(self, value: Any) -> Any:
        from .node import node_of

        if self._type_name.endswith("Node"):
            return None if value is None else node_of(self._session, value)
        if isinstance(value, bool):
            return int(value)
        return [*value] if isinstance(value, (list, tuple)) else value

    def _set_numbers(self, setter: str, length: int, value: list[float]) -> None:
        if len(value) == length:
            self.value = value
        else:
            say(f"Error: {setter}(): length of 'value' argument should be {length}.")

    def getSFBool(self) -> int:
        """0 or 1. As in Webots, each `getSF...` gives the value, of whatever type it is."""
        return self.value

    def getSFInt32(self) -> int:
        """The value."""
        return self.value

    def getSFFloat(self) -> float:
        """The value."""
        return self.value

    def getSFVec2f(self) -> list[float]:
        """Two numbers."""
        return self.value

    def getSFVec3f(self) -> list[float]:
        """Three numbers."""
        return self.value

    def getSFRotation(self) -> list[float]:
        """Axis and angle in radians: four numbers."""
        return self.value

    def getSFColor(self) -> list[float]:
        """Red, green and blue, each 0 to 1."""
        return self.value

    def getSFString(self) -> str:
        """The value."""
        return self.value

    def getSFNode(self) -> Node | None:
        """The node; None for NULL."""
        return self.value

    def setSFBool(self, value: bool) -> None:
        """Set the value with the next step; an int is refused with a line on stderr."""
        self.value = value

    def setSFInt32(self, value: int) -> None:
        """Set the value with the next step."""
        self.value = value

    def setSFFloat(self, value: float) -> None:
        """Set the value with the next step; an int is refused with a line on stderr."""
        self.value = value

    def setSFVec2f(self, value: list[float]) -> None:
        """Set two numbers with the next step; a tuple is refused with a line on stderr."""
        self._set_numbers("setSFVec2f", 2, value)

    def setSFVec3f(self, value: list[float]) -> None:
        """Set three numbers with the next step; a tuple is refused with a line on stderr."""
        self._set_numbers("setSFVec3f", 3, value)

    def setSFRotation(self, value: list[float]) -> None:
        """Set axis and angle with the next step; a tuple is refused with a line on stderr."""
        self._set_numbers("setSFRotation", 4, value)

    def setSFColor(self, value: list[float]) -> None:
        """Set red, green and blue with the next step; a tuple is refused with a line on stderr."""
        self._set_numbers("setSFColor", 3, value)

    def setSFString(self, value: str) -> None:
        """Set the value with the next step."""
        self.value = value

    # Fields with entries -------------------------------------------------------------------------

    def _entry(self, kind: str, index: int) -> Any:
        if self._has_entry("get", kind, integer(index, position=2)):
            return self._as_given(self._session.read_field(self._key, index))
        return _BEYOND_THE_END[kind]

    def _set_entry(self, kind: str, index: int, value: Any) -> None:
        if self._is_inner:
            say(_READ_ONLY)
        elif self._has_entry("set", kind, integer(index, position=2)):
            self._session.set_field(self._key, index, value)

    def _has_entry(self, what: str, kind: str, index: int) -> bool:
        function = f"Error: wb_supervisor_field_{what}_mf_{kind.lower()}()"
        if self._type_name != f"MF{kind}":
            say(f"{function} called with a field of type {self._type_name}.")
            return False
        if not self._count:
            say(f"{function} called on an empty list.")
            return False
        return self._is_within(function, index, -self._count, self._count - 1)

    def _is_within(self, function: str, index: int, least: int, most: int) -> bool:
        if not least <= index <= most:
            bounds = f"(should be between {least} and {most})"
            say(f"{function} called with an out-of-bound index: {index} {bounds}.")
        return least <= index <= most

    def getMFBool(self, index: int) -> bool:
        """One entry."""
        return bool(self._entry("Bool", index))

    def getMFInt32(self, index: int) -> int:
        """One entry."""
        return self._entry("Int32", index)

    def getMFFloat(self, index: int) -> float:
        """One entry."""
        return self._entry("Float", index)

    def getMFVec2f(self, index: int) -> list[float]:
        """One entry: two numbers."""
        return self._entry("Vec2f", index)

    def getMFVec3f(self, index: int) -> list[float]:
        """One entry: three numbers."""
        return self._entry("Vec3f", index)

    def getMFRotation(self, index: int) -> list[float]:
        """One entry: axis and angle in radians."""
        return self._entry("Rotation", index)

    def getMFColor(self, index: int) -> list[float]:
        """One entry: red, green and blue, each 0 to 1."""
        return self._entry("Color", index)

    def getMFString(self, index: int) -> str:
        """One entry."""
        return self._entry("String", index)

    def getMFNode(self, index: int) -> Node | None:
        """One entry; -1 is the last."""
        return self._entry("Node", index)

    def setMFBool(self, index: int, value: bool) -> None:
        """Set one entry with the next step."""
        self._set_entry("Bool", index, bool(value))

    def setMFInt32(self, index: int, value: int) -> None:
        """Set one entry with the next step."""
        self._set_entry("Int32", index, integer(value, position=3))

    def setMFFloat(self, index: int, value: float) -> None:
        """Set one entry with the next step."""
        self._set_entry("Float", index, number(value))

    def setMFVec2f(self, index: int, value: list[float]) -> None:
        """Set one entry with the next step."""
        self._set_entry("Vec2f", index, numbers(value, 2))

    def setMFVec3f(self, index: int, value: list[float]) -> None:
        """Set one entry with the next step."""
        self._set_entry("Vec3f", index, numbers(value, 3))

    def setMFRotation(self, index: int, value: list[float]) -> None:
        """Set one entry with the next step."""
        self._set_entry("Rotation", index, numbers(value, 4))

    def setMFColor(self, index: int, value: list[float]) -> None:
        """Set one entry with the next step."""
        self._set_entry("Color", index, numbers(value, 3))

    def setMFString(self, index: int, value: str) -> None:
        """Set one entry with the next step."""
        self._set_entry("String", index, text(value))

    # More and fewer entries: at once, after the changes that were not sent yet -------------------

    def _insert(self, kind: str, index: int, value: Any) -> None:
        function = f"Error: wb_supervisor_field_insert_mf_{kind.lower()}()"
        if self._is_inner:
            say(_READ_ONLY)
        elif self._type_name != f"MF{kind}":
            say(f"{function} called with a field of type {self._type_name}.")
        elif self._is_within(function, integer(index, 2), -self._count - 1, self._count):
            self._change("field_insert", index, value)

    def _change(self, operation: str, *arguments: Any) -> None:
        count = self._session.change_field(operation, self._key, *arguments)
        if count is not None and self._count >= 0:
            self._session.counts[self._key] = count

    def insertMFBool(self, index: int, value: bool) -> None:
        """Add an entry before that of the index; -1 adds it at the end."""
        self._insert("Bool", index, bool(value))

    def insertMFInt32(self, index: int, value: int) -> None:
        """Add an entry before that of the index; -1 adds it at the end."""
        self._insert("Int32", index, integer(value, position=3))

    def insertMFFloat(self, index: int, value: float) -> None:
        """Add an entry before that of the index; -1 adds it at the end."""
        self._insert("Float", index, number(value))

    def insertMFVec2f(self, index: int, value: list[float]) -> None:
        """Add an entry before that of the index; -1 adds it at the end."""
        self._insert("Vec2f", index, numbers(value, 2))

    def insertMFVec3f(self, index: int, value: list[float]) -> None:
        """Add an entry before that of the index; -1 adds it at the end."""
        self._insert("Vec3f", index, numbers(value, 3))

    def insertMFRotation(self, index: int, value: list[float]) -> None:
        """Add an entry before that of the index; -1 adds it at the end."""
        self._insert("Rotation", index, numbers(value, 4))

    def insertMFColor(self, index: int, value: list[float]) -> None:
        """Add an entry before that of the index; -1 adds it at the end."""
        self._insert("Color", index, numbers(value, 3))

    def insertMFString(self, index: int, value: str) -> None:
        """Add an entry before that of the index; -1 adds it at the end."""
        self._insert("String", index, text(value))

    def removeMF(self, index: int) -> None:
        """Remove an entry; of a field of nodes the node."""
        function = "Error: wb_supervisor_field_remove_mf()"
        if self._is_inner:
            say(_READ_ONLY)
        elif self._count <= 0:
            say(f"{function} called for an empty field.")
        elif self._is_within(function, integer(index, 2), -self._count, self._count - 1):
            self._change("field_remove", index)

    def removeSF(self) -> None:
        """Remove the node of a field that holds one."""
        if self._is_inner:
            say(_READ_ONLY)
        elif self._type_name != "SFNode":
            say("Error: wb_supervisor_field_remove_sf() called with wrong field type.")
        elif self.value is None:
            say("Error: wb_supervisor_field_remove_sf() called for an empty field.")
        else:
            self._change("field_remove", None)

    def importMFNodeFromString(self, position: int, nodeString: str) -> None:
        """Add a node that is written as in a world file; -1 adds it at the end."""
        function = "Error: wb_supervisor_field_import_mf_node_from_string()"
        if self._may_import(function, "MFNode", text(nodeString)) and self._is_within(
            function, integer(position, 2), -self._count - 1, self._count
        ):
            self._change("field_import", position, nodeString)

    def importSFNodeFromString(self, nodeString: str) -> None:
        """Put a node that is written as in a world file into a field that is NULL."""
        function = "Error: wb_supervisor_field_import_sf_node_from_string()"
        if self._may_import(function, "SFNode", text(nodeString)):
            if self.value is not None:
                say(f"{function} called with a non-empty field.")
            else:
                self._change("field_import", None, nodeString)

    def _may_import(self, function: str, kind: str, node: str) -> bool:
        if self._is_inner:
            say(_READ_ONLY)
        elif self._type_name != kind:
            say(f"{function} called with a wrong field type: {self._type_name}.")
        elif not node:
            say(f"{function} called with a NULL or empty 'node_string' argument.")
        else:
            return True
        return False


def _as_sent(value: Any) -> Any:
    if not isinstance(value, list):
        return value
    values = cast("list[Any]", value)
    return numbers(values, len(values))


def _fits(kind: str, value: Any) -> bool:
    if kind in _LENGTHS:
        return isinstance(value, list) and len(cast("list[Any]", value)) == _LENGTHS[kind]
    return kind in _TYPES and isinstance(value, _TYPES[kind])


field_of = Field._of  # pyright: ignore[reportPrivateUsage]
"""Makes the object for a field that the simulator has described."""


def inner_field_of(session: Session, node_id: int, name: str, found: tuple[str, int]) -> Field:
    """The object for a field inside a PROTO node, which is read-only."""
    return field_of(session, node_id, name, found, is_inner=True)
