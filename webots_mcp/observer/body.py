"""A robot or another solid of the world, and where it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.scene import SceneNode, read_value
from webots_mcp.naming import SEEN_SPEED

_DIGITS: Final = 6  # of metres and radians that are recorded
_MOVED_M: Final = 0.001
_TURNED_RAD: Final = 0.01


class Place(NamedTuple):
    """Where a body is at a moment."""

    sim_time_s: float
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float

    def distance_m(self, position: list[float]) -> float:
        """How far away another position is."""
        return math.dist((self.x_m, self.y_m, self.z_m), position)

    def is_elsewhere(self, other: Place) -> bool:
        """Whether a body has moved or turned between the two."""
        turned = abs(math.remainder(self.heading_rad - other.heading_rad, math.tau))
        return self.distance_m([*other[1:4]]) > _MOVED_M or turned > _TURNED_RAD


@dataclass
class Body:
    """A node whose pose is followed.

    Attributes:
        key: What it is called in signals.
        scene: Its node, where it stands in the tree.
        name: Its field `name`.
        controller: The controller of a robot; "" of another solid.
        is_robot: Whether it is a robot.
        place: Where it was seen last.
        has_moved: Whether it was ever seen to move.
        speed_mps: Between the two places that were seen last; None before.
    """

    key: str
    scene: SceneNode
    name: str
    controller: str
    is_robot: bool
    place: Place | None = None
    has_moved: bool = False
    speed_mps: float | None = None
    _first: Place | None = field(default=None, repr=False)

    @property
    def is_told(self) -> bool:
        """A robot always; another solid once it has moved."""
        return self.is_robot or self.has_moved

    def look(self, sim_time_s: float) -> bool:
        """See where it is now; False where its node is not there any more, or has no place."""
        node: Any = self.scene.node
        if int(node.getId()) != self.scene.id:  # what the library knows is of another node now
            return False
        pose = node.getPose()
        if not math.isfinite(pose[3]):
            return False
        place = Place(sim_time_s, pose[3], pose[7], pose[11], math.atan2(pose[4], pose[0]))
        self._go_on(place)
        return True

    def _go_on(self, place: Place) -> None:
        before = self.place
        if before is None or place.sim_time_s < before.sim_time_s:  # the beginning, or a reset
            self._first, self.speed_mps, self.has_moved = place, None, False
        elif place.sim_time_s > before.sim_time_s:
            distance_m = place.distance_m([*before[1:4]])
            self.speed_mps = distance_m / (place.sim_time_s - before.sim_time_s)
        self.place = place
        self.has_moved = self.has_moved or place.is_elsewhere(self._first or place)

    def signals(self) -> dict[str, float | None]:
        """What is recorded of it at a moment."""
        if self.place is None:
            return {}
        _, x, y, z, heading = (round(value, _DIGITS) for value in self.place)
        speed = None if self.speed_mps is None else round(self.speed_mps, _DIGITS)
        return {"x_m": x, "y_m": y, "z_m": z, "heading_rad": heading, SEEN_SPEED: speed}

    def describe(self) -> dict[str, object]:
        """What does not change of it: where it is, too, as long as it has not moved."""
        carrier = robot_around(self.scene)
        told = {
            "key": self.key,
            "type": self.scene.type_name,
            "def": _other_than(self.key, self.scene.definition),
            "name": _other_than(self.key, self.name),
            "controller": self.controller or None,
            "on_robot": carrier.name if carrier else None,
        }
        place = {} if self.is_told else self.signals() | {SEEN_SPEED: None}
        return {what: value for what, value in (told | place).items() if value is not None}


def is_followed(scene: SceneNode) -> bool:
    """Robots, and solids with a DEF name that are no part of a robot nor of a PROTO node."""
    if scene.base_type != "Solid":
        return scene.base_type == "Robot"
    return bool(scene.definition) and not scene.hidden and robot_around(scene) is None


def robot_around(scene: SceneNode) -> SceneNode | None:
    """The robot that a node is a part of, or stands on."""
    around = scene.parent
    while around is not None and around.base_type != "Robot":
        around = around.parent
    return around


def _other_than(key: str, name: str) -> str | None:
    return name if name and name != key else None


def body_of(scene: SceneNode, key: str) -> Body:
    """The body of a node that stands in the tree; its fields are asked for."""
    is_robot = scene.base_type == "Robot"
    controller = read_value(scene.node, "controller") if is_robot else None
    return Body(key, scene, scene.name, str(controller or ""), is_robot)
