"""Values as a person types them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias

import cyclopts
from cyclopts import Token
from cyclopts.validators import Number

from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING or hasattr(cyclopts.Parameter(), "metavar"):
    Parameter = cyclopts.Parameter
else:  # cyclopts 4, the last for Python 3.10: options have no words for their values

    def Parameter(*names: str, metavar: str | None = None, **given: Any) -> cyclopts.Parameter:  # noqa: N802
        """How an argument is typed, without the word for its value."""
        return cyclopts.Parameter(*names, **given)


_TOO_LARGE: Final = 2**63  # for SQLite, and no id that it has given
_NO_KINDS: Final[Mapping[str, str]] = MappingProxyType({})


def whole_number(_kind: Any, tokens: Sequence[Token]) -> int:
    """What was typed; cyclopts by itself would round 1.5.

    Raises:
        ValueError: It is no whole number, or one that SQLite cannot hold.
    """
    text = tokens[0].value
    if not re.fullmatch(r"[+-]?[0-9]+", text):
        raise ValueError(f"{text!r} is no whole number")
    if abs(int(text)) >= _TOO_LARGE:
        raise ValueError(f"{text} is too large")
    return int(text)


def refuse_options(_kind: Any, value: Any) -> None:
    """A hyphen alone is a value, and so is a condition such as '-x > 3'.

    Raises:
        ValueError: It is an option, and nobody knows it.
    """
    if isinstance(value, (str, Path)) and re.match(r"--?\w[\w-]*(=|$)", str(value)):
        raise ValueError(f"unknown option {value}")


def _row_id(_kind: Any, tokens: Sequence[Token]) -> int:
    text = tokens[0].value
    if (
        text.isascii() and text.isdecimal() and int(text) < _TOO_LARGE
    ):  # what SQLite could have given
        return int(text)
    raise ValueError(f"{text!r} is no id: it is a number from an answer")


Id: TypeAlias = Annotated[int, Parameter(converter=_row_id)]
Count: TypeAlias = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=1))]


def settings_of(texts: Sequence[str], kinds: Mapping[str, str] = _NO_KINDS) -> dict[str, Any]:
    """Values by name, of texts NAME=VALUE; a value that is no JSON is a text.

    Args:
        texts: As they were typed.
        kinds: Of parameters, by name: the value of one of kind `str` is a text, also one that looks
            like a number.

    Raises:
        InvalidInputError: One has no `=`.
    """
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise InvalidInputError(f"{text!r} names no value: write {name}=VALUE")
        values[name] = value if kinds.get(name) == "str" else value_of(value)
    return values


def value_of(text: str) -> Any:
    """What was typed, as JSON; what is none is a text."""
    try:
        return json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError):
        return text


def _no_constant(name: str) -> float:
    """NaN and the infinities are Python's, and none of JSON."""
    raise ValueError(name)
