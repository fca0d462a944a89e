"""Restoring the scene after a reset, as far as Webots has not done so itself."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.scene_path import Pace, children, fields_of
from webots_mcp.bridge.scene_tree import entries
from webots_mcp.bridge.scene_values import is_same, read, write

# Physics has changed these since a command set them, and Webots' own reset restores them.
_MOVED_BY_PHYSICS: Final = ("translation", "rotation", "battery")

_MOST_EXPORTED_CHARACTERS: Final = 200_000  # of a removed node

_Spot = tuple[int | None, str, int | None]


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
        node_id: The number of the node, or of the one that replaced it at the last reset.
        parent_id: The number of its parent; None for the top of the tree.
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

    @property
    def is_written_out(self) -> bool:
        """Whether Webots exported its text, and it is short enough to be remembered."""
        return 0 < len(self.text) <= _MOST_EXPORTED_CHARACTERS


class Restoration:
    """Undoes the changes of one run, after its reset.

    Args:
        robot: The Supervisor.
        failed: Receives each error of a call to Webots.
    """

    def __init__(self, robot: Any, failed: Callable[[str, Exception], None]) -> None:
        self._robot = robot
        self._failed = failed
        self._set: list[FieldEdit] = []
        self._outcomes: dict[str, list[str]] = {"by_webots": [], "by_bridge": [], "not": []}

    def put_back(
        self, fields: list[FieldEdit], added: dict[int, str], removed: list[Removal]
    ) -> list[Removal]:
        """Restore fields, remove added nodes, and add removed nodes again.

        Returns:
            The removed nodes with their new numbers. They have to be remembered: to Webots they
            are added nodes, so the next reset will remove them again.
        """
        for edit in reversed(fields):
            self._try(edit.path, self._set_back, edit)
        for node_id, path in added.items():
            self._try(path, self._take_away, node_id, path)
        in_order = sorted(removed, key=lambda each: each.entry or 0)
        return [self._try(each.path, self._bring_back, each) or each for each in in_order]

    def outcome(self) -> dict[str, object]:
        """What was put back by Webots, what by the bridge, and what was not; a step later."""
        for edit in self._set:
            self._try(edit.path, self._check_set, edit)
        return {how: paths for how, paths in self._outcomes.items() if paths}

    def _try(self, path: str, restore: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return restore(*arguments)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed(f"putting {path} back", error)
            self._outcomes["not"].append(path)
            return None

    def _set_back(self, edit: FieldEdit) -> None:
        field = find_again(self._robot, edit.node_id, edit.name)
        if field is None:
            self._outcomes["not"].append(f"{edit.path}: its node does not exist any more")
        elif edit.name in _MOVED_BY_PHYSICS or not self._holds(edit, edit.value):
            self._outcomes["by_webots"].append(edit.path)
        else:
            write(field, edit.before, edit.entry)
            self._set.append(edit)

    def _check_set(self, edit: FieldEdit) -> None:
        self._note(edit.path, done=self._holds(edit, edit.before))

    def _holds(self, edit: FieldEdit, value: Any) -> bool:
        field = find_again(self._robot, edit.node_id, edit.name)
        return field is not None and is_same(edit.type_name, read(field, edit.entry), value)

    def _take_away(self, node_id: int, path: str) -> None:
        node = self._robot.getFromId(node_id)
        if node is None:
            self._outcomes["by_webots"].append(f"{path} (added)")
            return
        node.remove()
        self._note(f"{path} (added)", done=self._robot.getFromId(node_id) is None)

    def _bring_back(self, removal: Removal) -> Removal:
        if self._robot.getFromId(removal.node_id) is not None:
            return removal
        parent = self._robot.getRoot()
        if removal.parent_id is not None:
            parent = self._robot.getFromId(removal.parent_id)
        field = None if parent is None else parent.getField(removal.field)
        node = None if field is None else import_node(field, removal.text, removal.entry)
        self._note(f"{removal.path} (removed)", done=node is not None)
        return removal if node is None else removal._replace(node_id=int(node.getId()))

    def _note(self, path: str, *, done: bool) -> None:
        self._outcomes["by_bridge" if done else "not"].append(path)


def find_again(robot: Any, node_id: int, name: str) -> Any | None:
    """The field of that name, of a node that may not exist any more."""
    node = robot.getFromId(node_id)
    return None if node is None else node.getField(name)


def import_node(field: Any, text: str, index: int | None = None) -> Any | None:
    """Add a node to a field of nodes, by default at its end.

    Webots reports errors in its console only, and the package raises nothing, so the field is
    compared with before.

    Returns:
        The new node; None if none was added.
    """
    if field.getTypeName() == "SFNode":
        field.importSFNodeFromString(text)
        return field.getSFNode()
    before = field.getCount()
    place = before if index is None else min(index, before)
    field.importMFNodeFromString(place, text)
    return field.getMFNode(place) if field.getCount() > before else None


def spot_of(robot: Any, node: Any) -> Generator[None, None, _Spot | None]:
    """The position of a node: the number of its parent (None: the top), the field, and the index.

    Returns:
        None where it is not found.
    """
    parent, root, wanted, pace = node.getParentNode(), robot.getRoot(), node.getId(), Pace()
    parent_id, fields = None, iter((children(root),))
    if parent is not None and parent.getId() != root.getId():
        parent_id, fields = int(parent.getId()), fields_of(parent)
    for field in fields:
        if field.getTypeName() not in ("SFNode", "MFNode"):
            continue
        for index, each in entries(field):
            if each.getId() == wanted:
                return parent_id, str(field.getName()), index
            yield from pace.rest()
    return None
