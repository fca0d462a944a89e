"""The text of a condition, made ready for Python's parser: signs of the language only.

`a < 1 for 0.5` is not an expression of Python's. With a comma in the place of `for` it is a pair,
whose precedence is the one that is wanted: lower than `or`. Real commas stand in calls only. And
`pose.0`, as signals are called, becomes `pose[0]`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from webots_mcp.errors import InvalidConditionError

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
_NAMES: Final = ("word", "item")
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
    "!": "write `not`, or != for unlike",
    "~": "write `not`",
    "^": "there is no power operator: write x * x",
    "%": "there is no remainder operator",
    "{": "there are no braces",
    ":": "there are no slices and lambdas",
    "\\": _NO_ESCAPES,
    '"': "a text is not closed",
    "'": "a text is not closed",
}


@dataclass(frozen=True)
class Scanned:
    """A text that Python's parser takes.

    Attributes:
        original: As it was given, without the spaces around it.
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
    """The error of a text, at a column of its `source` that is counted from 0."""
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
        if kind == "number" and token[0] == "." and (before in _NAMES or text[place - 1] in ")]"):
            kind = "item"
        if (before, kind) in _NEVER_TOGETHER:
            raise refusal(unread, place, "a space or an operator is missing before it")
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
    """The text without the spaces around it, if it is one of a possible length."""
    if not isinstance(text, str):
        raise InvalidConditionError(f"a {what} is a text such as {_SUCH_AS[what]!r}, not {text!r}")
    stripped = text.strip(" ")
    if not stripped:
        raise InvalidConditionError(f"the {what} is empty: give one such as {_SUCH_AS[what]!r}")
    if len(stripped) > MAX_CHARACTERS:
        raise InvalidConditionError(
            f"the {what} has {len(stripped)} characters; at most {MAX_CHARACTERS} are possible"
        )
    return stripped


def _why_unknown(sign: str) -> str:
    if sign in "\n\r\t":
        return "a condition is one line, with spaces between its words"
    hint = _INSTEAD.get(sign, "it has no meaning in a condition; texts stand in quotes")
    return f"{sign!r}: {hint}"
