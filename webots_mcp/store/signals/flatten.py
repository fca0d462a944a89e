"""A state row's JSON text, and how values of it are reduced and shown."""

from __future__ import annotations

import json
from typing import Any, Final, cast

from webots_mcp.naming import LONGEST_SPREAD_ARRAY, REDUCTIONS, Value

ANY_ITEM: Final = "*"
MAX_TEXT: Final = 200  # characters of a text value that are kept and compared


def parse(text: str) -> dict[str, Any]:
    """A state row's JSON text; empty where it is no JSON object (rows of foreign origin)."""
    try:
        state = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return cast("dict[str, Any]", state) if isinstance(state, dict) else {}


def shown(value: Value) -> str | None:
    """A value of a text or boolean signal as change points have it."""
    if value is None or isinstance(value, str):
        return value[:MAX_TEXT] if value else value
    return json.dumps(value)


def replaced_names(replaced: str | None) -> dict[str, str]:
    """What was replaced (nan, inf, ...) by signal: by its own name, or by an item of its array.

    Of an array in which all nulls are of one kind it is named for every item, and under `name.*`.
    """
    if replaced is None:
        return {}
    reasons: dict[str, str] = {}
    for path, reason in cast("dict[str, str]", parse(replaced)).items():
        array, _, item = path.rpartition(".")
        if item == ANY_ITEM:
            reasons.update((f"{array}.{index}", reason) for index in range(LONGEST_SPREAD_ARRAY))
        if item == ANY_ITEM or item.isdecimal():
            reasons.update((f"{array}.{reduction}", reason) for reduction in REDUCTIONS)
        reasons[path] = reason
    return reasons


def is_replaced(reasons: dict[str, str], name: str, value: Value) -> bool:
    """Whether a value is what the reasons of its row are about: of `name.*` only the nulls are."""
    array, _, item = name.rpartition(".")
    return not item.isdecimal() or value is None or f"{array}.{ANY_ITEM}" not in reasons
