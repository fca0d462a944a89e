"""The bodies of a world, and what happens when a moving body touches another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import cos, hypot, sin
from typing import Final

from webots_mcp.standin.geometry import Color, Disc, Shape, UprightBox
from webots_mcp.standin.world import World, own_frame
from webots_mcp.worlds.frames import CoordinateFrame, frame_of
from webots_mcp.worlds.vrml import WorldNode, children_of, descendants_of

_DEFAULT_COLOR: Final[Color] = (0.5, 0.5, 0.5)
_SLIDING_FRICTION: Final = 1.0
"""Coulomb friction of bodies on the floor: Webots' default."""


@dataclass(frozen=True)
class SceneColors:
    """Colors of floor and sky."""

    floor: Color = (0.75, 0.75, 0.72)
    sky: Color = (0.6, 0.75, 0.9)


@dataclass(frozen=True)
class BodyPart:
    """One geometry of a body: its pose in the body, and half its size along x, y and z."""

    kind: str
    frame: CoordinateFrame
    half_m: tuple[float, float, float]
    color: Color
    is_solid: bool
    """Whether it is part of a bounding object, which robots can run into."""

    def reach_m(self, x: float, y: float) -> float:
        """Return the distance of its farthest point from a vertical line."""
        hx, hy, _ = self.half_m
        if self.kind == "Box":
            corners = [self.frame.point((a * hx, b * hy, 0.0)) for a in (-1, 1) for b in (-1, 1)]
            return max(hypot(corner_x - x, corner_y - y) for corner_x, corner_y, _ in corners)
        part_x, part_y, _ = self.frame.translation
        return hypot(part_x - x, part_y - y) + hx

    def standing(self, body: CoordinateFrame) -> Shape:
        """Return this part as a shape in the world, for a body that stands upright."""
        x, y, z = body.point(self.frame.translation)
        hx, hy, hz = self.half_m
        if self.kind == "Box":
            yaw = body.yaw_rad + self.frame.yaw_rad
            return UprightBox(x, y, cos(yaw), sin(yaw), hx, hy, z - hz, z + hz, self.color)
        return Disc(x, y, hx, z - hz, z + hz, self.color, self.kind == "Sphere")


@dataclass(frozen=True)
class Footprint:
    """The disc that a moving body occupies on the floor, relative to its origin."""

    ahead_m: float
    left_m: float
    radius_m: float

    @staticmethod
    def around(parts: list[BodyPart]) -> Footprint:
        """Return a disc around all parts, in the middle of their bounding rectangle."""
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
    """A Solid or Robot at the top of the scene tree, with everything that is fixed to it."""

    def __init__(self, node: WorldNode, frame: CoordinateFrame) -> None:
        self.node = node
        self.name: str = node.fields["name"]
        self.is_movable = node.type_name == "Solid" and node.fields["physics"] is not None
        self.velocity_mps = (0.0, 0.0)
        self.yaw_rate_radps = 0.0
        self.is_pushed = False
        """Whether its velocity was set by a supervisor and friction has not stopped it yet."""
        self.touched: list[tuple[float, float]] = []
        """Shifts in metres by which obstacles pushed it back in the last step."""
        self.stand(frame)

    def stand(self, frame: CoordinateFrame) -> None:
        """Put the body at `frame`, which may be tilted."""
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
        """Set the velocity to 0."""
        self.velocity_mps, self.yaw_rate_radps, self.is_pushed = (0.0, 0.0), 0.0, False

    @property
    def frame(self) -> CoordinateFrame:
        """Return the pose of the body, upright."""
        return frame_of((self.x, self.y, self.z), (0.0, 0.0, 1.0, self.yaw_rad))

    def move(self, x: float, y: float, yaw_rad: float) -> None:
        """Move the body on the plane, and update its node."""
        if (x, y, yaw_rad) == (self.x, self.y, self.yaw_rad):
            return
        self.node.fields["translation"] = [x, y, self.z]
        if yaw_rad != self.yaw_rad:
            self.node.fields["rotation"] = [0.0, 0.0, 1.0, yaw_rad]
        self.x, self.y, self.yaw_rad = x, y, yaw_rad
        self._shapes = None

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Return the parts at the body's present pose."""
        if self._shapes is None:
            frame = self.frame
            self._shapes = tuple(part.standing(frame) for part in self.parts)
        return self._shapes

    @property
    def solid_shapes(self) -> tuple[Shape, ...]:
        """Return the solid parts at the body's present pose."""
        shapes = self.shapes
        if self._solid_of is not shapes:
            pairs = zip(self.parts, shapes, strict=True)
            self._solid_of = shapes
            self._solid_shapes = tuple(shape for part, shape in pairs if part.is_solid)
        return self._solid_shapes

    def centre(self) -> tuple[float, float]:
        """Return the centre of the footprint in the world."""
        disc, c, s = self.footprint, cos(self.yaw_rad), sin(self.yaw_rad)
        return (
            self.x + c * disc.ahead_m - s * disc.left_m,
            self.y + s * disc.ahead_m + c * disc.left_m,
        )


class Arena:
    """All bodies of a world, fixed and movable.

    A movable Solid (one with Physics) is pushed along by what runs into it, as far as no obstacle
    stops it. It neither turns nor rolls on.
    """

    def __init__(self, world: World) -> None:
        self.bodies = [*_bodies_in(world.root, CoordinateFrame())]
        self.world = world
        self.colors = _scene_colors(world)
        self.gravity_mps2: float = world.info.fields["gravity"]
        self.step_s = world.basic_time_step_ms / 1000.0
        self._sort()

    def _sort(self) -> None:
        self.lights = [
            node
            for node in self.world.nodes
            if node.type_name in ("DirectionalLight", "PointLight")
        ]
        self._obstacles = [body for body in self.bodies if body.is_obstacle]
        self._movable = [body for body in self._obstacles if body.is_movable]

    def follow(self) -> None:
        """Update the bodies after nodes were added or removed."""
        known = {body.node: body for body in self.bodies}
        self.bodies[:] = [
            known.get(b.node, b) for b in _bodies_in(self.world.root, CoordinateFrame())
        ]
        self._sort()

    def scene(self, without: Body) -> list[Shape]:
        """Return all shapes that one body can see: those of all others."""
        return [shape for body in self.bodies if body is not without for shape in body.shapes]

    def obstacles(self, *without: Body) -> list[Shape]:
        """Return the shapes of all bounding objects except those of some bodies."""
        return [
            shape
            for body in self.bodies
            if body not in without and body.is_obstacle
            for shape in body.solid_shapes
        ]

    def settle(self, body: Body) -> bool:
        """Move a body out of what it ran into.

        Returns:
            True if it touched something that could not be pushed away.
        """
        body.touched.clear()
        for movable in self._movable:
            self._push_away(movable, body)
        return self._clear(body)

    def glide(self, seconds: float) -> None:
        """Let bodies slide whose velocity a supervisor has set, until friction has stopped them."""
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
        """Move a body out of all obstacles but the one that pushes it; True if it touched one."""
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
    x, y = body.centre()  # Robots collide with each other as discs.
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
    """Yield the bounding object of a Solid, else its visible shapes, and those of Solids in it."""
    bounding = node.fields["boundingObject"]
    shown = [bounding] if bounding else node.fields["children"]
    for child in shown:
        for geometry, place in _geometries(child, frame):
            yield _part(geometry, place, color, is_solid=bounding is not None)
    for child in node.fields["children"]:
        yield from _solids(child, frame)


def bounding_parts(node: WorldNode, frame: CoordinateFrame) -> list[BodyPart]:
    """Return the parts of the bounding object of a node at `frame`."""
    bounding = node.fields["boundingObject"]
    geometries = _geometries(bounding, frame) if bounding else ()
    return [_part(geometry, place, _DEFAULT_COLOR, True) for geometry, place in geometries]


def _geometries(
    node: WorldNode, frame: CoordinateFrame
) -> Iterator[tuple[WorldNode, CoordinateFrame]]:
    frame = frame.then(own_frame(node))
    if node.type_name in ("Box", "Capsule", "Cylinder", "Sphere"):
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
    lying = _turned_half(frame, (hx, hy, hz))  # A lying shape counts as its bounding box.
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
