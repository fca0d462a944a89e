"""Poses: positions and orientations of nodes, and how they follow from each other."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, hypot, sin
from typing import Final, NamedTuple, cast

Matrix = tuple[float, float, float, float, float, float, float, float, float]
"""A rotation by rows, as `Node.getOrientation` gives it."""
Vector = tuple[float, float, float]

IDENTITY: Final[Matrix] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class CoordinateFrame(NamedTuple):
    """Position and orientation of something, seen from its parent."""

    rotation: Matrix = IDENTITY
    translation: Vector = (0.0, 0.0, 0.0)

    @property
    def yaw_rad(self) -> float:
        """Return the heading: the rotation about the vertical axis."""
        return atan2(self.rotation[3], self.rotation[0])

    def point(self, local: Sequence[float]) -> Vector:
        """Return a point of this frame, seen from the parent."""
        x, y, z = local
        r, (tx, ty, tz) = self.rotation, self.translation
        return (
            r[0] * x + r[1] * y + r[2] * z + tx,
            r[3] * x + r[4] * y + r[5] * z + ty,
            r[6] * x + r[7] * y + r[8] * z + tz,
        )

    def inverse(self) -> CoordinateFrame:
        """Return the parent, seen from this frame."""
        r = self.rotation
        turned = CoordinateFrame((r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]))
        x, y, z = turned.point(self.translation)
        return CoordinateFrame(turned.rotation, (-x, -y, -z))

    def direction(self, outside: Sequence[float]) -> Vector:
        """Return a direction of the parent, seen from this frame."""
        return self.inverse().turned(outside)

    def turned(self, local: Sequence[float]) -> Vector:
        """Return a direction of this frame, seen from the parent."""
        return CoordinateFrame(self.rotation).point(local)

    def then(self, inner: CoordinateFrame) -> CoordinateFrame:
        """Return a frame inside this one, seen from the parent."""
        a, b = self.rotation, inner.rotation
        rows = ((a[i], a[i + 1], a[i + 2]) for i in (0, 3, 6))
        product = (p * b[k] + q * b[k + 3] + r * b[k + 6] for p, q, r in rows for k in (0, 1, 2))
        return CoordinateFrame(cast("Matrix", tuple(product)), self.point(inner.translation))


def _rotation_matrix(axis_angle: Sequence[float]) -> Matrix:
    """Return the matrix of an SFRotation (axis x, y, z and angle in radians)."""
    x, y, z, angle = axis_angle
    length = hypot(x, y, z)
    if length == 0.0:
        return IDENTITY
    x, y, z = x / length, y / length, z / length
    c, s = cos(angle), sin(angle)
    v = 1.0 - c
    return (
        *(x * x * v + c, x * y * v - z * s, x * z * v + y * s),
        *(y * x * v + z * s, y * y * v + c, y * z * v - x * s),
        *(z * x * v - y * s, z * y * v + x * s, z * z * v + c),
    )


def frame_of(translation: Sequence[float], axis_angle: Sequence[float]) -> CoordinateFrame:
    """Return the frame that a `translation` and a `rotation` field describe."""
    x, y, z = translation
    return CoordinateFrame(_rotation_matrix(axis_angle), (x, y, z))
