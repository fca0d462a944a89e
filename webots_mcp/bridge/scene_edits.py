"""The changes of the scene tree that a reset has to undo.

A reset by Webots restores poses and removes added nodes. It restores neither other fields nor
removed nodes: that is done here, as long as the controller's process lives.
"""

from __future__ import annotations

from collections.abc import Collection, Generator
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.field_values import is_same, read, write
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.scene_nodes import entries, node_fields
from webots_mcp.bridge.scene_paths import Pace, PathTarget
from webots_mcp.bridge.simulation import Simulation

MOST_EDITS: Final = 200  # changes of a run that a reset undoes
_LONGEST_REMOVED: Final = 200_000  # characters of a node that is remembered
_ONLY_RELOADED: Final = "does not bring it back; a reload does"
_PUT_BACK_PROTO: Final = (
    "puts it back if the world declares its PROTO as IMPORTABLE EXTERNPROTO; else a reload does"
)
# A reset by Webots restores these fields, and physics changes them after a command has set them.
_MOVED_BY_PHYSICS: Final = ("translation", "rotation", "battery")
_TOO_MANY: Final = f"does not undo it: at most {MOST_EDITS} changes are remembered"


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
    """A removed node, as text, and where it was.

    Attributes:
        path: The path of the command.
        node_id: The number of the node, or of the node that a reset added in its place.
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
        """Remember that a field is about to be set; return what a reset will do to it."""
        key = (edit.node_id, edit.name, edit.entry)
        known = self.fields.get(key)
        if self.is_added(node):
            return "removes the node: it was added in this run"
        if known is None and self._is_full:
            return _TOO_MANY
        self.fields[key] = edit if known is None else known._replace(value=edit.value)
        return "puts it back"

    def is_added(self, node: Any | None) -> bool:
        """Return whether a node, or one that contains it, was added in this run."""
        return _is_within(node, self.added)

    def is_put_back(self, node: Any) -> bool:
        """Return whether a reset put back this node, or one around it, and will do so again."""
        return _is_within(node, {removal.node_id for removal in self.removed})

    def remember_removed(self, removal: Removal | None, *, is_proto: bool) -> str:
        """Remember that a node was removed; return what a reset will do to it."""
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
        """Undo after a reset what Webots has not undone, unless other code has changed it since."""
        edits, self.fields, self.added = reversed(self.fields.values()), {}, set()
        outcomes = {edit.path: self._set_back(edit) for edit in edits}
        put_back = {"paths": [path for path, is_set in outcomes.items() if is_set]}
        put_back |= self._bring_back()
        if facts := {name: paths for name, paths in put_back.items() if paths}:
            self._journal.event("put_back", dict[str, object](facts))

    def _bring_back(self) -> dict[str, list[str]]:
        """Add the removed nodes again, the last removed one first, so that each index is right.

        For Webots these are new nodes, which its next reset removes; so they are remembered again.
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
        """Add a removed node again and return it with its new number; None if Webots refuses."""
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
        """Set a field to its former value; False if anything else has set it since."""
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


def describe_removal(robot: Any, target: PathTarget) -> Generator[None, None, Removal | None]:
    """Describe how to bring a node back; None if its position or text cannot be read."""
    export = getattr(target.node, "exportString", None)
    found = yield from _position(robot, target.node)
    if export is None or found is None:
        return None
    text = str(export() or "")
    if not 0 < len(text) <= _LONGEST_REMOVED:
        return None
    return Removal(target.path, int(target.node.getId()), *found, text)


def find_again(robot: Any, node_id: int, name: str) -> Any | None:
    """Return a field of a node; None if the node does not exist any more."""
    node = robot.getFromId(node_id)
    return None if node is None else node.getField(name)


def import_node(field: Any, text: str, index: int | None = None) -> Any | None:
    """Add a node to a field of nodes, at an index or at its end.

    Webots reports an error in its console only, and its package raises nothing. So a node counts
    as added only if the field has one more node than before.

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


def _position(
    robot: Any, node: Any
) -> Generator[None, None, tuple[int | None, str, int | None] | None]:
    """Find where a node is in the tree.

    Returns:
        The parent's number (None for the root), the field, and the index in it (None in a field
        for a single node). None if the node was not found.
    """
    root, pace, node_id = robot.getRoot(), Pace(), node.getId()
    parent = node.getParentNode() or root
    for name, field, _ in node_fields(parent, inside=False, everything=True):
        for index, each in entries(field):
            if each.getId() == node_id:
                is_top = parent.getId() == root.getId()
                return None if is_top else int(parent.getId()), name, index
            yield from pace.rest()
    return None


def _is_within(node: Any | None, numbers: Collection[int]) -> bool:
    """Return whether a node, or one that contains it, has one of these numbers."""
    while node is not None and int(node.getId()) not in numbers:
        node = node.getParentNode()
    return node is not None
