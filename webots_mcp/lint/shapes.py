"""Bounding objects: their primitives, volumes and inertias, and how deep two of them overlap."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, pi, sqrt
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from webots_mcp.lint.scene import ENU_SINCE, TreeNode
from webots_mcp.worlds.frames import CoordinateFrame, frame_of

Array = NDArray[np.float64]
Kind = Literal["Box", "Cylinder", "Capsule", "Sphere", "Plane"]
_GEOMETRIES: Final = frozenset({"Box", "Cylinder", "Capsule", "Sphere", "Plane"})
_MESHES: Final = frozenset({"IndexedFaceSet", "Mesh", "ElevationGrid", "Cone"})
_FROM_Y_TO_Z: Final = CoordinateFrame((1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0))
"""Before R2022a, primitives stood along y."""
_REFINEMENTS_RAD: Final = (0.05, 0.02, 0.008, 0.003, 0.001, 0.0003)
_STARTS: Final = 4


def _sphere_points(count: int) -> Array:
    """Return directions that are spread evenly over a sphere."""
    i = np.arange(count) + 0.5
    height, angle = 1.0 - 2.0 * i / count, pi * (1.0 + sqrt(5.0)) * i
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


_DIRECTIONS: Final = _sphere_points(600)
_AROUND: Final = _sphere_points(24)


@dataclass(frozen=True, eq=False)
class Primitive:
    """A convex primitive of a bounding object, placed in the world.

    Attributes:
        kind: Its geometry.
        center: Its centre in the world, in metres.
        axes: Columns are its axes in the world.
        half: Half its size along each axis; the radius along x and y of a cylinder or capsule. A
            capsule's half along z is that of its cylinder.
        in_solid: Its pose in the Solid.
    """

    kind: Kind
    center: Array
    axes: Array
    half: Array
    in_solid: CoordinateFrame

    @property
    def volume_m3(self) -> float:
        """Return its volume."""
        x, y, z = self.half
        if self.kind == "Box":
            return float(8.0 * x * y * z)
        if self.kind == "Cylinder":
            return float(pi * x * x * 2.0 * z)
        if self.kind == "Sphere":
            return float(4.0 / 3.0 * pi * x**3)
        if self.kind == "Capsule":
            return float(pi * x * x * 2.0 * z + 4.0 / 3.0 * pi * x**3)
        return 0.0

    def inertia(self, mass_kg: float) -> Array:
        """Return the inertia about its centre and its own axes; a capsule counts as a cylinder."""
        x, y, z = self.half
        if self.kind == "Sphere":
            return np.eye(3) * 0.4 * mass_kg * x * x
        if self.kind == "Box":
            squares = np.array([y * y + z * z, x * x + z * z, x * x + y * y])
            return np.eye(3) * squares * mass_kg / 3.0
        across = mass_kg * (3.0 * x * x + 4.0 * z * z) / 12.0
        return np.eye(3) * np.array([across, across, 0.5 * mass_kg * x * x])

    def support(self, directions: Array) -> Array:
        """Return how far it extends from its centre in each direction."""
        local = directions @ self.axes
        x, _, z = self.half
        if self.kind == "Box":
            return np.abs(local) @ self.half
        if self.kind == "Sphere":
            return np.full(len(directions), float(x))
        along = np.abs(local[:, 2]) * z
        if self.kind == "Capsule":
            return along + x
        return along + x * np.sqrt(np.maximum(1.0 - local[:, 2] ** 2, 0.0))

    @property
    def extent(self) -> Array:
        """Return half the size of the upright box around it; infinite for a plane."""
        if self.kind == "Plane":
            return np.full(3, inf)
        return self.support(np.eye(3))


@dataclass(frozen=True)
class BoundingShape:
    """The bounding object of a Solid.

    Attributes:
        primitives: Its convex primitives.
        incomplete: Why something of it is missing here; empty if nothing is.
        is_mesh: Whether it has a mesh or an elevation grid.
    """

    primitives: tuple[Primitive, ...]
    incomplete: str = ""
    is_mesh: bool = False

    @property
    def volume_m3(self) -> float | None:
        """Return the sum of the volumes, as Webots counts them; None if it is not known."""
        if self.incomplete or self.is_mesh:
            return None
        return sum(each.volume_m3 for each in self.primitives)


def shape_of(bounding: TreeNode, solid_frame: CoordinateFrame) -> BoundingShape:
    """Return the bounding object of a Solid with this pose in the world."""
    found: list[Primitive] = []
    missing: list[str] = []
    for geometry, frame in _geometries(bounding, CoordinateFrame()):
        if geometry.unread:
            missing.append(f"{geometry.written_type}: {geometry.unread}")
        elif geometry.type_name in _MESHES:
            missing.append("")
        elif geometry.type_name == "Transform":
            missing.append("a Transform scales it")
        else:
            primitive = _primitive(geometry, frame, solid_frame)
            if primitive is not None:
                found.append(primitive)
            else:
                missing.append(f"{geometry.path} has no valid size")
    why = next((each for each in missing if each), "")
    return BoundingShape(tuple(found), why, "" in missing)


def _geometries(
    node: TreeNode, frame: CoordinateFrame
) -> Iterator[tuple[TreeNode, CoordinateFrame]]:
    """Yield primitives and meshes with their pose in the Solid; also what cannot be read."""
    if node.type_name == "Shape":
        geometry = node.child("geometry")
        if geometry is not None:
            yield from _geometries(geometry, frame)
    elif node.type_name in ("Group", "Pose", "Transform"):
        if node.type_name == "Transform" and node.vector("scale", 3) != [1.0, 1.0, 1.0]:
            yield node, frame
            return
        inner = frame.then(pose_of(node)) if node.type_name != "Group" else frame
        for child in node.children("children"):
            yield from _geometries(child, inner)
    elif node.unread or node.type_name in _GEOMETRIES or node.type_name in _MESHES:
        yield node, frame


def matrix_of(frame: CoordinateFrame) -> Array:
    """Return the rotation of a frame as a matrix."""
    r = frame.rotation
    return np.array([[r[0], r[1], r[2]], [r[3], r[4], r[5]], [r[6], r[7], r[8]]])


def columns_of(matrix: Array) -> list[Array]:
    """Return the columns of a matrix."""
    return [matrix[:, 0], matrix[:, 1], matrix[:, 2]]


def pose_of(node: TreeNode) -> CoordinateFrame:
    """Return the pose of a node in its parent."""
    return frame_of(node.vector("translation", 3), node.vector("rotation", 4))


def _primitive(
    node: TreeNode, in_solid: CoordinateFrame, solid_frame: CoordinateFrame
) -> Primitive | None:
    half = _half_size(node)
    if half is None:
        return None
    if node.type_name not in ("Box", "Sphere") and node.release < ENU_SINCE:
        in_solid = in_solid.then(_FROM_Y_TO_Z)
    world = solid_frame.then(in_solid)
    kind: Any = node.type_name
    return Primitive(
        kind,
        np.array(world.translation),
        matrix_of(world),
        np.array(half),
        in_solid,
    )


def _half_size(node: TreeNode) -> list[float] | None:
    if node.type_name == "Plane":
        return [inf, inf, 0.0]
    if node.type_name == "Box":
        half = [each / 2.0 for each in node.vector("size", 3)]
    elif node.type_name == "Sphere":
        half = [node.number("radius")] * 3
    else:
        radius = node.number("radius")
        half = [radius, radius, node.number("height") / 2.0]
    return half if all(0.0 < each < 1e9 for each in half) else None


def overlap_m(a: Primitive, b: Primitive, enough_m: float = -inf) -> float:
    """Return how deep two primitives overlap: the shortest shift that parts them.

    It is the minimum over all directions of the overlap of their shadows on that direction, which
    is exact at the faces of boxes and planes and approached from above elsewhere. Negative: the
    gap between them.

    Args:
        a: A primitive.
        b: Another.
        enough_m: The search ends once the result is known to be below this.
    """
    if a.kind == "Plane" or b.kind == "Plane":
        return _plane_overlap(a, b)
    apart = b.center - a.center
    of_a, of_b = columns_of(a.axes), columns_of(b.axes)
    special: list[Array] = [*of_a, *of_b, apart]
    special += [np.cross(u, v) for u in of_a for v in of_b]
    special += [apart - axis * (axis @ apart) for axis in (a.axes[:, 2], b.axes[:, 2])]
    lengths = [float(np.linalg.norm(each)) for each in special]
    known = [each / size for each, size in zip(special, lengths, strict=True) if size > 1e-9]
    first = np.array([*known, *(-each for each in known)])
    depths = _shadows(a, b, apart, first)
    if depths.min() < enough_m:
        return float(depths.min())
    directions = np.concatenate([first, _DIRECTIONS])
    depths = np.concatenate([depths, _shadows(a, b, apart, _DIRECTIONS)])
    best = directions[np.argsort(depths)[:_STARTS]]
    deepest = float(depths.min())
    for start in best:
        direction = start
        for angle in _REFINEMENTS_RAD:
            around = direction + angle * _AROUND
            around /= np.linalg.norm(around, axis=1, keepdims=True)
            found = _shadows(a, b, apart, around)
            if found.min() < deepest:
                deepest, direction = float(found.min()), around[found.argmin()]
    return deepest


def _shadows(a: Primitive, b: Primitive, apart: Array, directions: Array) -> Array:
    return a.support(directions) + b.support(directions) - directions @ apart


def _plane_overlap(a: Primitive, b: Primitive) -> float:
    plane, other = (a, b) if a.kind == "Plane" else (b, a)
    if other.kind == "Plane":
        return -inf
    normal = plane.axes[:, 2]
    reach = float(other.support(normal[None, :])[0])
    return reach - float((other.center - plane.center) @ normal)
