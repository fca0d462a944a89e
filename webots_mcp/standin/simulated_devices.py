"""The devices of a simulated robot: what they measure, and what a controller can set.

The constants of a device are the fields of its node. The controller receives them when it connects.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import atan2, cos, hypot, inf, nan, pi, sin
from typing import Any, Final

from webots_mcp.standin.arena import Arena, Body, BodyPart, bounding_parts
from webots_mcp.standin.camera_view import CameraView, render
from webots_mcp.standin.geometry import Shape, nearest_m, targets_from
from webots_mcp.standin.vehicle import Joint, Vehicle
from webots_mcp.standin.world import World, own_frame
from webots_mcp.worlds.frames import CoordinateFrame, Vector
from webots_mcp.worlds.vrml import WorldNode, children_of

_SUN_M: Final = 1000.0
"""Distance of a DirectionalLight: far enough for its rays to be parallel."""
"""Fields of a device's node that no getter of Webots returns."""


@dataclass(frozen=True)
class Mounting:
    """The place that a device is built into: robot, arena, joint and position in the robot."""

    vehicle: Vehicle
    arena: Arena
    frame: CoordinateFrame
    """Position and orientation of the device in the robot."""
    joint: Joint | None

    @property
    def body(self) -> Body:
        """Return the robot's body."""
        return self.vehicle.body

    def pose(self) -> CoordinateFrame:
        """Return position and orientation of the device in the world."""
        return self.body.frame.then(self.frame)

    def position_and_yaw(self) -> tuple[float, float, float, float]:
        """Return where the device is in the world: x, y, z in metres and yaw in radians."""
        body, (x, y, z) = self.body, self.frame.translation
        c, s = cos(body.yaw_rad), sin(body.yaw_rad)
        yaw = body.yaw_rad + self.frame.yaw_rad
        return body.x + c * x - s * y, body.y + s * x + c * y, body.z + z, yaw

    def axis(self) -> Vector:
        """Return the direction of the device's x axis, a unit vector."""
        r = self.pose().rotation
        return r[0], r[3], r[6]


class SimulatedDevice:
    """One device of a robot. Subclasses measure or set something."""

    def __init__(self, tag: int, node: WorldNode, site: Mounting) -> None:
        self.tag = tag
        self.node = node
        self.site = site
        self.name: str = node.fields["name"]
        self.period_ms = 0
        self._wait_ms = 0.0

    def description(self) -> dict[str, Any]:
        """Return the data about the device that the controller receives when it connects."""
        joint, joints = self.site.joint, self.site.vehicle.joints
        return {
            "tag": self.tag,
            "node_type": self.node.type_name,
            "joint": joints.index(joint) if joint else None,
            "fields": _sent(self.node),
        }

    def configure(self, setting: str, value: Any) -> None:
        """Take a setting from the controller."""
        if setting == "period":
            self.period_ms, self._wait_ms = value, float(value)

    def make_due(self) -> None:
        """Let an enabled sensor measure at the end of the step under way."""
        self._wait_ms = 0.0

    def is_due(self, passed_ms: float) -> bool:
        """Count down to the next sample.

        Args:
            passed_ms: Simulated time since the last call.

        Returns:
            True if it is time to measure.
        """
        if not self.period_ms:
            return False
        self._wait_ms -= passed_ms
        if self._wait_ms > 0.0:
            return False
        self._wait_ms += self.period_ms
        return True

    def put_value(self, fresh: dict[int, Any]) -> None:
        """Measure, and add the value to those that the controller has not received yet."""
        fresh[self.tag] = self.measure(self.period_ms)

    def measure(self, period_ms: float) -> Any:
        """Return the value that the sensor shows now, as it is sent to the controller."""
        raise AttributeError(f"{self.node.type_name} {self.name!r} measures nothing")


def _sent(node: WorldNode) -> dict[str, Any]:
    """Return the fields of a device and of the nodes in them, such as the Zoom of a camera."""
    return {
        name: _sent(value) if isinstance(value, WorldNode) else value
        for name, value in node.fields.items()
        if name not in ("children", "boundingObject", "physics")
    }


def looked_up(table: Sequence[Sequence[float]], measured: float) -> float:
    """Return the value that a lookup table gives, without its noise.

    An empty table leaves the value as it was measured.
    """
    if not table:
        return measured
    if measured <= table[0][0]:
        return table[0][1]
    for (x0, y0, _), (x1, y1, _) in pairwise(table):
        if measured <= x1:
            return y0 + (y1 - y0) * (measured - x0) / (x1 - x0)
    return table[-1][1]


def resolved(node: WorldNode, measured: float) -> float:
    """Return a value after the sensor's `lookupTable` and `resolution`."""
    value, resolution = looked_up(node.fields["lookupTable"], measured), node.fields["resolution"]
    return round(value / resolution) * resolution if resolution > 0.0 else value


class SimulatedMotor(SimulatedDevice):
    """Turns a joint."""

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


class SimulatedPositionSensor(SimulatedDevice):
    """Measures how far a joint has turned or slid, in radians or metres."""

    def measure(self, period_ms: float) -> float:
        """Return the position of the joint: radians, of a slider metres."""
        return self.site.joint.position_rad if self.site.joint else nan


class SimulatedGps(SimulatedDevice):
    """Measures the sensor's position and its mean velocity since the last sample."""

    _last: tuple[float, float, float] | None = None

    def make_due(self) -> None:
        """Forget the last position as well."""
        super().make_due()
        self._last = None

    def measure(self, period_ms: float) -> list[list[float]]:
        """Return position in metres and velocity in metres per second."""
        position = self.site.position_and_yaw()[:3]
        before = self._last or position
        self._last = position
        seconds = period_ms / 1000.0
        velocity = [(a - b) / seconds for a, b in zip(position, before, strict=True)]
        return [[*position], velocity]


class SimulatedInertialUnit(SimulatedDevice):
    """Measures roll, pitch and yaw. The floor is flat, so only yaw ever changes."""

    def measure(self, period_ms: float) -> list[float]:
        """Return roll, pitch and yaw in radians, yaw between -pi and pi."""
        return [0.0, 0.0, _wrapped(self.site.position_and_yaw()[3])]


class SimulatedVectorSensor(SimulatedDevice, ABC):
    """Measures a vector along the sensor's own axes. A disabled axis shows NaN."""

    def measure(self, period_ms: float) -> list[float]:
        """Return the vector along x, y and z of the sensor."""
        sensed = self.site.pose().direction(self.sense(period_ms / 1000.0))
        axes = (self.node.fields[axis] for axis in ("xAxis", "yAxis", "zAxis"))
        return [
            resolved(self.node, value) if is_on else nan
            for value, is_on in zip(sensed, axes, strict=True)
        ]

    @abstractmethod
    def sense(self, period_s: float) -> Vector:
        """Return the vector along the axes of the world."""


class SimulatedAccelerometer(SimulatedVectorSensor):
    """Measures the change of the sensor's velocity since its last sample, plus gravity."""

    _last_mps: tuple[float, float] | None = None

    def make_due(self) -> None:
        """Forget the last velocity as well."""
        super().make_due()
        self._last_mps = None

    def sense(self, period_s: float) -> Vector:
        """Return metres per second squared; at rest the reaction to gravity, which is upwards."""
        now, before = self._velocity_mps(), self._last_mps
        self._last_mps = now
        (vx, vy), (ux, uy) = now, before or now
        return (vx - ux) / period_s, (vy - uy) / period_s, self.site.arena.gravity_mps2

    def _velocity_mps(self) -> tuple[float, float]:
        body, (x, y, _) = self.site.body, self.site.pose().translation
        (vx, vy), turning = body.velocity_mps, body.yaw_rate_radps
        return vx - turning * (y - body.y), vy + turning * (x - body.x)


class SimulatedGyro(SimulatedVectorSensor):
    """Measures how fast the robot turns."""

    def sense(self, period_s: float) -> Vector:
        """Return radians per second. On a flat floor a robot turns about the vertical axis only."""
        return 0.0, 0.0, self.site.body.yaw_rate_radps


class SimulatedCompass(SimulatedVectorSensor):
    """Measures the direction of north, which is the world's y axis."""

    def sense(self, period_s: float) -> Vector:
        """Return a unit vector."""
        return 0.0, 1.0, 0.0


class SimulatedTouchSensor(SimulatedDevice):
    """Detects contact on the side of the robot where the sensor's bounding object is.

    A robot touches obstacles as a disc. The sensor reports contacts with the sector of that disc
    that its bounding object covers, seen from the centre.
    """

    def __init__(self, tag: int, node: WorldNode, site: Mounting) -> None:
        super().__init__(tag, node, site)
        disc = site.body.footprint
        parts = bounding_parts(node, site.frame)
        self._sides = [side for part in parts for side in _sides(part, disc.ahead_m, disc.left_m)]

    def measure(self, period_ms: float) -> float:
        """Return 1 while the sensor touches something, else 0."""
        yaw = self.site.body.yaw_rad
        angles = [atan2(-y, -x) - yaw for x, y in self.site.body.touched]
        return float(any(abs(_wrapped(a - at)) <= half for a in angles for at, half in self._sides))


def _sides(part: BodyPart, ahead_m: float, left_m: float) -> Iterator[tuple[float, float]]:
    """Yield the sector that a part covers: its middle direction and half its angle, in radians."""
    (x, y, _), (hx, hy, _) = part.frame.translation, part.half_m
    x, y = x - ahead_m, y - left_m
    if hypot(x, y) <= min(hx, hy):
        yield 0.0, pi
        return
    middle = atan2(y, x)
    corners = [
        part.frame.point((sx * hx, sy * hy, 0.0)) for sx, sy in product((-1.0, 1.0), repeat=2)
    ]
    angles = [_wrapped(atan2(cy - left_m, cx - ahead_m) - middle) for cx, cy, _ in corners]
    yield middle, max(abs(angle) for angle in angles)


def _wrapped(angle_rad: float) -> float:
    """Return the same angle between -pi and pi."""
    return angle_rad - 2.0 * pi * round(angle_rad / (2.0 * pi))


class SimulatedDistanceSensor(SimulatedDevice):
    """Measures along one ray in the direction of the sensor's x axis, without noise."""

    def measure(self, period_ms: float) -> float:
        """Return the value of the lookup table for the distance."""
        x, y, z, yaw = self.site.position_and_yaw()
        table = self.node.fields["lookupTable"] or [[0.0, 0.0, 0.0]]
        targets = targets_from(self.site.arena.obstacles(self.site.body), x, y, z, table[-1][0])
        return looked_up(table, nearest_m(targets, cos(yaw), sin(yaw)))


class FetchedSensor(SimulatedDevice, ABC):
    """A sensor of pictures or scans. It sends their number, and the data only on request."""

    _samples = 0

    def measure(self, period_ms: float) -> int:
        """Store what the picture or scan is made from, and return the number of the sample."""
        self.capture()
        self._samples += 1
        return self._samples

    @abstractmethod
    def capture(self) -> None:
        """Store what the next picture or scan is made from."""

    @abstractmethod
    def fetch(self) -> Any:
        """Return the picture or scan of the last sample."""


class SimulatedLidar(FetchedSensor):
    """Measures along a level fan of rays from left to right; inf where nothing is in range."""

    _seen: tuple[tuple[float, float, float, float], list[Shape]] | None = None

    def capture(self) -> None:
        """Store where everything stands."""
        scene = self.site.arena.scene(without=self.site.body)
        self._seen = (self.site.position_and_yaw(), scene)

    def fetch(self) -> list[float]:
        """Return the distances in metres, layer after layer."""
        if self._seen is None:
            return []
        (x, y, z, yaw), shapes = self._seen
        layer = self._ranges(targets_from(shapes, x, y, z, self.node.fields["maxRange"]), yaw)
        return layer * self.node.fields["numberOfLayers"]

    def _ranges(self, targets: Any, yaw_rad: float) -> list[float]:
        fields = self.node.fields
        low, high, fov_rad = fields["minRange"], fields["maxRange"], fields["fieldOfView"]
        resolution: int = fields["horizontalResolution"]
        step = fov_rad / max(resolution - 1, 1)
        angles = [yaw_rad + fov_rad / 2.0 - i * step for i in range(resolution)]
        ranges = [nearest_m(targets, cos(angle), sin(angle)) for angle in angles]
        return [distance if low <= distance <= high else inf for distance in ranges]


class SimulatedCamera(FetchedSensor):
    """Takes pictures. They are rendered when they are read."""

    _seen: CameraView | None = None

    def capture(self) -> None:
        """Store where everything stands."""
        self._seen = CameraView(
            *self.site.position_and_yaw(),
            width=self.node.fields["width"],
            height=self.node.fields["height"],
            field_of_view_rad=self.node.fields["fieldOfView"],
            shapes=tuple(self.site.arena.scene(without=self.site.body)),
        )

    def fetch(self) -> bytes:
        """Return blue, green, red and alpha of each pixel."""
        return b"" if self._seen is None else render(self._seen, self.site.arena.colors)


class SimulatedLightSensor(SimulatedDevice):
    """Measures the sum of the irradiance of all lights, as Webots does, without reflections."""

    def measure(self, period_ms: float) -> float:
        """Return the value of the lookup table for the irradiance."""
        world = self.site.arena.world
        irradiance = sum(self._from(light, world) for light in self.site.arena.lights)
        return resolved(self.node, irradiance)

    def _from(self, light: WorldNode, world: World) -> float:
        """Return the irradiance from one light."""
        fields, seen_through = light.fields, self.node.fields["colorFilter"]
        if not fields["on"]:
            return 0.0
        direction, distance_m = self._direction_to(light, world)
        direct = fields["intensity"] * max(_dot(self.site.axis(), direction), 0.0)
        color = _dot(fields["color"], seen_through) / 3.0
        return color * _attenuation(light, distance_m) * (fields["ambientIntensity"] + direct)

    def _direction_to(self, light: WorldNode, world: World) -> tuple[Vector, float]:
        """Return the direction of a light, a unit vector, and its distance in metres."""
        frame = world.frame_around(light)
        if light.type_name == "DirectionalLight":
            x, y, z = frame.turned(light.fields["direction"])
            return _unit((-x, -y, -z)), _SUN_M
        return _direction_and_distance_m(
            self.site.pose().translation, frame.point(light.fields["location"])
        )


def _attenuation(light: WorldNode, distance_m: float) -> float:
    if light.type_name == "DirectionalLight":
        return 1.0
    a, b, c = light.fields["attenuation"]
    return 1.0 / max(a + b * distance_m + c * distance_m**2, 1e-9)


def _direction_and_distance_m(start: Vector, end: Vector) -> tuple[Vector, float]:
    """Return the direction from one point to another, a unit vector, and their distance."""
    offset = (end[0] - start[0], end[1] - start[1], end[2] - start[2])
    return _unit(offset), hypot(*offset)


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _unit(vector: Vector) -> Vector:
    x, y, z = vector
    length = hypot(x, y, z) or 1.0
    return x / length, y / length, z / length


@dataclass(frozen=True)
class Packet:
    """A packet that a controller sent, with the channel and range at that moment."""

    data: bytes
    channel: int
    range_m: float
    """How far the packet reaches; negative for everywhere."""


class SimulatedEmitter(SimulatedDevice):
    """Sends packets. They arrive in the basic time step after which they were sent."""

    def __init__(self, tag: int, node: WorldNode, site: Mounting) -> None:
        super().__init__(tag, node, site)
        self._packets: list[Packet] = []

    def configure(self, setting: str, value: Any) -> None:
        """Queue a packet. The fields show channel and range of the last packet, as in Webots."""
        if setting == "send":
            packet = Packet(*value)
            self._packets.append(packet)
            self.node.fields |= {"channel": packet.channel, "range": packet.range_m}

    def make_due(self) -> None:
        """Drop the queued packets as well."""
        super().make_due()
        self._packets.clear()

    def transmit(self, receivers: Sequence[SimulatedReceiver]) -> None:
        """Deliver the queued packets to the receivers of other robots."""
        packets, self._packets = self._packets, []
        for receiver in receivers if packets else ():
            if receiver.site.body is not self.site.body:
                receiver.take(packets, self)


class SimulatedReceiver(SimulatedDevice):
    """Queues packets until its controller receives them with the next sample."""

    def __init__(self, tag: int, node: WorldNode, site: Mounting) -> None:
        super().__init__(tag, node, site)
        self._arrived: list[tuple[bytes, Vector, float]] = []

    def configure(self, setting: str, value: Any) -> None:
        """Take a setting from the controller."""
        super().configure(setting, value)
        if setting == "channel":
            self.node.fields["channel"] = value

    def make_due(self) -> None:
        """Drop the packets that have arrived as well."""
        super().make_due()
        self._arrived.clear()

    def take(self, packets: list[Packet], emitter: SimulatedEmitter) -> None:
        """Queue the packets of an emitter that are in range and on a channel it listens to."""
        if not self.period_ms or self.node.fields["type"] != emitter.node.fields["type"]:
            return
        own, other = self.site.pose(), emitter.site.pose()
        outside, distance_m = _direction_and_distance_m(own.translation, other.translation)
        strength = 1.0 / distance_m**2 if distance_m else inf
        direction = own.direction(outside)
        self._arrived.extend(
            (packet.data, direction, strength)
            for packet in packets
            if self._listens_to(packet.channel) and not 0.0 <= packet.range_m < distance_m
        )

    def _listens_to(self, channel: int) -> bool:
        mine: int = self.node.fields["channel"]
        return -1 in (mine, channel) or mine == channel

    def put_value(self, fresh: dict[int, Any]) -> None:
        """Add the packets to those that the controller has not received yet."""
        fresh.setdefault(self.tag, []).extend(self._arrived)
        self._arrived.clear()


DEVICES: Final[dict[str, Callable[[int, WorldNode, Mounting], SimulatedDevice]]] = {
    "RotationalMotor": SimulatedMotor,
    "LinearMotor": SimulatedMotor,
    "PositionSensor": SimulatedPositionSensor,
    "DistanceSensor": SimulatedDistanceSensor,
    "GPS": SimulatedGps,
    "InertialUnit": SimulatedInertialUnit,
    "Lidar": SimulatedLidar,
    "Camera": SimulatedCamera,
    "LED": SimulatedDevice,
    "Accelerometer": SimulatedAccelerometer,
    "Compass": SimulatedCompass,
    "Gyro": SimulatedGyro,
    "LightSensor": SimulatedLightSensor,
    "TouchSensor": SimulatedTouchSensor,
    "Emitter": SimulatedEmitter,
    "Receiver": SimulatedReceiver,
}
"""The devices that the stand-in has, by node type."""


def devices_in(vehicle: Vehicle, arena: Arena) -> list[SimulatedDevice]:
    """Return all devices of a robot in the order of the scene tree; tags count from 1."""
    found: list[tuple[WorldNode, Mounting]] = []
    _find(vehicle.body.node, Mounting(vehicle, arena, CoordinateFrame(), None), found)
    return [DEVICES[node.type_name](tag, node, site) for tag, (node, site) in enumerate(found, 1)]


def _find(node: WorldNode, site: Mounting, found: list[tuple[WorldNode, Mounting]]) -> None:
    joints = {joint.node: joint for joint in site.vehicle.joints}
    for child in children_of(node):
        if child.type_name == "Robot":
            continue
        frame = site.frame.then(own_frame(child))
        inner = Mounting(site.vehicle, site.arena, frame, joints.get(child, site.joint))
        if child.type_name in DEVICES:
            found.append((child, inner))
        _find(child, inner, found)
