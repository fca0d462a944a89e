"""The built-in actions that read the scene tree: find nodes, read a field or the fields of a node.

They ask Webots from within the controller's loop, for a few milliseconds in each of its rounds.
"""

from __future__ import annotations

import json
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Final, cast

from webots_mcp.bridge.claimed_commands import Progress, whole_number
from webots_mcp.bridge.error_report import cut
from webots_mcp.bridge.field_values import read, read_entries
from webots_mcp.bridge.scene_nodes import (
    DEEPEST,
    WALKED,
    SceneNode,
    children,
    fields_of,
    find_field,
    holds_solids,
    label,
    walk,
)
from webots_mcp.bridge.scene_paths import Pace, PathTarget, find, find_node
from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.naming import nearest_first


@dataclass(frozen=True)
class SceneAnswerLimits:
    """How much of the scene an answer shows.

    Attributes:
        characters: Characters of an answer's rows; the server would shorten more.
        entries: Entries of a field that is read alone.
        first_entries: Entries of a field in a table.
        text_characters: Characters of a text in a table.
        usual_depth: Levels of the tree without a search.
        top_nodes: Nodes at the top of the tree.
        patterns: Patterns of one kind in a search.
        nearest: Types or names that are listed if none matches.
    """

    characters: int = 2_600
    entries: int = 50
    first_entries: int = 3
    text_characters: int = 80
    usual_depth: int = 2
    top_nodes: int = 200
    patterns: int = 20
    nearest: int = 10


_LIMITS: Final = SceneAnswerLimits()


def get_scene(robot: Any, params: dict[str, Any]) -> Progress:
    """Find the nodes of the tree, or below a `path`, that match `types` and `names`."""
    types, names = _patterns(params, "types"), _patterns(params, "names")
    seen: dict[str, None] = {}
    wanted = [each for each in _patterns(params, "fields") if each != "name"]  # shown anyway
    after = whole_number(params, "cursor", 0, 10**9, default=0)
    usual = DEEPEST if types or names else _LIMITS.usual_depth
    depth = whole_number(params, "depth", 1, DEEPEST, default=usual)
    path = params.get("path")
    target = (yield from find_node(robot, path)) if path else None
    around = robot.getRoot() if target is None else target.node
    inside = bool(target or types or names)  # of PROTO nodes
    everything = not WALKED.issuperset(types)
    tree = walk(around, deepest=depth, inside=inside, everything=everything)
    rows, pace = _Rows(["depth", "path", "type", "name", *wanted]), Pace()
    shown, visited, definitions = list[tuple[tuple[int, ...], list[Any]]](), 0, set[str]()
    keys: dict[int, tuple[int, ...]] = {}
    for visited, found in enumerate(tree, 1):
        yield from pace.rest()
        # The walk is breadth first; these keys sort the answer's rows depth first, as a tree reads.
        before = keys.get(found.parent.id, ()) if found.parent else ()
        keys[found.id] = (*before, visited)
        row = _row(found, definitions, wanted)
        seen |= dict.fromkeys(_called(found) if names else _kinds(found))
        if visited <= after or not _matches(found, types, names):
            continue
        if not rows.fits(row):
            return rows.as_table([row for _, row in sorted(shown)]) | {"cursor": visited - 1}
        shown.append((keys[found.id], row))
    answer = rows.as_table([row for _, row in sorted(shown)]) | {"looked_at": visited}
    if (types or names) and not shown and not after:
        answer["nearest"] = nearest_first((names or types)[0], filter(None, seen))[
            : _LIMITS.nearest
        ]
    if target is not None:
        return answer | {"below": target.path}
    if types or names:
        return answer
    return answer | {"also_at_the_top": (yield from _others_at_the_top(around, pace))}


def get_field(robot: Any, params: dict[str, Any]) -> Progress:
    """Read the field, or all fields of the node, at a `path`."""
    target = yield from find(robot, params.get("path"))
    start = whole_number(params, "start", 0, 10**9, default=0)
    facts: dict[str, Any] = {"path": target.path}
    if target.is_hidden:
        facts["read_only"] = "it is inside a PROTO"
    if target.field is None:
        return facts | (yield from _describe_node(target, start))
    facts["type"] = str(target.field.getTypeName()) if target.entry is None else target.type_name
    if target.field.getCount() >= 0 and target.entry is None:
        return facts | _describe_entries(target, start)
    return facts | {"value": _value(target.field, target.entry)}


def _others_at_the_top(root: Any, pace: Pace) -> Generator[None, None, list[str]]:
    """List the types of the top nodes that are neither solids nor groups: WorldInfo, lights."""
    field, others = children(root), dict[str, None]()
    for index in range(min(field.getCount(), _LIMITS.top_nodes)):
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
        return self._characters <= _LIMITS.characters

    def as_table(self, rows: list[list[Any]]) -> dict[str, Any]:
        return {"columns": self._columns, "rows": rows}


def _row(found: SceneNode, definitions: set[str], wanted: list[str]) -> list[Any]:
    """Return a node's depth, unique path, type, name, and the values of the wanted fields."""
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
    """Return whether a text matches a pattern, ignoring case."""
    return any(fnmatchcase(text.lower(), each.lower()) for text in texts for each in patterns)


def _describe_node(target: PathTarget, start: int) -> Generator[None, None, dict[str, Any]]:
    node, pace, rows = target.node, Pace(), _Rows(["field", "type", "value"])
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


def _describe_entries(target: PathTarget, start: int) -> dict[str, Any]:
    field = target.field
    assert field is not None
    count, size, shown = int(field.getCount()), 0, list[Any]()
    for index in range(start, min(start + _LIMITS.entries, count)):
        value = _value(field, index)
        size += len(json.dumps(value)) + 1
        if size > _LIMITS.characters:
            break
        shown.append(value)
    more = start + len(shown)
    return {"count": count, "values": shown} | ({"next_start": more} if more < count else {})


def _value(field: Any, index: int | None) -> Any:
    """Read a single value or an entry; a node is its number and label."""
    if not str(field.getTypeName()).endswith("Node"):
        value = read(field, index)
        return cut(value, _LIMITS.characters // 2) if isinstance(value, str) else value
    node = field.getSFNode() if index is None else field.getMFNode(index)
    return None if node is None else f"#{node.getId()} {label(node)}"


def _brief(field: Any) -> Any:
    """Read a value shortened for a table; of a list the first entries and their number."""
    if field is None:
        return None
    if field.getCount() < 0:
        value = _value(field, None)
        return cut(value, _LIMITS.text_characters) if isinstance(value, str) else value
    count = int(field.getCount())
    if str(field.getTypeName()) == "MFNode":
        return f"{count} nodes"
    first = read_entries(field, 0, _LIMITS.first_entries)
    first = [
        cut(each, _LIMITS.text_characters) if isinstance(each, str) else each for each in first
    ]
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
    if len(texts) > _LIMITS.patterns:
        raise InvalidInputError(
            f"{name} has {len(texts)} texts; at most {_LIMITS.patterns} may be given"
        )
    return texts
