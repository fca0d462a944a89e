"""The observer: a robot of the world that only looks, records what it sees, and steers.

It is a Supervisor with a bridge of its own, so that nothing has to be changed in the controllers of
the robots that it watches. Standard library only: it runs inside a controller.

The loop must neither hold up the world nor hang in a pause. `step(n)` of a paused simulation does
not return, so a controller waiting in it cannot resume. A robot without synchronization need not
wait: it asks `step(0)`, which is answered at once, again and again. Whether these answers have the
time is tested, not assumed; where it does not, and in fast mode, where a moment would be
long in simulation time, the loop makes steps like any other.

Poses come with the steps (`enablePoseTracking`), so that fifty robots cost no more requests than
one. The tree is walked a few milliseconds at a time: at the start, where something has vanished or
the number of nodes has changed, and every few seconds.
"""

from __future__ import annotations

import keyword
import math
import os
import re
import signal
import socket
import sys
import threading
import time
import unicodedata
from collections.abc import Callable, Collection, Generator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, TypeAlias

from webots_mcp.bridge.custom_data import CustomDataReader, ObserverParts
from webots_mcp.bridge.mcp_bridge import MCPBridge
from webots_mcp.bridge.scene import MOST_NODES, SceneNode, read_value, walk
from webots_mcp.contract import LOOK_AT, MODE_EVENT, OBSERVER, WORLD_EVENT
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.signals.naming import SEEN_SPEED, SOLIDS, WORLD

PERIOD_MS: Final = 100  # of simulation time between two rows, unless another is asked for
LONGEST_PERIOD_MS: Final = 60_000

_ROUND_S: Final = 0.01  # of wall time
_END_SIGNALS: Final = ("SIGINT", "SIGTERM", "SIGHUP")
_GRACE_S: Final = 2.0  # of wall time in which a loop that a signal ends has to come round
_TRIAL_S: Final = 1.0  # of wall time in which time ought to have moved
_RECORD_AGAIN_S: Final = 3600.0  # of wall time: old events are purged
_MOST_CONTACTS: Final = 30
_DIGITS: Final = 6
_NO_RIGHTS: Final = (
    "the observer needs a robot with 'supervisor TRUE': {!r} is none. 'webots-mcp init --observer "
    "WORLD' adds one to a copy of a world"
)
_MOVED_M: Final = 0.001
_TURNED_RAD: Final = 0.01
_NO_WORD: Final = re.compile(r"\W")
_LONGEST_WORD: Final = 60  # characters
MOST_ROBOTS: Final = 200
MOST_SOLIDS: Final = 100
_WALK_S: Final = 0.004  # of wall time in one look
_REST_S: Final = 5.0  # of wall time between two walks
_STALE_M: Final = 0.01


def checked_period(period_ms: int) -> int:
    """A period that can be kept to.

    Raises:
        InvalidInputError: It cannot.
    """
    if not 1 <= period_ms <= LONGEST_PERIOD_MS:
        raise InvalidInputError(f"the period is from 1 to {LONGEST_PERIOD_MS} ms, not {period_ms}")
    return period_ms


class StepPace:
    """Makes the rounds of a loop.

    Args:
        robot: The observer's own Supervisor.
        period_ms: The step that it makes where it makes one.
        world_waits: Whether the world waits for the observer's steps.
    """

    def __init__(self, robot: Any, period_ms: int, *, world_waits: bool) -> None:
        self._robot = robot
        self._period_ms = period_ms
        self._may_pump = not world_waits
        self._tells_time: bool | None = None
        self._time_s = float(robot.getTime())
        self._stood_since_s = time.monotonic()

    def go_on(self, *, may_step: bool = True) -> bool:
        """One round; False where Webots wants the controller to end.

        Args:
            may_step: Whether it may make a step, which a command that counts steps forbids.
        """
        if not may_step:
            self._stood_since_s = time.monotonic()
            return self._robot.step(0) != -1
        is_fast = self._robot.simulationGetMode() == self._robot.SIMULATION_MODE_FAST
        if not self._may_pump or self._tells_time is False or is_fast:
            return self._robot.step(self._period_ms) != -1
        if self._tells_time is None and self._has_stood():
            return self._try_step()
        answer = self._robot.step(0)
        now_s = float(self._robot.getTime())
        if now_s != self._time_s:
            self._time_s, self._tells_time = now_s, True
        time.sleep(_ROUND_S)
        return answer != -1

    def _has_stood(self) -> bool:
        if self._robot.simulationGetMode() == self._robot.SIMULATION_MODE_PAUSE:
            self._stood_since_s = time.monotonic()
        return time.monotonic() - self._stood_since_s > _TRIAL_S

    def _try_step(self) -> bool:
        """Make one step; where time advances by more, `step(0)` is no longer trusted to show it."""
        before_s, self._stood_since_s = self._time_s, time.monotonic()
        answer = self._robot.step(self._period_ms)
        self._time_s = float(self._robot.getTime())
        if self._time_s - before_s > 2 * self._period_ms / 1000:
            self._tells_time = False
        return answer != -1


class ObserverBridge(MCPBridge):
    """The bridge of a robot that only looks."""

    _kind = OBSERVER

    def record_event(self, kind: str, data: dict[str, object]) -> None:
        """Record what changes seldom: what there is, and the mode."""
        self._session.journal.event(kind, data)

    def count_steps_by_time(self) -> None:
        """Count steps by time, since the world advances between two rounds of this loop."""
        self._session.clock.step_s = self._session.simulation.basic_time_step_s

    @property
    def world_waits(self) -> bool:
        """Whether the world waits for the observer's steps, by its own field."""
        return self._session.simulation.waits_for_robot

    @property
    def steps_world(self) -> bool:
        """Whether a command counts the observer's steps, for which the world waits meanwhile."""
        return self._session.simulation.world_is_waiting

    @property
    def mode_name(self) -> str:
        """The mode in which the simulation is seen to be."""
        return self._session.simulation.mode_name

    def read_custom_data(self) -> CustomDataReader:
        """What records the robots that have no bridge of their own."""
        own = self._session
        parts = (own.identity, own.simulation, own.clock, own.recorder, own.journal, own.errors)
        return CustomDataReader(ObserverParts(*parts))

    def failed(self, error: Exception) -> None:
        """Count what could not be seen, and say it once on stderr."""
        self._errors.failed("the observer", error)


def main(arguments: list[str] | None = None) -> None:
    """The whole controller; its first argument may be a period in milliseconds."""
    from controller import Supervisor  # type: ignore[import-not-found]

    given = " ".join(sys.argv[1:] if arguments is None else arguments)
    try:
        period_ms = checked_period(int(given)) if given else PERIOD_MS
    except (ValueError, InvalidInputError) as error:
        raise SystemExit(f"give a period of 1 to {LONGEST_PERIOD_MS} ms, not {given!r}") from error
    observe(Supervisor(), period_ms)


def observe(robot: Any, period_ms: int = PERIOD_MS, **options: Any) -> None:
    """Record the world until Webots ends the controller.

    Args:
        robot: A `Supervisor`.
        period_ms: Simulation time between two rows; it is rounded up to whole basic time steps.
        options: As of `MCPBridge`.

    Raises:
        CommandRefusedError: The robot has no supervisor's rights.
    """
    with EndSignals() as signals:
        observer = Observer(robot, period_ms, **options)
        with observer.bridge, closing(observer.custom_data):
            while signals.received is None and observer.go_on():
                pass


class EndSignals:
    """Lets SIGINT, SIGTERM and SIGHUP end the observer's loop between two rounds.

    Webots' library would end the process at once, and a world that waits for the observer's steps
    would wait on. A loop that does not come round, because it is blocked in a step, is ended after
    `_GRACE_S`: a signal's handler runs in no other thread, but the system wakes one.

    Attributes:
        received: The signal; None as long as there was none.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._over = threading.Event()
        self._before: dict[int, Any] = {}
        self._sockets = socket.socketpair()
        self._wakes_before = -1

    def __enter__(self) -> EndSignals:
        if threading.current_thread() is threading.main_thread():
            reader, writer = self._sockets
            writer.setblocking(False)
            names = (name for name in _END_SIGNALS if hasattr(signal, name))
            for number in (getattr(signal, name) for name in names):
                self._before[number] = signal.signal(number, self._receive)
                if hasattr(signal, "siginterrupt"):  # Webots' library takes EINTR for an error
                    signal.siginterrupt(number, False)
            self._wakes_before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
            threading.Thread(target=self._watch, args=(reader,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._before:
            signal.set_wakeup_fd(self._wakes_before)
            for number, handler in self._before.items():
                signal.signal(number, handler)
        for each in self._sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        if self.received is not None:
            signal.signal(self.received, signal.SIG_DFL)
            signal.raise_signal(self.received)

    def _receive(self, number: int, _: object) -> None:
        self.received = number

    def _watch(self, reader: socket.socket) -> None:
        with suppress(OSError):
            while number := reader.recv(1):
                if number[0] in self._before and not self._over.wait(_GRACE_S):
                    os._exit(128 + number[0])


class Observer:
    """Looks at a world, round by round.

    Raises:
        CommandRefusedError: The robot has no supervisor's rights.
    """

    def __init__(self, robot: Any, period_ms: int = PERIOD_MS, **options: Any) -> None:
        if not robot.getSupervisor():
            raise CommandRefusedError(_NO_RIGHTS.format(str(robot.getName())))
        basic_ms = float(robot.getBasicTimeStep())
        self._period_ms = max(int(math.ceil(period_ms / basic_ms) * basic_ms), 1)
        self._robot = robot
        self.bridge = ObserverBridge(robot, throttle_interval=1, keep_last_s=0, **options)
        self.bridge.count_steps_by_time()
        self.world = ObservedWorld(robot, self._period_ms, self._warn)
        self.custom_data = self.bridge.read_custom_data()
        self._pace = StepPace(robot, self._period_ms, world_waits=self.bridge.world_waits)
        self._due_s = -math.inf
        self._mode = -1
        self._record_again_s = math.inf
        self.bridge.register_command(LOOK_AT, self.look_at)

    def go_on(self) -> bool:
        """One round; False where Webots wants the controller to end."""
        if not self._pace.go_on(may_step=not self.bridge.steps_world):
            return False
        try:
            self._look()
        except Exception as error:  # noqa: BLE001  (it still steers, and looks again later)
            self.bridge.failed(error)
        self.bridge.get_command()
        return True

    def _look(self) -> None:
        """Look around, and record where everything is if it is time to."""
        sim_time_s = float(self._robot.getTime())
        if self.bridge.detect_reload():
            self.world.begin_run()
            self._due_s = -math.inf
        self._record_news()
        is_due = sim_time_s >= self._due_s
        if is_due and (seen := self.world.look(sim_time_s)):
            self._due_s = sim_time_s + self._period_ms / 1000 - 1e-6
            self.bridge.publish(seen)
        self.custom_data.look(
            [body for body in self.world.bodies.values() if body.is_robot], is_due=is_due
        )

    def _record_news(self) -> None:
        """Record the mode and what there is where they are not as before, or long ago."""
        is_due, mode = time.monotonic() > self._record_again_s, int(self._robot.simulationGetMode())
        if mode != self._mode or is_due:
            self._mode = mode
            self.bridge.record_event(MODE_EVENT, {"mode": self.bridge.mode_name})
        self.world.go_on()
        if self.world.is_new or is_due:
            self._record_again_s = time.monotonic() + _RECORD_AGAIN_S
            self.bridge.record_event(WORLD_EVENT, self.world.describe())

    def _warn(self, text: str) -> None:
        self.bridge.log(text, "warning")

    def look_at(self, command: dict[str, Any]) -> dict[str, Any]:
        """Velocity, contact points, centre of mass and static balance of a robot or solid now.

        params: of (its DEF, its name, or its word in the signals world.WORD.x_m).
        """
        body = self.world.find(command["params"].get("of"))
        if body is None:
            there = ", ".join(self.world.bodies) or "nothing yet"
            raise InvalidInputError(f"give params.of: one of {there}")
        return _looked_at(body, self._robot)


def _looked_at(body: ObservedBody, robot: Any) -> dict[str, Any]:
    node = body.scene.node
    velocity = [round(float(value), _DIGITS) for value in node.getVelocity()]
    answer: dict[str, Any] = {
        "key": body.key,
        "position_m": [round(float(value), _DIGITS) for value in node.getPosition()],
        "velocity_mps": velocity[:3],
        "angular_velocity_radps": velocity[3:],
    }
    return answer | _standing(node, robot)


def _standing(node: Any, robot: Any) -> dict[str, Any]:
    """Contacts, centre of mass and balance of a Solid; a note where Webots has none for it."""
    try:
        contacts = node.getContactPoints(True)
        return {
            "contacts": [_contact(contact, robot) for contact in contacts[:_MOST_CONTACTS]],
            "contacts_in_all": len(contacts),
            "center_of_mass_m": [round(float(value), _DIGITS) for value in node.getCenterOfMass()],
            "is_balanced": bool(node.getStaticBalance()),
        }
    except (AttributeError, TypeError, ValueError) as error:  # a null pointer is a ValueError
        return {"not_told": f"contact points, centre of mass and balance: {error}"}


def _contact(contact: Any, robot: Any) -> list[Any]:
    """Where it touches, and with which of its nodes."""
    point = [round(float(value), _DIGITS) for value in contact.getPoint()[:3]]
    node = robot.getFromId(contact.getNodeId())
    return [*point, None if node is None else node.getDef() or node.getTypeName()]


Seen: TypeAlias = "dict[str, dict[str, dict[str, float | None]]]"


class BodyPose(NamedTuple):
    """Where a body is at a moment."""

    sim_time_s: float
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float

    def distance_m(self, position: list[float]) -> float:
        """How far away another position is."""
        return math.dist((self.x_m, self.y_m, self.z_m), position)

    def signals(self) -> dict[str, float]:
        """It as it is recorded."""
        _, x, y, z, heading = (round(value, _DIGITS) for value in self)
        return {"x_m": x, "y_m": y, "z_m": z, "heading_rad": heading}

    def is_elsewhere(self, other: BodyPose) -> bool:
        """Whether a body has moved or turned between the two."""
        turned = abs(math.remainder(self.heading_rad - other.heading_rad, math.tau))
        return self.distance_m([*other[1:4]]) > _MOVED_M or turned > _TURNED_RAD


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
        speed_mps: Between the two places that were seen last; None before.
    """

    key: str
    scene: SceneNode
    name: str
    controller: str
    is_robot: bool
    place: BodyPose | None = None
    has_moved: bool = False
    speed_mps: float | None = None
    _first: BodyPose | None = field(default=None, repr=False)

    @property
    def is_published(self) -> bool:
        """A robot always; another solid once it has moved."""
        return self.is_robot or self.has_moved

    @property
    def is_there(self) -> bool:
        """Whether its node is; else what the library knows is of another node now."""
        node: Any = self.scene.node
        return int(node.getId()) == self.scene.id

    def look(self, sim_time_s: float) -> bool:
        """See where it is now; False where its node is not there any more, or has no place."""
        place = self._seen(sim_time_s) if self.is_there else None
        if place is not None:
            self._go_on(place)
        return place is not None

    def pose_now(self) -> dict[str, float] | None:
        """Where it is now, as signals; None where it has no place."""
        place = self._seen(0.0)
        return None if place is None else place.signals()

    def _seen(self, sim_time_s: float) -> BodyPose | None:
        node: Any = self.scene.node
        pose = node.getPose()
        if not math.isfinite(pose[3]):
            return None
        return BodyPose(sim_time_s, pose[3], pose[7], pose[11], math.atan2(pose[4], pose[0]))

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
        """What is recorded of it at a moment."""
        if self.place is None:
            return {}
        speed = None if self.speed_mps is None else round(self.speed_mps, _DIGITS)
        return {**self.place.signals(), SEEN_SPEED: speed}

    def describe(self) -> dict[str, object]:
        """What does not change of it: where it is, too, as long as it has not moved."""
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
    """Robots, and solids with a DEF name that are no part of a robot nor of a PROTO node."""
    if scene.base_type != "Solid":
        return scene.base_type == "Robot"
    return bool(scene.definition) and not scene.hidden and robot_around(scene) is None


def robot_around(scene: SceneNode) -> SceneNode | None:
    """The robot that a node is a part of, or stands on."""
    return _around(scene, lambda each: each.base_type == "Robot")


def _around(scene: SceneNode, is_meant: Callable[[SceneNode], bool]) -> SceneNode | None:
    """The innermost node of a kind that a node stands in."""
    around = scene.parent
    while around is not None and not is_meant(around):
        around = around.parent
    return around


def word_of(name: str, taken: Collection[str]) -> str:
    """The name as a word that is not taken yet: `2nd robot` becomes `_2nd_robot`.

    Conditions and positions can name it without quotes. A number is appended to one that is taken.
    """
    word = _NO_WORD.sub("_", unicodedata.normalize("NFKC", name))[:_LONGEST_WORD] or "robot"
    if word[0].isdigit() or keyword.iskeyword(word):
        word = f"_{word}"
    number, free = 2, word
    while free in taken:
        number, free = number + 1, f"{word}_{number}"
    return free


class ObservedWorld:
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
        self._own_id = int(robot.getSelf().getId())
        self._period_ms = period_ms
        self._warn = warn
        self._keys: dict[int, str] = {}  # by node id: a body keeps its word
        self._walk: Generator[None] | None = None
        self._next_walk_s = 0.0
        self._count = -1
        self._is_tracking = True
        self._seen_at_walk: dict[str, BodyPose] = {}
        self._is_cut = False
        self._is_walked = False
        self._is_new = False
        self.bodies: dict[str, ObservedBody] = {}

    @property
    def is_new(self) -> bool:
        """Whether a walk has found something that `describe` has not recorded yet."""
        return self._is_new and self._is_walked

    def look(self, sim_time_s: float) -> Seen:
        """Where everything is now, by the words of its signals: robots, and solids that moved."""
        gone = [key for key, body in self.bodies.items() if not body.look(sim_time_s)]
        for key in gone:
            self._lose(key)
        seen: Seen = {}
        for body in self.bodies.values():
            if body.is_published and (signals := body.signals()):
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
        described: dict[str, object] = {
            "title": self._title(),
            "file": str(self._robot.getWorldPath()),
            "basic_time_step_ms": float(self._robot.getBasicTimeStep()),
            "robots": [body.describe() for body in bodies if body.is_robot],
            "solids": [body.describe() for body in bodies if not body.is_robot],
        }
        return described | ({"more": True} if self._is_cut else {})

    def find(self, name: object) -> ObservedBody | None:
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
        self.bodies[key] = ObservedBody(key, scene, scene.name, controller, is_robot)
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


def _is_stale(body: ObservedBody, before: BodyPose | None) -> bool:
    """Whether it stood since then by what is tracked, and not by what is asked for."""
    place = body.place
    if place is None or before is None or place.sim_time_s <= before.sim_time_s:
        return False
    if place[1:] != before[1:]:
        return False
    return place.distance_m(body.scene.node.getPosition()) > _STALE_M


def _proto_id_around(scene: SceneNode) -> int | None:
    proto = _around(scene, lambda each: each.is_proto)
    return None if proto is None else proto.id
