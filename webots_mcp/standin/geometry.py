"""Upright shapes on a plane that rays hit and that push a disc away.

A box is a turned rectangle, a cylinder or a ball a disc, each between a bottom and a top.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import hypot, inf, sqrt
from typing import NamedTuple, TypeAlias

Color = tuple[float, float, float]
"""Red, green and blue, each 0 to 1."""
Push: TypeAlias = "tuple[float, float] | None"
"""The shift in metres that frees a shape from another; None if they do not touch."""
Target: TypeAlias = "Edge | Circle | EnclosingShape"
"""What a ray from a point can hit."""
Shape: TypeAlias = "UprightBox | Disc"


class Edge(NamedTuple):
    """One side of a box. All values are relative to the point that it is seen from."""

    nx: float
    ny: float
    offset_m: float
    """Distance from the point to the line through the edge."""
    ex: float
    ey: float
    start_m: float
    """Start of the edge, measured along (ex, ey)."""
    length_m: float
    shape: Shape

    def distance_m(self, dx: float, dy: float) -> float:
        """Return the length of a ray in direction (dx, dy) until it hits; inf if it does not."""
        closing = self.nx * dx + self.ny * dy
        if closing <= 1e-12:
            return inf
        distance = self.offset_m / closing
        along = distance * (self.ex * dx + self.ey * dy) - self.start_m
        return distance if 0.0 <= along <= self.length_m else inf

    def inward(self, distance_m: float, dx: float, dy: float) -> tuple[float, float]:
        """Return the direction at right angles into the shape where a ray hits it."""
        return self.nx, self.ny


class Circle(NamedTuple):
    """The outline of a disc, relative to the point that it is seen from."""

    x: float
    y: float
    radius_m: float
    gap_m2: float
    """Squared distance to the centre minus squared radius."""
    shape: Shape

    def distance_m(self, dx: float, dy: float) -> float:
        """Return the length of a ray in direction (dx, dy) until it hits; inf if it does not."""
        ahead = self.x * dx + self.y * dy
        square = ahead * ahead - self.gap_m2
        return ahead - sqrt(square) if ahead > 0.0 and square >= 0.0 else inf

    def inward(self, distance_m: float, dx: float, dy: float) -> tuple[float, float]:
        """Return the direction at right angles into the shape where a ray hits it."""
        return (self.x - distance_m * dx) / self.radius_m, (
            self.y - distance_m * dy
        ) / self.radius_m


class EnclosingShape(NamedTuple):
    """A shape around the point that rays start from."""

    shape: Shape

    def distance_m(self, dx: float, dy: float) -> float:
        """Return 0: the ray ends where it starts."""
        return 0.0

    def inward(self, distance_m: float, dx: float, dy: float) -> tuple[float, float]:
        """Return the ray's own direction."""
        return dx, dy


@dataclass(frozen=True)
class UprightBox:
    """A box that stands upright."""

    x: float
    y: float
    cos_yaw: float
    sin_yaw: float
    half_x_m: float
    half_y_m: float
    bottom_m: float
    top_m: float
    color: Color

    def _local(self, x: float, y: float) -> tuple[float, float]:
        dx, dy = x - self.x, y - self.y
        return self.cos_yaw * dx + self.sin_yaw * dy, self.cos_yaw * dy - self.sin_yaw * dx

    def targets(self, x: float, y: float, height_m: float | None, reach_m: float) -> list[Target]:
        """Return the sides that can be seen from a point, at one height or (None) at any."""
        if height_m is not None and not self.bottom_m <= height_m <= self.top_m:
            return []
        u, v = self._local(x, y)
        a, b = self.half_x_m, self.half_y_m
        beyond_x, beyond_y = abs(u) - a, abs(v) - b
        if beyond_x > reach_m or beyond_y > reach_m:
            return []
        if beyond_x <= 0.0 and beyond_y <= 0.0:
            return [] if height_m is None else [EnclosingShape(self)]
        c, s = self.cos_yaw, self.sin_yaw
        seen: list[Target] = []
        if beyond_x > 0.0:
            side = 1.0 if u > 0.0 else -1.0
            seen.append(Edge(-c * side, -s * side, beyond_x, -s, c, -b - v, 2.0 * b, self))
        if beyond_y > 0.0:
            side = 1.0 if v > 0.0 else -1.0
            seen.append(Edge(s * side, -c * side, beyond_y, c, s, -a - u, 2.0 * a, self))
        return seen

    def push(self, x: float, y: float, radius_m: float) -> Push:
        """Return the shortest shift that moves a disc out of this box."""
        u, v = self._local(x, y)
        if abs(u) >= self.half_x_m + radius_m or abs(v) >= self.half_y_m + radius_m:
            return None
        pu, pv = self._local_push(u, v, radius_m)
        if not pu and not pv:
            return None
        c, s = self.cos_yaw, self.sin_yaw
        return c * pu - s * pv, s * pu + c * pv

    def _local_push(self, u: float, v: float, radius_m: float) -> tuple[float, float]:
        a, b = self.half_x_m, self.half_y_m
        du, dv = u - min(max(u, -a), a), v - min(max(v, -b), b)
        if distance := hypot(du, dv):
            depth = max(radius_m - distance, 0.0) / distance
            return du * depth, dv * depth
        if a - abs(u) < b - abs(v):  # The centre is inside the box: leave by the nearest side.
            return (a - abs(u) + radius_m) * (1.0 if u >= 0.0 else -1.0), 0.0
        return 0.0, (b - abs(v) + radius_m) * (1.0 if v >= 0.0 else -1.0)


@dataclass(frozen=True)
class Disc:
    """A cylinder that stands upright, or a ball."""

    x: float
    y: float
    radius_m: float
    bottom_m: float
    top_m: float
    color: Color
    is_ball: bool = False

    def targets(self, x: float, y: float, height_m: float | None, reach_m: float) -> list[Target]:
        """Return the outline seen from a point, at one height or (None) at any."""
        radius = self.radius_m if height_m is None else self._radius_at(height_m)
        cx, cy = self.x - x, self.y - y
        gap = cx * cx + cy * cy - radius * radius
        if radius <= 0.0 or gap > reach_m * (reach_m + 2.0 * radius):
            return []
        if gap <= 0.0:
            return [] if height_m is None else [EnclosingShape(self)]
        return [Circle(cx, cy, radius, gap, self)]

    def _radius_at(self, height_m: float) -> float:
        if not self.bottom_m <= height_m <= self.top_m:
            return 0.0
        if not self.is_ball:
            return self.radius_m
        above = height_m - (self.bottom_m + self.top_m) / 2.0
        return sqrt(max(self.radius_m**2 - above**2, 0.0))

    def push(self, x: float, y: float, radius_m: float) -> Push:
        """Return the shift that moves another disc out of this one."""
        dx, dy = x - self.x, y - self.y
        distance = hypot(dx, dy)
        depth = self.radius_m + radius_m - distance
        if depth <= 0.0:
            return None
        return (dx / distance * depth, dy / distance * depth) if distance else (depth, 0.0)


def targets_from(
    shapes: Iterable[Shape], x: float, y: float, height_m: float | None, reach_m: float = inf
) -> list[Target]:
    """Return everything that rays from a point can hit.

    Args:
        shapes: The shapes around the point.
        x: Start of the rays, in metres.
        y: Start of the rays, in metres.
        height_m: Height of the rays; None for shapes at any height.
        reach_m: Length of the rays. Shapes that are farther away may be left out.
    """
    return [t for shape in shapes for t in shape.targets(x, y, height_m, reach_m)]


def nearest_m(targets: Iterable[Target], dx: float, dy: float) -> float:
    """Return the distance to the first target in the direction of a unit vector; inf for none."""
    nearest = inf
    for target in targets:
        distance = target.distance_m(dx, dy)
        if distance < nearest:
            nearest = distance
    return nearest
