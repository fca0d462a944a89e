"""The whole world as a Supervisor sees it: which robots and solids there are, and where they are.

Poses come with the steps (`enablePoseTracking`), so that fifty robots cost no more requests than
one. The tree is walked a few milliseconds at a time: at the start, where something has vanished or
the number of nodes has changed, and every few seconds.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from typing import Any, Final, TypeAlias

from webots_mcp.bridge.scene import MOST_NODES, SceneNode, read_value, walk
from webots_mcp.naming import SOLIDS, WORLD
from webots_mcp.observer.body import Body, Place, body_of, is_followed
from webots_mcp.observer.words import word_of

MOST_ROBOTS: Final = 200
MOST_SOLIDS: Final = 100
_WALK_S: Final = 0.004  # of wall time in one look
_REST_S: Final = 5.0  # of wall time between two walks
Seen: TypeAlias = "dict[str, dict[str, dict[str, float | None]]]"
_STALE_M: Final = 0.01


class World:
    """The bodies of a world, as far as they have been found.

    Args:
        robot: The observer's own Supervisor.
        period_ms: How often poses are to be sent, in simulation time.
        warn: Is told what could not be done.

    Attributes:
        bodies: By the words that they are called in signals.
    """

    def __init__(self, robot: Any, period_ms: int, warn: Any) -> None:
        self._robot = robot
        self._root = robot.getRoot()
        self._own_id = int(robot.getSelf().getId())
        self._period_ms = period_ms
        self._warn = warn
        self._keys: dict[int, str] = {}  # by node id: a body keeps its word
        self._walk: Generator[None] | None = None
        self._next_walk_s = 0.0
        self._count = -1
        self._is_tracking = True
        self._seen_at_walk: dict[str, Place] = {}
        self._is_cut = False
        self._is_walked = False
        self._is_new = False
        self.bodies: dict[str, Body] = {}

    @property
    def is_new(self) -> bool:
        """A walk has found something else than `describe` has told."""
        return self._is_new and self._is_walked

    def look(self, sim_time_s: float) -> Seen:
        """Where everything is now, by the words of its signals: robots, and solids that moved."""
        gone = [key for key, body in self.bodies.items() if not body.look(sim_time_s)]
        for key in gone:
            self._lose(key)
        seen: Seen = {}
        for body in self.bodies.values():
            if body.is_told and (signals := body.signals()):
                seen.setdefault(WORLD if body.is_robot else SOLIDS, {})[body.key] = signals
        return seen

    def go_on(self) -> None:
        """Walk on, or begin to walk where it is time to."""
        if self._walk is None and self._is_due():
            self._walk = self._survey()
        until_s = time.monotonic() + _WALK_S
        for _ in self._walk or ():
            if time.monotonic() > until_s:
                return
        if self._walk is not None:
            self._walk, self._is_walked = None, True
            self._next_walk_s = time.monotonic() + _REST_S

    def begin_run(self) -> None:
        """The world was reset: look at everything again."""
        self._look_again()

    def describe(self) -> dict[str, object]:
        """What there is, without where it is."""
        self._is_new = False
        for body in self.bodies.values():
            body.look(float(self._robot.getTime()))
        bodies = self.bodies.values()
        told: dict[str, object] = {
            "title": self._title(),
            "file": str(self._robot.getWorldPath()),
            "basic_time_step_ms": float(self._robot.getBasicTimeStep()),
            "robots": [body.describe() for body in bodies if body.is_robot],
            "solids": [body.describe() for body in bodies if not body.is_robot],
        }
        return told | ({"more": True} if self._is_cut else {})

    def find(self, name: object) -> Body | None:
        """The body of that word, DEF name or name."""
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
        """What stands in a slot may be shown in the slot and, with another id, inside the PROTO."""
        if not scene.hidden or scene.id in self._keys:
            return False
        around, name = _proto_around(scene), scene.name
        return any(
            body.name == name and not body.scene.hidden and _proto_around(body.scene) == around
            for body in self.bodies.values()
        )

    def _follow(self, scene: SceneNode) -> None:
        key = self._keys.get(scene.id)
        if key in self.bodies:
            return
        if key is None:
            key = self._name(scene)
        self.bodies[key] = body_of(scene, key)
        if self._is_tracking:
            scene.node.enablePoseTracking(self._period_ms)
        self._is_new = True

    def _name(self, scene: SceneNode) -> str:
        """A word that no other body has now: what was put back is called as before."""
        key = word_of(scene.definition or scene.name or scene.type_name, self.bodies)
        self._keys = {node: word for node, word in self._keys.items() if word != key}
        self._keys[scene.id] = key
        return key

    def _lose(self, key: str) -> None:
        """Nothing is asked of its node: it may not be there any more."""
        del self.bodies[key]
        self._look_again()

    def _look_again(self) -> None:
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


def _is_stale(body: Body, before: Place | None) -> bool:
    """Whether it stood since then by what is tracked, and not by what is asked for."""
    place = body.place
    if place is None or before is None or place.sim_time_s <= before.sim_time_s:
        return False
    if place[1:] != before[1:]:
        return False
    return place.distance_m(body.scene.node.getPosition()) > _STALE_M


def _proto_around(scene: SceneNode) -> int | None:
    """The id of the innermost PROTO node that a node stands in."""
    around = scene.parent
    while around is not None and not around.is_proto:
        around = around.parent
    return None if around is None else around.id
