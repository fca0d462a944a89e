"""What stands in the world, what moves it, and what happens when it touches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import cos, hypot, isinf, sin
from typing import Any, Final

from webots_mcp.standin.geometry import Color, CoordinateFrame, Disc, Shape, UprightBox, frame_of
from webots_mcp.standin.vrml import WorldNode, children_of, descendants_of
from webots_mcp.standin.world import World, own_frame

_GEOMETRIES: Final = ("Box", "Capsule", "Cylinder", "Sphere")
_DEFAULT_COLOR: Final[Color] = (0.5, 0.5, 0.5)
_LIGHTS: Final = ("DirectionalLight", "PointLight")
_SLIDING_FRICTION: Final = 1.0
"""Coulomb friction of everything on the floor, Webots' default."""

_MOTORS = ("RotationalMotor", "LinearMotor")
_JOINTS = ("HingeJoint", "SliderJoint")


@dataclass(frozen=True)
class SceneColors:
    """What is neither wall nor obstacle."""

    floor: Color = (0.75, 0.75, 0.72)
    sky: Color = (0.6, 0.75, 0.9)


@dataclass(frozen=True)
class BodyPart:
    """One geometry of a body: its place in the body and half of its size along x, y and z."""

    kind: str
    frame: CoordinateFrame
    half_m: tuple[float, float, float]
    color: Color
    is_solid: bool
    """Whether it is (part of) a bounding object: something to drive into."""

    def reach_m(self, x: float, y: float) -> float:
        """The distance of its farthest point from a vertical line."""
        hx, hy, _ = self.half_m
        if self.kind == "Box":
            corners = [self.frame.point((a * hx, b * hy, 0.0)) for a in (-1, 1) for b in (-1, 1)]
            return max(hypot(corner_x - x, corner_y - y) for corner_x, corner_y, _ in corners)
        part_x, part_y, _ = self.frame.translation
        return hypot(part_x - x, part_y - y) + hx

    def standing(self, body: CoordinateFrame) -> Shape:
        """This part as a shape in the world, for a body that stands upright."""
        x, y, z = body.point(self.frame.translation)
        hx, hy, hz = self.half_m
        if self.kind == "Box":
            yaw = body.yaw_rad + self.frame.yaw_rad
            return UprightBox(x, y, cos(yaw), sin(yaw), hx, hy, z - hz, z + hz, self.color)
        return Disc(x, y, hx, z - hz, z + hz, self.color, self.kind == "Sphere")


@dataclass(frozen=True)
class Footprint:
    """The disc that a moving body takes up on the floor, relative to its origin."""

    ahead_m: float
    left_m: float
    radius_m: float

    @staticmethod
    def around(parts: list[BodyPart]) -> Footprint:
        """A disc around all parts, in the middle of the rectangle that they fill."""
        at_and_half = [
            (part.frame.translation, _turned_half(part.frame, part.half_m)) for part in parts
        ]
        if not at_and_half:
            return Footprint(0.0, 0.0, 0.0)
        x, y = (
            (
                min(at[axis] - half[axis] for at, half in at_and_half)
                + max(at[axis] + half[axis] for at, half in at_and_half)
            )
            / 2.0
            for axis in (0, 1)
        )
        return Footprint(x, y, max(part.reach_m(x, y) for part in parts))


class Body:
    """A Solid or Robot at the top of the scene tree, with all that is fixed to it."""

    def __init__(self, node: WorldNode, frame: CoordinateFrame) -> None:
        self.node = node
        self.name: str = node.fields["name"]
        self.is_movable = node.type_name == "Solid" and node.fields["physics"] is not None
        self.velocity_mps = (0.0, 0.0)
        self.yaw_rate_radps = 0.0
        self.is_pushed = False
        """Whether its speed was set from outside and has not been worn off yet."""
        self.touched: list[tuple[float, float]] = []
        """By how much it was pushed back by what it ran into in the last step, metres."""
        self.stand(frame)

    def stand(self, frame: CoordinateFrame) -> None:
        """Put the body where `frame` says, tilted as it may be."""
        self.x, self.y, self.z = frame.translation
        self.yaw_rad = frame.yaw_rad
        upright = frame_of((0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -self.yaw_rad))
        tilt = upright.then(CoordinateFrame(frame.rotation))
        self.parts = [*_parts_of(self.node, tilt, _color_of(self.node))]
        self.is_obstacle = any(part.is_solid for part in self.parts)
        self.footprint = Footprint.around(self.parts)
        self._shapes: tuple[Shape, ...] | None = None
        self._solid_of: tuple[Shape, ...] | None = None
        self._solid_shapes: tuple[Shape, ...] = ()

    def stop(self) -> None:
        """Take its speed away."""
        self.velocity_mps, self.yaw_rate_radps, self.is_pushed = (0.0, 0.0), 0.0, False

    @property
    def frame(self) -> CoordinateFrame:
        """Where the body stands, upright."""
        return frame_of((self.x, self.y, self.z), (0.0, 0.0, 1.0, self.yaw_rad))

    def move(self, x: float, y: float, yaw_rad: float) -> None:
        """Move the body on the plane and say so in its node."""
        if (x, y, yaw_rad) == (self.x, self.y, self.yaw_rad):
            return
        self.node.fields["translation"] = [x, y, self.z]
        if yaw_rad != self.yaw_rad:
            self.node.fields["rotation"] = [0.0, 0.0, 1.0, yaw_rad]
        self.x, self.y, self.yaw_rad = x, y, yaw_rad
        self._shapes = None

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """The parts where they stand now."""
        if self._shapes is None:
            frame = self.frame
            self._shapes = tuple(part.standing(frame) for part in self.parts)
        return self._shapes

    @property
    def solid_shapes(self) -> tuple[Shape, ...]:
        """The parts that one can drive into, where they stand now."""
        shapes = self.shapes
        if self._solid_of is not shapes:
            pairs = zip(self.parts, shapes, strict=True)
            self._solid_of = shapes
            self._solid_shapes = tuple(shape for part, shape in pairs if part.is_solid)
        return self._solid_shapes

    def centre(self) -> tuple[float, float]:
        """Where the centre of the footprint is in the world."""
        disc, c, s = self.footprint, cos(self.yaw_rad), sin(self.yaw_rad)
        return (
            self.x + c * disc.ahead_m - s * disc.left_m,
            self.y + s * disc.ahead_m + c * disc.left_m,
        )


class Arena:
    """All bodies of a world, standing ones and movable ones.

    A movable Solid (one with Physics) is pushed along by what drives into it, as far as nothing is
    in its way; it neither turns nor rolls on.
    """

    def __init__(self, world: World) -> None:
        self.bodies = [*_bodies_in(world.root, CoordinateFrame())]
        self.world = world
        self.colors = _scene_colors(world)
        self.gravity_mps2: float = world.info.fields["gravity"]
        self.step_s = world.basic_time_step_ms / 1000.0
        self._sort()

    def _sort(self) -> None:
        self.lights = [node for node in self.world.nodes if node.type_name in _LIGHTS]
        self._obstacles = [body for body in self.bodies if body.is_obstacle]
        self._movable = [body for body in self._obstacles if body.is_movable]

    def follow(self) -> None:
        """Nodes were added or removed: bodies that are new stand there, those that are gone not."""
        known = {body.node: body for body in self.bodies}
        self.bodies[:] = [
            known.get(b.node, b) for b in _bodies_in(self.world.root, CoordinateFrame())
        ]
        self._sort()

    def scene(self, without: Body) -> list[Shape]:
        """All shapes but those of one body: what that one can see."""
        return [shape for body in self.bodies if body is not without for shape in body.shapes]

    def obstacles(self, *without: Body) -> list[Shape]:
        """The shapes that have a bounding object, but for those of some bodies."""
        return [
            shape
            for body in self.bodies
            if body not in without and body.is_obstacle
            for shape in body.solid_shapes
        ]

    def settle(self, body: Body) -> bool:
        """Move a body out of what it drove into; True if that did not give way."""
        body.touched.clear()
        for movable in self._movable:
            self._push_away(movable, body)
        return self._clear(body)

    def glide(self, seconds: float) -> None:
        """Let movable bodies whose speed was set slide on, until friction has stopped them."""
        for body in self._movable:
            if body.is_pushed:
                self._slide(body, seconds)
                body.touched.clear()
                if self._clear(body):
                    body.stop()

    def _slide(self, body: Body, seconds: float) -> None:
        (vx, vy), turn = body.velocity_mps, body.yaw_rate_radps
        body.move(body.x + vx * seconds, body.y + vy * seconds, body.yaw_rad + turn * seconds)
        speed, lost = hypot(vx, vy), _SLIDING_FRICTION * self.gravity_mps2 * seconds
        left = 1.0 - lost / speed if speed > lost else 0.0
        body.velocity_mps, body.yaw_rate_radps = (vx * left, vy * left), turn * left
        body.is_pushed = left > 0.0

    def _push_away(self, movable: Body, pusher: Body) -> None:
        x, y = pusher.centre()
        for shape in movable.solid_shapes:
            if push := shape.push(x, y, pusher.footprint.radius_m):
                pusher.touched.append(push)
                movable.touched.clear()
                movable.move(movable.x - push[0], movable.y - push[1], movable.yaw_rad)
                self._clear(movable, pusher)

    def _clear(self, body: Body, pusher: Body | None = None) -> bool:
        """Move a body out of every obstacle; the pusher does not count as one."""
        (x, y), touched = body.centre(), False
        for other in self._obstacles:
            if other is body or other is pusher:
                continue
            for shape in _solid_shapes(other):
                if push := shape.push(x, y, body.footprint.radius_m):
                    body.touched.append(push)
                    body.move(body.x + push[0], body.y + push[1], body.yaw_rad)
                    (x, y), touched = body.centre(), True
        return touched


def _solid_shapes(body: Body) -> tuple[Shape, ...]:
    if body.node.type_name != "Robot":
        return body.solid_shapes
    x, y = body.centre()  # two robots meet as discs
    return (Disc(x, y, body.footprint.radius_m, 0.0, 1.0, _DEFAULT_COLOR),)


def _scene_colors(world: World) -> SceneColors:
    colors: dict[str, Color] = {}
    for background in world.of_type("Background"):
        colors["sky"] = _color(background.fields["skyColor"][0])
    for solid in world.of_type("Solid"):
        if any(node.type_name == "Plane" for node in descendants_of(solid)):
            colors["floor"] = _color_of(solid)
    return SceneColors(**colors)


def _bodies_in(node: WorldNode, frame: CoordinateFrame) -> Iterator[Body]:
    for child in children_of(node):
        place = frame.then(own_frame(child))
        if child.type_name in ("Solid", "Robot"):
            yield Body(child, place)
        elif child.type_name in ("Group", "Pose", "Transform"):
            yield from _bodies_in(child, place)


def _parts_of(node: WorldNode, frame: CoordinateFrame, color: Color) -> Iterator[BodyPart]:
    """The bounding object of a Solid, or else what can be seen of it, and of all Solids in it."""
    bounding = node.fields["boundingObject"]
    shown = [bounding] if bounding else node.fields["children"]
    for child in shown:
        for geometry, place in _geometries(child, frame):
            yield _part(geometry, place, color, is_solid=bounding is not None)
    for child in node.fields["children"]:
        yield from _solids(child, frame)


def bounding_parts(node: WorldNode, frame: CoordinateFrame) -> list[BodyPart]:
    """The bounding object of a node that stands at `frame`."""
    bounding = node.fields["boundingObject"]
    geometries = _geometries(bounding, frame) if bounding else ()
    return [_part(geometry, place, _DEFAULT_COLOR, True) for geometry, place in geometries]


def _geometries(
    node: WorldNode, frame: CoordinateFrame
) -> Iterator[tuple[WorldNode, CoordinateFrame]]:
    frame = frame.then(own_frame(node))
    if node.type_name in _GEOMETRIES:
        yield node, frame
    elif node.type_name in ("Group", "Pose", "Transform", "Shape"):
        for child in children_of(node):
            yield from _geometries(child, frame)


def _solids(node: WorldNode, frame: CoordinateFrame) -> Iterator[BodyPart]:
    frame = frame.then(own_frame(node))
    if node.type_name == "Solid":
        yield from _parts_of(node, frame, _color_of(node))
    elif node.type_name in ("Group", "Pose", "Transform", "HingeJoint", "SliderJoint"):
        for child in children_of(node):
            yield from _solids(child, frame)


def _part(geometry: WorldNode, frame: CoordinateFrame, color: Color, is_solid: bool) -> BodyPart:
    fields = geometry.fields
    if geometry.type_name == "Box":
        hx, hy, hz = (size / 2.0 for size in fields["size"])
    elif geometry.type_name == "Sphere":
        return BodyPart("Sphere", frame, (fields["radius"],) * 3, color, is_solid)
    else:
        hx, hy, hz = fields["radius"], fields["radius"], fields["height"] / 2.0
        hz += fields["radius"] if geometry.type_name == "Capsule" else 0.0
    if frame.rotation[8] > 0.999:
        return BodyPart(geometry.type_name, frame, (hx, hy, hz), color, is_solid)
    lying = _turned_half(frame, (hx, hy, hz))  # a lying shape counts as the box around it
    return BodyPart("Box", CoordinateFrame(translation=frame.translation), lying, color, is_solid)


def _turned_half(
    frame: CoordinateFrame, half_m: tuple[float, float, float]
) -> tuple[float, float, float]:
    r, (hx, hy, hz) = frame.rotation, half_m
    x, y, z = (abs(r[i]) * hx + abs(r[i + 1]) * hy + abs(r[i + 2]) * hz for i in (0, 3, 6))
    return x, y, z


def _color_of(node: WorldNode) -> Color:
    for part in descendants_of(node):
        color = part.fields.get("baseColor") or part.fields.get("diffuseColor")
        if color:
            return _color(color)
    return _DEFAULT_COLOR


def _color(numbers: Sequence[float]) -> Color:
    r, g, b = numbers
    return r, g, b


# Motors turn wheels, and wheels move a robot ------------------------------------------------------


@dataclass
class Joint:
    """A hinge, its motor and how far it has turned; of a slider, metres in the place of radians."""

    node: WorldNode
    max_velocity_radps: float
    acceleration_radps2: float
    min_position_rad: float
    max_position_rad: float
    start_rad: float
    target_rad: float = 0.0
    """Where the motor is to turn to; inf: turn on with `target_radps` (velocity control)."""
    target_radps: float = 0.0
    position_rad: float = 0.0
    velocity_radps: float = 0.0

    @staticmethod
    def of(node: WorldNode) -> Joint:
        """The joint that a node describes; without a motor it stands still."""
        motors = [n for n in node.fields["device"] if n.type_name in _MOTORS]
        fields: dict[str, Any] = motors[0].fields if motors else {}
        parameters = node.fields["jointParameters"]
        joint = Joint(
            node,
            fields.get("maxVelocity", 0.0),
            fields.get("acceleration", -1.0),
            fields.get("minPosition", 0.0),
            fields.get("maxPosition", 0.0),
            parameters.fields["position"] if parameters else 0.0,
        )
        joint.reset()
        return joint

    def reset(self) -> None:
        """Back to the start; the motor stands still until its next command."""
        self.position_rad, self.velocity_radps = self.start_rad, 0.0
        self.hold()

    def hold(self) -> None:
        """Make the motor hold where the joint is."""
        self.target_rad, self.target_radps = self.position_rad, self.max_velocity_radps

    def turn(self, seconds: float) -> float:
        """Turn for one time step; returns by how much, in radians."""
        wanted = self._wanted_radps(seconds)
        if self.acceleration_radps2 > 0.0:
            change = self.acceleration_radps2 * seconds
            wanted = min(max(wanted, self.velocity_radps - change), self.velocity_radps + change)
        self.velocity_radps = wanted
        turned = wanted * seconds
        self.position_rad += turned
        return turned

    def _wanted_radps(self, seconds: float) -> float:
        limit = self.max_velocity_radps
        if isinf(self.target_rad):
            wanted = self.target_radps if self.target_rad > 0.0 else -self.target_radps
            return min(max(wanted, -limit), limit)
        target = self.target_rad
        if self.min_position_rad != self.max_position_rad:
            target = min(max(target, self.min_position_rad), self.max_position_rad)
        limit = min(limit, abs(self.target_radps))
        return min(max((target - self.position_rad) / seconds, -limit), limit)


@dataclass
class Wheel:
    """A joint about the robot's left-right axis that carries something round."""

    joint: Joint
    radius_m: float
    """Negative if turning forwards drives backwards."""
    left_m: float


@dataclass
class Vehicle:
    """A robot's body and what moves it; robots without wheels stand where they are."""

    body: Body
    joints: list[Joint]
    touching: bool = False
    collisions: int = 0
    """How often the robot began to touch something that does not give way."""
    wheels: list[Wheel] = field(init=False)

    def __post_init__(self) -> None:
        self.wheels = [wheel for joint in self.joints if (wheel := _wheel_of(joint))]
        left = [wheel for wheel in self.wheels if wheel.left_m > 0.0]
        right = [wheel for wheel in self.wheels if wheel.left_m < 0.0]
        self._sides = (left, right) if left and right else None

    def reset(self) -> None:
        """Back to the start; where the body stands is the world's business."""
        for joint in self.joints:
            joint.reset()
        self.touching, self.collisions = False, 0

    def stop(self) -> None:
        """Take all speed away."""
        for joint in self.joints:
            joint.velocity_radps = 0.0
        self.body.stop()

    def drive(self, arena: Arena, seconds: float) -> None:
        """Move the robot for one time step.

        Wheels turn as their motors say, whatever is in the way: against a wall they spin, so that
        wheel sensors and GPS disagree as they do in reality.
        """
        rolled = {id(joint): joint.turn(seconds) for joint in self.joints}
        if self._sides is None:
            return
        left, right = (
            sum(rolled[id(wheel.joint)] * wheel.radius_m for wheel in side) / len(side)
            for side in self._sides
        )
        track = self._sides[0][0].left_m - self._sides[1][0].left_m
        self._roll((left + right) / 2.0, (right - left) / track, arena, seconds)

    def _roll(self, ahead_m: float, turn_rad: float, arena: Arena, seconds: float) -> None:
        body = self.body
        x, y, yaw = body.x, body.y, body.yaw_rad
        if ahead_m or turn_rad:
            middle = yaw + turn_rad / 2.0  # exact to second order: the arc's chord
            body.move(x + ahead_m * cos(middle), y + ahead_m * sin(middle), yaw + turn_rad)
            self._notice(arena.settle(body))
        else:
            body.touched.clear()
        body.velocity_mps = ((body.x - x) / seconds, (body.y - y) / seconds)
        body.yaw_rate_radps = (body.yaw_rad - yaw) / seconds

    def _notice(self, touching: bool) -> None:
        self.collisions += touching and not self.touching
        self.touching = touching


def joints_in(robot: WorldNode) -> list[Joint]:
    """All joints of a robot, in the order of the scene tree."""
    return [Joint.of(node) for node in descendants_of(robot) if node.type_name in _JOINTS]


def _wheel_of(joint: Joint) -> Wheel | None:
    parameters, end = joint.node.fields["jointParameters"], joint.node.fields["endPoint"]
    if parameters is None or end is None or joint.max_velocity_radps == 0.0:
        return None
    if joint.node.type_name != "HingeJoint":
        return None
    axis, anchor = parameters.fields["axis"], parameters.fields["anchor"]
    middle = end.fields.get("translation", anchor)  # of the wheel, along the axis
    left_m: float = middle[1] or anchor[1]
    radius_m = _radius_m(end.fields.get("boundingObject")) or _radius_m(end)
    if not radius_m or abs(axis[1]) < 0.9 or left_m == 0.0:
        return None
    return Wheel(joint, radius_m if axis[1] > 0.0 else -radius_m, left_m)


def _radius_m(shape: WorldNode | None) -> float:
    nodes = (shape, *descendants_of(shape)) if shape else ()
    return next((node.fields["radius"] for node in nodes if "radius" in node.fields), 0.0)
