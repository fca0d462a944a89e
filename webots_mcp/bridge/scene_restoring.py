"""Putting the scene back after a reset, as far as Webots has not done so itself."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.scene import entries
from webots_mcp.bridge.scene_path import Pace, children, fields_of
from webots_mcp.bridge.scene_values import is_same, read, write

# Where a body is, it was moved on since it was put there, and a reset brings it back by itself.
_MOVED_BY_PHYSICS: Final = ("translation", "rotation", "battery")

_MOST_EXPORTED_CHARACTERS: Final = 200_000  # of a removed node

_Spot = tuple[int | None, str, int | None]


class FieldEdit(NamedTuple):
    """A field, or an entry of one, that was set.

    Attributes:
        path: The way to it, as it was asked for.
        node_id: The number of its node.
        name: Of the field.
        entry: Its place; None for all of the field.
        type_name: Of what was set.
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
    """A node that was removed, as text, and where it stood.

    Attributes:
        path: The way to it, as it was asked for.
        node_id: Of the node, or of the one that took its place at the last reset.
        parent_id: Of the node around it; None for the top of the tree.
        field: The name of the field in which it stood.
        entry: Its place in the field; None in one that holds a single node.
        text: As it would stand in a world file.
    """

    path: str
    node_id: int
    parent_id: int | None
    field: str
    entry: int | None
    text: str

    @property
    def is_written_out(self) -> bool:
        """Whether the text is there, and short enough to be remembered."""
        return 0 < len(self.text) <= _MOST_EXPORTED_CHARACTERS


class Restoration:
    """One reset.

    Args:
        robot: The Supervisor.
        failed: Is told of what Webots' package did not take.
    """

    def __init__(self, robot: Any, failed: Callable[[str, Exception], None]) -> None:
        self._robot = robot
        self._failed = failed
        self._set: list[FieldEdit] = []
        self._told: dict[str, list[str]] = {"by_webots": [], "by_bridge": [], "not": []}

    def put_back(
        self, fields: list[FieldEdit], added: dict[int, str], removed: list[Removal]
    ) -> list[Removal]:
        """Set fields back, take away what was added, and bring back what was removed.

        Returns:
            What was removed, with the numbers of the nodes that stand there now: Webots takes
            them for added ones, so that the next reset will remove them once more.
        """
        for edit in reversed(fields):
            self._try(edit.path, self._set_back, edit)
        for node_id, path in added.items():
            self._try(path, self._take_away, node_id, path)
        in_order = sorted(removed, key=lambda each: each.entry or 0)
        return [self._try(each.path, self._bring_back, each) or each for each in in_order]

    def outcome(self) -> dict[str, object]:
        """What was put back by whom, a step later, and what was not."""
        for edit in self._set:
            self._try(edit.path, self._tell_whether_set, edit)
        return {how: paths for how, paths in self._told.items() if paths}

    def _try(self, path: str, restore: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return restore(*arguments)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed(f"putting {path} back", error)
            self._told["not"].append(path)
            return None

    def _set_back(self, edit: FieldEdit) -> None:
        field = find_again(self._robot, edit.node_id, edit.name)
        if field is None:
            self._told["not"].append(f"{edit.path}: its node is not there any more")
        elif edit.name in _MOVED_BY_PHYSICS or not self._holds(edit, edit.value):
            self._told["by_webots"].append(edit.path)
        else:
            write(field, edit.before, edit.entry)
            self._set.append(edit)

    def _tell_whether_set(self, edit: FieldEdit) -> None:
        self._tell(edit.path, done=self._holds(edit, edit.before))

    def _holds(self, edit: FieldEdit, value: Any) -> bool:
        field = find_again(self._robot, edit.node_id, edit.name)
        return field is not None and is_same(edit.type_name, read(field, edit.entry), value)

    def _take_away(self, node_id: int, path: str) -> None:
        node = self._robot.getFromId(node_id)
        if node is None:
            self._told["by_webots"].append(f"{path} (added)")
            return
        node.remove()
        self._tell(f"{path} (added)", done=self._robot.getFromId(node_id) is None)

    def _bring_back(self, removal: Removal) -> Removal:
        if self._robot.getFromId(removal.node_id) is not None:
            return removal
        parent = self._robot.getRoot()
        if removal.parent_id is not None:
            parent = self._robot.getFromId(removal.parent_id)
        field = None if parent is None else parent.getField(removal.field)
        node = None if field is None else import_node(field, removal.text, removal.entry)
        self._tell(f"{removal.path} (removed)", done=node is not None)
        return removal if node is None else removal._replace(node_id=int(node.getId()))

    def _tell(self, path: str, *, done: bool) -> None:
        self._told["by_bridge" if done else "not"].append(path)


def find_again(robot: Any, node_id: int, name: str) -> Any | None:
    """The field of that name, of a node that may be gone by now."""
    node = robot.getFromId(node_id)
    return None if node is None else node.getField(name)


def import_node(field: Any, text: str, index: int | None = None) -> Any | None:
    """Add a node to a field of nodes, by default at its end.

    Webots' console tells what it did not take, and the package says nothing: the field shows it.

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
    """Where a node stands: the number of its parent (None: the top), the field, and the entry.

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
