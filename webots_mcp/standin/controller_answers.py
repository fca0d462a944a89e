"""The answers of the simulator to the messages of controllers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, cast

from controller.simulator_link import Message

from webots_mcp.standin.arena import Body
from webots_mcp.standin.node_types import NODE_TYPES
from webots_mcp.standin.simulated_devices import FetchedSensor
from webots_mcp.standin.simulator import Mode, SimulatedRobot, Simulator, TrackedKey
from webots_mcp.standin.standin_errors import WorldError
from webots_mcp.standin.view_pictures import Label
from webots_mcp.standin.world import as_text
from webots_mcp.worlds.vrml import FieldDefinition, Parser, WorldNode, descendants_of
from webots_mcp.worlds.world_errors import WorldFileError

CUSTOM_DATA_TAG: Final = 0
"""Tag of the robot itself among the tags of its devices."""
"""Fields of a PROTO node that can be set after it was built."""

FieldReference = tuple[int, str]
"""Node id and field name."""
FieldSet = tuple[FieldReference, int | None, Any]
"""A field, the index of an entry or None, and the new value."""


def description(simulator: Simulator, robot: SimulatedRobot) -> dict[str, Any]:
    """Return the data that a controller receives when it connects."""
    fields = robot.node.fields
    requests = SupervisorRequests(simulator, robot)
    return {
        "name": robot.name,
        "model": fields["model"],
        "custom_data": fields["customData"],
        "supervisor": fields["supervisor"],
        "synchronization": fields["synchronization"],
        "basic_time_step": simulator.world.basic_time_step_ms,
        "world_path": str(simulator.world.path),
        "project_path": str(simulator.world.path.parent.parent),
        "time": simulator.time_s,
        "mode": int(simulator.mode),
        "left_out": simulator.world.left_out_in(robot.node),
        "root": requests.shown(simulator.world.root),
        "self": requests.shown(robot.node),
        "devices": [device.description() for device in robot.devices.values()],
    }


def answer(simulator: Simulator, robot: SimulatedRobot, message: Message) -> Message | None:
    """Return the answer to a controller; None if it has to wait until simulated time has passed."""
    kind, *rest = message
    if kind == "step":
        return _step(simulator, robot, *rest)
    if kind == "fetch":
        device = robot.devices[rest[0]]
        return ("fetched", device.fetch() if isinstance(device, FetchedSensor) else None)
    operation, arguments, field_sets = rest
    requests = SupervisorRequests(simulator, robot)
    requests.set_fields(field_sets)
    return ("answer", requests.carry_out(operation, arguments), int(simulator.mode))


def step_over(simulator: Simulator, robot: SimulatedRobot) -> Message:
    """Return the answer to a step request: time, mode and the values since the last one."""
    values: list[tuple[Any, Any]] = [*robot.fresh.items()]
    robot.fresh.clear()
    requests = SupervisorRequests(simulator, robot)
    values.extend((what, requests.sent(what)) for what in robot.due(simulator.time_ms))
    return ("stepped", simulator.time_s, int(simulator.mode), robot.delay_ms, values)


def _step(
    simulator: Simulator,
    robot: SimulatedRobot,
    duration_ms: int,
    changes: list[Any],
    field_sets: list[FieldSet],
) -> Message | None:
    for tag, setting, value in changes:
        if tag == CUSTOM_DATA_TAG:
            robot.node.fields["customData"] = value
        elif setting == "track":
            robot.track(tag, value)
        else:
            robot.devices[tag].configure(setting, value)
    SupervisorRequests(simulator, robot).set_fields(field_sets)
    if duration_ms == 0 or simulator.ask_step(robot, duration_ms):
        return step_over(simulator, robot)
    return None


class _NodeRemovedError(Exception):
    """A request names a node that was removed."""


class SupervisorRequests:
    """Carries out the requests of one robot's `Supervisor`.

    The request `simulation_reset` is the method `on_simulation_reset`; the names are those of
    Webots' C functions without `wb_supervisor_`.
    """

    def __init__(self, simulator: Simulator, robot: SimulatedRobot) -> None:
        self._simulator = simulator
        self._world = simulator.world
        self._robot = robot

    def carry_out(self, operation: str, arguments: list[Any]) -> Any:
        """Answer one request by its name; None if it names a node that was removed."""
        method: Callable[..., Any] = getattr(self, f"on_{operation}")
        try:
            return method(*arguments)
        except _NodeRemovedError:
            return None

    def sent(self, what: TrackedKey) -> Any:
        """Return a tracked pose or field; None if its node was removed."""
        if isinstance(what[1], str):
            return self.carry_out("field_get", [what, None])
        return self.carry_out("node_get_pose", [*what])

    def _node(self, node_id: int) -> WorldNode:
        node = self._world.node(node_id)
        if node is None:
            raise _NodeRemovedError(node_id)
        return node

    # Nodes ---------------------------------------------------------------------------------------

    def on_node_get_from_def(self, def_path: str) -> Any:
        """Return a node by its DEF name."""
        return self.shown(self._world.find(def_path))

    def on_node_get_from_id(self, node_id: int) -> Any:
        """Return a node by its number."""
        return self.shown(self._world.node(node_id))

    def on_node_get_from_device(self, tag: int) -> Any:
        """Return the node of one of the robot's devices."""
        device = self._robot.devices.get(tag)
        return self.shown(device.node if device else None)

    def on_node_get_parent_node(self, node_id: int) -> Any:
        """Return the parent of a node."""
        return self.shown(self._world.parent_of(self._node(node_id)))

    def shown(self, node: WorldNode | None) -> Any:
        """Return the data about a node for a controller: `NodeFacts` of its package."""
        if node is None:
            return None
        type_name = node.proto_name or node.type_name
        parent = self._world.parent_of(node)
        parent_id = -1 if parent is None else self._world.id_of(parent)
        return (self._world.id_of(node), type_name, node.type_name, node.def_name, parent_id)

    # Fields --------------------------------------------------------------------------------------

    def on_node_get_field(self, node_id: int, name: str) -> Any:
        """Return type and number of entries of a field; None if the node has no such field."""
        node = self._node(node_id)
        return _described(node, name, self._world.protos.visible_fields(node))

    def on_node_get_base_node_field(self, node_id: int, name: str) -> Any:
        """Return the same of the base node of a PROTO node."""
        node = self._node(node_id)
        return _described(node, name, NODE_TYPES[node.type_name])

    def on_node_get_field_names(self, node_id: int) -> list[str]:
        """Return the names of all fields of a node."""
        return [*self._world.protos.visible_fields(self._node(node_id))]

    def on_field_get(self, field: FieldReference, index: int | None) -> Any:
        """Return the value of a field or of one entry; None beyond its end."""
        node_id, name = field
        value = self._node(node_id).fields[name]
        if index is not None:
            value = value[index] if -len(value) <= index < len(value) else None
        return self.shown(value) if isinstance(value, WorldNode) else value

    def set_fields(self, field_sets: list[FieldSet]) -> None:
        """Write fields, and update what they describe."""
        for (node_id, name), index, value in field_sets:
            node = self._world.node(node_id)
            if node is None:
                continue
            if index is None:
                node.fields[name] = value
            elif -len(node.fields[name]) <= index < len(node.fields[name]):
                node.fields[name][index] = value
            self._follow(node, name, value)

    def on_field_insert(self, field: FieldReference, index: int, value: Any) -> int:
        """Insert an entry, and return the number of entries after that."""
        node_id, name = field
        node = self._node(node_id)
        values: list[Any] = node.fields[name]
        values.insert(index if index >= 0 else len(values) + index + 1, value)
        self._follow(node, name, value)
        return len(values)

    def on_field_remove(self, field: FieldReference, index: int | None) -> int:
        """Remove an entry or the node of a single field; return the number of entries left."""
        node_id, name = field
        node = self._node(node_id)
        value = node.fields[name] if index is None else node.fields[name][index]
        if isinstance(value, WorldNode):
            self._remove(value)
        else:
            del node.fields[name][index]
            self._follow(node, name, None)
        return -1 if index is None else len(node.fields[name])

    def on_field_import(self, field: FieldReference, index: int | None, text: str) -> int:
        """Add a node if possible, and return the number of entries after that."""
        node_id, name = field
        around = self._node(node_id)
        many: list[Any] | None = None if index is None else around.fields[name]
        if index is not None and many is not None and index < 0:
            index += len(many) + 1
        try:
            nodes = Parser(text).nodes()
            if len(nodes) != 1:
                raise WorldError("one node is to be given")
            for type_name in self._world.add(nodes[0], around, name, index):
                self._simulator.log(
                    f"WARNING: importing a node: the stand-in has no {type_name} nodes; "
                    f"what is one is left out{self._world.why_not(type_name)}."
                )
            self._simulator.added.append(nodes[0])
            self._update_around(around)
        except WorldFileError as error:
            self._simulator.log(f"ERROR: importing a node: {error}")
        return -1 if many is None else len(many)

    def on_node_remove(self, node_id: int) -> Any:
        """Remove a node; return its parent, the field that held it and the entries left there."""
        found = self._remove(self._node(node_id))
        if found is None:
            return None
        parent, name = found
        left = parent.fields[name]
        count = len(cast("list[Any]", left)) if isinstance(left, list) else -1
        return self._world.id_of(parent), name, count

    def _remove(self, node: WorldNode) -> tuple[WorldNode, str] | None:
        if _holds_robot(node):
            self._simulator.log("ERROR: the stand-in removes no robots")
            return None
        if node.type_name in ("WorldInfo", "Viewpoint") or node is self._world.root:
            self._simulator.log(f"ERROR: the {node.type_name} node cannot be removed")
            return None
        found = self._world.remove(node)
        if found is not None:
            self._update_around(found[0])
        return found

    def _update_around(self, around: WorldNode) -> None:
        self._simulator.arena.follow()
        if body := self._body_around(around):
            self._simulator.update_pose(body)

    def on_node_export_string(self, node_id: int) -> str:
        """Return a node and everything in it, as written in a world file."""
        return as_text(self._node(node_id), self._world.protos, self._simulator.hidden_state())

    def _follow(self, node: WorldNode, name: str, value: Any) -> None:
        if node.type_name == "Robot" and name == "customData":
            self._simulator.robot_of(node).fresh[CUSTOM_DATA_TAG] = value
        elif node.proto_name and name not in ("translation", "rotation", "name", "customData"):
            self._simulator.log(
                f"WARNING: {node.proto_name}.{name} was set, which changes nothing: "
                "the stand-in builds PROTO nodes once"
            )
        elif body := self._body_around(node):
            self._simulator.update_pose(body)

    # Poses ---------------------------------------------------------------------------------------

    def on_node_get_pose(self, node_id: int, seen_from_id: int | None = None) -> Any:
        """Return orientation (9 numbers) and position (3), seen from the world or another node.

        None for a node without a pose.
        """
        frame = self._world.frame_of(self._node(node_id))
        if frame is not None and seen_from_id is not None:
            seen_from = self._world.frame_of(self._node(seen_from_id))
            frame = frame if seen_from is None else seen_from.inverse().then(frame)
        return None if frame is None else (frame.rotation, frame.translation)

    def on_node_get_velocity(self, node_id: int) -> Any:
        """Return linear and angular velocity; None for a node that is no Solid."""
        node = self._node(node_id)
        body = self._body_around(node)
        if body is None or "boundingObject" not in node.fields:
            return None
        return [*body.velocity_mps, 0.0, 0.0, 0.0, body.yaw_rate_radps]

    def on_node_set_velocity(self, node_id: int, velocity: list[float]) -> None:
        """Set the velocity of a body on the plane."""
        if body := self._body_around(self._node(node_id)):
            body.velocity_mps, body.yaw_rate_radps = (velocity[0], velocity[1]), velocity[5]
            body.is_pushed = True

    def on_node_reset_physics(self, node_id: int) -> None:
        """Stop a body."""
        if body := self._body_around(self._node(node_id)):
            body.stop()
        for robot in self._simulator.robots:
            if robot.node is self._node(node_id):
                robot.vehicle.stop()

    def _body_around(self, node: WorldNode | None) -> Body | None:
        bodies = {body.node: body for body in self._simulator.arena.bodies}
        while node is not None and node not in bodies:
            node = self._world.parent_of(node)
        return bodies[node] if node else None

    # The simulation ------------------------------------------------------------------------------

    def on_simulation_set_mode(self, mode: int) -> None:
        """Set the mode. As in Webots, any other number pauses."""
        self._simulator.mode = Mode(mode) if mode in [*Mode] else Mode.PAUSE

    def on_simulation_reset(self) -> None:
        """Reset the world at the end of the next physics step."""
        self._simulator.is_reset_wanted = True

    def on_world_reload(self) -> None:
        """Read the world again from its file."""
        self._simulator.wanted = ""

    def on_world_load(self, path: str) -> None:
        """Load another world after the next physics step."""
        self._simulator.wanted_after_step = str(self._robot.folder / path)

    def on_world_save(self, path: str | None) -> int:
        """Write the world to a file, by default to its own; return 1, or 0 if that fails."""
        file = self._world.path if path is None else self._robot.folder / path
        return int(self._simulator.save_world(file))

    def on_simulation_quit(self, status: int) -> None:
        """End the simulation."""
        self._simulator.wanted = status

    def on_export_image(self, path: str, quality: int) -> None:
        """Write a picture of the arena; relative paths start in the controller's folder."""
        self._simulator.export(self._robot.folder / path, quality)

    def on_movie_start_recording(self, path: str, width: int, height: int, quality: int) -> None:
        """Begin a movie of the arena from above."""
        self._simulator.recorder.start_movie(self._robot.folder / path, (width, height), quality)

    def on_movie_stop_recording(self) -> None:
        """End the movie; its file is written a moment later."""
        self._simulator.recorder.stop_movie()

    def on_movie_status(self) -> int:
        """Return what became of the movie."""
        return int(self._simulator.recorder.movie_status())

    def on_animation_start_recording(self, path: str) -> int:
        """Begin an animation; return 1, or 0 if its file cannot be written."""
        return int(self._simulator.recorder.start_animation(self._robot.folder / path))

    def on_animation_stop_recording(self) -> int:
        """End the animation and write its files; return 1 unless they cannot be written."""
        return int(self._simulator.recorder.stop_animation())

    def on_set_label(
        self, number: int, text: str, x: float, y: float, size: float, rgb: int
    ) -> None:
        """Show a text over the picture; an empty text removes it."""
        if not 0 <= number <= 99:
            self._simulator.log(f"ERROR: setLabel: the id {number} is not between 0 and 99")
        elif text:
            self._simulator.labels[number] = Label(text, x, y, size, rgb)
        else:
            self._simulator.labels.pop(number, None)


def _holds_robot(node: WorldNode) -> bool:
    return any(each.type_name == "Robot" for each in (node, *descendants_of(node)))


def _described(node: WorldNode, name: str, definitions: Mapping[str, FieldDefinition]) -> Any:
    definition = definitions.get(name)
    if definition is None:
        return None
    many = definition.type_name.startswith("MF")
    return definition.type_name, len(node.fields[name]) if many else -1
