"""The parser of the VRML dialect of .wbt and .proto files.

It makes trees of nodes, whose fields `give_types` turns into Python values of their types.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias, cast

from webots_mcp.worlds.world_errors import WorldFileError

Value: TypeAlias = "bool | str | WorldNode | list[float] | list[Value] | None"
"""A field as written: numbers are always a list of floats, `[...]` is a list of any values."""
NUMBERS_IN: Final = {"Vec2f": 2, "Vec3f": 3, "Color": 3, "Rotation": 4}
"""Numbers in one value of a type; all other types take one."""

_FIELD_KEYWORDS: Final = (
    *("field", "vrmlField", "w3dField", "exposedField"),
    *("unconnectedField", "hiddenField", "deprecatedField"),
)
"""The oldest release with the present axes."""

_TOKEN: Final = re.compile(r'[\s,]+|#[^\n]*|(?P<token>"(?:[^"\\]|\\.)*"|[\[\]{}]|[^\s\[\]{}",#]+)')
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\Z")
_NAME: Final = re.compile(r"[^\s0-9\"'#+,.\-\[\]\\{}\x7f][^\s\"'#,.\[\]\\{}\x7f]*\Z")
"""A name as VRML97 has it: letters of any language."""
_WORDS: Final[dict[str, bool | None]] = {"TRUE": True, "FALSE": False, "NULL": None}


class FieldDefinition(NamedTuple):
    """The definition of a field in a node type."""

    type_name: str
    """`SFVec3f`, `MFNode` and so on."""
    default: Value
    """The default as written."""
    is_hidden: bool = False
    """Whether only the PROTO itself uses the field."""


class Token(NamedTuple):
    """A word of the file and its line."""

    text: str
    line: int


@dataclass(eq=False)
class WorldNode:
    """A node of the scene tree. The parser sets the fields that the file names, as `Value`s."""

    type_name: str
    def_name: str
    line: int
    fields: dict[str, Any] = field(default_factory=lambda: {})
    proto_name: str = ""
    """Name of the PROTO, if it was built from one. Its type is then that of its base node."""
    parameters: frozenset[str] = frozenset()
    """Fields that only the PROTO has. Nodes in them are part of the base node as well."""
    field_lines: dict[str, int] = field(default_factory=lambda: {})
    """Line of each field that the file names."""
    file: Path | None = None
    """The file that the node was read from, if the parser was given one."""
    hidden: dict[str, Value] = field(default_factory=lambda: {})
    """Fields that Webots writes where a simulation in motion is saved, such as velocities."""


def children_of(node: WorldNode) -> Iterator[WorldNode]:
    """Yield the nodes in the fields of a node, in the order of the file."""
    for name, value in node.fields.items():
        if name in node.parameters:
            continue
        if isinstance(value, WorldNode):
            yield value
        elif isinstance(value, list):
            items = cast("list[Any]", value)
            yield from (item for item in items if isinstance(item, WorldNode))


def descendants_of(node: WorldNode) -> Iterator[WorldNode]:
    """Yield every node inside a node, in the order of the file."""
    for child in children_of(node):
        yield child
        yield from descendants_of(child)


def tokens_of(text: str) -> Iterator[Token]:
    """Split a world into words, without comments, commas and white space."""
    line, position = 1, 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            raise WorldFileError(f"unexpected character {text[position]!r}", line)
        if word := match["token"]:
            yield Token(word, line)
        line += match[0].count("\n")
        position = match.end()


class Parser:
    """A recursive-descent parser of the words of one file."""

    def __init__(
        self,
        text: str | Sequence[Token],
        given: Mapping[str, Value] | None = None,
        line: int | None = None,
        file: Path | None = None,
    ) -> None:
        """Begin at the first word.

        Args:
            text: The text, or the words of a PROTO's body.
            given: Values of the fields of a PROTO, for `IS` in its body.
            line: Line of the PROTO node in the world, which all nodes of the body are given.
            file: The file that the text is from, which all nodes are given.
        """
        self._tokens = [*tokens_of(text)] if isinstance(text, str) else text
        self._given = given
        self._line = line
        self._file = file
        self._next = 0
        self._defined: dict[str, WorldNode] = {}
        self.urls: dict[str, str] = {}
        """URLs of PROTOs by name, from EXTERNPROTO."""
        self._last_line = self._tokens[-1].line if self._tokens else 1

    def nodes(self) -> list[WorldNode]:
        """Return the nodes at the top of the file, in order."""
        nodes: list[WorldNode] = []
        while self._next < len(self._tokens):
            if not self._takes_externproto():
                line = self._tokens[self._next].line
                try:
                    nodes.append(self._node())
                except RecursionError:
                    why = "this node holds more, one in the other, than can be read"
                    raise WorldFileError(why, line) from None
        return nodes

    def _takes_externproto(self) -> bool:
        """Read `EXTERNPROTO "url"` if it comes next; return whether it did."""
        if self._peek().text == "IMPORTABLE":
            self._take()
        if self._peek().text != "EXTERNPROTO":
            return False
        token = self._take()
        if not self._peek().text.startswith('"'):
            raise WorldFileError("EXTERNPROTO has no URL", token.line)
        url = self._take().text.strip('"')
        self.urls[url.rpartition("/")[2].removesuffix(".proto")] = url
        return True

    def definitions(self, end: str) -> dict[str, FieldDefinition]:
        """Return the fields of a node type, up to a closing bracket."""
        found: dict[str, FieldDefinition] = {}
        while (token := self._take()).text != end:
            keyword = token.text if token.text in _FIELD_KEYWORDS else ""
            type_token = self._take() if keyword else token
            if self._peek().text == "{":  # The list of allowed values.
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
        """Return fields by node type, from a text in the format of Webots' node files."""
        known: dict[str, dict[str, FieldDefinition]] = {}
        while self._next < len(self._tokens):
            name = self._take().text
            self._take()
            known[name] = self.definitions("}")
        return known

    def proto(self) -> tuple[str, dict[str, FieldDefinition], Sequence[Token]]:
        """Return the definition of a PROTO: its name, its fields and the words of its body."""
        while self._takes_externproto():
            pass
        if self._take().text != "PROTO":
            raise WorldFileError("there is no PROTO definition", self._last_line)
        name = self._name("the name of a PROTO").text
        self._take()
        fields = self.definitions("]")
        start = self._next + 1
        self._skip_braces()
        return name, fields, self._tokens[start : self._next - 1]

    def _peek(self) -> Token:
        if self._next == len(self._tokens):
            raise WorldFileError("the file ends in the middle of a node", self._last_line)
        return self._tokens[self._next]

    def _take(self) -> Token:
        token = self._peek()
        self._next += 1
        return token

    def _name(self, what: str) -> Token:
        token = self._take()
        if not _NAME.match(token.text):
            raise WorldFileError(f"expected {what}, found {token.text!r}", token.line)
        return token

    def _node(self) -> WorldNode:
        token = self._name("a node")
        if token.text == "USE":
            return self._used()
        if token.text == "PROTO":
            why = "a world holds no PROTO definitions, they have own files"
            raise WorldFileError(why, token.line)
        if token.text != "DEF":
            return self._body(token, "")
        name = self._name("a DEF name").text
        return self._body(self._name("a node type"), name)

    def _used(self) -> WorldNode:
        token = self._name("a DEF name")
        if token.text not in self._defined:
            raise WorldFileError(f"USE {token.text} comes before any DEF {token.text}", token.line)
        return self._defined[token.text]

    def _body(self, type_token: Token, def_name: str) -> WorldNode:
        is_inner = self._line is not None  # Nodes in a PROTO cannot be found from outside.
        line = type_token.line if self._line is None else self._line
        node = WorldNode(type_token.text, "" if is_inner else def_name, line, file=self._file)
        brace = self._take()
        if brace.text != "{":
            raise WorldFileError(
                f"expected {{ after {node.type_name}, found {brace.text!r}", brace.line
            )
        while self._peek().text != "}":
            token = self._name("a field name or }")
            if token.text == "hidden":
                hidden = self._name("a field name")
                node.hidden[hidden.text] = self._value(hidden)
            else:
                node.field_lines[token.text] = token.line
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
            raise WorldFileError(f"field {owner.text} has no value", token.line)
        return self._node()

    def _is_value(self) -> Value:
        self._take()
        name = self._name("a field of the PROTO")
        if self._given is None or name.text not in self._given:
            raise WorldFileError(f"the PROTO has no field {name.text}", name.line)
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
            what = f"field {owner.text}: expected ], found {token.text!r}"
            raise WorldFileError(what, token.line)


def _word(token: Token) -> bool | str | None:
    if token.text in _WORDS:
        return _WORDS[token.text]
    return re.sub(r"\\(.)", r"\1", token.text[1:-1])


def require_release(text: str, what: str = "world") -> None:
    """Check the first line of a file.

    Raises:
        WorldFileError: It is not a file of Webots, or of a release with different axes.
    """
    first, first_line = "#VRML_SIM R2023b utf8", text.partition("\n")[0]
    release = re.match(r"#VRML_SIM (R20\d\d)[ab]?\S* utf8", first_line)
    if release is None:
        raise WorldFileError(f'a {what} begins with "{first}", not {first_line[:40]!r}', 1)
    if release[1] < "R2022":
        raise WorldFileError(
            f"{what}s of {release[1]} have other axes: "
            "open and save it with Webots R2022a or newer",
            1,
        )


def give_types(node: WorldNode, definitions: Mapping[str, FieldDefinition]) -> None:
    """Give a node all fields of its type, with values of the right types.

    Raises:
        WorldFileError: A value has the wrong type; the text names the field and the line.
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
        raise WorldFileError(
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
    """Return all numbers of a value in one list, also if it was given its type before."""
    if isinstance(value, list):
        return [number for item in cast("list[Any]", value) for number in _numbers(item)]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError("numbers")
    return [float(value)]


def _shown(value: Value) -> str:
    return f"a {value.type_name} node" if isinstance(value, WorldNode) else repr(value)
