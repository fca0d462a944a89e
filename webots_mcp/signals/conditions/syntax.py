"""The text of a condition or a score, from its characters to Python's tree, and its refusal.

`a < 1 for 0.5` is not an expression of Python's. With a comma in the place of `for` it is a pair,
whose precedence is the one that is wanted: lower than `or`. Real commas stand in calls only. And
`pose.0`, as signals are called, becomes `pose[0]`.
"""

from __future__ import annotations

import ast
import keyword
import re
from dataclasses import dataclass
from typing import Final, NoReturn, cast

from webots_mcp.errors import ConditionFailedError, InvalidConditionError

MAX_CHARACTERS: Final = 500

_TOKEN: Final = re.compile(
    r"""(?P<text>"[^"]*"|'[^']*')
    |(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)
    |(?P<word>[^\W\d]\w*)
    |(?P<sign><=|>=|==|!=|[-+*/<>().,\[\]])
    |(?P<space>[ ]+)""",
    re.VERBOSE,
)
_SUCH_AS: Final = {"condition": "front_m < 0.1 for 0.5", "score": "mean(abs(error))"}
_NEVER_TOGETHER: Final = frozenset(
    (
        ("number", "word"),
        ("number", "number"),
        ("word", "text"),
        ("item", "word"),
        ("item", "number"),
        ("item", "text"),
    )
)
_NO_ESCAPES: Final = "texts have no escapes"
_INSTEAD: Final = {
    "=": "to compare, write ==",
    "&": "write `and`",
    "|": "write `or`",
    "!": "write `not`, or != to compare",
    "~": "write `not`",
    "^": "there is no power operator: write x * x",
    "%": "there is no remainder operator",
    "{": "there are no braces",
    ":": "there are no slices and lambdas",
    "\\": _NO_ESCAPES,
    '"': "a text is not closed",
    "'": "a text is not closed",
}
_NAME: Final = re.compile(r"""'[^']*'|"[^"]*"|(?P<name>[^\W\d]\w*(?:\.\w+|\[\d+\])*)""")
_SIGNS: Final = ("and", "or", "not", "in", "is", "for", "if", "else", "True", "False", "None")
MAX_DEPTH: Final = 50
MAX_NUMBER: Final = 1e300
MAX_NAME_CHARACTERS: Final = 200
FLAGS: Final = {"true": True, "false": False, "True": True, "False": False}


@dataclass(frozen=True)
class Scanned:
    """A text that Python's parser takes.

    Attributes:
        original: The text as it was given, without the spaces around it.
        source: For the parser: a comma stands in the place of each `for`.
        columns: For each sign of `source`, and its end, the place in the original; from 0.
        durations: The places in `source` of the words `for`.
        what: What the text is: a condition, or a score.
    """

    original: str
    source: str
    columns: tuple[int, ...]
    durations: frozenset[int]
    what: str = "condition"

    def place(self, column: int) -> str:
        """The text and a place in it, for messages; the column is that in `source`, from 0."""
        return f"{self.what} {self.original!r}, column {self.columns[column] + 1}"


def refusal(scanned: Scanned, column: int, why: str) -> InvalidConditionError:
    """Return the error of a text, at a column of its `source` that is counted from 0."""
    return InvalidConditionError(f"{scanned.place(column)}: {why}")


def scan(text: str, what: str = "condition") -> Scanned:
    """Look at each sign of a condition, or of what else is written in its language.

    Raises:
        InvalidConditionError: It is empty or too long, or holds a sign that is not of the language.
    """
    text = _stripped(text, what)
    unread = Scanned(text, text, tuple(range(len(text) + 1)), frozenset(), what)
    source, columns, durations = "", list[int](), list[int]()
    place, before, last = 0, "space", ""
    while place < len(text):
        found = _TOKEN.match(text, place)
        if found is None:
            raise refusal(unread, place, _why_unknown(text[place]))
        kind, token = str(found.lastgroup), found.group()
        if (
            kind == "number"
            and token[0] == "."
            and (before in ("word", "item") or text[place - 1] in ")]")
        ):
            kind = "item"
        if (before, kind) in _NEVER_TOGETHER:
            raise refusal(unread, place, _missing_before(before, token))
        if kind == last == "text":  # which Python would join to one
            raise refusal(unread, place, "an operator is missing between two texts; " + _NO_ESCAPES)
        if token == "for":
            durations.append(len(source))
            token = ",  "
        elif kind == "item":
            token = _as_item(unread, place, token)
        source += token
        columns += (place + min(i, found.end() - place - 1) for i in range(len(token)))
        place, before, last = found.end(), kind, last if kind == "space" else kind
    return Scanned(text, source, (*columns, len(text)), frozenset(durations), what)


def _as_item(unread: Scanned, place: int, token: str) -> str:
    """`.0` as `[0]`."""
    if not token[1:].isdecimal():
        raise refusal(unread, place, "an item is a number from 0, as in pose.0 or pose[0]")
    return f"[{token[1:]}]"


def _stripped(text: object, what: str) -> str:
    """Return the text without the spaces around it, if it is one of a possible length."""
    if not isinstance(text, str):
        raise InvalidConditionError(
            f"A {what} must be a text such as {_SUCH_AS[what]!r}, not {text!r}."
        )
    stripped = text.strip(" ")
    if not stripped:
        raise InvalidConditionError(f"The {what} is empty. Give one such as {_SUCH_AS[what]!r}.")
    if len(stripped) > MAX_CHARACTERS:
        raise InvalidConditionError(
            f"The {what} has {len(stripped)} characters, and at most {MAX_CHARACTERS} "
            "are possible. Shorten it."
        )
    return stripped


def _missing_before(before: str, token: str) -> str:
    if before == "number" and token[0].isalpha():
        return f"a number has no unit; write it in the signal's own unit, without {token!r}"
    return f"a space or an operator is missing before {token!r}, as in x < 1 and y > 2"


def _why_unknown(sign: str) -> str:
    if sign in "\n\r\t":
        return "a condition is one line; use spaces between its words"
    hint = _INSTEAD.get(
        sign,
        "it has no meaning in a condition; join conditions with and, or; quote texts, as in "
        "mode == 'turn'",
    )
    return f"{sign!r}: {hint}"


def parse(scanned: Scanned) -> ast.expr:
    """Python's tree of a scanned text.

    Raises:
        InvalidConditionError: Its signs make no sense in this order.
    """
    reserved = _reserved_name(scanned.original, dotted=True)
    if reserved is not None:
        raise refusal(scanned, scanned.columns.index(reserved.start()), _instead_of(reserved))
    try:
        return ast.parse(scanned.source, mode="eval").body
    except SyntaxError as error:
        end = len(scanned.source)
        place = min(error.offset - 1, end) if error.offset else end
        raise refusal(scanned, place, _why_unread(scanned, place, error)) from None
    except (RecursionError, MemoryError, ValueError):
        raise refusal(scanned, 0, "it is nested too deep") from None


def _why_unread(scanned: Scanned, place: int, error: SyntaxError) -> str:
    if "never closed" in str(error.msg) or "unmatched" in str(error.msg):
        return f"{error.msg}; add or remove a parenthesis"
    if reserved := _reserved_name(scanned.original, dotted=False):
        return _instead_of(reserved)
    rest = scanned.original[scanned.columns[place] :].strip()
    if not rest:
        return "it ends too early; add a value or a condition, as in x < 1 and y > 2"
    if re.search(r"\b(if|else)\b", scanned.original):
        return "if and else have no meaning here; join conditions with and, or, not"
    if rest.startswith("during"):
        return (
            "cannot read 'during'; only expectations have it, followed by a condition, as in "
            "x > 0 during mode == 'drive'; for a minimum duration write for 0.5"
        )
    if re.search(r"\bfor\b", scanned.original[: scanned.columns[place]]):
        return f"cannot read {rest[:20]!r}; after `for` give seconds without a unit, as in for 0.5"
    return f"cannot read {rest[:20]!r}; join conditions with and, or; quote texts, as in 'turn'"


def _reserved_name(text: str, *, dotted: bool) -> re.Match[str] | None:
    """The first name that Python's parser takes for something else: a part of it is reserved.

    One without a dot may be meant as what it is, a sign such as `and`.
    """
    for found in _NAME.finditer(text):
        parts = re.split(r"[.\[]", found["name"] or "")
        reserved = any(keyword.iskeyword(part) for part in parts)
        if reserved and (len(parts) > 1) == dotted and (dotted or parts[0] not in _SIGNS):
            return found
    return None


def _instead_of(reserved: re.Match[str]) -> str:
    name = re.sub(r"\[(\d+)\]", r".\1", reserved.group())
    return f"a part of {name!r} is a reserved word: write signal({name!r})"


class Nodes:
    """What every compiler of the language asks of the nodes that it meets."""

    def __init__(self, scanned: Scanned) -> None:
        self._scanned = scanned
        self._durations: set[int] = set(scanned.durations)
        self._encoded = scanned.source.encode()

    def _constant(self, node: ast.Constant) -> int | float | str:
        value = node.value
        if type(value) is str or type(value) is bool:
            return value
        if type(value) not in (int, float):
            self._refuse(node, "it has no meaning here; for no value, write missing(x)")
        number = cast("int | float", value)
        if abs(number) > MAX_NUMBER:
            self._refuse(node, f"numbers are up to {MAX_NUMBER:g}")
        return number

    def _signal_name(self, node: ast.expr) -> str:
        name = self._name(node)
        if len(name) > MAX_NAME_CHARACTERS:
            self._refuse(node, f"a name has at most {MAX_NAME_CHARACTERS} characters")
        return name

    def _name(self, node: ast.expr) -> str:
        if isinstance(node, ast.Name):
            return node.id
        if isinstance(node, ast.Attribute):
            return f"{self._name(node.value)}.{node.attr}"
        if isinstance(node, ast.Subscript):
            return f"{self._name(node.value)}.{self._item(node.slice)}"
        if isinstance(node, ast.Call) and function_of(node) == "signal":
            return self._quoted_name(self._only(node))
        self._refuse(node, "a signal is needed here")

    def _quoted_name(self, node: ast.expr) -> str:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value:
            return node.value
        self._refuse(node, "signal() takes a name in quotes, as in signal('front left.x')")

    def _item(self, node: ast.expr) -> str:
        value = node.value if isinstance(node, ast.Constant) else None
        if (type(value) is int or type(value) is str) and len(str(value)) < MAX_NAME_CHARACTERS:
            return str(value)
        self._refuse(node, "an item is a number from 0, or a key in quotes, as in front[2]")

    def _durations_between(self, node: ast.Tuple) -> list[int]:
        start, end = self._column(node), self._end_column(node)
        inner = [(self._column(part), self._end_column(part)) for part in node.elts]
        return sorted(
            place
            for place in self._durations
            if start <= place < end and not any(a <= place < b for a, b in inner)
        )

    def _only(self, node: ast.Call) -> ast.expr:
        self._require_plain_call(node)
        if len(node.args) != 1:
            self._refuse(node, f"{function_of(node)} takes one value, not {len(node.args)}")
        return node.args[0]

    def _require_plain_call(self, node: ast.Call) -> None:
        if node.keywords or any(isinstance(each, ast.Starred) for each in node.args):
            self._refuse(node, "a function takes values only, as in max(a, b)")

    def _require_shallow(self, tree: ast.expr) -> None:
        level: list[ast.AST] = [tree]
        for _ in range(MAX_DEPTH):
            level = [child for node in level for child in ast.iter_child_nodes(node)]
        if level:
            self._refuse_at(0, f"it is nested over {MAX_DEPTH} levels: make it simpler")

    def _column(self, node: ast.expr) -> int:
        return len(self._encoded[: node.col_offset].decode())

    def _end_column(self, node: ast.expr) -> int:
        return len(self._encoded[: node.end_col_offset].decode())

    def _operator_column(self, node: ast.BinOp) -> int:
        """Behind the left operand, and the parentheses and spaces after it."""
        start = self._end_column(node.left)
        after = self._scanned.source[start:]
        return start + len(after) - len(after.lstrip(" )"))

    def _refuse(self, node: ast.expr, why: str) -> NoReturn:
        self._refuse_at(self._column(node), why)

    def _refuse_at(self, column: int, why: str) -> NoReturn:
        raise refusal(self._scanned, column, why)

    def _failure(self, column: int, why: str) -> ConditionFailedError:
        return ConditionFailedError(f"{self._scanned.place(column)}: {why}")


def is_signal(node: ast.expr) -> bool:
    """Return whether it names a signal."""
    if isinstance(node, ast.Name):
        return node.id not in FLAGS
    return isinstance(node, (ast.Attribute, ast.Subscript)) or function_of(node) == "signal"


def function_of(node: ast.expr) -> str | None:
    """Return the name of the function that is called; None where none is."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return node.func.id
    return None
