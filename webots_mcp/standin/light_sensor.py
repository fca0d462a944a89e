"""The light sensor: what falls on it from the lights of the world."""

from __future__ import annotations

from math import acos, hypot
from typing import Any

from webots_mcp.standin.frame import Vector
from webots_mcp.standin.shapes import targets_from
from webots_mcp.standin.simulated_device import Device, resolved, table_of
from webots_mcp.standin.vrml import Node
from webots_mcp.standin.world import World

_SUN_M = 1000.0
"""How far away a DirectionalLight is, where something may stand in its light."""


class LightSensor(Device):
    """Adds up the irradiance of all lights, as Webots does; nothing reflects light."""

    kind = "LightSensor"

    def description(self) -> dict[str, Any]:
        """Add what the device's getters tell."""
        return super().description() | table_of(self.node)

    def measure(self, period_ms: float) -> float:
        """The looked-up value of the irradiance."""
        world = self.site.arena.world
        irradiance = sum(self._from(light, world) for light in self.site.arena.lights)
        return resolved(self.node, irradiance)

    def _from(self, light: Node, world: World) -> float:
        fields, seen_through = light.fields, self.node.fields["colorFilter"]
        if not fields["on"]:
            return 0.0
        way, distance_m = self._way_to(light, world)
        direct = fields["intensity"] * max(_dot(self._axis(), way), 0.0) * _spot(light, way, world)
        if direct and self.node.fields["occlusion"] and self._is_dark(way, distance_m):
            direct = 0.0
        color = _dot(fields["color"], seen_through) / 3.0
        return color * _attenuation(light, distance_m) * (fields["ambientIntensity"] + direct)

    def _axis(self) -> Vector:
        r = self.site.pose().rotation
        return r[0], r[3], r[6]

    def _way_to(self, light: Node, world: World) -> tuple[Vector, float]:
        """The direction of a light, a unit vector, and its distance in metres."""
        frame = world.frame_around(light)
        if light.type_name == "DirectionalLight":
            x, y, z = frame.turned(light.fields["direction"])
            return _unit((-x, -y, -z)), _SUN_M
        here, there = self.site.pose().translation, frame.point(light.fields["location"])
        way = (there[0] - here[0], there[1] - here[1], there[2] - here[2])
        return _unit(way), hypot(*way)

    def _is_dark(self, way: Vector, distance_m: float) -> bool:
        x, y, z = self.site.pose().translation
        level = hypot(way[0], way[1])
        if level < 1e-9:  # straight above
            return False
        dx, dy, reach_m = way[0] / level, way[1] / level, distance_m * level
        obstacles = self.site.arena.obstacles(without=self.site.body)
        for target in targets_from(obstacles, x, y, None, reach_m):
            away_m = target.distance_m(dx, dy)
            height_m = z + away_m * way[2] / level if away_m <= reach_m else -1.0
            if target.shape.bottom_m <= height_m <= target.shape.top_m:
                return True
        return False


def _attenuation(light: Node, distance_m: float) -> float:
    if light.type_name == "DirectionalLight":
        return 1.0
    a, b, c = light.fields["attenuation"]
    return 1.0 / max(a + b * distance_m + c * distance_m**2, 1e-9)


def _spot(light: Node, way: Vector, world: World) -> float:
    """How much of a SpotLight's beam goes this way, 0 to 1."""
    if light.type_name != "SpotLight":
        return 1.0
    beam = _unit(world.frame_around(light).turned(light.fields["direction"]))
    angle = acos(min(max(-_dot(beam, way), -1.0), 1.0))
    cut_off, full = light.fields["cutOffAngle"], light.fields["beamWidth"]
    if angle > cut_off:
        return 0.0
    return 1.0 if angle <= full else (angle - cut_off) / (full - cut_off)


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _unit(vector: Vector) -> Vector:
    x, y, z = vector
    length = hypot(x, y, z) or 1.0
    return x / length, y / length, z / length
