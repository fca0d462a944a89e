"""The text of a condition, made ready for Python's parser: signs of the language only.

`a < 1 for 0.5` is no expression of Python's. With a comma in the place of `for` it is a pair,
whose precedence is the one that is wanted: lower than `or`. Real commas stand in calls only.
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
_INSTEAD: Final = {
    "=": "to compare, write ==",
    "&": "write `and`",
    "|": "write `or`",
    "!": "write `not`, or != for unlike",
    "~": "write `not`",
    "^": "there are no powers: write x * x",
    "%": "there is no remainder",
    "{": "there are no braces",
    ":": "there are no slices and lambdas",
    "\\": "texts have no escapes",
    '"': "a text is not closed",
    "'": "a text is not closed",
}


@dataclass(frozen=True)
class Scanned:
    """A text that Python's parser takes, with the same columns.

    Attributes:
        original: As it was given, without the spaces around it.
        source: A comma stands in the place of each `for`.
        durations: The places of the words `for`, from 0.
        what: What the text is: a condition, or a score.
    """

    original: str
    source: str
    durations: frozenset[int]
    what: str = "condition"

    def place(self, column: int) -> str:
        """The text and a place in it, for messages; the column is counted from 0."""
        return f"{self.what} {self.original!r}, column {column + 1}"


def refusal(scanned: Scanned, column: int, why: str) -> InvalidConditionError:
    """The error of a text, at a column that is counted from 0."""
    return InvalidConditionError(f"{scanned.place(column)}: {why}")


def scan(text: str, what: str = "condition") -> Scanned:
    """Look at each sign of a condition, or of what else is written in its language.

    Raises:
        InvalidConditionError: It is empty or too long, or holds a sign that is not of the language.
    """
    text = text.strip(" ")
    _require_length(text, what)
    unread = Scanned(text, text, frozenset(), what)
    durations: list[int] = []
    place, before = 0, "space"
    while place < len(text):
        found = _TOKEN.match(text, place)
        if found is None:
            raise refusal(unread, place, _why_unknown(text[place]))
        kind = str(found.lastgroup)
        if (before, kind) in (("number", "word"), ("word", "text"), ("number", "number")):
            raise refusal(unread, place, "a space or an operator is missing before it")
        if found.group() == "for":
            durations.append(place)
        place, before = found.end(), kind
    source = list(text)
    for place in durations:
        source[place : place + 3] = ",  "
    return Scanned(text, "".join(source), frozenset(durations), what)


def _require_length(text: str, what: str) -> None:
    if not text:
        raise InvalidConditionError(f"the {what} is empty: give one such as {_SUCH_AS[what]!r}")
    if len(text) > MAX_CHARACTERS:
        raise InvalidConditionError(
            f"the {what} has {len(text)} characters; at most {MAX_CHARACTERS} are possible"
        )


def _why_unknown(sign: str) -> str:
    if sign in "\n\r\t":
        return "a condition is one line, with spaces between its words"
    hint = _INSTEAD.get(sign, "it has no meaning in a condition; texts stand in quotes")
    return f"{sign!r}: {hint}"
