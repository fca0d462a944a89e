"""Paths into the scene tree: `ROVER.translation`, `BALL.children[0].appearance` or `#12.name`.

A path begins with a DEF name, the name of a robot or another Solid, the type of a node at the top
of the tree (`WorldInfo`), `root`, or `#` and a node's number. Names of fields and indices in
brackets follow. For a path that leads nowhere the error lists the nearest existing names.
"""

from __future__ import annotations

import re
import time
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.scene_nodes import (
    SceneNode,
    children,
    field_names,
    find_inner_field,
    label,
    walk,
)
from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.naming import nearest_first

MOST_SEARCHED: Final = 1000  # nodes, for a name
_HEAD: Final = re.compile(
    r"\s*/?(?:root\s*[./]\s*(?=children))?(?:(?:DEF|USE)\s+)?"
    r'(?:"(?P<quoted>[^"]+)"|(?P<plain>[^."\[/][^.\[/]*))'
)
_STEP: Final = re.compile(
    r"\s*(?:\[\s*(?P<index>-?\d+)\s*\]|[./]\s*(?P<target>\d+)(?=[./\[]|$)|[./]\s*(?P<name>[^.\[\]/]+))"
)
_EXAMPLES: Final = "write a path such as ROVER.translation, BALL.children[0].appearance or #12.name"


@dataclass(frozen=True)
class SceneSearchLimits:
    """Limits of searching the scene tree.

    Attributes:
        named: Nodes or fields that an error names.
        path_characters: Maximum length of a path.
        slice_s: Time that reading may take in one round of the controller's loop.
    """

    named: int = 20
    path_characters: int = 500
    slice_s: float = 0.005


_SEARCH: Final = SceneSearchLimits()


class Pace:
    """Interrupts a long reading of the scene, so that the controller's loop continues meanwhile."""

    def __init__(self) -> None:
        self._until_s = time.monotonic() + _SEARCH.slice_s

    def rest(self) -> Generator[None]:
        """Wait for the next round if the time of this one is used up."""
        if time.monotonic() > self._until_s:
            yield
            self._until_s = time.monotonic() + _SEARCH.slice_s


class PathTarget(NamedTuple):
    """The target of a path: a node, or (with `field`) one of its fields.

    Attributes:
        path: The path to it.
        node: Webots' `Node`.
        field: Webots' `Field`; None where the path ends at the node.
        entry: The index of the entry in the field; None for the whole field.
        is_hidden: It is inside a PROTO node: it can be read, but not changed.
        definition: The path as DEF names with dots; "" where it has other parts.
    """

    path: str
    node: Any
    field: Any | None = None
    entry: int | None = None
    is_hidden: bool = False
    definition: str = ""

    @property
    def webots_field(self) -> Any:
        """Webots' `Field` of a path that is known to lead to one."""
        return self.field

    @property
    def type_name(self) -> str:
        """The type of the field, such as SFVec3f; for one entry the single-valued type."""
        whole = str(self.field.getTypeName()) if self.field is not None else ""
        return whole if self.entry is None else f"SF{whole[2:]}"


def find(supervisor: Any, path: object) -> Generator[None, None, PathTarget]:
    """Resolve a path.

    Raises:
        InvalidInputError: If it is no path or leads nowhere; the text lists the nearest names.
    """
    head, steps = parse(path)
    target = yield from _find_head(supervisor, head, Pace())
    for step in steps:
        target = _go(supervisor, target, step)
    return target


def find_node(supervisor: Any, path: object) -> Generator[None, None, PathTarget]:
    """Resolve a path to a node, or to a field that contains a single node.

    Raises:
        InvalidInputError: As for `find`, or if there is no node at its end.
    """
    target = yield from find(supervisor, path)
    if target.field is None:
        return target
    if target.type_name != "SFNode":
        raise InvalidInputError(f"{target.path} is a field of type {target.type_name}, not a node")
    return _enter(target)


def parse(path: object) -> tuple[str, list[str | int]]:
    """Split a path into the name that it begins with, and its steps.

    Raises:
        InvalidInputError: If it is not a path.
    """
    if not isinstance(path, str) or not path.strip() or len(path) > _SEARCH.path_characters:
        raise InvalidInputError(f"{path!r:.80} is not a path of the scene tree: {_EXAMPLES}")
    head = _HEAD.match(path)
    position, steps = (head.end() if head else 0), list[str | int]()
    while head and position < len(path.rstrip()):
        step = _STEP.match(path, position)
        if step is None:
            break
        steps.append((step["name"] or "").strip() or int(step["index"] or step["target"]))
        position = step.end()
    if head is None or position < len(path.rstrip()):
        raise InvalidInputError(
            f"{path!r} is not a path of the scene tree: {path[position:]!r} is invalid; {_EXAMPLES}"
        )
    return (head["quoted"] or head["plain"]).strip(), steps


def _find_head(supervisor: Any, head: str, pace: Pace) -> Generator[None, None, PathTarget]:
    root = supervisor.getRoot()
    if head == "root":
        return PathTarget("root", root)
    if head == "children":
        return _field_of(supervisor, PathTarget("root", root), head)
    if head.startswith("#"):
        return PathTarget(head, _numbered(supervisor, head))
    node = supervisor.getFromDef(head)
    if node is not None:
        return PathTarget(head, node, definition=head)
    found = yield from _named(root, head, pace)
    return PathTarget(head, found.node, is_hidden=found.hidden)


def _numbered(supervisor: Any, head: str) -> Any:
    digits = head[1:].strip()
    node = supervisor.getFromId(int(digits)) if digits.isdigit() and len(digits) < 10 else None
    if node is None:
        raise InvalidInputError(f"there is no node {head}; webots_get_scene lists the nodes")
    return node


def _named(root: Any, head: str, pace: Pace) -> Generator[None, None, SceneNode]:
    """Find the only Solid of a name, preferably a Robot, or else the only top node of a type."""
    solids, types, labels = list[SceneNode](), list[SceneNode](), list[str]()
    top = list[SceneNode]()
    for index in range(min(children(root).getCount(), MOST_SEARCHED)):
        yield from pace.rest()
        top.append(_at_the_top(root, index))
    below = walk(root, most=MOST_SEARCHED)
    searched = 0
    for found in _once((*top, *below)):
        yield from pace.rest()
        searched += 1
        name = found.name if found.is_solid else ""
        if name == head:
            solids.append(found)
        if found.parent is None and head in (found.type_name, found.base_type):
            types.append(found)
        if found.parent is None or found.base_type == "Robot":
            labels.append(found.definition or name or found.type_name)
    robots = [each for each in solids if each.base_type == "Robot"]
    for several in (robots, solids, types):
        if len(several) == 1:
            return several[0]
        if several:
            raise InvalidInputError(
                f"{len(several)} nodes have the name {head!r}: {_listed(several)}"
            )
    raise InvalidInputError(_unknown(head, labels, searched))


def _once(found: Iterable[SceneNode]) -> Iterable[SceneNode]:
    seen: set[int] = set()
    for each in found:
        if each.id not in seen:
            seen.add(each.id)
            yield each


def _at_the_top(root: Any, index: int) -> SceneNode:
    node = children(root).getMFNode(index)
    return SceneNode.of(node, None, "children", index, hidden=False)


def _listed(several: Sequence[SceneNode]) -> str:
    shown = ", ".join(f"#{each.id} {each.type_name}" for each in several[: _SEARCH.named])
    return f"{shown}; give the number of one of them"


def _unknown(head: str, labels: list[str], searched: int) -> str:
    existing = list(dict.fromkeys(nearest_first(head, labels)))
    bound = f" among the first {MOST_SEARCHED} nodes" if searched >= MOST_SEARCHED else ""
    return (
        f"no node has the DEF name, name or type {head!r}{bound}; robots and nodes at the top "
        f"(the nearest first): {some(existing)}"
    )


def _go(supervisor: Any, target: PathTarget, step: str | int) -> PathTarget:
    if target.field is None:
        return _field_of(supervisor, target, step)
    if isinstance(step, int):
        return _entry_of(target, step)
    if target.type_name == "SFNode":
        return _field_of(supervisor, _enter(target), step)
    if target.type_name == "MFNode":
        raise InvalidInputError(
            f"{target.path} is a list of nodes: give an index, such as {target.path}[0]; it has "
            f"{_entries_of(target)}"
        )
    raise InvalidInputError(
        f"{target.path} is of type {target.type_name}: it has no fields, so the path must end there"
    )


def _enter(target: PathTarget) -> PathTarget:
    """Go from a field to the node that it holds."""
    assert target.field is not None
    node = target.field.getSFNode()
    if node is None:
        raise InvalidInputError(f"{target.path} is NULL: it contains no node")
    return PathTarget(target.path, node, is_hidden=target.is_hidden)


def _field_of(supervisor: Any, target: PathTarget, step: str | int) -> PathTarget:
    if isinstance(step, int):
        raise InvalidInputError(
            f"{target.path} is a node: name one of its fields, such as "
            f"{target.path}.children[{step}]"
        )
    node, path = target.node, f"{target.path}.{step}"
    field = node.getField(step)
    if field is not None:
        return target._replace(path=path, field=field, definition="")
    inner = find_inner_field(node, step)
    if inner is not None:
        return target._replace(path=path, field=inner, is_hidden=True, definition="")
    definition = f"{target.definition}.{step}" if target.definition else ""
    below = supervisor.getFromDef(definition) if definition else None
    if below is not None:
        return PathTarget(path, below, definition=definition)
    raise InvalidInputError(_no_field(target, step))


def _no_field(target: PathTarget, step: str) -> str:
    names = nearest_first(step, field_names(target.node))
    kind = target.node.getTypeName()
    return (
        f"{target.path} ({kind}) has no field {step!r}; it has (the nearest first): {some(names)}"
    )


def _entry_of(target: PathTarget, index: int) -> PathTarget:
    field = target.field
    assert field is not None
    count = field.getCount() if target.entry is None else -1
    if count < 0:
        raise InvalidInputError(
            f"{target.path} is one value of type {target.type_name}, not a list: use it without "
            "index"
        )
    if not -count <= index < count:
        raise InvalidInputError(f"{target.path} has no entry {index}: it has {_entries_of(target)}")
    index %= count
    path = f"{target.path}[{index}]"
    if target.type_name == "MFNode":
        return PathTarget(path, field.getMFNode(index), is_hidden=target.is_hidden)
    return target._replace(path=path, entry=index)


def _entries_of(target: PathTarget) -> str:
    """Describe the number of entries of a field, and its nodes."""
    field = target.field
    assert field is not None
    count = field.getCount()
    if not count:
        return "none"
    if target.type_name != "MFNode":
        return f"{count}: 0 to {count - 1}"
    shown = [f"[{i}] {label(field.getMFNode(i))}" for i in range(min(count, _SEARCH.named))]
    return f"{count}: {some(shown, count)}"


def some(names: Sequence[str], total: int | None = None) -> str:
    """Return a text with the first names and the number of further ones."""
    total = len(names) if total is None else total
    shown = names[: _SEARCH.named]
    more = f" and {total - len(shown)} more" if total > len(shown) else ""
    return f"{', '.join(shown) or 'nothing'}{more}"
