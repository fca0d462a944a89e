"""The touch sensor: bumpers and force sensors."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from math import atan2, hypot, pi
from typing import Any, Final

from webots_mcp.standin.arena import Part, bounding_parts
from webots_mcp.standin.simulated_device import Device, Site, resolved, table_of
from webots_mcp.standin.vrml import Node

_TYPES: Final = {"bumper": 0, "force": 1, "force-3d": 2}


class TouchSensor(Device):
    """Feels what the robot runs into on the side where the sensor's bounding object is.

    A robot touches things as a disc, so the sensor answers for the part of that disc which its
    bounding object covers, seen from the middle.
    """

    kind = "TouchSensor"

    def __init__(self, tag: int, node: Node, site: Site) -> None:
        super().__init__(tag, node, site)
        disc = site.body.footprint
        parts = bounding_parts(node, site.frame)
        self._sides = [side for part in parts for side in _sides(part, disc.ahead_m, disc.left_m)]

    def description(self) -> dict[str, Any]:
        """Add what the device's getters tell."""
        kind = _TYPES.get(self.node.fields["type"], 0)
        return super().description() | {"type": kind} | table_of(self.node)

    def measure(self, period_ms: float) -> float | list[float]:
        """Of a bumper 0 or 1, else the force in newtons, looked up."""
        kind = self.node.fields["type"]
        fx, fy = self._force_n()
        if kind not in ("force", "force-3d"):
            return float(bool(self._felt()))
        force = self.site.pose().direction((fx, fy, 0.0))
        if kind == "force":  # its x axis points outwards, against what presses
            return resolved(self.node, -force[0])
        return [resolved(self.node, part) for part in force]

    def _felt(self) -> list[tuple[float, float]]:
        """How far what it touches pushed the robot back in the last step, metres."""
        yaw = self.site.body.yaw_rad
        return [
            push
            for push in self.site.body.touched
            if any(
                abs(_turn(atan2(-push[1], -push[0]) - yaw - at)) <= half for at, half in self._sides
            )
        ]

    def _force_n(self) -> tuple[float, float]:
        """The momentum that was taken from the robot in the last step, by its duration."""
        scale = self.site.body.mass_kg() / self.site.arena.step_s**2
        felt = self._felt()
        return scale * sum(x for x, _ in felt), scale * sum(y for _, y in felt)


def _sides(part: Part, ahead_m: float, left_m: float) -> Iterator[tuple[float, float]]:
    """The directions that a part covers: the middle one and half of the angle, in radians."""
    (x, y, _), (hx, hy, _) = part.frame.translation, part.half_m
    x, y = x - ahead_m, y - left_m
    if hypot(x, y) <= min(hx, hy):
        yield 0.0, pi
        return
    middle = atan2(y, x)
    corners = [
        part.frame.point((sx * hx, sy * hy, 0.0)) for sx, sy in product((-1.0, 1.0), repeat=2)
    ]
    angles = [_turn(atan2(cy - left_m, cx - ahead_m) - middle) for cx, cy, _ in corners]
    yield middle, max(abs(angle) for angle in angles)


def _turn(angle_rad: float) -> float:
    return angle_rad - 2.0 * pi * round(angle_rad / (2.0 * pi))
