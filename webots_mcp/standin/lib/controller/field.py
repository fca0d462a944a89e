"""Fields of nodes."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, cast

from .arguments import integer, number
from .console import say
from .node_types import FIELD_NUMBER_OF
from .session import Session

if TYPE_CHECKING:
    from .node import Node

_LENGTHS: Final = {"Vec2f": 2, "Vec3f": 3, "Color": 3, "Rotation": 4}
_TYPES: Final[dict[str, tuple[type, ...]]] = {
    "Bool": (bool, int),
    "Int32": (int,),
    "Float": (float,),
    "String": (str,),
}


class Field:
    """A field of a node. Reads are answered at once, writes go out with the next step."""

    SF_BOOL, SF_INT32, SF_FLOAT, SF_VEC2F, SF_VEC3F = range(1, 6)
    SF_ROTATION, SF_COLOR, SF_STRING, SF_NODE = range(6, 10)
    MF = 16
    MF_BOOL, MF_INT32, MF_FLOAT, MF_VEC2F, MF_VEC3F = range(17, 22)
    MF_ROTATION, MF_COLOR, MF_STRING, MF_NODE = range(22, 26)

    def __init__(self, session: Session, node_id: int, name: str, found: tuple[str, int]) -> None:
        self._session = session
        self._key = (node_id, name)
        self._type_name, self._count = found

    def getName(self) -> str:
        """The name of the field."""
        return self._key[1]

    @property
    def name(self) -> str:
        """The name of the field."""
        return self.getName()

    def getType(self) -> int:
        """The number of the type, as `Field.SF_VEC3F`."""
        return FIELD_NUMBER_OF[self._type_name]

    @property
    def type(self) -> int:
        """The number of the type, as `Field.SF_VEC3F`."""
        return self.getType()

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
    def count(self) -> int:
        """The number of entries; -1 for a single field."""
        return self.getCount()

    @property
    def value(self) -> Any:
        """The whole value: of an MF field a list."""
        if self._count < 0:
            return self._read(self._type_name, None)
        return [self._read(self._type_name, index) for index in range(self._count)]

    def _read(self, type_name: str, index: int | None) -> Any:
        if not self._is(type_name, "get"):
            return None
        if index is not None and not -self._count <= integer(index) < self._count:
            say(f"Error: index {index} is out of the range of field '{self.name}'.")
            return None
        return self._as_given(self._session.read_field(self._key, index))

    def _as_given(self, value: Any) -> Any:
        from .node import Node

        if self._type_name.endswith("Node"):
            return None if value is None else Node(self._session, value)
        if isinstance(value, bool):
            return int(value)
        return [*value] if isinstance(value, (list, tuple)) else value

    def _write(self, type_name: str, index: int | None, value: Any) -> None:
        if not self._is(type_name, "set"):
            return
        if not _fits(type_name[2:], value):
            say("Error: new field value has wrong type or length.")
            return
        value = bool(value) if type_name.endswith("Bool") else value
        self._session.set_field(self._key, index, _as_sent(value))

    def _is(self, type_name: str, what: str) -> bool:
        if type_name != self._type_name:
            function = f"wb_supervisor_field_{what}_{type_name[:2].lower()}_{type_name[2:].lower()}"
            say(f"Error: {function}() called with a field of type {self._type_name}.")
        return type_name == self._type_name

    def getSFBool(self) -> int:
        """0 or 1."""
        return self._read("SFBool", None)

    def getSFInt32(self) -> int:
        """The value."""
        return self._read("SFInt32", None)

    def getSFFloat(self) -> float:
        """The value."""
        return self._read("SFFloat", None)

    def getSFVec2f(self) -> list[float]:
        """Two numbers."""
        return self._read("SFVec2f", None)

    def getSFVec3f(self) -> list[float]:
        """Three numbers."""
        return self._read("SFVec3f", None)

    def getSFRotation(self) -> list[float]:
        """Axis and angle in radians: four numbers."""
        return self._read("SFRotation", None)

    def getSFColor(self) -> list[float]:
        """Red, green and blue, each 0 to 1."""
        return self._read("SFColor", None)

    def getSFString(self) -> str:
        """The value."""
        return self._read("SFString", None)

    def getSFNode(self) -> Node | None:
        """The node; None for NULL."""
        return self._read("SFNode", None)

    def getMFFloat(self, index: int) -> float:
        """One entry."""
        return self._read("MFFloat", index)

    def getMFVec3f(self, index: int) -> list[float]:
        """One entry: three numbers."""
        return self._read("MFVec3f", index)

    def getMFColor(self, index: int) -> list[float]:
        """One entry: red, green and blue, each 0 to 1."""
        return self._read("MFColor", index)

    def getMFString(self, index: int) -> str:
        """One entry."""
        return self._read("MFString", index)

    def getMFNode(self, index: int) -> Node | None:
        """One entry; -1 is the last."""
        return self._read("MFNode", index)

    def setSFBool(self, value: bool) -> None:
        """Set the value with the next step."""
        self._write("SFBool", None, value)

    def setSFInt32(self, value: int) -> None:
        """Set the value with the next step."""
        self._write("SFInt32", None, value)

    def setSFFloat(self, value: float) -> None:
        """Set the value with the next step; an int is refused with a line on stderr."""
        self._write("SFFloat", None, value)

    def setSFVec2f(self, values: list[float]) -> None:
        """Set two numbers with the next step; a tuple is refused with a line on stderr."""
        self._write("SFVec2f", None, values)

    def setSFVec3f(self, values: list[float]) -> None:
        """Set three numbers with the next step; a tuple is refused with a line on stderr."""
        self._write("SFVec3f", None, values)

    def setSFRotation(self, values: list[float]) -> None:
        """Set axis and angle with the next step; a tuple is refused with a line on stderr."""
        self._write("SFRotation", None, values)

    def setSFColor(self, values: list[float]) -> None:
        """Set red, green and blue with the next step; a tuple is refused with a line on stderr."""
        self._write("SFColor", None, values)

    def setSFString(self, value: str) -> None:
        """Set the value with the next step."""
        self._write("SFString", None, value)

    def setMFFloat(self, index: int, value: float) -> None:
        """Set one entry with the next step."""
        self._write("MFFloat", index, value)

    def setMFVec3f(self, index: int, values: list[float]) -> None:
        """Set one entry with the next step."""
        self._write("MFVec3f", index, values)

    def setMFColor(self, index: int, values: list[float]) -> None:
        """Set one entry with the next step."""
        self._write("MFColor", index, values)

    def setMFString(self, index: int, value: str) -> None:
        """Set one entry with the next step."""
        self._write("MFString", index, value)


def _as_sent(value: Any) -> Any:
    if not isinstance(value, list):
        return value
    return [number(part) for part in cast("list[Any]", value)]


def _fits(kind: str, value: Any) -> bool:
    if kind in _LENGTHS:
        return isinstance(value, list) and len(cast("list[Any]", value)) == _LENGTHS[kind]
    return isinstance(value, _TYPES.get(kind, ()))
