"""The simulation itself: robots, time and modes, without messages, processes and sockets.

A `BaseSimulation` calls `advance` for each physics step, and carries out the request in `wanted`
that a controller made for the whole simulation.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from math import ceil
from pathlib import Path
from typing import Any, TypeAlias

from webots_mcp.standin.arena import Arena, Body
from webots_mcp.standin.scene_recorder import SceneRecorder
from webots_mcp.standin.simulated_devices import (
    SimulatedDevice,
    SimulatedEmitter,
    SimulatedReceiver,
    devices_in,
)
from webots_mcp.standin.standin_errors import WorldError
from webots_mcp.standin.vehicle import Vehicle, joints_in
from webots_mcp.standin.view_pictures import Label, PictureRequest, save_picture
from webots_mcp.standin.world import HiddenState, World, world_text
from webots_mcp.worlds.frames import frame_of
from webots_mcp.worlds.vrml import WorldNode

TrackedKey: TypeAlias = "tuple[int, int | str | None]"
"""A field: node id and name. A pose: node id and the id it is seen from, None for the world."""


class Mode(IntEnum):
    """Mode of the simulation; the numbers are those of `Supervisor.SIMULATION_MODE_...`."""

    PAUSE = 0
    REAL_TIME = 1
    FAST = 2


Wanted: TypeAlias = "str | int"
"""A request of a controller for the whole simulation.

The path of a world to load, empty to reload the present one, or the exit status to quit with.
"""


class SimulatedRobot:
    """A robot of the world, and the state of its controller's requests."""

    def __init__(self, body: Body, arena: Arena) -> None:
        self.node: WorldNode = body.node
        self.vehicle = Vehicle(body, joints_in(body.node))
        self.devices: dict[int, SimulatedDevice] = {
            d.tag: d for d in devices_in(self.vehicle, arena)
        }
        self.folder = Path.cwd()
        """Folder that relative paths of its controller start in."""
        self.remaining_ms: float | None = None
        """Simulated time until the requested step is over; None if there is no request."""
        self.ahead_ms = 0.0
        """Simulated time since the end of the last requested step."""
        self.delay_ms = 0
        """Delay of the last step, of robots without synchronization."""
        self.fresh: dict[int, Any] = {}
        """Values that the controller has not received yet, by tag."""
        self._tracked: dict[TrackedKey, tuple[int, float]] = {}
        """Period and next due time in ms of each pose and field that is sent with the steps."""

    @property
    def name(self) -> str:
        """Return the `name` field."""
        return self.node.fields["name"]

    @property
    def is_synchronous(self) -> bool:
        """Return whether the world waits for its controller."""
        return self.node.fields["synchronization"]

    @property
    def position(self) -> tuple[float, float, float]:
        """Return its true position in metres."""
        body = self.vehicle.body
        return body.x, body.y, body.z

    @property
    def yaw_rad(self) -> float:
        """Return its true heading."""
        return self.vehicle.body.yaw_rad

    @property
    def collisions(self) -> int:
        """Return how often it began to touch something that cannot be pushed away."""
        return self.vehicle.collisions

    @property
    def is_touching(self) -> bool:
        """Return whether it is pressing against something now."""
        return self.vehicle.touching

    def track(self, what: TrackedKey, period_ms: int) -> None:
        """Send a pose or field with the steps, at once and then once a period; 0 ends that."""
        self._tracked.pop(what, None)
        if period_ms:
            self._tracked[what] = (period_ms, 0.0)

    def due(self, time_ms: float) -> list[TrackedKey]:
        """Return the tracked poses and fields that have to be sent now."""
        due = [what for what, (_, due_ms) in self._tracked.items() if time_ms >= due_ms]
        for what in due:
            period_ms, _ = self._tracked[what]
            self._tracked[what] = (period_ms, time_ms + period_ms)
        return due

    def make_tracked_due(self) -> None:
        """Make tracked poses and fields due at once, as sensors are after a reset."""
        self._tracked = {what: (period_ms, 0.0) for what, (period_ms, _) in self._tracked.items()}

    def forget_controller(self) -> None:
        """Prepare for another controller: no request, all sensors disabled, motors at rest."""
        self.remaining_ms, self.ahead_ms = None, 0.0
        self.fresh.clear()
        self._tracked.clear()
        for device in self.devices.values():
            device.configure("period", 0)
        for joint in self.vehicle.joints:
            joint.hold()


class Simulator:
    """One running world."""

    def __init__(self, world: World, mode: Mode, log: Callable[[str], None]) -> None:
        self.world = world
        self.mode = mode
        self.log = log
        self.arena = Arena(world)
        self.robots = [
            SimulatedRobot(b, self.arena) for b in self.arena.bodies if b.node.type_name == "Robot"
        ]
        names = [robot.name for robot in self.robots]
        if double := {name for name in names if names.count(name) > 1}:
            raise WorldError(f"two robots have the name {double.pop()!r}; give each its own")
        for warning in world.warnings():
            log(warning)
        if not self.robots and world.left_out:
            raise WorldError(self.no_robot())
        devices = [device for robot in self.robots for device in robot.devices.values()]
        self._emitters = [device for device in devices if isinstance(device, SimulatedEmitter)]
        self._receivers = [device for device in devices if isinstance(device, SimulatedReceiver)]
        self.time_ms = 0.0
        self.wanted: Wanted | None = None
        self.labels: dict[int, Label] = {}
        self.is_reset_wanted = False
        """Whether the world is reset at the end of the next physics step."""
        self.wanted_after_step: Wanted | None = None
        self.added: list[WorldNode] = []
        """Nodes that controllers have added; the next reset removes them."""
        self._pictures: list[PictureRequest] = []
        self.recorder = SceneRecorder(world, self.arena, log)
        self._start = self._poses()
        self._set_saved_motion()

    @property
    def time_s(self) -> float:
        """Return simulated time in seconds."""
        return self.time_ms / 1000.0

    def robot(self, name: str) -> SimulatedRobot:
        """Return the robot with this name.

        Raises:
            WorldError: The world has no such robot.
        """
        for robot in self.robots:
            if robot.name == name:
                return robot
        raise WorldError(self.no_robot(name))

    def no_robot(self, name: str | None = None) -> str:
        """Return the text that says why there is no robot of this name, or none at all."""
        if left_out := self.left_out_robots(name):
            types = [*dict.fromkeys(node.type_name for node in left_out)]
            return (
                f"{self.world.path.name}, line {left_out[0].line}: the stand-in has no "
                f"{' or '.join(types)} nodes{self.world.why_not(types[0])}. If the robot is one: "
                "in Webots, right-click it, choose 'Convert Root to Base Node(s)' and save the "
                "world, or let WEBOTS_HOME name an installed Webots, whose PROTO files are read "
                "then; 'webots-mcp help standin' lists what the stand-in has"
            )
        known = ", ".join(repr(robot.name) for robot in self.robots)
        asked = "no robot" if name is None else f"no robot {name!r}"
        return f"{asked} in {self.world.path.name}; it has {known or 'none'}"

    def left_out_robots(self, name: str | None = None) -> list[WorldNode]:
        """Return nodes that were left out and may be this robot: those with a controller."""
        at_top = [n for n in self.world.left_out if self.world.parent_of(n) is self.world.root]
        robots = [node for node in self.world.left_out if _has_controller(node)]
        if name is None:
            return robots or at_top
        return [node for node in robots if node.fields.get("name", name) == name]

    def robot_of(self, node: WorldNode) -> SimulatedRobot:
        """Return the robot that a Robot node describes."""
        return next(robot for robot in self.robots if robot.node is node)

    def ask_step(self, robot: SimulatedRobot, duration_ms: int) -> bool:
        """Take a controller's request for a step; True if that much time has passed already."""
        basic = self.world.basic_time_step_ms
        robot.remaining_ms = ceil(duration_ms / basic) * basic - robot.ahead_ms
        return self._is_over(robot)

    def _is_over(self, robot: SimulatedRobot) -> bool:
        if robot.remaining_ms is None or robot.remaining_ms > 0.0:
            return False
        late_ms = -robot.remaining_ms
        robot.remaining_ms = None
        robot.ahead_ms = late_ms if robot.is_synchronous else 0.0
        robot.delay_ms = 0 if robot.is_synchronous else int(late_ms)
        return True

    def advance(self) -> list[SimulatedRobot]:
        """Make one physics step; return the robots whose controllers waited for it."""
        basic = self.world.basic_time_step_ms
        for robot in self.robots:
            robot.vehicle.drive(self.arena, basic / 1000.0)
        self.arena.glide(basic / 1000.0)
        for emitter in self._emitters:
            emitter.transmit(self._receivers)
        self.time_ms += basic
        if self.is_reset_wanted:
            self.reset()
            self.time_ms = basic  # The step that resets counts.
        for robot in self.robots:
            self._measure(robot, basic)
        self._render()
        self.recorder.note_step(self.time_ms, [*self.labels.values()])
        if self.wanted_after_step is not None:
            self.wanted, self.wanted_after_step = self.wanted_after_step, None
        return [robot for robot in self.robots if self._let_pass(robot, basic)]

    def _measure(self, robot: SimulatedRobot, passed_ms: float) -> None:
        for device in robot.devices.values():
            if device.is_due(passed_ms):
                device.put_value(robot.fresh)

    def _let_pass(self, robot: SimulatedRobot, passed_ms: float) -> bool:
        if robot.remaining_ms is None:
            robot.ahead_ms += passed_ms
            return False
        robot.remaining_ms -= passed_ms
        return self._is_over(robot)

    def reset(self) -> None:
        """Return everything to the start of the world, at time 0. Controllers keep running."""
        self.is_reset_wanted = False
        self.time_ms = 0.0
        added, self.added = self.added, []
        for node in added:
            self.world.remove(node)
        self.arena.follow()
        for node, (translation, rotation) in self._start.items():
            node.fields["translation"], node.fields["rotation"] = [*translation], [*rotation]
        for body in self.arena.bodies:
            self.update_pose(body)
            body.stop()
            body.touched.clear()
        for robot in self.robots:
            robot.vehicle.reset()
            robot.ahead_ms = 0.0
            robot.make_tracked_due()
            for device in robot.devices.values():
                device.make_due()
        self._set_saved_motion()

    # Saving a world in motion --------------------------------------------------------------------

    def hidden_state(self) -> HiddenState:
        """Return what the fields of bodies and robots do not show, by the names of Webots.

        Webots numbers the Solids in a node; joint `n` counts as the one that Solid `n + 1` is on.
        """
        vehicles = {robot.vehicle.body: robot.vehicle for robot in self.robots}
        return {
            body.node: hidden
            for body in self.arena.bodies
            if (hidden := _hidden_of(body, vehicles.get(body)))
        }

    def save_world(self, path: Path) -> bool:
        """Write the world as it is now; False if that fails.

        As in Webots, the file is the current world from then on, and a reset returns to now.
        """
        state = self.hidden_state()
        try:
            path.write_text(world_text(self.world, state), encoding="utf-8")
        except OSError as error:
            self.log(f"ERROR: cannot save the world {path}: {error}")
            return False
        self.world.path = path
        self._start, self.added = self._poses(), []
        for body in self.arena.bodies:
            saved = state.get(body.node, {})
            body.node.hidden = {name: [*numbers] for name, numbers in saved.items()}
        return True

    def _poses(self) -> dict[WorldNode, tuple[list[float], list[float]]]:
        return {
            node: ([*node.fields["translation"]], [*node.fields["rotation"]])
            for node in self.world.nodes
            if "rotation" in node.fields
        }

    def _set_saved_motion(self) -> None:
        """Continue the motion in which the world was saved."""
        for body in self.arena.bodies:
            saved: dict[str, Any] = body.node.hidden
            if rotation := saved.get("rotation_0"):
                body.yaw_rad = rotation[3]
            if velocity := saved.get("linearVelocity_0"):
                body.velocity_mps, body.is_pushed = (velocity[0], velocity[1]), body.is_movable
            if turning := saved.get("angularVelocity_0"):
                body.yaw_rate_radps, body.is_pushed = turning[2], body.is_movable
        for robot in self.robots:
            for number, joint in enumerate(robot.vehicle.joints):
                saved = robot.node.hidden
                if position := saved.get(f"position_0_{number}"):
                    (joint.start_rad,) = position
                    joint.reset()
                if turning := saved.get(f"angularVelocity_{number + 1}"):
                    joint.velocity_radps = turning[0]

    def update_pose(self, body: Body) -> None:
        """Move a body to the pose in its node's fields."""
        frame = self.world.frame_of(body.node)
        assert frame is not None
        body.stand(frame)

    def export(self, path: Path, quality: int) -> None:
        """Write a picture: at once if paused, else with the next step."""
        self._pictures.append(PictureRequest(path, quality))
        if self.mode is Mode.PAUSE:
            self._render()

    def _render(self) -> None:
        pictures, self._pictures = self._pictures, []
        for picture in pictures:
            self._save(picture)

    def _save(self, picture: PictureRequest) -> None:
        try:
            save_picture(picture, self.arena, self.time_s, [*self.labels.values()])
        except (OSError, ValueError, ImportError) as error:
            self.log(f"ERROR: cannot export the image {picture.path}: {error}")


def _hidden_of(body: Body, vehicle: Vehicle | None) -> dict[str, list[float]]:
    hidden: dict[str, list[float]] = {}
    shown = frame_of(body.node.fields["translation"], body.node.fields["rotation"])
    if shown.yaw_rad != body.yaw_rad:  # its last digits, and whole turns
        hidden["rotation_0"] = [0.0, 0.0, 1.0, body.yaw_rad]
    for number, joint in enumerate(vehicle.joints if vehicle else ()):
        parameters = joint.node.fields["jointParameters"]
        if joint.position_rad != (parameters.fields["position"] if parameters else 0.0):
            hidden[f"position_0_{number}"] = [joint.position_rad]
    if any(body.velocity_mps):
        hidden["linearVelocity_0"] = [*body.velocity_mps, 0.0]
    if body.yaw_rate_radps:
        hidden["angularVelocity_0"] = [0.0, 0.0, body.yaw_rate_radps]
    for number, joint in enumerate(vehicle.joints if vehicle else (), 1):
        if joint.velocity_radps:
            hidden[f"angularVelocity_{number}"] = [joint.velocity_radps, 0.0, 0.0]
    return hidden


def _has_controller(node: WorldNode) -> bool:
    return "controller" in node.fields or "controllerArgs" in node.fields
