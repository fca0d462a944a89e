"""The built-in actions that change the scene tree: set_field, add_node, remove_node.

Webots sets a field with the next step, so the answer has the field's value after that step. Each
change is an event, and is remembered, so that a reset undoes it.
"""

from __future__ import annotations

import itertools
import json
import re
import time
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.bridge.claimed_commands import ClaimedCommand, Progress
from webots_mcp.bridge.error_report import cut
from webots_mcp.bridge.field_values import (
    MOST_ENTRIES,
    checked,
    is_nearer,
    is_same,
    read,
    require_no_path,
    write,
)
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.scene_edits import (
    FieldEdit,
    SceneEdits,
    describe_removal,
    find_again,
    import_node,
)
from webots_mcp.bridge.scene_nodes import children, label
from webots_mcp.bridge.scene_paths import PathTarget, find, find_node
from webots_mcp.bridge.simulation import Clock, Simulation
from webots_mcp.errors import CommandRefusedError, InvalidInputError

_REQUIRED: Final = ("WorldInfo", "Viewpoint")  # nodes without which Webots has no world
_ONE_NODE: Final = re.compile(r"\s*(?:DEF\s+\S+\s+)?[A-Za-z_][\w-]*\s*\{.*\}\s*\Z", re.DOTALL)
_WORD: Final = re.compile(r'"(?:[^"\\]|\\.)*"|#[^\r\n]*|[{}\[\]]|[^\s,"#{}\[\]]+', re.DOTALL)
_SEE_CONSOLE: Final = "Webots' console has the reason (see webots_get_logs, if it is recorded)"


@dataclass(frozen=True)
class SceneChangeLimits:
    """Limits of a change of the scene tree.

    Attributes:
        node_characters: Maximum length of a node that is added.
        shown_characters: Length at which an answer cuts a value.
        step_s: Wall time until the next round of the loop.
    """

    node_characters: int = 50_000
    shown_characters: int = 1_000
    step_s: float = 3.0


_LIMITS: Final = SceneChangeLimits()


class SceneChanges:
    """Sets fields, and adds and removes nodes.

    Each change asks Webots from within the controller's loop, for a few milliseconds per round.
    """

    def __init__(
        self, simulation: Simulation, clock: Clock, journal: Journal, edits: SceneEdits
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._journal = journal
        self._edits = edits

    def begin_run(self) -> None:
        """Undo after a reset the changes that Webots has not undone."""
        self._edits.begin_run()

    def set_field(self, command: ClaimedCommand) -> Progress:
        """Set the field, or the entry of a field, at a `path` to a `value`."""
        robot, params = self._simulation.robot, command.params
        if (stops := params.get("stop")) is not None and not isinstance(stops, bool):
            raise InvalidInputError(f"stop must be true or false, not {stops!r:.80}")
        target = yield from find(robot, params.get("path"))
        _require_settable(robot, target)
        value = checked(target.path, target.type_name, params.get("value"))
        require_no_path(str(target.webots_field.getName()), value)
        before = read(target.field, target.entry)
        reset = self._edits.remember_field(_edit(target, before, value), target.node)
        write(target.field, value, target.entry)
        if stops:
            target.node.resetPhysics()
        facts: dict[str, Any] = {"path": target.path, "type": target.type_name}
        facts |= {"from": _shown(before), "to": _shown(value)}
        is_stepped = yield from self._until_stepped()
        now = _read_again(robot, target)
        if not is_stepped and not is_same(target.type_name, now, value):
            facts["now"] = _shown(now)
            facts["when"] = "it is set with the next step: simulation time stands still"
        elif not is_nearer(target.type_name, now, value, before) and not is_same(
            target.type_name, before, value
        ):
            raise CommandRefusedError(
                f"{target.path} is {now!r:.200} after it was set: a controller set it again, or "
                f"Webots refused the value; {_SEE_CONSOLE}. "
                "Fields inside a PROTO cannot be set"
            )
        elif not is_same(target.type_name, now, value):
            facts["now"] = _shown(now)  # the simulation has changed it since
        self._journal.event("set_field", facts | _asked_by(command), target.path)
        return facts | {"sim_time_s": self._clock.sim_time_s, "a_reset": reset}

    def add_node(self, command: ClaimedCommand) -> Progress:
        """Add the node in `vrml` to the children of the node, or to the field, at a `path`."""
        robot, params = self._simulation.robot, command.params
        text = _require_one_node(params.get("vrml"))
        target = yield from _find_field_for_node(robot, params.get("path") or "root")
        before = _count(target)
        node = import_node(target.field, text)
        if node is None:
            yield from self._until_stepped()
            node = _newest(robot, target, before)
        if node is None:
            raise CommandRefusedError(
                f"Webots added nothing to {target.path}; {_SEE_CONSOLE}. A PROTO has "
                "to be declared in the world file first: IMPORTABLE EXTERNPROTO"
            )
        path = _path_of(robot, node)
        self._edits.added.add(int(node.getId()))
        facts: dict[str, Any] = {
            "path": path,
            "type": str(node.getTypeName()),
            "parent": target.path,
        }
        yield from self._until_stepped()
        self._journal.event(
            "add_node", facts | {"vrml": cut(text, 2000)} | _asked_by(command), path
        )
        now_s = self._clock.sim_time_s
        return facts | {"node": label(node), "sim_time_s": now_s, "a_reset": "removes it"}

    def remove_node(self, command: ClaimedCommand) -> Progress:
        """Remove the node at a `path`, with everything in it."""
        robot = self._simulation.robot
        target = yield from find_node(robot, command.params.get("path"))
        _require_removable(robot, target)
        node, node_id = target.node, int(target.node.getId())
        facts: dict[str, Any] = {
            "path": target.path,
            "type": str(node.getTypeName()),
            "node": label(node),
        }
        is_added = self._edits.is_added(node)
        is_known = is_added or self._edits.is_put_back(node)
        removal = None if is_known else (yield from describe_removal(robot, target))
        is_proto = bool(node.isProto())
        node.remove()
        if robot.getFromId(node_id) is not None:
            yield from self._until_stepped()
        if robot.getFromId(node_id) is not None:
            raise CommandRefusedError(f"Webots did not remove {target.path}; {_SEE_CONSOLE}")
        reset = "puts it back"
        if is_added:
            reset = "does not bring it back: it was added in this run"
        elif not is_known:
            reset = self._edits.remember_removed(removal, is_proto=is_proto)
        self._journal.event("remove_node", facts | _asked_by(command), target.path)
        return facts | {"sim_time_s": self._clock.sim_time_s, "a_reset": reset}

    def _until_stepped(self) -> Generator[None, None, bool]:
        """Wait for a step of the simulation; False if simulation time stands still."""
        clock, from_step = self._clock, self._clock.steps_seen
        until_s = time.monotonic() + _LIMITS.step_s
        while clock.steps_seen == from_step:
            yield
            stands = self._simulation.paused or time.monotonic() > until_s
            if stands and clock.steps_seen == from_step:
                return False
        return True


def _shown(value: Any) -> Any:
    """Return a value, or the beginning of its text if that is long."""
    text = json.dumps(value, ensure_ascii=False)
    return value if len(text) <= _LIMITS.shown_characters else cut(text, _LIMITS.shown_characters)


def _edit(target: PathTarget, before: Any, value: Any) -> FieldEdit:
    name = str(target.webots_field.getName())
    node_id = int(target.node.getId())
    return FieldEdit(target.path, node_id, name, target.entry, target.type_name, before, value)


def _require_settable(robot: Any, target: PathTarget) -> None:
    if target.field is None:
        raise InvalidInputError(
            f"{target.path} is a node ({label(target.node)}): name the field to set, such as "
            f"{target.path}.translation"
        )
    if target.is_hidden:
        raise InvalidInputError(
            f"{target.path} is inside a PROTO, where nothing can be set: set a field of the PROTO "
            "node itself"
        )
    if target.entry is None and target.field.getCount() > MOST_ENTRIES:
        raise InvalidInputError(
            f"{target.path} has {target.field.getCount()} entries: set one, such as "
            f"{target.path}[0]"
        )
    if target.field.getName() == "supervisor" and target.node.getId() == robot.getSelf().getId():
        raise InvalidInputError(
            f"{target.path} cannot be set: this bridge needs the permission of a Supervisor itself"
        )


def _read_again(robot: Any, target: PathTarget) -> Any:
    """Read a field after setting it; setting may rebuild a PROTO, so it is found again."""
    assert target.field is not None
    field = find_again(robot, int(target.node.getId()), str(target.field.getName()))
    if field is None:
        raise CommandRefusedError(
            f"{target.path} does not exist any more after it was set: look with webots_get_scene"
        )
    return read(field, target.entry)


def _asked_by(command: ClaimedCommand) -> dict[str, Any]:
    return {"command_id": command.id, "requested_by": command.requested_by}


def _count(target: PathTarget) -> int:
    return int(target.webots_field.getCount())


def _newest(robot: Any, target: PathTarget, before: int) -> Any | None:
    """Return the node that was added to a field since; None without one."""
    field = find_again(robot, int(target.node.getId()), str(target.webots_field.getName()))
    if field is None or target.type_name == "SFNode":
        return None if field is None else field.getSFNode()
    return field.getMFNode(-1) if field.getCount() > before else None


def _require_one_node(text: object) -> str:
    """Return the text of a node; refuse any other text before Webots is asked.

    Raises:
        InvalidInputError: If it is not the text of one node.
    """
    what = 'give vrml as one node of a world file, such as DEF BOX Solid { name "box" }'
    if (
        not isinstance(text, str)
        or len(text) > _LIMITS.node_characters
        or not _ONE_NODE.match(text)
    ):
        raise InvalidInputError(f"{what}; got {text!r:.100}")
    words = [word for word in _WORD.findall(text) if not word.startswith("#")]
    for field, value in itertools.pairwise(words):
        if value.startswith('"'):
            require_no_path(field, value[1:-1])
    for opening, closing in ("{}", "[]"):
        opened, closed = words.count(opening), words.count(closing)
        if opened != closed:
            raise InvalidInputError(f"{what}; this has {opened} {opening} and {closed} {closing}")
    return text


def _find_field_for_node(robot: Any, path: object) -> Generator[None, None, PathTarget]:
    """Find the field that a node is to be added to.

    Raises:
        InvalidInputError: If there is none, or nothing can be added to it.
    """
    target = yield from find(robot, path)
    if target.field is None:
        field = children(target.node)
        if field is None:
            raise InvalidInputError(
                f"{target.path} ({label(target.node)}) has no field children: name a field of nodes"
            )
        target = target._replace(path=f"{target.path}.children", field=field)
    field = target.webots_field
    if target.type_name == "SFNode" and field.getSFNode() is not None:
        holds = label(field.getSFNode())
        raise InvalidInputError(
            f"{target.path} already has a node ({holds}): remove that one first"
        )
    if not target.type_name.endswith("Node"):
        raise InvalidInputError(
            f"{target.path} is of type {target.type_name}, which cannot contain nodes"
        )
    if target.is_hidden:
        raise InvalidInputError(f"{target.path} is inside a PROTO, where nothing can be added")
    return target


def _path_of(robot: Any, node: Any) -> str:
    """Return a path that identifies a node as long as it exists."""
    definition = str(node.getDef())
    found = robot.getFromDef(definition) if definition else None
    is_first = found is not None and found.getId() == node.getId()
    return definition if is_first else f"#{node.getId()}"


def _require_removable(robot: Any, target: PathTarget) -> None:
    """Refuse to remove a node that the world, or this bridge, depends on.

    Raises:
        InvalidInputError: If the world or the bridge depends on it.
    """
    node = target.node
    if target.is_hidden:
        raise InvalidInputError(f"{target.path} is inside a PROTO, where nothing can be removed")
    if node.getTypeName() in _REQUIRED or node.getId() == robot.getRoot().getId():
        raise InvalidInputError(f"{target.path} ({label(node)}) cannot be removed from a world")
    each = robot.getSelf()
    while each is not None:
        if each.getId() == node.getId():
            raise InvalidInputError(
                f"{target.path} contains the robot {robot.getName()!r} and cannot be removed: the "
                "bridge of that robot runs this command"
            )
        each = each.getParentNode()
