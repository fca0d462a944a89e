"""The scene tree of a world: walking it, paths into it, and the values of its fields.

Reading a field or one of its entries may be a request to Webots, so a walk is a generator: its
caller decides when to continue. It skips shapes and appearances unless `everything` is set.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from fnmatch import fnmatchcase
from typing import Any, Final, NamedTuple, cast

from webots_mcp.bridge.commands import Progress, whole_number
from webots_mcp.bridge.error_report import cut
from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.naming import nearest_first

MOST_NODES: Final = 5000  # that one walk yields
DEEPEST: Final = 24  # levels below the root

_CHILDREN: Final = ("children",)
# By base type: the fields that contain solids, joints and devices. Other types contain none.
_FIELDS: Final[dict[str, tuple[str, ...]]] = {
    **dict.fromkeys(("Group", "Pose", "Transform", "Billboard", "Solid", "Robot"), _CHILDREN),
    **dict.fromkeys(("Accelerometer", "Altimeter", "Camera", "Charger", "Compass"), _CHILDREN),
    **dict.fromkeys(("Connector", "Display", "DistanceSensor", "Emitter", "GPS"), _CHILDREN),
    **dict.fromkeys(("Gyro", "InertialUnit", "LED", "Lidar", "LightSensor", "Pen"), _CHILDREN),
    **dict.fromkeys(("Radar", "RangeFinder", "Receiver", "Speaker", "TouchSensor"), _CHILDREN),
    **dict.fromkeys(("VacuumGripper", "Fluid"), _CHILDREN),
    **dict.fromkeys(("HingeJoint", "SliderJoint"), ("device", "endPoint")),
    "Hinge2Joint": ("device", "device2", "endPoint"),
    "BallJoint": ("device", "device2", "device3", "endPoint"),
    "Propeller": ("device",),
    "Slot": ("endPoint",),
    "Track": ("device", *_CHILDREN),
}
WALKED: Final = frozenset(_FIELDS)
"""Base types of the nodes that a walk yields even without `everything`."""
_GROUPS: Final = ("Group", "Pose", "Transform")  # whose only field of nodes is `children`
_NO_SOLIDS: Final = ("Group", "Pose", "Transform", "Billboard", "Fluid")
SOLIDS: Final = frozenset(
    name for name, fields in _FIELDS.items() if "children" in fields and name not in _NO_SOLIDS
)
"""Base types that are a Solid or one of its subclasses: they have a `name` and a velocity."""

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
_MOST_CHARACTERS: Final = 2_600  # of an answer's rows; the server would shorten more
_MOST_SHOWN: Final = 50  # entries of a field
_FIRST_ENTRIES: Final = 3  # of a field among others
_LONGEST_TEXT: Final = 80  # of a field among others
_USUAL_DEPTH: Final = 2
_MOST_AT_THE_TOP: Final = 200
_MOST_PATTERNS: Final = 20
_MOST_NEAR: Final = 10  # types or names that are listed where none matches
MOST_ENTRIES: Final = 200  # of a field that are set at once: each is a request to Webots
MOST_CHARACTERS: Final = 10_000  # of one text
_LARGEST_FLOAT: Final = 3.4028234e38  # beyond it Webots refuses a number
_TOLERANCE: Final = 1e-6  # relative: Webots may store a value in single precision
# Fields that name programs that Webots runs: it searches each in its folder of the project.
_PROGRAMS: Final = ("controller", "window", "remoteControl", "physics")


class SceneNode(NamedTuple):
    """A node and its position in the tree.

    Attributes:
        node: Webots' `Node`.
        id: Its number, which is unique in the world and never used again.
        type_name: The PROTO's name, such as `E-puck`; else the same as `base_type`.
        base_type: The type of node, such as `Robot`.
        definition: Its DEF name, or "".
        parent: Its parent node; None at the top of the tree.
        field: The field of the parent, or of the root, that contains it.
        entry: Its index in that field; None where the field holds a single node.
        hidden: It is inside a PROTO node: it can be read, but not changed.
    """

    node: Any
    id: int
    type_name: str
    base_type: str
    definition: str
    parent: SceneNode | None
    field: str
    entry: int | None
    hidden: bool

    @classmethod
    def of(
        cls, node: Any, parent: SceneNode | None, field: str, index: int | None, *, hidden: bool
    ) -> SceneNode:
        """A `Node` of Webots with its position in the tree."""
        kinds = (node.getTypeName(), node.getBaseTypeName(), node.getDef())
        return cls(node, int(node.getId()), *kinds, parent, field, index, hidden)

    @property
    def depth(self) -> int:
        """The number of its ancestors."""
        return 0 if self.parent is None else self.parent.depth + 1

    @property
    def is_solid(self) -> bool:
        """Whether it is a Solid, a Robot or a device that is one."""
        return self.base_type in SOLIDS

    @property
    def is_proto(self) -> bool:
        """Whether it is an instance of a PROTO."""
        return bool(self.node.isProto())

    @property
    def name(self) -> str:
        """The value of its field `name`; "" where it has none."""
        value = read_value(self.node, "name")
        return value if isinstance(value, str) else ""


class NodeField(NamedTuple):
    """A field that can hold nodes.

    Attributes:
        name: Its name.
        field: Webots' `Field`.
        hidden: It belongs to the internal node of a PROTO.
    """

    name: str
    field: Any
    hidden: bool


def walk(
    root: Any,
    *,
    most: int = MOST_NODES,
    deepest: int = DEEPEST,
    inside: bool = True,
    everything: bool = False,
) -> Generator[SceneNode]:
    """The nodes of the tree, each once, breadth first.

    Args:
        root: The node to begin at, which is not yielded itself: `supervisor.getRoot()`, or another.
        most: The largest number of nodes to yield.
        deepest: The largest number of levels below the root.
        inside: Also yield the nodes inside PROTO nodes, which Webots allows to be read.
        everything: Also yield shapes, appearances and the like.
    """
    seen: set[int] = {int(root.getId())}
    waiting: deque[tuple[Any, SceneNode | None]] = deque([(root, None)])
    while waiting:
        node, around = waiting.popleft()
        for found in _nodes_in(node, around, inside=inside, everything=everything):
            if found.id in seen:  # a USE, or a node that is reachable through a slot as well
                continue
            if len(seen) > most:
                return
            seen.add(found.id)
            if found.depth + 1 < deepest:
                waiting.append((found.node, found))
            yield found


def _nodes_in(
    node: Any, around: SceneNode | None, *, inside: bool, everything: bool
) -> Iterator[SceneNode]:
    hidden = around is not None and around.hidden
    for name, field, is_inside in node_fields(node, inside=inside, everything=everything):
        for index, child in entries(field):
            if everything or child.getBaseTypeName() in _FIELDS or name.startswith("device"):
                yield SceneNode.of(child, around, name, index, hidden=hidden or is_inside)


def node_fields(node: Any, *, inside: bool = True, everything: bool = False) -> Iterator[NodeField]:
    """The fields of a node that can contain nodes; of a PROTO node the internal ones come last."""
    base_type: str = node.getBaseTypeName()
    if node.isProto() or (everything and base_type not in _GROUPS):
        yield from _all_node_fields(node)
    elif base_type in _FIELDS:
        for name in _FIELDS[base_type]:
            if (field := node.getField(name)) is not None:
                yield NodeField(name, field, False)
    if inside and node.isProto():
        for name in _FIELDS.get(base_type, ()):
            if (field := find_inner_field(node, name)) is not None:
                yield NodeField(name, field, True)


def _all_node_fields(node: Any) -> Iterator[NodeField]:
    for index in range(node.getNumberOfFields()):
        field = node.getFieldByIndex(index)
        if field is not None and field.getTypeName() in ("SFNode", "MFNode"):
            yield NodeField(field.getName(), field, False)


def holds_solids(node: Any) -> bool:
    """Whether a walk yields it even without `everything`."""
    return node.getBaseTypeName() in WALKED


def find_inner_field(node: Any, name: str) -> Any | None:
    """A read-only field of the node that a PROTO node is made of; None where it has none."""
    # R2025a renamed what R2023b calls getProtoField.
    look = getattr(node, "getBaseNodeField", None) or getattr(node, "getProtoField", None)
    return None if look is None or not node.isProto() else look(name)


def find_field(node: Any, name: str) -> Any | None:
    """A field of a node: its own, or else one of the node that a PROTO node is made of."""
    field = node.getField(name)
    return find_inner_field(node, name) if field is None else field


def read_value(node: Any, name: str) -> Any | None:
    """The value of a single-valued field; None where the node has no such field."""
    field = find_field(node, name)
    return None if field is None or field.getCount() >= 0 else field.value


def entries(field: Any) -> Iterator[tuple[int | None, Any]]:
    """The nodes in a field, with their indices."""
    if field.getTypeName() == "SFNode":
        node = field.getSFNode()
        if node is not None:
            yield None, node
        return
    for index in range(field.getCount()):
        node = field.getMFNode(index)
        if node is not None:
            yield index, node


# -- paths: `ROVER.translation`, `BALL.children[0].appearance`, `#12.name` -------------------------
# A path begins with a DEF name, the name of a robot or another Solid, the type of a node at the
# top of the tree (`WorldInfo`), `root`, or `#` and a node's number. Names of fields and indices in
# brackets follow. For a path that leads nowhere the error lists the nearest existing names.


class Pace:
    """Interrupts a long reading of the scene, so that the controller's loop continues meanwhile."""

    def __init__(self) -> None:
        self._until_s = time.monotonic() + _SLICE_S

    def rest(self) -> Generator[None]:
        """Wait for the next round if the time of this one is used up."""
        if time.monotonic() > self._until_s:
            yield
            self._until_s = time.monotonic() + _SLICE_S


class Place(NamedTuple):
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
        return place._replace(path=path, field=field, definition="")
    inner = find_inner_field(node, step)
    if inner is not None:
        return place._replace(path=path, field=inner, is_hidden=True, definition="")
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
    count = field.getCount() if place.entry is None else -1
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
    return place._replace(path=path, entry=index)


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


# -- the actions that read -------------------------------------------------------------------------
# They ask Webots from within the controller's loop, for a few milliseconds per round.


def get_scene(robot: Any, params: dict[str, Any]) -> Progress:
    """The nodes of the tree, or below a `path`, that match `types` and `names`."""
    types, names = _patterns(params, "types"), _patterns(params, "names")
    seen: dict[str, None] = {}
    wanted = [each for each in _patterns(params, "fields") if each != "name"]  # shown anyway
    after = whole_number(params, "cursor", 0, 10**9, default=0)
    usual = DEEPEST if types or names else _USUAL_DEPTH
    depth = whole_number(params, "depth", 1, DEEPEST, default=usual)
    path = params.get("path")
    place = (yield from find_node(robot, path)) if path else None
    around = robot.getRoot() if place is None else place.node
    inside = bool(place or types or names)  # of PROTO nodes
    everything = not WALKED.issuperset(types)
    tree = walk(around, deepest=depth, inside=inside, everything=everything)
    rows, pace = _Rows(["depth", "path", "type", "name", *wanted]), Pace()
    shown, looked, definitions = list[tuple[tuple[int, ...], list[Any]]](), 0, set[str]()
    keys: dict[int, tuple[int, ...]] = {}
    for looked, found in enumerate(tree, 1):
        yield from pace.rest()
        # The walk is breadth first; these keys sort the answer's rows depth first, as a tree reads.
        before = keys.get(found.parent.id, ()) if found.parent else ()
        keys[found.id] = (*before, looked)
        row = _row(found, definitions, wanted)
        seen |= dict.fromkeys(_called(found) if names else _kinds(found))
        if looked <= after or not _matches(found, types, names):
            continue
        if not rows.fits(row):
            return rows.as_table([row for _, row in sorted(shown)]) | {"cursor": looked - 1}
        shown.append((keys[found.id], row))
    answer = rows.as_table([row for _, row in sorted(shown)]) | {"looked_at": looked}
    if (types or names) and not shown and not after:
        answer["nearest"] = nearest_first((names or types)[0], filter(None, seen))[:_MOST_NEAR]
    if place is not None:
        return answer | {"below": place.path}
    if types or names:
        return answer
    return answer | {"also_at_the_top": (yield from _others_at_the_top(around, pace))}


def _others_at_the_top(root: Any, pace: Pace) -> Generator[None, None, list[str]]:
    """The types of the top nodes that are neither solids nor groups: WorldInfo, lights."""
    field, others = children(root), dict[str, None]()
    for index in range(min(field.getCount(), _MOST_AT_THE_TOP)):
        yield from pace.rest()
        node = field.getMFNode(index)
        if node is not None and not holds_solids(node):
            others[str(node.getTypeName())] = None
    return [*others]


class _Rows:
    """The rows of an answer, limited in characters."""

    def __init__(self, columns: list[str]) -> None:
        self._columns = columns
        self._characters = 0

    def fits(self, row: list[Any]) -> bool:
        self._characters += len(json.dumps(row, default=str)) + 1
        return self._characters <= _MOST_CHARACTERS

    def as_table(self, rows: list[list[Any]]) -> dict[str, Any]:
        return {"columns": self._columns, "rows": rows}


def _row(found: SceneNode, definitions: set[str], wanted: list[str]) -> list[Any]:
    """A node's depth, unique path, type and name, and the values of the wanted fields."""
    path = found.definition if found.definition not in definitions else ""
    definitions.add(found.definition)
    kind = found.type_name
    if kind != found.base_type:
        kind = f"{kind} ({found.base_type})"
    if found.hidden:
        kind = f"{kind}, inside a PROTO"
    values = [_brief(find_field(found.node, each)) for each in wanted]
    return [found.depth + 1, path or f"#{found.id}", kind, found.name or None, *values]


def _matches(found: SceneNode, types: list[str], names: list[str]) -> bool:
    of_type = not types or _any_match(_kinds(found), types)
    return of_type and (not names or _any_match(_called(found), names))


def _kinds(found: SceneNode) -> tuple[str, str]:
    return found.type_name, found.base_type


def _called(found: SceneNode) -> tuple[str, str]:
    return found.definition, found.name or ""


def _any_match(texts: Iterable[str], patterns: list[str]) -> bool:
    """Whether one of the texts matches one of the patterns, ignoring case."""
    return any(fnmatchcase(text.lower(), each.lower()) for text in texts for each in patterns)


def get_field(robot: Any, params: dict[str, Any]) -> Progress:
    """The value of the field, or all fields of the node, at a `path`."""
    place = yield from find(robot, params.get("path"))
    start = whole_number(params, "start", 0, 10**9, default=0)
    facts: dict[str, Any] = {"path": place.path}
    if place.is_hidden:
        facts["read_only"] = "it is inside a PROTO"
    if place.field is None:
        return facts | (yield from _describe_node(place, start))
    facts["type"] = str(place.field.getTypeName()) if place.entry is None else place.type_name
    if place.field.getCount() >= 0 and place.entry is None:
        return facts | _describe_entries(place, start)
    return facts | {"value": _value(place.field, place.entry)}


def _describe_node(place: Place, start: int) -> Generator[None, None, dict[str, Any]]:
    node, pace, rows = place.node, Pace(), _Rows(["field", "type", "value"])
    facts = {"node": label(node), "id": int(node.getId())}
    if node.isProto():
        facts["proto_of"] = str(node.getBaseTypeName())
    shown: list[list[Any]] = []
    for index, field in enumerate(fields_of(node)):
        yield from pace.rest()
        row = [field.getName(), field.getTypeName(), _brief(field)]
        if index < start:
            continue
        if not rows.fits(row):
            return facts | rows.as_table(shown) | {"next_start": index}
        shown.append(row)
    return facts | rows.as_table(shown)


def _describe_entries(place: Place, start: int) -> dict[str, Any]:
    field = place.field
    assert field is not None
    count, size, shown = int(field.getCount()), 0, list[Any]()
    for index in range(start, min(start + _MOST_SHOWN, count)):
        value = _value(field, index)
        size += len(json.dumps(value)) + 1
        if size > _MOST_CHARACTERS:
            break
        shown.append(value)
    more = start + len(shown)
    return {"count": count, "values": shown} | ({"next_start": more} if more < count else {})


def _value(field: Any, index: int | None) -> Any:
    """A single value, or an entry; a node as its number and label."""
    if not str(field.getTypeName()).endswith("Node"):
        value = read(field, index)
        return cut(value, _MOST_CHARACTERS // 2) if isinstance(value, str) else value
    node = field.getSFNode() if index is None else field.getMFNode(index)
    return None if node is None else f"#{node.getId()} {label(node)}"


def _brief(field: Any) -> Any:
    """A value shortened for a table; of a list the first entries and their number."""
    if field is None:
        return None
    if field.getCount() < 0:
        value = _value(field, None)
        return cut(value, _LONGEST_TEXT) if isinstance(value, str) else value
    count = int(field.getCount())
    if str(field.getTypeName()) == "MFNode":
        return f"{count} nodes"
    first = read_entries(field, 0, _FIRST_ENTRIES)
    first = [cut(each, _LONGEST_TEXT) if isinstance(each, str) else each for each in first]
    return first if count <= len(first) else [*first, f"... {count} in all"]


def _patterns(params: dict[str, Any], name: str) -> list[str]:
    given = params.get(name)
    if given is None:
        return []
    if not isinstance(given, list) or not all(isinstance(e, str) for e in cast("list[Any]", given)):
        raise InvalidInputError(
            f'{name} must be a list of texts, such as ["Robot"], not {given!r:.80}'
        )
    texts = cast("list[str]", given)
    if len(texts) > _MOST_PATTERNS:
        raise InvalidInputError(
            f"{name} has {len(texts)} texts; at most {_MOST_PATTERNS} may be given"
        )
    return texts


# -- values of fields ------------------------------------------------------------------------------
# Webots' package accepts exact types only and reports others by printing, so every value is
# checked here first.


class _RefusedError(ValueError):
    """A value that a field cannot have."""


def _bool(value: object) -> bool:
    if not isinstance(value, bool):
        raise _RefusedError
    return value


def _int32(value: object) -> int:
    number = int(value) if isinstance(value, float) and value.is_integer() else value
    if isinstance(number, bool) or not isinstance(number, int) or not -(2**31) <= number < 2**31:
        raise _RefusedError
    return number


def _float(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _RefusedError
    if not abs(value) <= _LARGEST_FLOAT:  # NaN as well
        raise _RefusedError
    return float(value)


def _string(value: object) -> str:
    if isinstance(value, (list, dict)):  # a JSON text that the client's SDK has already parsed
        value = json.dumps(value, ensure_ascii=False)
    if not isinstance(value, str) or len(value) > MOST_CHARACTERS or "\0" in value:
        raise _RefusedError
    return value


def _floats(length: int) -> Callable[[object], list[float]]:
    def convert(value: object) -> list[float]:
        if not isinstance(value, list) or len(cast("list[Any]", value)) != length:
            raise _RefusedError
        return [_float(number) for number in cast("list[Any]", value)]

    return convert


def _color(value: object) -> list[float]:
    color = _floats(3)(value)
    if not all(0.0 <= part <= 1.0 for part in color):
        raise _RefusedError
    return color


def _rotation(value: object) -> list[float]:
    rotation = _floats(4)(value)
    if not any(rotation[:3]):
        raise _RefusedError
    return rotation


class _Kind(NamedTuple):
    convert: Callable[[object], Any]
    expected: str
    example: str


_KINDS: Final[dict[str, _Kind]] = {
    "Bool": _Kind(_bool, "true or false", "true"),
    "Int32": _Kind(_int32, "a whole number of 32 bits", "3"),
    "Float": _Kind(_float, "a finite number", "0.5"),
    "Vec2f": _Kind(_floats(2), "2 finite numbers", "[0.5, 1]"),
    "Vec3f": _Kind(_floats(3), "3 finite numbers", "[0, 0.5, 0.1]"),
    "Rotation": _Kind(_rotation, "an axis (not 0 0 0) and an angle in rad", "[0, 0, 1, 1.57]"),
    "Color": _Kind(_color, "red, green and blue, each from 0 to 1", "[1, 0.5, 0]"),
    "String": _Kind(_string, f"a text of at most {MOST_CHARACTERS} characters", '"text"'),
}


def require_no_path(field: str, value: object) -> None:
    """Refuse a path in a field that names a program: it could start one outside of the project.

    Raises:
        InvalidInputError: The value is a path.
    """
    if field not in _PROGRAMS or not isinstance(value, str):
        return
    if value == ".." or any(each in value for each in "/\\"):
        raise InvalidInputError(
            f"{field} must be the name of a program in its folder of the project, not a path: "
            f"{value!r:.200}"
        )


def checked(path: str, type_name: str, value: object) -> Any:
    """The value in the type that Webots' package accepts.

    Raises:
        InvalidInputError: The field at the path has another type; the text shows an example.
    """
    many, kind = type_name.startswith("MF"), _KINDS.get(type_name[2:])
    if kind is None:
        raise InvalidInputError(
            f"{path} contains nodes ({type_name}): webots_edit_scene adds and removes them; "
            f"to set a field of a node in it, extend the path, such as {path}"
            f"{'[0]' if many else ''}.name"
        )
    try:
        if not many:
            return kind.convert(value)
        values = cast("list[Any]", value)
        if not isinstance(value, list) or len(values) > MOST_ENTRIES:
            raise _RefusedError
        return [kind.convert(each) for each in values]
    except _RefusedError:
        expected = f"{kind.expected}, such as {kind.example}"
        if many:
            expected = f"a list of at most {MOST_ENTRIES}, each {expected}: [{kind.example}]"
        raise InvalidInputError(
            f"{path} is of type {type_name}: give {expected}; got {value!r:.100}"
        ) from None


def read(field: Any, index: int | None = None) -> Any:
    """The value of a field that holds no nodes, or one of its entries."""
    kind = str(field.getTypeName())[2:]
    if field.getCount() < 0:
        return _plain(kind, getattr(field, f"getSF{kind}")())
    get = getattr(field, f"getMF{kind}")
    if index is not None:
        return _plain(kind, get(index))
    return [_plain(kind, get(each)) for each in range(field.getCount())]


def read_entries(field: Any, start: int, most: int) -> list[Any]:
    """Up to `most` entries of a multi-valued field, from index `start` on."""
    return [read(field, index) for index in range(start, min(start + most, field.getCount()))]


def _plain(kind: str, value: Any) -> Any:
    return bool(value) if kind == "Bool" else value


def write(field: Any, value: Any, index: int | None = None) -> None:
    """Set a field, or one entry of it, to a checked value; Webots does so with the next step."""
    kind = str(field.getTypeName())[2:]
    if field.getCount() < 0:
        getattr(field, f"setSF{kind}")(value)
    elif index is not None:
        getattr(field, f"setMF{kind}")(index, value)
    else:
        _write_all(field, kind, value)


def _write_all(field: Any, kind: str, values: Sequence[Any]) -> None:
    """Set the existing entries, then insert missing ones or remove surplus ones."""
    set_entry, count = getattr(field, f"setMF{kind}"), field.getCount()
    for index, value in enumerate(values[:count]):
        set_entry(index, value)
    for index in range(count, len(values)):
        getattr(field, f"insertMF{kind}")(index, values[index])
    for index in range(count - 1, len(values) - 1, -1):
        field.removeMF(index)


def is_same(type_name: str, one: Any, other: Any) -> bool:
    """Whether two values of a field are equal within the precision that Webots stores."""
    if type_name.startswith("MF"):
        single = f"SF{type_name[2:]}"
        return len(one) == len(other) and all(map(lambda a, b: is_same(single, a, b), one, other))
    return _distance(type_name, one, other) == 0.0


def is_nearer(type_name: str, value: Any, wanted: Any, before: Any) -> bool:
    """Whether a value is closer to the wanted one than to the one before.

    Physics may have changed it since it was set, so that it equals neither.
    """
    if type_name.startswith("MF") or type_name[2:] in ("Bool", "Int32", "String"):
        return is_same(type_name, value, wanted)
    from_before = _distance(type_name, value, before)
    return _distance(type_name, value, wanted) <= from_before and from_before > 0.0


def _distance(type_name: str, one: Any, other: Any) -> float:
    """The distance of two single values; 0 within the precision that Webots stores."""
    if type_name[2:] in ("Bool", "Int32", "String"):
        return float(one != other)
    a, b = _as_vector(type_name, one), _as_vector(type_name, other)
    apart = math.dist(a, b)
    if type_name == "SFRotation":  # a quaternion and its negative are one rotation
        apart = min(apart, math.dist(a, [-part for part in b]))
    return apart if apart > _TOLERANCE * max(1.0, *map(abs, a)) else 0.0


def _as_vector(type_name: str, value: Any) -> list[float]:
    if type_name == "SFFloat":
        return [value]
    return _quaternion(value) if type_name == "SFRotation" else value


def _quaternion(rotation: Sequence[float]) -> list[float]:
    *axis, angle_rad = rotation
    length = math.hypot(*axis) or 1.0
    sine = math.sin(angle_rad / 2.0) / length
    return [math.cos(angle_rad / 2.0), *(sine * part for part in axis)]
