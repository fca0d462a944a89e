"""Nodes of the scene tree, as a supervisor sees them."""

# ruff: noqa: N802, N803 - the names are those of Webots

from __future__ import annotations

from math import nan
from typing import TYPE_CHECKING, Any

from .arguments import integer, text
from .field import Field
from .node_types import CONSTANTS, NUMBER_OF
from .session import Session

if TYPE_CHECKING:
    from collections.abc import Sequence


class _NodeTypes(type):
    """Gives `Node` a constant for each node type, as `Node.GPS`."""

    def __getattr__(cls, name: str) -> int:
        if name in CONSTANTS:
            return CONSTANTS[name]
        raise AttributeError(f"type object 'Node' has no attribute {name!r}")


class Node(metaclass=_NodeTypes):
    """A node of the scene tree; a null node (no rights) answers with defaults."""

    def __init__(self, session: Session, found: Sequence[Any]) -> None:
        self._session = session
        self._id, self._type_name, self._def_name = found

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Node) and (other._id, other._session) == (self._id, self._session)

    def __hash__(self) -> int:
        return hash(self._id)

    def getId(self) -> int:
        """A number that no other node has."""
        return self._id

    @property
    def id(self) -> int:
        """A number that no other node has."""
        return self.getId()

    def getType(self) -> int:
        """The number of the node type, to compare with `Node.ROBOT` and the like."""
        return NUMBER_OF.get(self._type_name, 0)

    @property
    def type(self) -> int:
        """The number of the node type."""
        return self.getType()

    def getTypeName(self) -> str:
        """The node type, as `Robot`."""
        return self._type_name

    @property
    def type_name(self) -> str:
        """The node type, as `Robot`."""
        return self.getTypeName()

    def getBaseTypeName(self) -> str:
        """The node type; the stand-in has no PROTO nodes."""
        return self._type_name

    @property
    def base_type_name(self) -> str:
        """The node type; the stand-in has no PROTO nodes."""
        return self.getBaseTypeName()

    def isProto(self) -> bool:
        """False: the stand-in has no PROTO nodes."""
        return False

    def getDef(self) -> str:
        """The DEF name, empty if there is none."""
        return self._def_name

    @property
    def def_name(self) -> str:
        """The DEF name, empty if there is none."""
        return self.getDef()

    def getParentNode(self) -> Node | None:
        """The node around this one; None for the root."""
        found = self._session.ask("node_get_parent_node", self._id)
        return None if found is None else Node(self._session, found)

    # Fields --------------------------------------------------------------------------------------

    def getField(self, fieldName: str) -> Field | None:
        """A field by name; None if the node has no such field."""
        found = self._session.ask("node_get_field", self._id, text(fieldName))
        return None if found is None else Field(self._session, self._id, fieldName, found)

    def getNumberOfFields(self) -> int:
        """How many fields the node has."""
        return len(self._session.ask("node_get_field_names", self._id, default=[]))

    def getFieldByIndex(self, index: int) -> Field | None:
        """A field by its place; None beyond the last."""
        names: list[str] = self._session.ask("node_get_field_names", self._id, default=[])
        return self.getField(names[index]) if 0 <= integer(index) < len(names) else None

    # Places --------------------------------------------------------------------------------------

    def getPosition(self) -> list[float]:
        """x, y and z in the world, metres; NaN for a node that has no place."""
        return [*self._pose()[1]]

    @property
    def position(self) -> list[float]:
        """x, y and z in the world, metres."""
        return self.getPosition()

    def getOrientation(self) -> list[float]:
        """The rotation matrix in the world by rows: nine numbers."""
        return [*self._pose()[0]]

    @property
    def orientation(self) -> list[float]:
        """The rotation matrix in the world by rows: nine numbers."""
        return self.getOrientation()

    def getPose(self) -> list[float]:
        """The 4 x 4 matrix in the world by rows: sixteen numbers."""
        r, (x, y, z) = self._pose()
        return [*r[0:3], x, *r[3:6], y, *r[6:9], z, 0.0, 0.0, 0.0, 1.0]

    def _pose(self) -> Any:
        return self._session.ask("node_get_pose", self._id, default=([nan] * 9, [nan] * 3))

    def getVelocity(self) -> list[float]:
        """Linear (metres a second) and angular (radians a second) velocity: six numbers."""
        return [*self._session.ask("node_get_velocity", self._id, default=[nan] * 6)]

    @property
    def velocity(self) -> list[float]:
        """Linear and angular velocity: six numbers."""
        return self.getVelocity()

    def restartController(self) -> None:
        """End the controller of this Robot node and start it again."""
        self._session.ask("node_restart_controller", self._id)

    def resetPhysics(self) -> None:
        """Take the node's speed away."""
        self._session.ask("node_reset_physics", self._id)
