"""Nodes of the scene tree, as a supervisor sees them."""

# ruff: noqa: N802, N803 - the names are those of Webots

from __future__ import annotations

from math import nan
from typing import TYPE_CHECKING, Any, Final

from .arguments import integer, number, numbers, text
from .console import say
from .field import Field, field_of, inner_field_of
from .lacking import lacking, lacks
from .node_types import CONSTANTS, NUMBER_OF
from .session import Session

if TYPE_CHECKING:
    from collections.abc import Sequence

    class _NodeTypes(type):
        """Says that there is a constant for each node type, as `Node.GPS`."""

        def __getattr__(cls, name: str) -> int: ...
else:
    _NodeTypes = type


_NO_POSE: Final = ([nan] * 9, [nan] * 3)


@lacks(
    "addForce addForceWithOffset addTorque disableContactPointsTracking "
    "enableContactPointsTracking getCenterOfMass getContactPoints getFromProtoDef "
    "getProto getProtoField getProtoFieldByIndex getStaticBalance "
    "loadState moveViewpoint saveState setVisibility"
)
class Node(metaclass=_NodeTypes):
    """A node of the scene tree; a null node (no rights) answers with defaults.

    As in Webots, each call that gives a node makes another object, equal to no other: compare
    `getId()`.
    """

    _session: Session
    _id: int
    _found: tuple[str, str, str]

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
    def _of(cls, session: Session, found: Sequence[Any]) -> Node:
        node = cls.__new__(cls)
        node._session, node._id = session, found[0]
        node._found = (found[1], found[2], found[3])
        return node

    def getId(self) -> int:
        """A number that no other node has."""
        return self._id

    @property
    def id(self) -> int:
        """A number that no other node has."""
        return self.getId()

    def getType(self) -> int:
        """The number of the node type, to compare with `Node.ROBOT` and the like."""
        return NUMBER_OF.get(self.getBaseTypeName(), 0)

    @property
    def type(self) -> int:
        """The number of the node type."""
        return self.getType()

    def getTypeName(self) -> str:
        """The node type, as `Robot`; of a PROTO node its own name, as `WoodenBox`."""
        return self._found[0]

    @property
    def type_name(self) -> str:
        """The node type, as `Robot`; of a PROTO node its own name, as `WoodenBox`."""
        return self.getTypeName()

    def getBaseTypeName(self) -> str:
        """The node type; of a PROTO node what it is made of, as `Solid`."""
        return self._found[1]

    @property
    def base_type_name(self) -> str:
        """The node type; of a PROTO node what it is made of, as `Solid`."""
        return self.getBaseTypeName()

    def isProto(self) -> bool:
        """Whether it is a PROTO node."""
        return self._found[0] != self._found[1]

    def getDef(self) -> str:
        """The DEF name, empty if there is none."""
        return self._found[2]

    @property
    def DEF(self) -> str:
        """The DEF name, empty if there is none."""
        return self.getDef()

    def getParentNode(self) -> Node | None:
        """The node around this one; None for the root."""
        found = self._session.ask("node_get_parent_node", self._id)
        return None if found is None else node_of(self._session, found)

    def exportString(self) -> str:
        """The node and all in it, as written in a world file."""
        return self._session.ask("node_export_string", self._id, default="")

    def remove(self) -> None:
        """Take the node, and all in it, out of the world."""
        found = self._session.ask("node_remove", self._id)
        if found is not None:
            node_id, name, count = found
            self._session.counts[node_id, name] = count

    # Fields --------------------------------------------------------------------------------------

    def getField(self, fieldName: str) -> Field | None:
        """A field by name; None if the node has no such field."""
        found = self._session.ask("node_get_field", self._id, text(fieldName))
        return None if found is None else field_of(self._session, self._id, fieldName, found)

    def getNumberOfFields(self) -> int:
        """How many fields the node has."""
        return len(self._session.ask("node_get_field_names", self._id, default=[]))

    @property
    def number_of_fields(self) -> int:
        """How many fields the node has."""
        return self.getNumberOfFields()

    def getFieldByIndex(self, index: int) -> Field | None:
        """A field by its place; None beyond the last."""
        names: list[str] = self._session.ask("node_get_field_names", self._id, default=[])
        return self.getField(names[index]) if 0 <= integer(index, 2) < len(names) else None

    def getBaseNodeField(self, fieldName: str) -> Field | None:
        """A field of the node that a PROTO node is made of, to be read only."""
        if not self._is_proto("getBaseNodeField"):
            return None
        found = self._session.ask("node_get_base_node_field", self._id, text(fieldName))
        return None if found is None else inner_field_of(self._session, self._id, fieldName, found)

    def getNumberOfBaseNodeFields(self) -> int:
        """How many fields the node has that a PROTO node is made of."""
        return len(self._base_node_field_names("getNumberOfBaseNodeFields"))

    @property
    def number_of_base_node_fields(self) -> int:
        """How many fields the node has that a PROTO node is made of."""
        return self.getNumberOfBaseNodeFields()

    def getBaseNodeFieldByIndex(self, index: int) -> Field | None:
        """A field of what a PROTO node is made of, by its place; None beyond the last."""
        names = self._base_node_field_names("getBaseNodeFieldByIndex")
        has_it = 0 <= integer(index, 2) < len(names)
        return self.getBaseNodeField(names[index]) if has_it else None

    def _base_node_field_names(self, asked: str) -> list[str]:
        if not self._is_proto(asked):
            return []
        return self._session.ask("node_get_base_node_field_names", self._id, default=[])

    def _is_proto(self, asked: str) -> bool:
        if not self.isProto():
            say(f"Error: {asked}() called with a node that is no PROTO node.")
        return self.isProto()

    # Places --------------------------------------------------------------------------------------

    def getPosition(self) -> list[float]:
        """x, y and z in the world, metres; NaN for a node that has no place."""
        return [*self._pose()[1]]

    def getOrientation(self) -> list[float]:
        """The rotation matrix in the world by rows: nine numbers."""
        return [*self._pose()[0]]

    def getPose(self, fromNode: Node | None = None) -> list[float]:
        """The 4 x 4 matrix by rows, in the world or in another node: sixteen numbers.

        As in Webots only this one is answered from the last step, where the pose is tracked.
        """
        tracked = self._session.tracked((self._id, fromNode._id if fromNode else None))
        r, (x, y, z) = tracked or self._pose(fromNode)
        return [*r[0:3], x, *r[3:6], y, *r[6:9], z, 0.0, 0.0, 0.0, 1.0]

    def _pose(self, seen_from: Node | None = None) -> Any:
        node_ids = (self._id, seen_from._id if seen_from else None)
        return self._session.ask("node_get_pose", *node_ids, default=_NO_POSE)

    def getVelocity(self) -> list[float]:
        """Linear (metres a second) and angular (radians a second) velocity: six numbers."""
        return [*self._session.ask("node_get_velocity", self._id, default=[nan] * 6)]

    def setVelocity(self, velocity: list[float]) -> None:
        """Set linear and angular velocity; on the plane, so x, y and the turn about z count."""
        self._session.ask("node_set_velocity", self._id, numbers(velocity, 6))

    def enablePoseTracking(self, samplingPeriod: int, fromNode: Node | None = None) -> None:
        """Have the pose sent with the steps, so that `getPose` need not ask for it."""
        period_ms = integer(samplingPeriod, position=2)
        self._session.track((self._id, fromNode._id if fromNode else None), period_ms)

    def disablePoseTracking(self, fromNode: Node | None = None) -> None:
        """Have it sent no more."""
        self._session.track((self._id, fromNode._id if fromNode else None), 0)

    def setJointPosition(self, position: float, index: int = 1) -> None:
        """Turn a HingeJoint to an angle in radians at once."""
        if integer(index, position=3) == 1:
            self._session.ask("node_set_joint_position", self._id, number(position))
        else:
            say(f"Error: wb_supervisor_node_set_joint_position(): a hinge has no axis {index}.")

    def restartController(self) -> None:
        """End the controller of this Robot node and start it again."""
        self._session.ask("node_restart_controller", self._id)

    def resetPhysics(self) -> None:
        """Take the node's speed away."""
        self._session.ask("node_reset_physics", self._id)


for _name, _number in CONSTANTS.items():
    setattr(Node, _name, _number)

node_of = Node._of  # pyright: ignore[reportPrivateUsage]
"""Makes the object for a node that the simulator has described."""
