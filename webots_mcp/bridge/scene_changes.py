"""The built-in actions that change the scene tree: set a field, add and remove a node.

Webots sets a field with the next step, so the answer has the field's value after that step. Each
change is an event, and is remembered, so that a reset puts it back.
"""

from __future__ import annotations

import itertools
import json
import re
import time
from collections.abc import Collection, Generator
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.commands import Action, ClaimedCommand, Progress
from webots_mcp.bridge.error_report import ErrorReport, cut
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.scene import (
    MOST_ENTRIES,
    Pace,
    Place,
    checked,
    children,
    entries,
    find,
    find_node,
    get_field,
    get_scene,
    is_nearer,
    is_same,
    label,
    node_fields,
    read,
    require_no_path,
    write,
)
from webots_mcp.bridge.simulation import Clock, Simulation
from webots_mcp.errors import CommandRefusedError, InvalidInputError

_LONGEST_NODE: Final = 50_000  # characters of a node that is added
_LONGEST_REMOVED: Final = 200_000  # characters of a node that is remembered
_LONGEST_SHOWN: Final = 1_000  # characters of a value in an answer
_LONGEST_STEP_S: Final = 3.0  # of wall time, until the next round of the loop
_STAY: Final = ("WorldInfo", "Viewpoint")
_ONE_NODE: Final = re.compile(r"\s*(?:DEF\s+\S+\s+)?[A-Za-z_][\w-]*\s*\{.*\}\s*\Z", re.DOTALL)
_WORD: Final = re.compile(r'"(?:[^"\\]|\\.)*"|#[^\r\n]*|[{}\[\]]|[^\s,"#{}\[\]]+', re.DOTALL)
_ADDED_BEFORE: Final = "does not bring it back: it was added in this run"
_ONLY_RELOADED: Final = "does not bring it back; a reload does"
_PUT_BACK_PROTO: Final = (
    "puts it back if the world declares its PROTO as IMPORTABLE EXTERNPROTO; else a reload does"
)
_SAYS: Final = "Webots' console has the reason (see webots_get_logs, if it is recorded)"
# Physics has changed these since a command set them, and Webots' own reset restores them.
_MOVED_BY_PHYSICS: Final = ("translation", "rotation", "battery")
MOST_EDITS: Final = 200  # that are put back
_TOO_MANY: Final = f"does not undo it: at most {MOST_EDITS} changes are remembered"


class SceneActions:
    """The built-in actions on the scene tree: read it, set fields, add and remove nodes.

    They ask Webots from within the controller's loop, for a few milliseconds per round.
    """

    def __init__(
        self, simulation: Simulation, clock: Clock, journal: Journal, edits: SceneEdits
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._journal = journal
        self._edits = edits

    def by_name(self) -> dict[str, Action]:
        """Return the functions by the name of their action."""
        return {
            "get_scene": self.get_scene,
            "get_field": self.get_field,
            "set_field": self.set_field,
            "add_node": self.add_node,
            "remove_node": self.remove_node,
        }

    def get_scene(self, command: ClaimedCommand) -> Progress:
        """Find nodes of the tree, see `scene.get_scene`."""
        return get_scene(self._simulation.robot, command.params)

    def get_field(self, command: ClaimedCommand) -> Progress:
        """Read a field or the fields of a node, see `scene.get_field`."""
        return get_field(self._simulation.robot, command.params)

    def set_field(self, command: ClaimedCommand) -> Progress:
        """Set the field, or the entry of a field, at a `path` to a `value`."""
        robot, params = self._simulation.robot, command.params
        if (stops := params.get("stop")) is not None and not isinstance(stops, bool):
            raise InvalidInputError(f"stop must be true or false, not {stops!r:.80}")
        place = yield from find(robot, params.get("path"))
        _require_settable(robot, place)
        value = checked(place.path, place.type_name, params.get("value"))
        require_no_path(str(place.webots_field.getName()), value)
        before = read(place.field, place.entry)
        reset = self._edits.remember_field(_edit(place, before, value), place.node)
        write(place.field, value, place.entry)
        if stops:
            place.node.resetPhysics()
        facts: dict[str, Any] = {"path": place.path, "type": place.type_name}
        facts |= {"from": _shown(before), "to": _shown(value)}
        is_stepped = yield from self._until_stepped()
        now = _read_again(robot, place)
        if not is_stepped and not is_same(place.type_name, now, value):
            facts["now"] = _shown(now)
            facts["when"] = "it is set with the next step: simulation time stands still"
        elif not is_nearer(place.type_name, now, value, before) and not is_same(
            place.type_name, before, value
        ):
            raise CommandRefusedError(
                f"{place.path} is {now!r:.200} after it was set: a controller set it again, or "
                f"Webots refused the value; {_SAYS}. Fields inside a PROTO cannot be set"
            )
        elif not is_same(place.type_name, now, value):
            facts["now"] = _shown(now)  # the simulation has changed it since
        self._journal.event("set_field", facts | _asked_by(command), place.path)
        return facts | {"sim_time_s": self._clock.sim_time_s, "a_reset": reset}

    def add_node(self, command: ClaimedCommand) -> Progress:
        """Add the node in `vrml` to the children of the node, or to the field, at a `path`."""
        robot, params = self._simulation.robot, command.params
        text = _require_one_node(params.get("vrml"))
        place = yield from _find_room(robot, params.get("path") or "root")
        before = _count(place)
        node = import_node(place.field, text)
        if node is None:
            yield from self._until_stepped()
            node = _newest(robot, place, before)
        if node is None:
            raise CommandRefusedError(
                f"Webots added nothing to {place.path}; {_SAYS}. A PROTO has to be declared in the "
                "world file first: IMPORTABLE EXTERNPROTO"
            )
        path = _path_of(robot, node)
        self._edits.added.add(int(node.getId()))
        facts: dict[str, Any] = {
            "path": path,
            "type": str(node.getTypeName()),
            "parent": place.path,
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
        place = yield from find_node(robot, command.params.get("path"))
        _require_removable(robot, place)
        node, node_id = place.node, int(place.node.getId())
        facts: dict[str, Any] = {
            "path": place.path,
            "type": str(node.getTypeName()),
            "node": label(node),
        }
        is_added = self._edits.is_added(node)
        is_known = is_added or self._edits.is_put_back(node)
        removal = None if is_known else (yield from _removal(robot, place))
        is_proto = bool(node.isProto())
        node.remove()
        if robot.getFromId(node_id) is not None:
            yield from self._until_stepped()
        if robot.getFromId(node_id) is not None:
            raise CommandRefusedError(f"Webots did not remove {place.path}; {_SAYS}")
        reset = "puts it back"
        if is_added:
            reset = _ADDED_BEFORE
        elif not is_known:
            reset = self._edits.remember_removed(removal, is_proto=is_proto)
        self._journal.event("remove_node", facts | _asked_by(command), place.path)
        return facts | {"sim_time_s": self._clock.sim_time_s, "a_reset": reset}

    def _until_stepped(self) -> Generator[None, None, bool]:
        """Wait for a step of the simulation; False where simulation time stands still."""
        clock, from_step = self._clock, self._clock.steps_seen
        until_s = time.monotonic() + _LONGEST_STEP_S
        while clock.steps_seen == from_step:
            yield
            stands = self._simulation.paused or time.monotonic() > until_s
            if stands and clock.steps_seen == from_step:
                return False
        return True


def _shown(value: Any) -> Any:
    """A value, or the beginning of its text where it is long."""
    text = json.dumps(value, ensure_ascii=False)
    return value if len(text) <= _LONGEST_SHOWN else cut(text, _LONGEST_SHOWN)


def _edit(place: Place, before: Any, value: Any) -> FieldEdit:
    name = str(place.webots_field.getName())
    node_id = int(place.node.getId())
    return FieldEdit(place.path, node_id, name, place.entry, place.type_name, before, value)


def _require_settable(robot: Any, place: Place) -> None:
    if place.field is None:
        raise InvalidInputError(
            f"{place.path} is a node ({label(place.node)}): name the field to set, such as "
            f"{place.path}.translation"
        )
    if place.is_hidden:
        raise InvalidInputError(
            f"{place.path} is inside a PROTO, where nothing can be set: set a field of the PROTO "
            "node itself"
        )
    if place.entry is None and place.field.getCount() > MOST_ENTRIES:
        raise InvalidInputError(
            f"{place.path} has {place.field.getCount()} entries: set one, such as {place.path}[0]"
        )
    if place.field.getName() == "supervisor" and place.node.getId() == robot.getSelf().getId():
        raise InvalidInputError(
            f"{place.path} cannot be set: this bridge needs the permission of a Supervisor itself"
        )


def _read_again(robot: Any, place: Place) -> Any:
    """The value of a field after setting it; setting may rebuild a PROTO, so it is found again."""
    assert place.field is not None
    field = find_again(robot, int(place.node.getId()), str(place.field.getName()))
    if field is None:
        raise CommandRefusedError(
            f"{place.path} does not exist any more after it was set: look with webots_get_scene"
        )
    return read(field, place.entry)


def _asked_by(command: ClaimedCommand) -> dict[str, Any]:
    return {"command_id": command.id, "requested_by": command.requested_by}


def _count(place: Place) -> int:
    return int(place.webots_field.getCount())


def _newest(robot: Any, place: Place, before: int) -> Any | None:
    """The node that was added to a field since; None where none was."""
    field = find_again(robot, int(place.node.getId()), str(place.webots_field.getName()))
    if field is None or place.type_name == "SFNode":
        return None if field is None else field.getSFNode()
    return field.getMFNode(-1) if field.getCount() > before else None


def _require_one_node(text: object) -> str:
    """The text of a node; a text that cannot be one is refused before Webots is asked.

    Raises:
        InvalidInputError: It is not the text of one node.
    """
    what = 'give vrml as one node of a world file, such as DEF BOX Solid { name "box" }'
    if not isinstance(text, str) or len(text) > _LONGEST_NODE or not _ONE_NODE.match(text):
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


def _find_room(robot: Any, path: object) -> Generator[None, None, Place]:
    """The field that a node is added to.

    Raises:
        InvalidInputError: There is none, or no room in it.
    """
    place = yield from find(robot, path)
    if place.field is None:
        room = children(place.node)
        if room is None:
            raise InvalidInputError(
                f"{place.path} ({label(place.node)}) has no field children: name a field of nodes"
            )
        place = place._replace(path=f"{place.path}.children", field=room)
    room = place.webots_field
    if place.type_name == "SFNode" and room.getSFNode() is not None:
        holds = label(room.getSFNode())
        raise InvalidInputError(f"{place.path} already has a node ({holds}): remove that one first")
    if not place.type_name.endswith("Node"):
        raise InvalidInputError(
            f"{place.path} is of type {place.type_name}, which cannot contain nodes"
        )
    if place.is_hidden:
        raise InvalidInputError(f"{place.path} is inside a PROTO, where nothing can be added")
    return place


def _path_of(robot: Any, node: Any) -> str:
    """A path that identifies a node as long as it exists."""
    definition = str(node.getDef())
    found = robot.getFromDef(definition) if definition else None
    is_first = found is not None and found.getId() == node.getId()
    return definition if is_first else f"#{node.getId()}"


def _require_removable(robot: Any, place: Place) -> None:
    """Refuse to remove a node that the world, or this bridge, depends on.

    Raises:
        InvalidInputError: The text has the reason.
    """
    node = place.node
    if place.is_hidden:
        raise InvalidInputError(f"{place.path} is inside a PROTO, where nothing can be removed")
    if node.getTypeName() in _STAY or node.getId() == robot.getRoot().getId():
        raise InvalidInputError(f"{place.path} ({label(node)}) cannot be removed from a world")
    each = robot.getSelf()
    while each is not None:
        if each.getId() == node.getId():
            raise InvalidInputError(
                f"{place.path} contains the robot {robot.getName()!r} and cannot be removed: the "
                "bridge of that robot runs this command"
            )
        each = each.getParentNode()


def _removal(robot: Any, place: Place) -> Generator[None, None, Removal | None]:
    """How to bring a node back; None where its position or its text is not to be had."""
    export = getattr(place.node, "exportString", None)
    found = yield from _position(robot, place.node)
    if export is None or found is None:
        return None
    text = str(export() or "")
    if not 0 < len(text) <= _LONGEST_REMOVED:
        return None
    return Removal(place.path, int(place.node.getId()), *found, text)


def _position(
    robot: Any, node: Any
) -> Generator[None, None, tuple[int | None, str, int | None] | None]:
    """The parent's number (None: the root), the field and the index; None where none is found."""
    root, pace, node_id = robot.getRoot(), Pace(), node.getId()
    parent = node.getParentNode() or root
    for name, field, _ in node_fields(parent, inside=False, everything=True):
        for index, each in entries(field):
            if each.getId() == node_id:
                is_top = parent.getId() == root.getId()
                return None if is_top else int(parent.getId()), name, index
            yield from pace.rest()
    return None


class FieldEdit(NamedTuple):
    """A field, or an entry of one, that was set.

    Attributes:
        path: The path of the command.
        node_id: The number of its node.
        name: The name of the field.
        entry: The index of the entry; None for the whole field.
        type_name: The type of the value.
        before: The value before it was set for the first time in this run.
        value: The newest value that it was set to.
    """

    path: str
    node_id: int
    name: str
    entry: int | None
    type_name: str
    before: Any
    value: Any


class Removal(NamedTuple):
    """A node that was removed, as text, and its former position.

    Attributes:
        path: The path of the command.
        node_id: The number of the node, or of the one that a reset has put in its place.
        parent_id: The number of its parent; None for the root.
        field: The name of the field that contained it.
        entry: Its index in the field; None in a field for a single node.
        text: Its text as in a world file.
    """

    path: str
    node_id: int
    parent_id: int | None
    field: str
    entry: int | None
    text: str


def find_again(robot: Any, node_id: int, name: str) -> Any | None:
    """The field of that name, of a node that may not exist any more."""
    node = robot.getFromId(node_id)
    return None if node is None else node.getField(name)


def import_node(field: Any, text: str, index: int | None = None) -> Any | None:
    """Add a node to a field of nodes, at an index or at its end.

    Webots reports errors in its console only, and the package raises nothing, so the field is
    compared with before.

    Returns:
        The new node; None if none was added.
    """
    if field.getTypeName() == "SFNode":
        field.importSFNodeFromString(text)
        return field.getSFNode()
    before = field.getCount()
    index = before if index is None else min(index, before)
    field.importMFNodeFromString(index, text)
    return field.getMFNode(index) if field.getCount() > before else None


# -- what a reset has to undo ----------------------------------------------------------------------
# A reset by Webots restores poses and removes added nodes. It does not restore other fields and
# removed nodes: that is done here, as long as the controller's process lives.


class SceneEdits:
    """Remembers changes of the scene, and undoes after a reset what Webots does not.

    Attributes:
        fields: The fields that were set in this run, in that order.
        added: The numbers of the nodes that were added in this run.
        removed: The nodes that were removed in this run, or put back at its beginning, in the order
            of their removal.
    """

    def __init__(self, simulation: Simulation, journal: Journal, errors: ErrorReport) -> None:
        self._simulation = simulation
        self._journal = journal
        self._errors = errors
        self.fields: dict[tuple[int, str, int | None], FieldEdit] = {}
        self.added: set[int] = set()
        self.removed: list[Removal] = []

    def remember_field(self, edit: FieldEdit, node: Any) -> str:
        """Remember that a field of a node is about to be set; what a reset will make of it."""
        key = (edit.node_id, edit.name, edit.entry)
        known = self.fields.get(key)
        if self.is_added(node):
            return "removes the node: it was added in this run"
        if known is None and self._is_full:
            return _TOO_MANY
        self.fields[key] = edit if known is None else known._replace(value=edit.value)
        return "puts it back"

    def is_added(self, node: Any | None) -> bool:
        """Whether a node, or one that contains it, was added in this run."""
        return _is_within(node, self.added)

    def is_put_back(self, node: Any) -> bool:
        """Whether a reset has put it back, or one that contains it, and the next one will again."""
        return _is_within(node, {removal.node_id for removal in self.removed})

    def remember_removed(self, removal: Removal | None, *, is_proto: bool) -> str:
        """Remember that a node was removed; what a reset will make of it."""
        if removal is None:
            return _ONLY_RELOADED
        if self._is_full:
            return _TOO_MANY
        self.removed.append(removal)
        return _PUT_BACK_PROTO if is_proto else "puts it back"

    @property
    def _is_full(self) -> bool:
        return len(self.fields) + len(self.removed) >= MOST_EDITS

    def begin_run(self) -> None:
        """The world was reset: undo what Webots has not undone, and no one else has changed."""
        edits, self.fields, self.added = reversed(self.fields.values()), {}, set()
        outcomes = {edit.path: self._set_back(edit) for edit in edits}
        put_back = {"paths": [path for path, is_set in outcomes.items() if is_set]}
        put_back |= self._bring_back()
        if facts := {name: paths for name, paths in put_back.items() if paths}:
            self._journal.event("put_back", dict[str, object](facts))

    def _bring_back(self) -> dict[str, list[str]]:
        """Add the removed nodes again, the last one first, so that each index is right.

        To Webots they are added nodes then, which the next reset removes.
        """
        put_back: dict[str, list[str]] = {"nodes": [], "not": []}
        numbers: dict[int | None, int] = {}  # new ones, by those before
        removals, self.removed = self.removed[::-1], []
        for removal in removals:
            parent_id = numbers.get(removal.parent_id, removal.parent_id)
            again = self._added_again(removal._replace(parent_id=parent_id))
            if again is None:
                put_back["not"].append(removal.path)
                continue
            if again.node_id != removal.node_id:
                put_back["nodes"].append(removal.path)
                numbers[removal.node_id] = again.node_id
            self.removed.insert(0, again)
        return put_back

    def _added_again(self, removal: Removal) -> Removal | None:
        """With the number that it has now; None where Webots did not add it."""
        try:
            robot = self._simulation.robot
            if robot.getFromId(removal.node_id) is not None:
                return removal
            top = removal.parent_id is None
            parent = robot.getRoot() if top else robot.getFromId(removal.parent_id)
            field = None if parent is None else parent.getField(removal.field)
            node = None if field is None else import_node(field, removal.text, removal.entry)
            return None if node is None else removal._replace(node_id=int(node.getId()))
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed(f"putting {removal.path} back", error)
            return None

    def _set_back(self, edit: FieldEdit) -> bool:
        """Set a field to its value before; False where Webots or someone else has set it since."""
        try:
            field = find_again(self._simulation.robot, edit.node_id, edit.name)
            if field is None or edit.name in _MOVED_BY_PHYSICS:
                return False
            if not is_same(edit.type_name, read(field, edit.entry), edit.value):
                return False
            write(field, edit.before, edit.entry)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed(f"putting {edit.path} back", error)
            return False
        return True


def _is_within(node: Any | None, numbers: Collection[int]) -> bool:
    """Whether a node, or one that contains it, has one of these numbers."""
    while node is not None and int(node.getId()) not in numbers:
        node = node.getParentNode()
    return node is not None
