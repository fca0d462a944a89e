"""Find the bodies of a world that an observer records: robots and solids of the scene tree.

Poses come with the steps (`enablePoseTracking`), so that fifty robots cost no more requests than
one. The tree is walked a few milliseconds at a time: at the start, after a body has vanished or the
number of nodes has changed, and every few seconds.
"""

from __future__ import annotations

import keyword
import math
import re
import time
import unicodedata
from collections.abc import Callable, Collection, Generator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, TypeAlias

from webots_mcp.bridge.scene_nodes import MOST_NODES, SceneNode, read_value, walk, world_up_axis
from webots_mcp.signals.meaning import DeclaredMeaning, Quantity
from webots_mcp.signals.naming import SEEN_SPEED, SOLIDS, WORLD

DIGITS: Final = 6
MOST_ROBOTS: Final = 200
MOST_SOLIDS: Final = 100
Seen: TypeAlias = "dict[str, dict[str, dict[str, float | None]]]"


@dataclass(frozen=True)
class WalkLimits:
    """When the tree is walked, and when a body counts as moved.

    Attributes:
        moved_m: Distance from which on a body has moved, in metres.
        turned_rad: Angle from which on it has turned, in radians.
        stale_m: Distance between tracked and current position from which on tracking is not
            trusted, in metres.
        walk_s: Wall time of one piece of a walk.
        rest_s: Wall time between two walks.
        word_characters: Characters of the name of a body in signals.
    """

    moved_m: float = 0.001
    turned_rad: float = 0.01
    stale_m: float = 0.01
    walk_s: float = 0.004
    rest_s: float = 5.0
    word_characters: int = 60


_LIMITS: Final = WalkLimits()
_UNITS: Final[dict[Quantity, str]] = {
    "x": "m", "y": "m", "height": "m", "heading": "rad", "roll": "rad", "pitch": "rad",
    "speed": "m/s",
}  # fmt: skip


class BodyPose(NamedTuple):
    """Where a body is at a moment, and its orientation relative to the world's up direction."""

    sim_time_s: float
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    height_m: float = 0.0

    def distance_m(self, position: list[float]) -> float:
        """Return how far away another position is."""
        return math.dist((self.x_m, self.y_m, self.z_m), position)

    def signals(self) -> dict[str, float]:
        """Return the pose as recorded signals."""
        values = self._asdict()
        del values["sim_time_s"]
        return {name: round(value, DIGITS) + 0.0 for name, value in values.items()}  # no -0.0

    def is_elsewhere(self, other: BodyPose) -> bool:
        """Return whether a body has moved or turned between the two."""
        turned = abs(math.remainder(self.heading_rad - other.heading_rad, math.tau))
        return self.distance_m([*other[1:4]]) > _LIMITS.moved_m or turned > _LIMITS.turned_rad


def pose_of(matrix: Sequence[float], sim_time_s: float, up_axis: int) -> BodyPose:
    """Return the pose given by a matrix of Webots.

    Roll and pitch are those of the world's up direction in the body's own frame, so that they do
    not depend on where the body heads. Where the world's y axis is up (NUE), its z axis points to
    the right of its x axis: angles are those of the same body in a world whose z axis is up.

    Args:
        matrix: 16 numbers by rows, as `Node.getPose` returns them.
        sim_time_s: When it was there.
        up_axis: The axis of the world that points up: 1 or 2.
    """
    place = matrix[3], matrix[7], matrix[11]
    up = matrix[4 * up_axis : 4 * up_axis + 3]
    if up_axis == 1:
        heading_rad, up = math.atan2(-matrix[8], matrix[0]), (up[0], -up[2], up[1])
    else:
        heading_rad = math.atan2(matrix[4], matrix[0])
    roll_rad = math.atan2(up[1], up[2])
    pitch_rad = math.asin(max(-1.0, min(1.0, -up[0])))
    return BodyPose(sim_time_s, *place, heading_rad, roll_rad, pitch_rad, place[up_axis])


@dataclass
class ObservedBody:
    """A node whose pose is followed.

    Attributes:
        key: What it is called in signals.
        scene: Its node, where it stands in the tree.
        name: Its field `name`.
        controller: The controller of a robot; "" of another solid.
        is_robot: Whether it is a robot.
        place: Where it was seen last.
        has_moved: Whether it was ever seen to move.
        up_axis: The axis of the world that points up.
        speed_mps: Between the two places that were seen last; None before.
    """

    key: str
    scene: SceneNode
    name: str
    controller: str
    is_robot: bool
    up_axis: int = 2
    place: BodyPose | None = None
    has_moved: bool = False
    speed_mps: float | None = None
    _first: BodyPose | None = field(default=None, repr=False)

    @property
    def is_published(self) -> bool:
        """Whether the body is recorded: a robot always, another solid once it has moved."""
        return self.is_robot or self.has_moved

    @property
    def is_there(self) -> bool:
        """Whether its node still exists; otherwise the library may have reused its id."""
        node: Any = self.scene.node
        return int(node.getId()) == self.scene.id

    def update_pose(self, sim_time_s: float) -> bool:
        """Read where it is now; return False if its node was removed or has no position."""
        place = self._seen(sim_time_s) if self.is_there else None
        if place is not None:
            self._go_on(place)
        return place is not None

    def pose_now(self) -> dict[str, float] | None:
        """Return where it is now, as signals; None where it has no place."""
        place = self._seen(0.0)
        return None if place is None else place.signals()

    def _seen(self, sim_time_s: float) -> BodyPose | None:
        node: Any = self.scene.node
        matrix: Sequence[float] = node.getPose()
        return pose_of(matrix, sim_time_s, self.up_axis) if math.isfinite(matrix[3]) else None

    def _go_on(self, place: BodyPose) -> None:
        before = self.place
        if before is None or place.sim_time_s < before.sim_time_s:  # the beginning, or a reset
            self._first, self.speed_mps, self.has_moved = place, None, False
        elif place.sim_time_s > before.sim_time_s:
            distance_m = place.distance_m([*before[1:4]])
            self.speed_mps = distance_m / (place.sim_time_s - before.sim_time_s)
        self.place = place
        self.has_moved = self.has_moved or place.is_elsewhere(self._first or place)

    def signals(self) -> dict[str, float | None]:
        """Return what is recorded of it at a moment."""
        if self.place is None:
            return {}
        speed = None if self.speed_mps is None else round(self.speed_mps, DIGITS)
        return {**self.place.signals(), SEEN_SPEED: speed}

    def describe(self) -> dict[str, object]:
        """Return what does not change of it: where it is, too, as long as it has not moved."""
        carrier = robot_around(self.scene)
        described = {
            "key": self.key,
            "type": self.scene.type_name,
            "def": self.scene.definition if self.scene.definition not in ("", self.key) else None,
            "name": self.name if self.name not in ("", self.key) else None,
            "controller": self.controller or None,
            "on_robot": carrier.name if carrier else None,
        }
        place = {} if self.is_published else self.signals() | {SEEN_SPEED: None}
        return {what: value for what, value in (described | place).items() if value is not None}


def is_followed(scene: SceneNode) -> bool:
    """Return whether a node is a robot, or a free solid with a DEF name that is recorded too."""
    if scene.base_type != "Solid":
        return scene.base_type == "Robot"
    return bool(scene.definition) and not scene.hidden and robot_around(scene) is None


def robot_around(scene: SceneNode) -> SceneNode | None:
    """Return the robot that a node is a part of, or stands on."""
    return _around(scene, lambda each: each.base_type == "Robot")


def _around(scene: SceneNode, is_meant: Callable[[SceneNode], bool]) -> SceneNode | None:
    """Return the innermost node of a kind that a node stands in."""
    around = scene.parent
    while around is not None and not is_meant(around):
        around = around.parent
    return around


def word_of(name: str, taken: Collection[str]) -> str:
    """Return the name as a word that is not taken yet: `2nd robot` becomes `_2nd_robot`.

    Conditions and positions can name it without quotes. A number is appended to one that is taken.
    """
    word = re.sub(r"\W", "_", unicodedata.normalize("NFKC", name))
    word = word[: _LIMITS.word_characters] or "robot"
    if word[0].isdigit() or keyword.iskeyword(word):
        word = f"_{word}"
    number, free = 2, word
    while free in taken:
        number, free = number + 1, f"{word}_{number}"
    return free


class ObservedBodies:
    """The bodies of a world, as far as they have been found.

    Args:
        robot: The observer's own Supervisor.
        period_ms: How often poses are to be sent, in simulation time.
        warn: Receives each thing that could not be done.

    Attributes:
        bodies: By the words that they are called in signals.
    """

    def __init__(self, robot: Any, period_ms: int, warn: Any) -> None:
        self._robot = robot
        self._root = robot.getRoot()
        self._up_axis = world_up_axis(robot)
        self._own_id = int(robot.getSelf().getId())
        self._period_ms = period_ms
        self._warn = warn
        self._keys: dict[int, str] = {}  # by node id: a body keeps its word
        self._walk: Generator[None] | None = None
        self._next_walk_s = 0.0
        self._count = -1
        self._is_tracking = True
        self._asked_at: dict[str, list[float]] = {}
        self._seen_at_walk: dict[str, BodyPose] = {}
        self._is_cut = False
        self._is_walked = False
        self._is_new = False
        self.bodies: dict[str, ObservedBody] = {}

    @property
    def is_new(self) -> bool:
        """Whether a walk has found something that `describe` has not recorded yet."""
        return self._is_new and self._is_walked

    def read_poses(self, sim_time_s: float) -> Seen:
        """Return where everything is now, by signal: robots, and solids that have moved."""
        gone = [key for key, body in self.bodies.items() if not body.update_pose(sim_time_s)]
        for key in gone:
            self._lose(key)
        seen: Seen = {}
        for body in self.bodies.values():
            if body.is_published and (signals := body.signals()):
                seen.setdefault(WORLD if body.is_robot else SOLIDS, {})[body.key] = signals
        return seen

    def moves(self) -> bool:
        """Return whether a robot is elsewhere than at the last call, whatever the time says.

        Unlike a pose, which Webots sends with the steps, a position is asked of it each time.
        """
        before, self._asked_at = self._asked_at, {}
        for key, body in self.bodies.items():
            if body.is_robot and body.is_there:
                node: Any = body.scene.node
                self._asked_at[key] = [float(value) for value in node.getPosition()]
        return any(
            math.dist(position, before[key]) > _LIMITS.moved_m
            for key, position in self._asked_at.items()
            if key in before
        )

    def go_on(self) -> None:
        """Continue the walk, or begin one when it is due."""
        if self._walk is None and self._is_due():
            self._walk = self._survey()
        until_s = time.monotonic() + _LIMITS.walk_s
        for _ in self._walk or ():
            if time.monotonic() > until_s:
                return
        if self._walk is not None:
            self._walk, self._is_walked = None, True
            self._next_walk_s = time.monotonic() + _LIMITS.rest_s

    def begin_run(self) -> None:
        """Survey the tree again, since the world was reset."""
        self._survey_again()

    def describe(self) -> dict[str, object]:
        """Return what there is, without where it is."""
        self._is_new = False
        for body in self.bodies.values():
            body.update_pose(float(self._robot.getTime()))
        bodies = self.bodies.values()
        described: dict[str, object] = {
            "title": self._title(),
            "file": str(self._robot.getWorldPath()),
            "basic_time_step_ms": float(self._robot.getBasicTimeStep()),
            "robots": [body.describe() for body in bodies if body.is_robot],
            "solids": [body.describe() for body in bodies if not body.is_robot],
        }
        return described | ({"more": True} if self._is_cut else {})

    def describe_signals(self) -> list[tuple[DeclaredMeaning, str]]:
        """Return what the signals of all bodies mean, and the device that says it."""
        quantities: dict[str, Quantity] = {
            "x_m": "x", "y_m": "y", "z_m": "height", "heading_rad": "heading",
            "roll_rad": "roll", "pitch_rad": "pitch", "height_m": "height", SEEN_SPEED: "speed",
        }  # fmt: skip
        if self._up_axis == 1:
            quantities |= {"y_m": "height", "z_m": "y"}
        said = f"pose of the body by the supervisor {str(self._robot.getName())!r}"
        return [
            (DeclaredMeaning(f"{branch}.*.{part}", quantity, "measured", _UNITS[quantity]), said)
            for branch in (WORLD, SOLIDS)
            for part, quantity in quantities.items()
        ]

    def find(self, name: object) -> ObservedBody | None:
        """Return the body of that word, DEF name or name."""
        named = [body for body in self.bodies.values() if body.key == name]
        named += [body for body in self.bodies.values() if body.scene.definition == name]
        named += [body for body in self.bodies.values() if body.name == name]
        return named[0] if named else None

    def _is_due(self) -> bool:
        children = self._root.getField("children")
        count = children.getCount() if children is not None else 0
        changed, self._count = count != self._count, count
        return changed or time.monotonic() >= self._next_walk_s

    def _survey(self) -> Generator[None]:
        """Walk through the whole tree; what is found is followed at once."""
        found: set[int] = set()
        nodes = robots = solids = 0
        is_cut = False
        for scene in walk(self._root):
            nodes += 1
            if not is_followed(scene) or scene.id == self._own_id:
                yield
                continue
            is_robot = scene.base_type == "Robot"
            robots, solids = robots + is_robot, solids + (not is_robot)
            if robots > MOST_ROBOTS or solids > MOST_SOLIDS:
                is_cut = True
            elif not self._is_shown_twice(scene):
                found.add(scene.id)
                self._follow(scene)
            yield
        self._is_cut = is_cut or nodes >= MOST_NODES
        for key in [key for key, body in self.bodies.items() if body.scene.id not in found]:
            self._lose(key)
            yield
        self._check_tracking()

    def _is_shown_twice(self, scene: SceneNode) -> bool:
        """Return whether a node in a slot is also shown inside its PROTO, with another id."""
        if not scene.hidden or scene.id in self._keys:
            return False
        around, name = _proto_id_around(scene), scene.name
        return any(
            body.name == name and not body.scene.hidden and _proto_id_around(body.scene) == around
            for body in self.bodies.values()
        )

    def _follow(self, scene: SceneNode) -> None:
        key = self._keys.get(scene.id)
        if key in self.bodies:
            return
        if key is None:
            key = self._name(scene)
        is_robot = scene.base_type == "Robot"
        controller = str((is_robot and read_value(scene.node, "controller")) or "")
        self.bodies[key] = ObservedBody(key, scene, scene.name, controller, is_robot, self._up_axis)
        if self._is_tracking:
            scene.node.enablePoseTracking(self._period_ms)
        self._is_new = True

    def _name(self, scene: SceneNode) -> str:
        """Return a word that no other body has now: what was put back is called as before."""
        key = word_of(scene.definition or scene.name or scene.type_name, self.bodies)
        self._keys = {node: word for node, word in self._keys.items() if word != key}
        self._keys[scene.id] = key
        return key

    def _lose(self, key: str) -> None:
        """Stop following a body without a request to its node, which may have been removed."""
        del self.bodies[key]
        self._survey_again()

    def _survey_again(self) -> None:
        self._next_walk_s, self._is_new, self._is_walked = 0.0, True, False

    def _check_tracking(self) -> None:
        """Ask for the poses where what comes with the steps does not follow what is asked for."""
        before, self._seen_at_walk = self._seen_at_walk, {}
        for key, body in self.bodies.items():
            if body.place is None:
                continue
            self._seen_at_walk[key] = body.place
            if self._is_tracking and _is_stale(body, before.get(key)):
                self._stop_tracking()

    def _stop_tracking(self) -> None:
        self._is_tracking = False
        for body in self.bodies.values():
            body.scene.node.disablePoseTracking()
        self._warn("Webots does not send the poses that are tracked: each is asked for from now on")

    def _title(self) -> str | None:
        top = walk(self._root, deepest=1, everything=True)
        infos = (scene.node for scene in top if scene.base_type == "WorldInfo")
        return next((read_value(node, "title") or None for node in infos), None)


def _is_stale(body: ObservedBody, before: BodyPose | None) -> bool:
    """Return whether it stood since then by what is tracked, and not by what is asked for."""
    place = body.place
    if place is None or before is None or place.sim_time_s <= before.sim_time_s:
        return False
    if place[1:] != before[1:]:
        return False
    return place.distance_m(body.scene.node.getPosition()) > _LIMITS.stale_m


def _proto_id_around(scene: SceneNode) -> int | None:
    proto = _around(scene, lambda each: each.is_proto)
    return None if proto is None else proto.id
