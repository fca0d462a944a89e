"""The nodes of a world's scene tree and their fields, and the walk through all of them.

Reading a field or one of its entries may be a request to Webots, so a walk is a generator: its
caller decides when to continue. It skips shapes and appearances unless `everything` is set.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from typing import Any, Final, NamedTuple

MOST_NODES: Final = 5000  # that one walk yields
DEEPEST: Final = 24  # levels below the root
MOST_FIELDS: Final = 100  # of one node
_CHILDREN: Final = ("children",)
# By base type: the fields that contain solids, joints and devices. Other types contain none.
_FIELDS: Final[dict[str, tuple[str, ...]]] = {
    **dict.fromkeys(("Group", "Pose", "Transform", "Billboard", "Solid", "Robot"), _CHILDREN),
    **dict.fromkeys(("Accelerometer", "Altimeter", "Camera", "Charger", "Compass"), _CHILDREN),
    **dict.fromkeys(("Connector", "Display", "DistanceSensor", "Emitter", "GPS"), _CHILDREN),
    **dict.fromkeys(("Gyro", "InertialUnit", "LED", "Lidar", "LightSensor", "Pen"), _CHILDREN),
    **dict.fromkeys(("Radar", "RangeFinder", "Receiver", "Speaker", "TouchSensor"), _CHILDREN),
    **dict.fromkeys(("VacuumGripper", "Fluid"), _CHILDREN),
    **dict.fromkeys(("HingeJoint", "SliderJoint"), ("device", "endPoint")),
    "Hinge2Joint": ("device", "device2", "endPoint"),
    "BallJoint": ("device", "device2", "device3", "endPoint"),
    "Propeller": ("device",),
    "Slot": ("endPoint",),
    "Track": ("device", *_CHILDREN),
}
WALKED: Final = frozenset(_FIELDS)
"""Base types of the nodes that a walk yields even without `everything`."""
_GROUPS: Final = ("Group", "Pose", "Transform")  # whose only field of nodes is `children`
_NO_SOLIDS: Final = ("Group", "Pose", "Transform", "Billboard", "Fluid")
SOLIDS: Final = frozenset(
    name for name, fields in _FIELDS.items() if "children" in fields and name not in _NO_SOLIDS
)
"""Base types that are a Solid or one of its subclasses: they have a `name` and a velocity."""


class SceneNode(NamedTuple):
    """A node and its position in the tree.

    Attributes:
        node: Webots' `Node`.
        id: Its number, which is unique in the world and never used again.
        type_name: The PROTO's name, such as `E-puck`; else the same as `base_type`.
        base_type: The type of node, such as `Robot`.
        definition: Its DEF name, or "".
        parent: Its parent node; None at the top of the tree.
        field: The field of the parent, or of the root, that contains it.
        entry: Its index in that field; None where the field holds a single node.
        hidden: It is inside a PROTO node: it can be read, but not changed.
    """

    node: Any
    id: int
    type_name: str
    base_type: str
    definition: str
    parent: SceneNode | None
    field: str
    entry: int | None
    hidden: bool

    @classmethod
    def of(
        cls, node: Any, parent: SceneNode | None, field: str, index: int | None, *, hidden: bool
    ) -> SceneNode:
        """Read the facts of a `Node` of Webots and add its position in the tree."""
        kinds = (node.getTypeName(), node.getBaseTypeName(), node.getDef())
        return cls(node, int(node.getId()), *kinds, parent, field, index, hidden)

    @property
    def depth(self) -> int:
        """The number of its ancestors."""
        return 0 if self.parent is None else self.parent.depth + 1

    @property
    def is_solid(self) -> bool:
        """Whether it is a Solid, a Robot or a device that is one."""
        return self.base_type in SOLIDS

    @property
    def is_proto(self) -> bool:
        """Whether it is an instance of a PROTO."""
        return bool(self.node.isProto())

    @property
    def name(self) -> str:
        """The value of its field `name`; "" where it has none."""
        value = read_value(self.node, "name")
        return value if isinstance(value, str) else ""


class NodeField(NamedTuple):
    """A field that can hold nodes.

    Attributes:
        name: Its name.
        field: Webots' `Field`.
        hidden: It belongs to the internal node of a PROTO.
    """

    name: str
    field: Any
    hidden: bool


def walk(
    root: Any,
    *,
    most: int = MOST_NODES,
    deepest: int = DEEPEST,
    inside: bool = True,
    everything: bool = False,
) -> Generator[SceneNode]:
    """Yield the nodes of the tree, each once, breadth first.

    Args:
        root: The node to begin at, which is not yielded itself: `supervisor.getRoot()`, or another.
        most: The largest number of nodes to yield.
        deepest: The largest number of levels below the root.
        inside: Also yield the nodes inside PROTO nodes, which Webots allows to be read.
        everything: Also yield shapes, appearances and the like.
    """
    seen: set[int] = {int(root.getId())}
    waiting: deque[tuple[Any, SceneNode | None]] = deque([(root, None)])
    while waiting:
        node, around = waiting.popleft()
        for found in _nodes_in(node, around, inside=inside, everything=everything):
            if found.id in seen:  # a USE, or a node that is reachable through a slot as well
                continue
            if len(seen) > most:
                return
            seen.add(found.id)
            if found.depth + 1 < deepest:
                waiting.append((found.node, found))
            yield found


def world_up_axis(robot: Any) -> int:
    """Return the axis of the world that points up: 1 (y) in a world of type NUE, else 2 (z).

    Args:
        robot: A Supervisor.
    """
    top = walk(robot.getRoot(), deepest=1, everything=True)
    infos = (scene.node for scene in top if scene.base_type == "WorldInfo")
    return next((1 for info in infos if read_value(info, "coordinateSystem") == "NUE"), 2)


def holds_solids(node: Any) -> bool:
    """Return whether a walk yields a node even without `everything`."""
    return node.getBaseTypeName() in WALKED


def node_fields(node: Any, *, inside: bool = True, everything: bool = False) -> Iterator[NodeField]:
    """Yield the fields that can contain nodes; those inside a PROTO node come last."""
    base_type: str = node.getBaseTypeName()
    if node.isProto() or (everything and base_type not in _GROUPS):
        yield from _all_node_fields(node)
    elif base_type in _FIELDS:
        for name in _FIELDS[base_type]:
            if (field := node.getField(name)) is not None:
                yield NodeField(name, field, False)
    if inside and node.isProto():
        for name in _FIELDS.get(base_type, ()):
            if (field := find_inner_field(node, name)) is not None:
                yield NodeField(name, field, True)


def children(root: Any) -> Any:
    """Return the field of a node that contains its children; of the root the top nodes."""
    return root.getField("children")


def fields_of(node: Any) -> Iterator[Any]:
    """Yield the fields of a node; of a PROTO node its own."""
    found = (node.getFieldByIndex(i) for i in range(min(node.getNumberOfFields(), MOST_FIELDS)))
    return (field for field in found if field is not None)


def field_names(node: Any) -> list[str]:
    """Return the names of the fields of a node; of a PROTO node its own."""
    return [field.getName() for field in fields_of(node)]


def find_field(node: Any, name: str) -> Any | None:
    """Return a field of a node, or else of the node that a PROTO node is made of."""
    field = node.getField(name)
    return find_inner_field(node, name) if field is None else field


def find_inner_field(node: Any, name: str) -> Any | None:
    """Return a read-only field of the node that a PROTO node is made of; None without one."""
    # R2025a renamed what R2023b calls getProtoField.
    get_field = getattr(node, "getBaseNodeField", None) or getattr(node, "getProtoField", None)
    return None if get_field is None or not node.isProto() else get_field(name)


def read_value(node: Any, name: str) -> Any | None:
    """Return the value of a single-valued field; None if the node has no such field."""
    field = find_field(node, name)
    return None if field is None or field.getCount() >= 0 else field.value


def entries(field: Any) -> Iterator[tuple[int | None, Any]]:
    """Yield the nodes in a field with their indices."""
    if field.getTypeName() == "SFNode":
        node = field.getSFNode()
        if node is not None:
            yield None, node
        return
    for index in range(field.getCount()):
        node = field.getMFNode(index)
        if node is not None:
            yield index, node


def label(node: Any) -> str:
    """Return a short label of a node: its type, with its DEF name or else its name."""
    name = node.getDef() or read_value(node, "name")
    return f"{node.getTypeName()} {name}" if name else str(node.getTypeName())


def _nodes_in(
    node: Any, around: SceneNode | None, *, inside: bool, everything: bool
) -> Iterator[SceneNode]:
    hidden = around is not None and around.hidden
    for name, field, is_inside in node_fields(node, inside=inside, everything=everything):
        for index, child in entries(field):
            if everything or child.getBaseTypeName() in _FIELDS or name.startswith("device"):
                yield SceneNode.of(child, around, name, index, hidden=hidden or is_inside)


def _all_node_fields(node: Any) -> Iterator[NodeField]:
    for index in range(node.getNumberOfFields()):
        field = node.getFieldByIndex(index)
        if field is not None and field.getTypeName() in ("SFNode", "MFNode"):
            yield NodeField(field.getName(), field, False)
