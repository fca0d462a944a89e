"""Reads the VRML dialect of .wbt and .proto files into trees of nodes with typed fields.

A node of a PROTO becomes what it stands for.

StandInError
├── WorldError            the world file cannot be used; names the line
├── WouldBlockError       the call would wait for ever: the simulation is paused
└── ControllerEndedError  the API was used after `step` had returned -1
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from math import cos, pi, sin, tan
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias, cast

DATA: Final = Path(__file__).with_name("data")
"""The folder of the node types and of the PROTO nodes that are built in."""

Value: TypeAlias = "bool | str | WorldNode | list[float] | list[Value] | None"
"""A field as written: numbers are always a list of floats, `[...]` is a list of anything."""
NUMBERS_IN: Final = {"Vec2f": 2, "Vec3f": 3, "Color": 3, "Rotation": 4}
"""How many numbers make one value of a type; all other types take one."""

_FIELD_KEYWORDS: Final = (
    *("field", "vrmlField", "w3dField", "exposedField"),
    *("unconnectedField", "hiddenField", "deprecatedField"),
)
_FIRST_RELEASE: Final = "R2022"
"""The oldest one with the axes of today."""

_TOKEN: Final = re.compile(r'[\s,]+|#[^\n]*|(?P<token>"(?:[^"\\]|\\.)*"|[\[\]{}]|[^\s\[\]{}",#]+)')
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\Z")
_NAME: Final = re.compile(r"[A-Za-z_][^\s\"'#,.\[\]\\{}]*\Z")
_WORDS: Final[dict[str, bool | None]] = {"TRUE": True, "FALSE": False, "NULL": None}
HOME_VARIABLE: Final = "WEBOTS_HOME"
BUILT_IN: Final = sorted(file.stem for file in DATA.glob("*.proto"))
_OF_WEBOTS: Final = re.compile(
    r"(?:webots://|https://raw\.githubusercontent\.com/cyberbotics/webots/[^/]+/)(projects/.+)"
)


class FieldDefinition(NamedTuple):
    """What a node type says about one of its fields."""

    type_name: str
    """`SFVec3f`, `MFNode` and so on."""
    default: Value
    """As written."""
    is_hidden: bool = False
    """Whether only the PROTO itself uses it."""


class Token(NamedTuple):
    """A word of the file and the line it stands on."""

    text: str
    line: int


@dataclass(eq=False)
class WorldNode:
    """A node of the scene tree; the parser fills in the fields that the file names, as `Value`s."""

    type_name: str
    def_name: str
    line: int
    fields: dict[str, Any] = field(default_factory=lambda: {})
    proto_name: str = ""
    """Of a PROTO node that was built: its own name; its type is that of what it is made of."""
    parameters: frozenset[str] = frozenset()
    """Fields that a PROTO node has and its base node has not; the nodes in them stand in that."""


def children_of(node: WorldNode) -> Iterator[WorldNode]:
    """The nodes in the fields of a node, in the order of the file."""
    for name, value in node.fields.items():
        if name in node.parameters:
            continue
        if isinstance(value, WorldNode):
            yield value
        elif isinstance(value, list):
            items = cast("list[Any]", value)
            yield from (item for item in items if isinstance(item, WorldNode))


def descendants_of(node: WorldNode) -> Iterator[WorldNode]:
    """Everything inside a node, from the top of the file to the bottom."""
    for child in children_of(node):
        yield child
        yield from descendants_of(child)


def tokens_of(text: str) -> Iterator[Token]:
    """Split a world into words; comments, commas and white space fall away."""
    line, position = 1, 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            raise WorldError(f"unexpected character {text[position]!r}", line)
        if word := match["token"]:
            yield Token(word, line)
        line += match[0].count("\n")
        position = match.end()


class StandInError(Exception):
    """Anything the stand-in refuses to do."""


class WorldError(StandInError):
    """A world file that the stand-in cannot use."""

    def __init__(self, message: str, line: int | None = None) -> None:
        super().__init__(message if line is None else f"line {line}: {message}")
        self.line = line


class WouldBlockError(StandInError):
    """An in-process `step` that would never return, because the simulation is paused."""


class RequestAfterEndError(StandInError):
    """The API was used after `step` had returned -1.

    A controller process would end here without a word (C `exit`); in process that would end the
    whole test run, hence an exception.
    """


class Parser:
    """Recursive descent over the words of one file."""

    def __init__(
        self,
        text: str | Sequence[Token],
        given: Mapping[str, Value] | None = None,
        line: int | None = None,
    ) -> None:
        """Begin at the first word.

        Args:
            text: The text, or the words of a PROTO's body.
            given: Of a PROTO's body the values of its fields, for `IS`.
            line: Where the PROTO node stands in the world: that of all nodes in the body.
        """
        self._tokens = [*tokens_of(text)] if isinstance(text, str) else text
        self._given = given
        self._line = line
        self._next = 0
        self._defined: dict[str, WorldNode] = {}
        self.urls: dict[str, str] = {}
        """Where the file says that PROTOs come from, by their names."""
        self._last_line = self._tokens[-1].line if self._tokens else 1

    def nodes(self) -> list[WorldNode]:
        """The nodes at the top of the file, in order."""
        nodes: list[WorldNode] = []
        while self._next < len(self._tokens):
            if not self._takes_externproto():
                line = self._tokens[self._next].line
                try:
                    nodes.append(self._node())
                except RecursionError:
                    why = "this node holds more, one in the other, than the stand-in can read"
                    raise WorldError(why, line) from None
        return nodes

    def _takes_externproto(self) -> bool:
        """Read `EXTERNPROTO "url"`, if that comes next."""
        if self._peek().text == "IMPORTABLE":
            self._take()
        if self._peek().text != "EXTERNPROTO":
            return False
        token = self._take()
        if not self._peek().text.startswith('"'):
            raise WorldError("EXTERNPROTO has no URL", token.line)
        url = self._take().text.strip('"')
        self.urls[url.rpartition("/")[2].removesuffix(".proto")] = url
        return True

    def definitions(self, end: str) -> dict[str, FieldDefinition]:
        """The fields of a node type, up to a closing bracket."""
        found: dict[str, FieldDefinition] = {}
        while (token := self._take()).text != end:
            keyword = token.text if token.text in _FIELD_KEYWORDS else ""
            type_token = self._take() if keyword else token
            if self._peek().text == "{":  # the values that are allowed
                self._skip_braces()
            name = self._name("a field name")
            found[name.text] = FieldDefinition(
                type_token.text, self._value(name), keyword == "hiddenField"
            )
        return found

    def _skip_braces(self) -> None:
        depth = 0
        while True:
            depth += {"{": 1, "}": -1}.get(self._take().text, 0)
            if depth == 0:
                return

    def types(self) -> dict[str, dict[str, FieldDefinition]]:
        """Fields by node type, from a text as Webots writes its node files."""
        known: dict[str, dict[str, FieldDefinition]] = {}
        while self._next < len(self._tokens):
            name = self._take().text
            self._take()
            known[name] = self.definitions("}")
        return known

    def proto(self) -> tuple[str, dict[str, FieldDefinition], Sequence[Token]]:
        """The definition of a PROTO: its name, its fields and the words of its body."""
        while self._takes_externproto():
            pass
        if self._take().text != "PROTO":
            raise WorldError("there is no PROTO definition", self._last_line)
        name = self._name("the name of a PROTO").text
        self._take()
        fields = self.definitions("]")
        start = self._next + 1
        self._skip_braces()
        return name, fields, self._tokens[start : self._next - 1]

    def _peek(self) -> Token:
        if self._next == len(self._tokens):
            raise WorldError("the file ends in the middle of a node", self._last_line)
        return self._tokens[self._next]

    def _take(self) -> Token:
        token = self._peek()
        self._next += 1
        return token

    def _name(self, what: str) -> Token:
        token = self._take()
        if not _NAME.match(token.text):
            raise WorldError(f"expected {what}, found {token.text!r}", token.line)
        return token

    def _node(self) -> WorldNode:
        token = self._name("a node")
        if token.text == "USE":
            return self._used()
        if token.text == "PROTO":
            raise WorldError("a world holds no PROTO definitions, they have own files", token.line)
        if token.text != "DEF":
            return self._body(token, "")
        name = self._name("a DEF name").text
        return self._body(self._name("a node type"), name)

    def _used(self) -> WorldNode:
        token = self._name("a DEF name")
        if token.text not in self._defined:
            raise WorldError(f"USE {token.text} comes before any DEF {token.text}", token.line)
        return self._defined[token.text]

    def _body(self, type_token: Token, def_name: str) -> WorldNode:
        is_inner = self._line is not None  # in a PROTO: not to be found from outside
        line = type_token.line if self._line is None else self._line
        node = WorldNode(type_token.text, "" if is_inner else def_name, line)
        brace = self._take()
        if brace.text != "{":
            raise WorldError(
                f"expected {{ after {node.type_name}, found {brace.text!r}", brace.line
            )
        while self._peek().text != "}":
            token = self._name("a field name or }")
            if token.text == "hidden":  # what Webots keeps of a saved simulation
                self._value(self._take())
            else:
                node.fields[token.text] = self._value(token)
        self._take()
        if def_name:
            self._defined[def_name] = node
        return node

    def _value(self, owner: Token) -> Value:
        token = self._peek()
        if token.text == "IS" and self._given is not None:
            return self._is_value()
        if token.text == "[":
            return self._list(owner)
        if _NUMBER.match(token.text):
            return self._numbers()
        if token.text in _WORDS or token.text.startswith('"'):
            return _word(self._take())
        if token.text in "]{}":
            raise WorldError(f"field {owner.text} has no value", token.line)
        return self._node()

    def _is_value(self) -> Value:
        self._take()
        name = self._name("a field of the PROTO")
        if self._given is None or name.text not in self._given:
            raise WorldError(f"the PROTO has no field {name.text}", name.line)
        value = self._given[name.text]
        return [*value] if isinstance(value, list) else value  # pyright: ignore[reportReturnType]

    def _numbers(self) -> list[float]:
        numbers: list[float] = []
        while _NUMBER.match(self._peek().text):
            numbers.append(float(self._take().text))
        return numbers

    def _list(self, owner: Token) -> list[Value] | list[float]:
        self._take()
        if _NUMBER.match(self._peek().text):
            numbers = self._numbers()
            self._close(owner)
            return numbers
        values: list[Value] = []
        while self._peek().text != "]":
            values.append(self._value(owner))
        self._close(owner)
        return values

    def _close(self, owner: Token) -> None:
        token = self._take()
        if token.text != "]":
            raise WorldError(f"field {owner.text}: expected ], found {token.text!r}", token.line)


def _word(token: Token) -> bool | str | None:
    if token.text in _WORDS:
        return _WORDS[token.text]
    return re.sub(r"\\(.)", r"\1", token.text[1:-1])


def require_release(text: str, what: str = "world") -> None:
    """Read the first line of a file.

    Raises:
        WorldError: It is none of Webots', or of a release with other axes.
    """
    first, first_line = "#VRML_SIM R2023b utf8", text.partition("\n")[0]
    release = re.match(r"#VRML_SIM (R20\d\d)[ab]?\S* utf8", first_line)
    if release is None:
        raise WorldError(f'a {what} begins with "{first}", not {first_line[:40]!r}', 1)
    if release[1] < _FIRST_RELEASE:
        raise WorldError(
            f"{what}s of {release[1]} have other axes: "
            "open and save it with Webots R2022a or newer",
            1,
        )


NODE_TYPES: Final = Parser((DATA / "nodes.txt").read_text(encoding="utf-8")).types()
"""Fields by node type."""


def give_types(node: WorldNode, definitions: Mapping[str, FieldDefinition]) -> None:
    """Give a node all fields that its type has, with values of their types.

    Raises:
        WorldError: A value is of another type; names the field and the line.
    """
    written = node.fields
    node.fields = {}
    for name, definition in definitions.items():
        value = written[name] if name in written else deepcopy(definition.default)
        node.fields[name] = _typed(value, name, definition, node)


def _typed(value: Value, name: str, definition: FieldDefinition, node: WorldNode) -> Value:
    many, kind = definition.type_name[:2] == "MF", definition.type_name[2:]
    try:
        if not many:
            return _single(value, kind)
        if kind in ("String", "Node", "Bool"):
            values: list[Any] = value if isinstance(value, list) else [value]
            return [_single(item, kind) for item in values]
        return _several_numbers(value, kind)
    except (TypeError, ValueError):
        raise WorldError(
            f"{node.type_name}.{name} has to be {definition.type_name}, not {_shown(value)}",
            node.line,
        ) from None


def _single(value: Value, kind: str) -> Any:
    if kind in ("Bool", "String", "Node"):
        expected = {"Bool": bool, "String": str, "Node": (WorldNode, type(None))}[kind]
        if not isinstance(value, expected):
            raise TypeError(kind)
        return value
    numbers = _numbers(value)
    if len(numbers) != NUMBERS_IN.get(kind, 1):
        raise ValueError(kind)
    if kind in NUMBERS_IN:
        return numbers
    return int(numbers[0]) if kind == "Int32" else numbers[0]


def _several_numbers(value: Value, kind: str) -> Value:
    numbers = _numbers(value)
    size = NUMBERS_IN.get(kind, 1)
    if len(numbers) % size:
        raise ValueError(kind)
    if size == 1:
        return numbers
    return [numbers[i : i + size] for i in range(0, len(numbers), size)]


def _numbers(value: Any) -> list[float]:
    """Numbers one after the other; those of a field that was given its type already, too."""
    if isinstance(value, list):
        return [number for item in cast("list[Any]", value) for number in _numbers(item)]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError("numbers")
    return [float(value)]


def _shown(value: Value) -> str:
    return f"a {value.type_name} node" if isinstance(value, WorldNode) else repr(value)


# -- what a PROTO stands for -----------------------------------------------------------------------
#
# PROTO nodes that most worlds have are built in, with the sizes and defaults of Webots and without
# its looks (`data/*.proto`). Others are read from their files: those that the world names by
# EXTERNPROTO, those of its project's `protos/`, and those of the Webots that WEBOTS_HOME names.
# Files that are templates in JavaScript are not read.


"""The names of those that need no file of Webots."""


@dataclass(frozen=True)
class Proto:
    """The definition of a PROTO node."""

    file: Path
    fields: Mapping[str, FieldDefinition]
    body: Sequence[Token]

    @property
    def base_type(self) -> str:
        """The type of the node that it is made of."""
        words = [token.text for token in self.body[:3]]
        return words[2] if words[0] == "DEF" else words[0]

    @property
    def shown(self) -> dict[str, FieldDefinition]:
        """The fields that a world sets and a supervisor sees."""
        return {name: each for name, each in self.fields.items() if not each.is_hidden}


class Protos:
    """The PROTO nodes that a world may have."""

    def __init__(self, world: Path, urls: Mapping[str, str]) -> None:
        self._project = world.parent.parent / "protos"
        self._files: dict[str, Path] = {}
        self._known: dict[str, Proto | None] = {}
        self.urls: dict[str, str] = {}
        """What EXTERNPROTO says, by name."""
        self.why_not: dict[str, str] = {}
        """Why the file of a PROTO cannot be used, by its name."""
        self._note(urls, world.parent)

    def find(self, name: str) -> Proto | None:
        """The definition of a PROTO; None where there is none that the stand-in can use."""
        if name not in self._known:
            self._known[name] = None  # one that is made of itself is made of nothing
            self._known[name] = self._read(name)
        return self._known[name]

    def _read(self, name: str) -> Proto | None:
        file = self._file_of(name)
        if file is None:
            return None
        try:
            text = file.read_text(encoding="utf-8")
            require_release(text, "PROTO file")
            if re.search(r"%[<{]", text):
                raise WorldError("it is a template in JavaScript")
            parser = Parser(text)
            _, fields, body = parser.proto()
        except (OSError, ValueError, WorldError) as error:
            self.why_not[name] = f"{file.name}: {error}"
            return None
        self._note(parser.urls, file.parent)
        proto = Proto(file, fields, body)
        if proto.base_type in NODE_TYPES or self.find(proto.base_type):
            return proto
        self.why_not[name] = f"{file.name}: it is made of a {proto.base_type} node"
        return None

    def _note(self, urls: Mapping[str, str], folder: Path) -> None:
        for name, url in urls.items():
            self.urls.setdefault(name, url)
            of_webots = _OF_WEBOTS.fullmatch(url)
            if of_webots and self._home:
                self._files.setdefault(name, self._home / of_webots[1])
            elif "://" not in url:
                self._files.setdefault(name, folder / url)

    def _file_of(self, name: str) -> Path | None:
        if name in BUILT_IN:
            return DATA / f"{name}.proto"
        if name in self._files:
            return self._files[name]
        if "/" not in name and (self._project / f"{name}.proto").is_file():
            return self._project / f"{name}.proto"
        return self._installed.get(name)

    @cached_property
    def _home(self) -> Path | None:
        """The folder of the installed Webots that holds `projects`."""
        home = Path(os.environ.get(HOME_VARIABLE) or "/nowhere")
        return next(
            (root for root in (home, home / "Contents") if (root / "projects").is_dir()), None
        )

    @cached_property
    def _installed(self) -> dict[str, Path]:
        """The files of the installed Webots by name, for worlds without EXTERNPROTO."""
        files = (self._home / "projects").rglob("*.proto") if self._home else ()
        return {file.stem: file for file in files}

    def build(self, node: WorldNode) -> None:
        """Make a PROTO node what it stands for; its own fields and those of its base are there.

        Raises:
            WorldError: A field has a value of another type, or the body is not understood.
        """
        proto = self.find(node.type_name)
        assert proto is not None
        give_types(node, proto.shown)
        own = {name: each.default for name, each in proto.fields.items() if each.is_hidden}
        derive = _DERIVED.get(node.type_name) if proto.file.parent == DATA else None
        given = deepcopy(own) | node.fields | (derive(node.fields) if derive else {})
        try:
            (base,) = Parser(proto.body, given, node.line).nodes()
        except (WorldError, ValueError) as error:
            raise WorldError(f"{proto.file.name}: {error}", node.line) from None
        if base.type_name in NODE_TYPES:
            give_types(base, NODE_TYPES[base.type_name])
        else:
            self.build(base)
        node.parameters = frozenset(node.fields.keys() - base.fields.keys()) | base.parameters
        node.fields = node.fields | base.fields
        node.proto_name, node.type_name = node.type_name, base.type_name

    def shown_definitions(self, node: WorldNode) -> Mapping[str, FieldDefinition]:
        """The fields that a supervisor sees of a node: of a PROTO node its own."""
        proto = self.find(node.proto_name) if node.proto_name else None
        return proto.shown if proto else NODE_TYPES[node.type_name]


# Values of the built-in ones that are computed from their fields ----------------------------------


def _e_puck(fields: Mapping[str, Any]) -> dict[str, Any]:
    is_second = fields["version"] == "2"
    return {
        "maxVelocity": 7.536 if is_second else 6.28,
        "mass": 0.13 if is_second else 0.15,
        "model": f"GCtronic e-puck{'2' if is_second else ''}",
    }


def _loose_box(fields: Mapping[str, Any]) -> dict[str, Any]:
    physics = WorldNode("Physics", "", 0, {"density": [-1.0], "mass": [fields["mass"]]})
    return {"physics": physics if fields["mass"] > 0.0 else None}


def _rectangle_arena(fields: Mapping[str, Any]) -> dict[str, Any]:
    (x, y), thickness, height = fields["floorSize"], fields["wallThickness"], fields["wallHeight"]
    east, north, z = (x + thickness) / 2.0, (y + thickness) / 2.0, height / 2.0
    return {
        **{"east": [east, 0.0, z], "west": [-east, 0.0, z]},
        **{"north": [0.0, north, z], "south": [0.0, -north, z]},
        **{"alongX": [x + 2.0 * thickness, thickness, height], "alongY": [thickness, y, height]},
    }


def _circle_arena(fields: Mapping[str, Any]) -> dict[str, Any]:
    radius, thickness, height = fields["radius"], fields["wallThickness"], fields["wallHeight"]
    count = max(fields["subdivision"], 8)
    middle_m = radius + thickness / 2.0
    length_m = 2.0 * (radius + thickness) * tan(pi / count)
    walls: list[WorldNode] = []
    for angle in (2.0 * pi * i / count for i in range(count)):
        place = [middle_m * cos(angle), middle_m * sin(angle), height / 2.0]
        wall: dict[str, Any] = {"translation": place, "rotation": [0.0, 0.0, 1.0, angle]}
        wall |= {"size": [thickness, length_m, height], "name": "wall"}
        wall["appearance"] = fields["wallAppearance"]
        walls.append(WorldNode("SolidBox", "", 0, wall))
    return {"floorSize": [2.0 * radius, 2.0 * radius], "walls": walls}


_DERIVED: Final[dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]]] = {
    "CardboardBox": _loose_box,
    "CircleArena": _circle_arena,
    "E-puck": _e_puck,
    "RectangleArena": _rectangle_arena,
    "Wall": lambda fields: {"middle": [0.0, 0.0, fields["size"][2] / 2.0]},
    "WoodenBox": _loose_box,
    "Youbot": lambda fields: {} if fields["numberOfArms"] else {"arm": []},
}
