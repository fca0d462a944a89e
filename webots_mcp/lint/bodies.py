"""The solids of a scene, the bodies that the physics engine makes of them, and their joints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np

from webots_mcp.lint.scene import JOINTS, NODE_TYPES, SOLIDS, Scene, TreeNode
from webots_mcp.lint.shapes import Array, BoundingShape, matrix_of, pose_of, shape_of
from webots_mcp.worlds.frames import CoordinateFrame

_UNSCALED: Final = [1.0, 1.0, 1.0]
_PARTS: Final = ("children", "endPoint", "startPoint", "rotatingHead")


@dataclass(eq=False)
class SolidPart:
    """A Solid, Robot or device with a place in the world.

    Attributes:
        node: Its node.
        frame: Its pose in the world; None if an unread PROTO or a scale is around it.
        parent: The Solid around it.
        joint: The joint between it and its parent.
        joint_frame: The pose of what is around the joint.
        is_in_unread: Whether a PROTO node whose source cannot be read is around it.
    """

    node: TreeNode
    frame: CoordinateFrame | None
    parent: SolidPart | None
    joint: TreeNode | None
    joint_frame: CoordinateFrame | None
    is_in_unread: bool
    children: list[SolidPart] = field(default_factory=list["SolidPart"])

    @property
    def physics(self) -> TreeNode | None:
        """Return its Physics node."""
        return self.node.child("physics")

    @property
    def bounding(self) -> TreeNode | None:
        """Return its bounding object."""
        return self.node.child("boundingObject")

    @cached_property
    def shape(self) -> BoundingShape:
        """Return the primitives of its bounding object."""
        if self.bounding is None:
            return BoundingShape(())
        shape = shape_of(self.bounding, self.frame or CoordinateFrame())
        return shape if self.frame else BoundingShape((), "its place is not known")

    def ancestors(self) -> Iterator[SolidPart]:
        """Yield the solids around it, the nearest first."""
        part = self.parent
        while part is not None:
            yield part
            part = part.parent

    def descendants(self) -> Iterator[SolidPart]:
        """Yield the solids in it."""
        for child in self.children:
            yield child
            yield from child.descendants()

    @property
    def robot(self) -> TreeNode | None:
        """Return the outermost Robot that it belongs to."""
        line = [self, *self.ancestors()]
        kinds = ("Robot", "DifferentialWheels")
        return next((each.node for each in reversed(line) if each.node.type_name in kinds), None)

    @cached_property
    def mass_kg(self) -> float | None:
        """Return its mass; None if it has no physics or if the mass is not known."""
        physics = self.physics
        if physics is None or physics.unread:
            return None
        if (mass := physics.number("mass")) > 0.0:
            return mass
        density = physics.number("density")
        if density <= 0.0 or self.bounding is None:
            return 1.0  # what Webots takes, with a warning
        volume = self.shape.volume_m3
        return None if volume is None else density * volume

    def inertia_about(self, point: Array, axis: Array) -> float | None:
        """Return the moment of inertia about a line in the world; None if it is not known."""
        physics, mass = self.physics, self.mass_kg
        if physics is None:
            return 0.0
        if mass is None or self.frame is None:
            return None
        local = CoordinateFrame(self.frame.rotation).inverse()
        center = physics.numbers("centerOfMass")
        direction = np.array(local.point(list(axis)))
        matrix = physics.numbers("inertiaMatrix")
        if len(matrix) == 6:
            inertia = inertia_matrix(matrix)
            middle = np.array(center[:3] if len(center) >= 3 else [0.0, 0.0, 0.0])
        else:
            shape = self.shape
            if shape.incomplete or shape.is_mesh or not shape.primitives or not shape.volume_m3:
                return None
            inertia, middle = _uniform(shape, mass)
            if len(center) >= 3:
                middle = np.array(center[:3])
        offset = np.array(self.frame.point(list(middle))) - point
        across = offset - axis * (offset @ axis)
        return float(direction @ inertia @ direction + mass * (across @ across))


def _uniform(shape: BoundingShape, mass: float) -> tuple[Array, Array]:
    """Return the inertia about the centre of a uniform bounding object, and that centre."""
    volume = shape.volume_m3 or 1.0
    parts = [(each, mass * each.volume_m3 / volume) for each in shape.primitives]
    middle = sum((m * np.array(p.in_solid.translation) for p, m in parts), np.zeros(3)) / mass
    total: Array = np.zeros((3, 3))
    for primitive, part in parts:
        turn = matrix_of(primitive.in_solid)
        offset = np.array(primitive.in_solid.translation) - middle
        turned: Array = turn @ primitive.inertia(part) @ np.transpose(turn)
        total = total + turned + part * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return total, middle


def inertia_matrix(values: list[float]) -> Array:
    """Return the matrix that an `inertiaMatrix` field of two vectors describes."""
    xx, yy, zz, xy, xz, yz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@dataclass(eq=False)
class PhysicsBody:
    """What the physics engine moves as one: a Solid with physics and those merged into it."""

    parts: list[SolidPart] = field(default_factory=list[SolidPart])
    joined: set[int] = field(default_factory=set[int])
    """Places in the list of bodies of those that a joint connects it with."""
    is_fixed: bool = False
    """Whether it cannot move: it is fixed to the static environment."""
    is_on_static: bool = False
    """Whether a joint connects it to the static environment."""

    @property
    def top(self) -> SolidPart:
        """Return the Solid that the others are merged into."""
        return self.parts[0]

    @property
    def mass_kg(self) -> float | None:
        """Return its mass; None if that of a part is not known."""
        masses = [part.mass_kg for part in self.parts]
        known = [each for each in masses if each is not None]
        return sum(known) if len(known) == len(masses) else None


class Bodies:
    """All solids of a scene with their poses, and the bodies that are made of them."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.parts: list[SolidPart] = []
        self.bodies: list[PhysicsBody] = []
        self.body_of: dict[SolidPart, int] = {}
        for root in scene.roots:
            self._walk(root, CoordinateFrame(), None, None, None, is_in_unread=False)
        for part in self.parts:
            self._place(part)
        self._refer()

    def _walk(
        self,
        node: TreeNode,
        frame: CoordinateFrame | None,
        parent: SolidPart | None,
        joint: TreeNode | None,
        joint_frame: CoordinateFrame | None,
        *,
        is_in_unread: bool,
    ) -> None:
        if node.unread:
            for child in node.children():
                self._walk(child, None, parent, None, None, is_in_unread=True)
            return
        if "rotation" in _fields_of(node):
            frame = frame.then(pose_of(node)) if frame else None
        if node.numbers("scale") not in ([], _UNSCALED):
            frame = None
        if node.type_name in SOLIDS:
            part = SolidPart(node, frame, parent, joint, joint_frame, is_in_unread)
            self.parts.append(part)
            if parent is not None:
                parent.children.append(part)
            parent, joint, joint_frame = part, None, None
        if node.type_name in JOINTS:
            joint, joint_frame = node, frame
        for child in node.children(*_PARTS):
            self._walk(child, frame, parent, joint, joint_frame, is_in_unread=is_in_unread)

    def _place(self, part: SolidPart) -> None:
        """Give a Solid with physics a body; those around it have theirs already."""
        if part.physics is None:
            return
        parent = part.parent
        above = self.body_of.get(parent) if parent else None
        if above is not None and part.joint is None:
            self.body_of[part] = above
            self.bodies[above].parts.append(part)
            return
        number = len(self.bodies)
        body = PhysicsBody([part])
        if above is not None:
            body.joined.add(above)
            self.bodies[above].joined.add(number)
        elif part.joint is not None:
            body.is_on_static = True
        elif parent is not None:
            body.is_fixed = True
        self.bodies.append(body)
        self.body_of[part] = number

    def _refer(self) -> None:
        """Connect the bodies that a SolidReference joins."""
        names = {part.node.text("name"): part for part in self.parts}
        for reference in self.scene.of_type("SolidReference"):
            name = reference.text("solidName")
            around = next((node for node in reference.around() if node.type_name in SOLIDS), None)
            here = next((part for part in self.parts if part.node is around), None)
            a = self.body_of.get(here) if here else None
            other = names.get(name)
            b = self.body_of.get(other) if other else None
            if a is not None and b is not None:
                self.bodies[a].joined.add(b)
                self.bodies[b].joined.add(a)
            elif a is not None or b is not None:
                self.bodies[a if a is not None else b or 0].is_on_static = True

    def joined_within(self, number: int, count: int) -> set[int]:
        """Return the bodies that at most this many joints connect with one."""
        near = {number}
        for _ in range(count):
            near |= {other for each in near for other in self.bodies[each].joined}
        return near

    def assembly_of(self, number: int) -> set[int]:
        """Return all bodies that joints connect with one, directly or not."""
        known, open_numbers = {number}, [number]
        while open_numbers:
            for other in self.bodies[open_numbers.pop()].joined - known:
                known.add(other)
                open_numbers.append(other)
        return known


def _fields_of(node: TreeNode) -> set[str]:
    return {*NODE_TYPES.get(node.type_name, {})}


class JointLine:
    """The line that a joint turns about or slides along, in the world."""

    def __init__(self, part: SolidPart) -> None:
        joint, frame = part.joint, part.joint_frame
        assert joint is not None
        self.parameters = joint.child("jointParameters")
        self.is_known = frame is not None and (
            self.parameters is None or not self.parameters.unread
        )
        source = self.parameters or TreeNode(
            "HingeJointParameters" if joint.type_name == "HingeJoint" else "JointParameters",
            "", "", joint.file, joint.line, joint.release, joint, "jointParameters", None,
        )  # fmt: skip
        axis = np.array((frame or CoordinateFrame()).turned(source.vector("axis", 3)))
        length = float(np.linalg.norm(axis))
        self.is_known = self.is_known and length > 1e-9
        self.axis = axis / (length or 1.0)
        self.anchor = np.array((frame or CoordinateFrame()).point(source.vector("anchor", 3)))
