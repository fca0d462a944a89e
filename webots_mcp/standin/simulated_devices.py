"""The devices of a simulated robot: what they measure, and what they let a controller set."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, inf, nan, pi, sin
from typing import Any, Final

from webots_mcp.standin import camera_rendering as camera
from webots_mcp.standin.arena import Arena
from webots_mcp.standin.frame import Frame
from webots_mcp.standin.light_sensor import LightSensor
from webots_mcp.standin.motion_sensors import Accelerometer, Compass, Gyro
from webots_mcp.standin.nodes import DEVICE_TYPES
from webots_mcp.standin.physics import Vehicle
from webots_mcp.standin.shapes import Shape, nearest_m, targets_from
from webots_mcp.standin.simulated_device import Device, Site, looked_up, table_of
from webots_mcp.standin.touch_sensor import TouchSensor
from webots_mcp.standin.vrml import Node, children_of
from webots_mcp.standin.world import own_frame

_DISTANCE_SENSOR_TYPES: Final = {"generic": 0, "infra-red": 1, "sonar": 2, "laser": 3}


class Motor(Device):
    """Turns a joint."""

    kind = "Motor"

    def description(self) -> dict[str, Any]:
        """Add what the device's getters tell."""
        fields = self.node.fields
        sensors: list[Node] = self.site.joint.node.fields["device"] if self.site.joint else []
        names = [node.fields["name"] for node in sensors if node.type_name == "PositionSensor"]
        return super().description() | {
            "min_position": fields["minPosition"],
            "max_position": fields["maxPosition"],
            "max_velocity": fields["maxVelocity"],
            "is_linear": self.node.type_name == "LinearMotor",
            "max_torque": fields.get("maxTorque", 0.0),
            "acceleration": fields["acceleration"],
            "multiplier": fields["multiplier"],
            "position_sensor": names[0] if names else None,
        }

    def configure(self, setting: str, value: Any) -> None:
        """Take a setting from the controller."""
        joint = self.site.joint
        if joint is None:
            return
        if setting == "position":
            joint.target_rad = value
        elif setting == "velocity":
            joint.target_radps = value
        elif setting == "acceleration":
            joint.acceleration_radps2 = value


class PositionSensor(Device):
    """Says how far a joint has turned or slid, in radians or metres."""

    kind = "PositionSensor"

    def measure(self, period_ms: float) -> float:
        """The angle of the joint in radians."""
        return self.site.joint.position_rad if self.site.joint else nan


class DistanceSensor(Device):
    """One ray along the sensor's x axis, translated by the lookup table; noise is left out."""

    kind = "DistanceSensor"

    def __init__(self, tag: int, node: Node, site: Site) -> None:
        super().__init__(tag, node, site)
        self.table: list[list[float]] = node.fields["lookupTable"] or [[0.0, 0.0, 0.0]]

    def description(self) -> dict[str, Any]:
        """Add what the device's getters tell."""
        values = [row[1] for row in self.table]
        return super().description() | {
            "min_value": min(values),
            "max_value": max(values),
            "aperture": self.node.fields["aperture"],
            "type": _DISTANCE_SENSOR_TYPES.get(self.node.fields["type"], 0),
            **table_of(self.node),
        }

    def measure(self, period_ms: float) -> float:
        """The looked-up value of the distance."""
        x, y, z, yaw = self.site.place()
        obstacles = self.site.arena.obstacles(without=self.site.body)
        targets = targets_from(obstacles, x, y, z, reach_m=self.table[-1][0])
        return looked_up(self.table, nearest_m(targets, cos(yaw), sin(yaw)))


class Gps(Device):
    """Where the sensor is, and how fast it moved since its last sample."""

    kind = "GPS"

    def __init__(self, tag: int, node: Node, site: Site) -> None:
        super().__init__(tag, node, site)
        self._last: tuple[float, float, float] | None = None

    def make_due(self) -> None:
        """Forget the last place as well."""
        super().make_due()
        self._last = None

    def measure(self, period_ms: float) -> list[list[float]]:
        """Position in metres and velocity in metres a second."""
        here = self.site.place()[:3]
        before = self._last or here
        self._last = here
        seconds = period_ms / 1000.0
        return [[*here], [(a - b) / seconds for a, b in zip(here, before, strict=True)]]


class InertialUnit(Device):
    """Roll, pitch and yaw in radians; the floor is flat, so only yaw ever changes."""

    kind = "InertialUnit"

    def description(self) -> dict[str, Any]:
        """Add what the device's getters tell."""
        return super().description() | {"noise": self.node.fields["noise"]}

    def measure(self, period_ms: float) -> list[float]:
        """Roll, pitch and yaw, yaw between -pi and pi."""
        yaw = self.site.place()[3]
        return [0.0, 0.0, yaw - 2.0 * pi * round(yaw / (2.0 * pi))]


class Lidar(Device):
    """A level fan of rays from left to right; inf where nothing is in range."""

    kind = "Lidar"
    fetched = True

    def __init__(self, tag: int, node: Node, site: Site) -> None:
        super().__init__(tag, node, site)
        self._samples = 0
        self._seen: tuple[tuple[float, float, float, float], list[Shape]] | None = None
        self.resolution: int = node.fields["horizontalResolution"]
        self.field_of_view_rad: float = node.fields["fieldOfView"]

    def description(self) -> dict[str, Any]:
        """Add what the device's getters tell."""
        fields = self.node.fields
        return super().description() | {
            "resolution": self.resolution,
            "layers": fields["numberOfLayers"],
            "fov": self.field_of_view_rad,
            "vertical_fov": fields["verticalFieldOfView"],
            "min_range": fields["minRange"],
            "max_range": fields["maxRange"],
            "near": fields["near"],
            "frequency": fields["defaultFrequency"],
            "min_frequency": fields["minFrequency"],
            "max_frequency": fields["maxFrequency"],
        }

    def measure(self, period_ms: float) -> int:
        """The number of the scan; `fetch` gives the scan itself."""
        self._seen = (self.site.place(), self.site.arena.scene(without=self.site.body))
        self._samples += 1
        return self._samples

    def fetch(self) -> list[float]:
        """Distances in metres, layer after layer."""
        if self._seen is None:
            return []
        (x, y, z, yaw), shapes = self._seen
        layer = self._ranges(targets_from(shapes, x, y, z, self.node.fields["maxRange"]), yaw)
        return layer * self.node.fields["numberOfLayers"]

    def _ranges(self, targets: Any, yaw_rad: float) -> list[float]:
        low, high = self.node.fields["minRange"], self.node.fields["maxRange"]
        step = self.field_of_view_rad / max(self.resolution - 1, 1)
        first = yaw_rad + self.field_of_view_rad / 2.0
        angles = [first - i * step for i in range(self.resolution)]
        ranges = [nearest_m(targets, cos(angle), sin(angle)) for angle in angles]
        return [distance if low <= distance <= high else inf for distance in ranges]


class Camera(Device):
    """Renders its image when the picture is read."""

    kind = "Camera"
    fetched = True

    def __init__(self, tag: int, node: Node, site: Site) -> None:
        super().__init__(tag, node, site)
        self._samples = 0
        self._seen: camera.View | None = None
        self.field_of_view_rad: float = node.fields["fieldOfView"]

    def description(self) -> dict[str, Any]:
        """Add what the device's getters tell."""
        fields, fov = self.node.fields, self.field_of_view_rad
        zoom: dict[str, Any] = fields["zoom"].fields if fields["zoom"] else {}
        return super().description() | {
            "width": fields["width"],
            "height": fields["height"],
            "fov": fov,
            "min_fov": zoom.get("minFieldOfView", fov),
            "max_fov": zoom.get("maxFieldOfView", fov),
            "near": fields["near"],
        }

    def configure(self, setting: str, value: Any) -> None:
        """Take a setting from the controller."""
        super().configure(setting, value)
        if setting == "fov":
            self.field_of_view_rad = value

    def measure(self, period_ms: float) -> int:
        """The number of the picture; `fetch` gives the picture itself."""
        arena, fields = self.site.arena, self.node.fields
        self._seen = camera.View(
            *self.site.place(),
            width=fields["width"],
            height=fields["height"],
            field_of_view_rad=self.field_of_view_rad,
            shapes=tuple(arena.scene(without=self.site.body)),
        )
        self._samples += 1
        return self._samples

    def fetch(self) -> bytes:
        """The picture: blue, green, red and alpha of each pixel."""
        return b"" if self._seen is None else camera.render(self._seen, self.site.arena.colors)


class Led(Device):
    """A lamp; what it shines is the controller's business."""

    kind = "LED"


_BY_NODE_TYPE: Final[dict[str, Callable[[int, Node, Site], Device]]] = {
    "RotationalMotor": Motor,
    "LinearMotor": Motor,
    "PositionSensor": PositionSensor,
    "DistanceSensor": DistanceSensor,
    "GPS": Gps,
    "InertialUnit": InertialUnit,
    "Lidar": Lidar,
    "Camera": Camera,
    "LED": Led,
    "Accelerometer": Accelerometer,
    "Compass": Compass,
    "Gyro": Gyro,
    "LightSensor": LightSensor,
    "TouchSensor": TouchSensor,
}


def devices_in(vehicle: Vehicle, arena: Arena) -> list[Device]:
    """All devices of a robot in the order of the scene tree; tags count from 1."""
    found: list[tuple[Node, Site]] = []
    _find(vehicle.body.node, Site(vehicle, arena, Frame(), None), found)
    return [
        _BY_NODE_TYPE[node.type_name](tag, node, site)
        for tag, (node, site) in enumerate(found, start=1)
    ]


def _find(node: Node, site: Site, found: list[tuple[Node, Site]]) -> None:
    for child in children_of(node):
        if child.type_name == "Robot":
            continue
        joints = {joint.node: joint for joint in site.vehicle.joints}
        frame = site.frame.then(own_frame(child))
        here = Site(site.vehicle, site.arena, frame, joints.get(child, site.joint))
        if child.type_name in DEVICE_TYPES:
            found.append((child, here))
        _find(child, here, found)
