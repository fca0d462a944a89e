"""Reads the VRML dialect of .wbt files into a tree of nodes; knows nothing of what nodes mean."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, TypeAlias, cast

from webots_mcp.standin.standin_errors import WorldError

Value: TypeAlias = "bool | str | Node | list[float] | list[Value] | None"
"""A field as written: numbers are always a list of floats, `[...]` is a list of anything."""

_TOKEN: Final = re.compile(r'[\s,]+|#[^\n]*|(?P<token>"(?:[^"\\]|\\.)*"|[\[\]{}]|[^\s\[\]{}",#]+)')
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\Z")
_NAME: Final = re.compile(r"[A-Za-z_][^\s\"'#,.\[\]\\{}]*\Z")
_WORDS: Final[dict[str, bool | None]] = {"TRUE": True, "FALSE": False, "NULL": None}


class Token(NamedTuple):
    """A word of the file and the line it stands on."""

    text: str
    line: int


@dataclass(eq=False)
class Node:
    """A node of the scene tree; the parser fills in the fields that the file names, as `Value`s."""

    type_name: str
    def_name: str
    line: int
    fields: dict[str, Any] = field(default_factory=lambda: {})
    proto_name: str = ""
    """Of a PROTO node that was built: its own name; its type is that of what it is made of."""


def children_of(node: Node) -> Iterator[Node]:
    """The nodes in the fields of a node, in the order of the file."""
    for value in node.fields.values():
        if isinstance(value, Node):
            yield value
        elif isinstance(value, list):
            items = cast("list[Any]", value)
            yield from (item for item in items if isinstance(item, Node))


def descendants_of(node: Node) -> Iterator[Node]:
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


class Parser:
    """Recursive descent over the words of one world."""

    def __init__(self, text: str) -> None:
        self._tokens = [*tokens_of(text)]
        self._next = 0
        self._defined: dict[str, Node] = {}
        self._last_line = self._tokens[-1].line if self._tokens else 1

    def nodes(self) -> list[Node]:
        """The nodes at the top of the file, in order."""
        nodes: list[Node] = []
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
        """Read over `EXTERNPROTO "url"`: it only says where a PROTO comes from."""
        if self._peek().text == "IMPORTABLE":
            self._take()
        if self._peek().text != "EXTERNPROTO":
            return False
        token = self._take()
        if not self._peek().text.startswith('"'):
            raise WorldError("EXTERNPROTO has no URL", token.line)
        self._take()
        return True

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

    def _node(self) -> Node:
        token = self._name("a node")
        if token.text == "USE":
            return self._used()
        if token.text == "PROTO":
            raise WorldError("a world holds no PROTO definitions, they have own files", token.line)
        if token.text != "DEF":
            return self._body(token, "")
        name = self._name("a DEF name").text
        return self._body(self._name("a node type"), name)

    def _used(self) -> Node:
        token = self._name("a DEF name")
        if token.text not in self._defined:
            raise WorldError(f"USE {token.text} comes before any DEF {token.text}", token.line)
        return self._defined[token.text]

    def _body(self, type_token: Token, def_name: str) -> Node:
        node = Node(type_token.text, def_name, type_token.line)
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
        if token.text == "[":
            return self._list(owner)
        if _NUMBER.match(token.text):
            return self._numbers()
        if token.text in _WORDS or token.text.startswith('"'):
            return _word(self._take())
        if token.text in "]{}":
            raise WorldError(f"field {owner.text} has no value", token.line)
        return self._node()

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


def parse(text: str) -> list[Node]:
    """Read the text of a .wbt file.

    Args:
        text: The whole file.

    Returns:
        The nodes at the top of the scene tree. A `USE` gives the very node that its `DEF` named.

    Raises:
        WorldError: The text is not a world; the message names the line.
    """
    first_line = text.partition("\n")[0]
    release = re.match(r"#VRML_SIM (R20\d\d)[ab]?\S* utf8", first_line)
    if release is None:
        raise WorldError(f'a world begins with "#VRML_SIM R2023b utf8", not {first_line[:40]!r}', 1)
    if release[1] < "R2022":
        raise WorldError(
            f"worlds of {release[1]} have other axes: open and save it with Webots R2022a or newer",
            1,
        )
    return Parser(text).nodes()
