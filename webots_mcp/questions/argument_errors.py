"""What is wrong with an argument, in words on which a model or a person can act.

The errors of pydantic are translated: the argument, what is expected, and the value that came.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import (
    Final,
)

from pydantic import (
    ValidationError,
)
from pydantic_core import ErrorDetails

from webots_mcp.signals.naming import perhaps_meant

_LONGEST_VALUE: Final = 80
_AS_DECLARED: Final[Mapping[str, str]] = MappingProxyType({})


def faults_of(error: ValidationError, typed: Mapping[str, str] = _AS_DECLARED) -> str:
    """Return the first things that are wrong: the argument, what is asked of it, and its value.

    Args:
        error: What pydantic said.
        typed: How the arguments are called where they were typed, if not by their names.
    """
    faults = {str(each["loc"][0]): _fault(each, typed) for each in reversed(error.errors())}
    return "; ".join(list(faults.values())[:3])


def _fault(error: ErrorDetails, typed: Mapping[str, str]) -> str:
    """One thing that is wrong: the parameter, what is asked of it, and what came."""
    first, *inside = error["loc"]  # a name after it is a type that the value might have had
    if str(first) in typed:
        first, inside = typed[str(first)], []  # each item of a list has been typed by itself
    name = ".".join(map(str, (first, *(item for item in inside if isinstance(item, int)))))
    if error["type"] == "missing":
        return f"{name} is missing"
    if error["type"] == "unexpected_keyword_argument":
        return f"there is no argument {shown_value(name)}"
    asked = re.sub(r"^(Value error, |\w+ should )", "must ", error["msg"])
    asked = re.sub(r", unable to parse .*| after validation, not \d+", "", asked)
    if error["type"] == "int_parsing_size":
        asked = "must be a smaller number"
    return f"{name} {asked}, not {shown_value(error['input'])}{_near(error)}"


def _near(error: ErrorDetails) -> str:
    """Return what was perhaps meant."""
    choices = re.findall(r"'([^']+)'", error["msg"])
    given = str(error["input"])[:_LONGEST_VALUE]
    near = perhaps_meant(given, choices, most=1)
    return f"; did you mean {' or '.join(map(repr, near))}?" if near else ""


def shown_value(value: object) -> str:
    """Return a value as it was given, if not too long."""
    return repr(value)[:_LONGEST_VALUE]
