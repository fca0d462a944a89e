"""Values as a person types them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

from webots_mcp.errors import InvalidInputError

_NO_KINDS: Final[Mapping[str, str]] = MappingProxyType({})


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
