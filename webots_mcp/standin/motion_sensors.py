"""Sensors that feel how the robot moves and turns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from math import nan
from typing import Any

from webots_mcp.standin.frame import Vector
from webots_mcp.standin.simulated_device import Device, Site, resolved, table_of
from webots_mcp.standin.vrml import Node


class MotionSensor(Device, ABC):
    """Three numbers along the sensor's own axes; a disabled axis shows NaN."""

    def description(self) -> dict[str, Any]:
        """Add what the device's getters tell."""
        return super().description() | table_of(self.node)

    def measure(self, period_ms: float) -> list[float]:
        """What is felt along x, y and z of the sensor."""
        felt = self.site.pose().direction(self.feel(period_ms / 1000.0))
        axes = (self.node.fields[axis] for axis in ("xAxis", "yAxis", "zAxis"))
        return [
            resolved(self.node, value) if on else nan for value, on in zip(felt, axes, strict=True)
        ]

    @abstractmethod
    def feel(self, period_s: float) -> Vector:
        """What is felt now, along the axes of the world."""


class Accelerometer(MotionSensor):
    """The change of the sensor's velocity since its last sample, and what carries its weight."""

    kind = "Accelerometer"

    def __init__(self, tag: int, node: Node, site: Site) -> None:
        super().__init__(tag, node, site)
        self._last_mps: tuple[float, float] | None = None

    def make_due(self) -> None:
        """Forget the last velocity as well."""
        super().make_due()
        self._last_mps = None

    def feel(self, period_s: float) -> Vector:
        """Metres a second squared; standing still, the reaction to gravity, upwards."""
        now, before = self._velocity_mps(), self._last_mps
        self._last_mps = now
        (vx, vy), (ux, uy) = now, before or now
        return (vx - ux) / period_s, (vy - uy) / period_s, self.site.arena.gravity_mps2

    def _velocity_mps(self) -> tuple[float, float]:
        body, (x, y, _) = self.site.body, self.site.pose().translation
        (vx, vy), turning = body.velocity_mps, body.yaw_rate_radps
        return vx - turning * (y - body.y), vy + turning * (x - body.x)


class Gyro(MotionSensor):
    """How fast the robot turns, radians a second."""

    kind = "Gyro"

    def feel(self, period_s: float) -> Vector:
        """On a flat floor it turns about the vertical axis only."""
        return 0.0, 0.0, self.site.body.yaw_rate_radps


class Compass(MotionSensor):
    """Where north is: the direction of the world's y axis."""

    kind = "Compass"

    def feel(self, period_s: float) -> Vector:
        """A unit vector."""
        return 0.0, 1.0, 0.0
