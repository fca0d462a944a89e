"""A state row's JSON text, and how values of it are reduced and shown."""

from __future__ import annotations

import json
from typing import Any, Final, cast

from webots_mcp.naming import LONGEST_SPREAD_ARRAY, REDUCTIONS, Value, reduce_array

MAX_TEXT: Final = 200  # characters of a text value that are kept and compared


def parse(text: str) -> dict[str, Any]:
    """A state row's JSON text; empty where it is no JSON object (rows of foreign origin)."""
    try:
        state = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return cast("dict[str, Any]", state) if isinstance(state, dict) else {}


def reductions(array: object) -> dict[str, Value]:
    """The reductions of a long array; empty of what is none."""
    if not isinstance(array, list) or len(cast("list[Any]", array)) <= LONGEST_SPREAD_ARRAY:
        return {}
    return dict(zip(REDUCTIONS, reduce_array(cast("list[Any]", array)), strict=True))


def shown(value: Value) -> str | None:
    """A value of a text or boolean signal as the change table keeps it."""
    if value is None or isinstance(value, str):
        return value[:MAX_TEXT] if value else value
    return json.dumps(value)
