"""What all devices of a simulated robot have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import cos, sin
from typing import Any

from webots_mcp.standin.arena import Arena, Body
from webots_mcp.standin.frame import Frame
from webots_mcp.standin.physics import Joint, Vehicle
from webots_mcp.standin.vrml import Node


@dataclass(frozen=True)
class Site:
    """What a device is built into."""

    vehicle: Vehicle
    arena: Arena
    frame: Frame
    """Where the device stands in the robot."""
    joint: Joint | None

    @property
    def body(self) -> Body:
        """The robot's body."""
        return self.vehicle.body

    def pose(self) -> Frame:
        """The device in the world."""
        return self.body.frame.then(self.frame)

    def place(self) -> tuple[float, float, float, float]:
        """The device in the world: x, y, z in metres and yaw in radians."""
        body, (x, y, z) = self.body, self.frame.translation
        c, s = cos(body.yaw_rad), sin(body.yaw_rad)
        yaw = body.yaw_rad + self.frame.yaw_rad
        return body.x + c * x - s * y, body.y + s * x + c * y, body.z + z, yaw


class Device:
    """One device; subclasses measure or set something."""

    kind = "Device"
    """The class of the `controller` package that stands for it."""
    fetched = False
    """Whether a sample stays here until the controller looks at it (pictures and scans)."""

    def __init__(self, tag: int, node: Node, site: Site) -> None:
        self.tag = tag
        self.node = node
        self.site = site
        self.name: str = node.fields["name"]
        self.period_ms = 0
        self._wait_ms = 0.0

    def description(self) -> dict[str, Any]:
        """The data about the device that the controller receives when it connects."""
        return {
            "tag": self.tag,
            "kind": self.kind,
            "name": self.name,
            "model": self.node.fields.get("model", ""),
            "node_type": self.node.type_name,
            "fetched": self.fetched,
        }

    def configure(self, setting: str, value: Any) -> None:
        """Take a setting from the controller."""
        if setting == "period":
            self.period_ms, self._wait_ms = value, float(value)

    def make_due(self) -> None:
        """Let an enabled sensor measure at the end of the step under way."""
        self._wait_ms = 0.0

    def is_due(self, passed_ms: float) -> bool:
        """Let time pass; True if it is time to measure."""
        if not self.period_ms:
            return False
        self._wait_ms -= passed_ms
        if self._wait_ms > 0.0:
            return False
        self._wait_ms += self.period_ms
        return True

    def measure(self, period_ms: float) -> Any:
        """What the sensor shows now, as the wire carries it."""
        raise AttributeError(f"{self.kind} {self.name!r} measures nothing")

    def fetch(self) -> Any:
        """What the last sample shows, for devices with `fetched`."""
        raise AttributeError(f"{self.kind} {self.name!r} has no pictures")


def table_of(node: Node) -> dict[str, Any]:
    """The data about a sensor's lookup table that the controller receives."""
    return {"lookup_table": [number for row in node.fields["lookupTable"] for number in row]}


def looked_up(table: Sequence[Sequence[float]], measured: float) -> float:
    """The value that a lookup table gives, without its noise; an empty one changes nothing."""
    if not table:
        return measured
    if measured <= table[0][0]:
        return table[0][1]
    for (x0, y0, _), (x1, y1, _) in pairwise(table):
        if measured <= x1:
            return y0 + (y1 - y0) * (measured - x0) / (x1 - x0)
    return table[-1][1]


def resolved(node: Node, measured: float) -> float:
    """A value as the sensor's `resolution` and `lookupTable` show it."""
    value, resolution = looked_up(node.fields["lookupTable"], measured), node.fields["resolution"]
    return round(value / resolution) * resolution if resolution > 0.0 else value
