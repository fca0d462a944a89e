"""Nodes of the scene tree and their fields, as a supervisor sees them."""

# ruff: noqa: N802, N803 - the names are those of Webots

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import nan
from typing import Any, Final, cast

from .simulator_link import ControllerSession, NodeFacts
from .surface import Completed, integer, lacking, number, numbers, say, text, type_number

_LENGTHS: Final = {"Vec2f": 2, "Vec3f": 3, "Color": 3, "Rotation": 4}
_TYPES: Final[dict[str, type]] = {"Bool": bool, "Int32": int, "Float": float, "String": str}
_READ_ONLY: Final = "Error: a field inside a PROTO node is read-only."
_UNREAD: Final[dict[str, Any]] = {
    **{"Bool": False, "Int32": 0, "Float": 0.0},
    **{kind: [0.0] * length for kind, length in _LENGTHS.items()},
}
"""Values at the end, by kind of field, of fields that were never read before."""
_BEYOND_THE_END: Final[dict[str, Any]] = {
    **{"Bool": False, "Int32": 0, "Float": nan, "String": "", "Node": None},
    **{kind: [nan] * length for kind, length in _LENGTHS.items()},
}


class Field(Completed):
    """A field of a node. Reads are answered at once, writes are sent with the next step.

    `getSF...`, `setSF...`, `getMF...`, `setMF...` and `insertMF...` are added below for all types.
    """

    type: int | None
    """The number of the type, such as `Field.SF_VEC3F`."""
    _session: ControllerSession
    _key: tuple[int, str]
    _type_name: str
    _is_inner: bool

    def __init__(self, ref: Any) -> None:
        raise lacking("Field(...); ask a node for its fields")

    @classmethod
    def _of(
        cls,
        session: ControllerSession,
        node_id: int,
        name: str,
        found: Sequence[Any],
        *,
        is_inner: bool = False,
    ) -> Field:
        field = cls.__new__(cls)
        field._is_inner = is_inner
        field._session, field._key = session, (node_id, name)
        field._type_name, session.counts[field._key] = found
        field.type = type_number("Field", field._type_name)
        return field

    def getName(self) -> str:
        """Return the name of the field."""
        return self._key[1]

    def getType(self) -> int | None:
        """Return the number of the type, such as `Field.SF_VEC3F`."""
        return self.type

    def getTypeName(self) -> str:
        """Return the type as text, such as `SFVec3f`."""
        return self._type_name

    def getCount(self) -> int:
        """Return the number of entries; -1 for a single field."""
        return self._count

    @property
    def _count(self) -> int:
        return self._session.counts[self._key]

    # Single fields -------------------------------------------------------------------------------

    @property
    def value(self) -> Any:
        """Return the value of a single field; None for a field with entries."""
        if self._count >= 0:
            return None
        return self._read(None)

    @value.setter
    def value(self, value: Any) -> None:
        if self._is_inner:
            say(_READ_ONLY)
        elif self._count >= 0 or not _fits(self._type_name[2:], value):
            say("Error: new field value has wrong type or length.")
        else:
            self._session.set_field(self._key, None, _as_sent(value))

    def enableSFTracking(self, samplingPeriod: int) -> None:
        """Receive the value of a single field with the steps, so that reading it is no request."""
        self._session.track(self._key, integer(samplingPeriod, position=2))

    def disableSFTracking(self) -> None:
        """Stop that."""
        self._session.track(self._key, 0)

    def _read(self, index: int | None) -> Any:
        kind = self._type_name[2:]
        if kind == "Node" and index is not None:
            unread = self._session.robot["root"]  # Its number is 0, which stands for no node.
        else:
            unread = _UNREAD.get(kind)
        value = self._session.read_field(self._key, index, unread)
        if kind == "String" and value is None and self._session.is_quitting:
            raise _nothing_to_decode()
        return self._as_given(value)

    def _as_given(self, value: Any) -> Any:
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

    # Fields with entries -------------------------------------------------------------------------

    def _entry(self, kind: str, index: int) -> Any:
        if self._has_entry("get", kind, integer(index, position=2)):
            return self._read(index)
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

    def _is_within(self, function: str, index: int, low: int, high: int) -> bool:
        if not low <= index <= high:
            bounds = f"(should be between {low} and {high})"
            say(f"{function} called with an out-of-bound index: {index} {bounds}.")
        return low <= index <= high

    # Adding and removing entries, at once and after the changes that wait -------------------------

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

    def removeMF(self, index: int) -> None:
        """Remove an entry; in a field of nodes, the node."""
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
        """Add a node that is written as in a world file; at -1, add it at the end."""
        function = "Error: wb_supervisor_field_import_mf_node_from_string()"
        if self._may_import(function, "MFNode", text(nodeString)) and self._is_within(
            function, integer(position, 2), -self._count - 1, self._count
        ):
            self._change("field_import", position, nodeString)

    def importSFNodeFromString(self, nodeString: str) -> None:
        """Set a field that is NULL to a node that is written as in a world file."""
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


def _nothing_to_decode() -> AttributeError:
    """Return the error that Webots' package raises where the C library has no text."""
    return AttributeError("'NoneType' object has no attribute 'decode'")


def _as_sent(value: Any) -> Any:
    if not isinstance(value, list):
        return value
    values = cast("list[Any]", value)
    return numbers(values, len(values))


def _fits(kind: str, value: Any) -> bool:
    if kind in _LENGTHS:
        return isinstance(value, list) and len(cast("list[Any]", value)) == _LENGTHS[kind]
    return kind in _TYPES and isinstance(value, _TYPES[kind])


# As in Webots, each getSF... returns the value, whatever its type, and a setter of another type
# prints an error. Indices count from 0, negative ones from the end.

_ENTRY_OF: Final[dict[str, Callable[[Any], Any]]] = {
    "Bool": bool,
    "Int32": lambda value: integer(value, position=3),
    "Float": number,
    "String": text,
    **{kind: partial(numbers, count=length) for kind, length in _LENGTHS.items()},
}
"""Functions that convert an argument to an entry, by kind of field."""


def _add_accessors(kind: str) -> None:
    """Add the methods to Field that get values of one kind."""

    def get_single(self: Any) -> Any:
        return self.value

    def get_entry(self: Any, index: int) -> Any:
        entry = self._entry(kind, index)
        return bool(entry) if kind == "Bool" else entry

    setattr(Field, f"getSF{kind}", get_single)
    setattr(Field, f"getMF{kind}", get_entry)


def _add_setters(kind: str, entry_of: Callable[[Any], Any]) -> None:
    """Add the methods to Field that set and insert values of one kind."""

    def set_single(self: Any, value: Any) -> None:
        if kind in _LENGTHS:
            self._set_numbers(f"setSF{kind}", _LENGTHS[kind], value)
        else:
            self.value = value

    def set_entry(self: Any, index: int, value: Any) -> None:
        self._set_entry(kind, index, entry_of(value))

    def insert(self: Any, index: int, value: Any) -> None:
        self._insert(kind, index, entry_of(value))

    setattr(Field, f"setSF{kind}", set_single)
    setattr(Field, f"setMF{kind}", set_entry)
    setattr(Field, f"insertMF{kind}", insert)


for _kind in (*_ENTRY_OF, "Node"):
    _add_accessors(_kind)
for _kind, _entry_of in _ENTRY_OF.items():
    _add_setters(_kind, _entry_of)

field_of = Field._of  # pyright: ignore[reportPrivateUsage]
"""Make the object of a field that the simulator has described."""


_NO_POSE: Final = ([nan] * 9, [nan] * 3)


class Node(Completed):
    """A node of the scene tree. A null node (without rights) answers with defaults.

    As in Webots, each call that returns a node makes a new object, which equals no other: compare
    `getId()`.
    """

    _session: ControllerSession
    _id: int
    _found: tuple[str, str, str]
    _parent_id: int

    def __init__(
        self,
        DEF: str | None = None,
        tag: int | None = None,
        id: int | None = None,  # noqa: A002 - Webots' name
        selected: bool | None = None,
        ref: int | None = None,
    ) -> None:
        raise lacking("Node(...); ask the supervisor for nodes")

    @classmethod
    def _of(cls, session: ControllerSession, found: NodeFacts) -> Node:
        node = cls.__new__(cls)
        node._session, node._id = session, found[0]
        node._found = (found[1], found[2], found[3])
        node._parent_id = found[4]
        if found[1]:  # no null node
            session.know(found)
        return node

    def getId(self) -> int:
        """Return the number of the node, which is unique."""
        return self._id

    def getType(self) -> int:
        """Return the number of the node type, to compare with `Node.ROBOT` and the like."""
        return type_number("Node", self.getBaseTypeName())

    def getTypeName(self) -> str:
        """Return the node type, such as `Robot`; of a PROTO node its name, such as `WoodenBox`."""
        return self._found[0]

    def getBaseTypeName(self) -> str:
        """Return the node type; of a PROTO node the type of its base node, such as `Solid`."""
        return self._found[1]

    def isProto(self) -> bool:
        """Return whether it is a PROTO node."""
        return self._found[0] != self._found[1]

    def getDef(self) -> str:
        """Return the DEF name, empty if there is none."""
        return self._found[2]

    def getParentNode(self) -> Node | None:
        """Return the parent; None for the root."""
        found = self._session.find_node(
            "node_get_parent_node", self._id, lambda node: node[0] == self._parent_id
        )
        return None if found is None else node_of(self._session, found)

    def exportString(self) -> str:
        """Return the node and everything in it, as written in a world file."""
        written = self._session.ask("node_export_string", self._id, kept_as=("text", self._id))
        if written is None and self._session.is_quitting:
            raise _nothing_to_decode()
        return written or ""

    def remove(self) -> None:
        """Remove the node, and everything in it, from the world."""
        found = self._session.ask("node_remove", self._id)
        if found is not None:
            node_id, name, count = found
            self._session.counts[node_id, name] = count
            self._session.forget(self._id)

    # Fields --------------------------------------------------------------------------------------

    def getField(self, fieldName: str) -> Field | None:
        """Return a field by name; None if the node has no such field."""
        return self._field("node_get_field", fieldName)

    def getNumberOfFields(self) -> int:
        """Return the number of fields; -1 for none."""
        return len(self._session.ask("node_get_field_names", self._id, default=[])) or -1

    def getFieldByIndex(self, index: int) -> Field | None:
        """Return a field by its index; None beyond the last."""
        name = self._session.find_field_name(self._id, integer(index, 2))
        return None if name is None else self.getField(name)

    def getBaseNodeField(self, fieldName: str) -> Field | None:
        """Return a field of the base node of a PROTO node, which is read-only."""
        if not self.isProto():
            say("Error: getBaseNodeField() called with a node that is no PROTO node.")
            return None
        return self._field("node_get_base_node_field", fieldName, is_inner=True)

    def _field(self, operation: str, name: str, *, is_inner: bool = False) -> Field | None:
        found = self._session.find_field(operation, (self._id, text(name)))
        if found is None:
            return None
        (node_id, name), *described = found
        return field_of(self._session, node_id, name, described, is_inner=is_inner)

    # Poses and velocities ------------------------------------------------------------------------

    def getPosition(self) -> list[float]:
        """Return x, y and z in the world in metres; NaN for a node without a pose."""
        return [*self._pose("position")[1]]

    def getOrientation(self) -> list[float]:
        """Return the rotation matrix in the world by rows: nine numbers."""
        return [*self._pose("orientation")[0]]

    def getPose(self, fromNode: Node | None = None) -> list[float]:
        """Return the 4 x 4 matrix by rows, in the world or in another node: sixteen numbers.

        As in Webots, only this getter uses the pose of the last step if the pose is tracked.
        """
        seen_from_id = fromNode._id if fromNode else None
        pose = self._session.tracked((self._id, seen_from_id)) or self._session.ask(
            "node_get_pose",
            self._id,
            seen_from_id,
            kept_as="pose",  # One for all nodes.
        )
        if pose is None and self._session.is_quitting:
            return [0.0] * 16
        r, (x, y, z) = pose or _NO_POSE
        return [*r[0:3], x, *r[3:6], y, *r[6:9], z, 0.0, 0.0, 0.0, 1.0]

    def _pose(self, wanted: str) -> Any:
        kept_as = (wanted, self._id)
        return self._session.ask("node_get_pose", self._id, None, kept_as=kept_as, default=_NO_POSE)

    def getVelocity(self) -> list[float]:
        """Return linear (m/s) and angular (rad/s) velocity: six numbers."""
        return [*self._session.ask("node_get_velocity", self._id, default=[nan] * 6)]

    def setVelocity(self, velocity: list[float]) -> None:
        """Let a body slide with a linear and angular velocity, of which x, y and yaw count.

        A robot follows its wheels instead.
        """
        self._session.ask("node_set_velocity", self._id, numbers(velocity, 6))

    def enablePoseTracking(self, samplingPeriod: int, fromNode: Node | None = None) -> None:
        """Receive the pose with the steps, so that `getPose` is no request."""
        period_ms = integer(samplingPeriod, position=2)
        self._session.track((self._id, fromNode._id if fromNode else None), period_ms)

    def disablePoseTracking(self, fromNode: Node | None = None) -> None:
        """Stop that."""
        self._session.track((self._id, fromNode._id if fromNode else None), 0)

    def resetPhysics(self) -> None:
        """Set the node's velocity to 0."""
        self._session.ask("node_reset_physics", self._id)


node_of = Node._of  # pyright: ignore[reportPrivateUsage]
"""Make the object of a node that the simulator has described."""
