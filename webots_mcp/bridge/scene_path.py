"""Paths into the scene tree: `ROVER.translation`, `BALL.children[0].appearance`, `#12.name`.

A path begins with a DEF name, the name of a robot or another Solid, the type of a node at the top
of the tree (`WorldInfo`), `root`, or `#` and a node's number. Names of fields and indices in
brackets follow. For a path that leads nowhere the error lists the nearest existing names.
"""

from __future__ import annotations

import re
import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from webots_mcp.bridge.scene_tree import SceneNode, find_inner_field, read_value, walk
from webots_mcp.errors import InvalidInputError
from webots_mcp.naming import nearest_first

MOST_SEARCHED: Final = 1000  # nodes, for a name
MOST_FIELDS: Final = 100  # of one node

_MOST_NAMED: Final = 20
_LONGEST_PATH: Final = 500
_SLICE_S: Final = 0.005  # the time that reading may take in one round of the controller's loop
_HEAD: Final = re.compile(
    r"\s*/?(?:root\s*[./]\s*(?=children))?(?:(?:DEF|USE)\s+)?"
    r'(?:"(?P<quoted>[^"]+)"|(?P<plain>[^."\[/][^.\[/]*))'
)
_STEP: Final = re.compile(
    r"\s*(?:\[\s*(?P<index>-?\d+)\s*\]|[./]\s*(?P<place>\d+)(?=[./\[]|$)|[./]\s*(?P<name>[^.\[\]/]+))"
)
_HOW: Final = "write a path such as ROVER.translation, BALL.children[0].appearance or #12.name"


class Pace:
    """Interrupts a long reading of the scene, so that the controller's loop continues meanwhile."""

    def __init__(self) -> None:
        self._until_s = time.monotonic() + _SLICE_S

    def rest(self) -> Generator[None]:
        """Wait for the next round if the time of this one is used up."""
        if time.monotonic() > self._until_s:
            yield
            self._until_s = time.monotonic() + _SLICE_S


@dataclass(frozen=True)
class Place:
    """The target of a path: a node, or (with `field`) one of its fields.

    Attributes:
        path: The path to it.
        node: Webots' `Node`.
        field: Webots' `Field`; None where the path ends at the node.
        index: The index of the entry in the field; None for the whole field.
        is_hidden: It is inside a PROTO node: it can be read, but not changed.
        definition: The path as DEF names with dots; "" where it has other parts.
    """

    path: str
    node: Any
    field: Any | None = None
    index: int | None = None
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
        return whole if self.index is None else f"SF{whole[2:]}"


def find(supervisor: Any, path: object) -> Generator[None, None, Place]:
    """Resolve a path.

    Raises:
        InvalidInputError: It is not a path, or leads nowhere; the text lists the nearest names.
    """
    head, steps = parse(path)
    place = yield from _find_head(supervisor, head, Pace())
    for step in steps:
        place = _go(supervisor, place, step)
    return place


def find_node(supervisor: Any, path: object) -> Generator[None, None, Place]:
    """Resolve a path to a node, or to a field that contains a single node.

    Raises:
        InvalidInputError: As `find`, or there is no node at its end.
    """
    place = yield from find(supervisor, path)
    if place.field is None:
        return place
    if place.type_name != "SFNode":
        raise InvalidInputError(f"{place.path} is a field of type {place.type_name}, not a node")
    return _enter(place)


def parse(path: object) -> tuple[str, list[str | int]]:
    """The name that a path begins with, and its steps.

    Raises:
        InvalidInputError: It is not a path.
    """
    if not isinstance(path, str) or not path.strip() or len(path) > _LONGEST_PATH:
        raise InvalidInputError(f"{path!r:.80} is not a path of the scene tree: {_HOW}")
    head = _HEAD.match(path)
    position, steps = (head.end() if head else 0), list[str | int]()
    while head and position < len(path.rstrip()):
        step = _STEP.match(path, position)
        if step is None:
            break
        steps.append((step["name"] or "").strip() or int(step["index"] or step["place"]))
        position = step.end()
    if head is None or position < len(path.rstrip()):
        raise InvalidInputError(
            f"{path!r} is not a path of the scene tree: {path[position:]!r} is invalid; {_HOW}"
        )
    return (head["quoted"] or head["plain"]).strip(), steps


def _find_head(supervisor: Any, head: str, pace: Pace) -> Generator[None, None, Place]:
    root = supervisor.getRoot()
    if head == "root":
        return Place("root", root)
    if head == "children":
        return _field_of(supervisor, Place("root", root), head)
    if head.startswith("#"):
        return Place(head, _numbered(supervisor, head))
    node = supervisor.getFromDef(head)
    if node is not None:
        return Place(head, node, definition=head)
    found = yield from _named(root, head, pace)
    return Place(head, found.node, is_hidden=found.hidden)


def _numbered(supervisor: Any, head: str) -> Any:
    digits = head[1:].strip()
    node = supervisor.getFromId(int(digits)) if digits.isdigit() and len(digits) < 10 else None
    if node is None:
        raise InvalidInputError(f"there is no node {head}; webots_get_scene lists the nodes")
    return node


def _named(root: Any, head: str, pace: Pace) -> Generator[None, None, SceneNode]:
    """The only Solid of that name, preferably a Robot; else the only top node of that type."""
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


def children(root: Any) -> Any:
    """The field of the root that contains the top nodes of the tree."""
    return root.getField("children")


def _listed(several: Sequence[SceneNode]) -> str:
    shown = ", ".join(f"#{each.id} {each.type_name}" for each in several[:_MOST_NAMED])
    return f"{shown}; give the number of one of them"


def _unknown(head: str, labels: list[str], searched: int) -> str:
    existing = list(dict.fromkeys(nearest_first(head, labels)))
    bound = f" among the first {MOST_SEARCHED} nodes" if searched >= MOST_SEARCHED else ""
    return (
        f"no node has the DEF name, name or type {head!r}{bound}; robots and nodes at the top "
        f"(the nearest first): {some(existing)}"
    )


def _go(supervisor: Any, place: Place, step: str | int) -> Place:
    if place.field is None:
        return _field_of(supervisor, place, step)
    if isinstance(step, int):
        return _entry_of(place, step)
    if place.type_name == "SFNode":
        return _field_of(supervisor, _enter(place), step)
    if place.type_name == "MFNode":
        raise InvalidInputError(
            f"{place.path} is a list of nodes: give an index, such as {place.path}[0]; it has "
            f"{_entries_of(place)}"
        )
    raise InvalidInputError(
        f"{place.path} is of type {place.type_name}: it has no fields, so the path must end there"
    )


def _enter(place: Place) -> Place:
    """The node that a field holds."""
    assert place.field is not None
    node = place.field.getSFNode()
    if node is None:
        raise InvalidInputError(f"{place.path} is NULL: it contains no node")
    return Place(place.path, node, is_hidden=place.is_hidden)


def _field_of(supervisor: Any, place: Place, step: str | int) -> Place:
    if isinstance(step, int):
        raise InvalidInputError(
            f"{place.path} is a node: name one of its fields, such as {place.path}.children[{step}]"
        )
    node, path = place.node, f"{place.path}.{step}"
    field = node.getField(step)
    if field is not None:
        return replace(place, path=path, field=field, definition="")
    inner = find_inner_field(node, step)
    if inner is not None:
        return replace(place, path=path, field=inner, is_hidden=True, definition="")
    definition = f"{place.definition}.{step}" if place.definition else ""
    below = supervisor.getFromDef(definition) if definition else None
    if below is not None:
        return Place(path, below, definition=definition)
    raise InvalidInputError(_no_field(place, step))


def _no_field(place: Place, step: str) -> str:
    names = nearest_first(step, field_names(place.node))
    kind = place.node.getTypeName()
    return f"{place.path} ({kind}) has no field {step!r}; it has (the nearest first): {some(names)}"


def field_names(node: Any) -> list[str]:
    """The names of the fields of a node; of a PROTO node its own."""
    return [field.getName() for field in fields_of(node)]


def fields_of(node: Any) -> Iterator[Any]:
    """The fields of a node; of a PROTO node its own."""
    found = (node.getFieldByIndex(i) for i in range(min(node.getNumberOfFields(), MOST_FIELDS)))
    return (field for field in found if field is not None)


def _entry_of(place: Place, index: int) -> Place:
    field = place.field
    assert field is not None
    count = field.getCount() if place.index is None else -1
    if count < 0:
        raise InvalidInputError(
            f"{place.path} is one value of type {place.type_name}, not a list: use it without index"
        )
    if not -count <= index < count:
        raise InvalidInputError(f"{place.path} has no entry {index}: it has {_entries_of(place)}")
    index %= count
    path = f"{place.path}[{index}]"
    if place.type_name == "MFNode":
        return Place(path, field.getMFNode(index), is_hidden=place.is_hidden)
    return replace(place, path=path, index=index)


def _entries_of(place: Place) -> str:
    """The number of entries of a field, and its nodes."""
    field = place.field
    assert field is not None
    count = field.getCount()
    if not count:
        return "none"
    if place.type_name != "MFNode":
        return f"{count}: 0 to {count - 1}"
    shown = [f"[{i}] {label(field.getMFNode(i))}" for i in range(min(count, _MOST_NAMED))]
    return f"{count}: {some(shown, count)}"


def label(node: Any) -> str:
    """A short label of a node: its type, with its DEF name or else its name."""
    name = node.getDef() or read_value(node, "name")
    return f"{node.getTypeName()} {name}" if name else str(node.getTypeName())


def some(names: Sequence[str], total: int | None = None) -> str:
    """The first names, and the number of further ones."""
    total = len(names) if total is None else total
    shown = names[:_MOST_NAMED]
    more = f" and {total - len(shown)} more" if total > len(shown) else ""
    return f"{', '.join(shown) or 'nothing'}{more}"
