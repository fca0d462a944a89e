"""The keys of a state in the order in which its controller gave them.

A pool that holds JSON parsed (PostgreSQL's jsonb) has an order of its own. The register of signals
knows the one from before: names are entered as they first come.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from typing import Any, Final, cast

_STEP: Final = re.compile(r'\.("(?:[^"\\]|\\.)*"|[^."\[\]]+)|\[(\d+)\]')
_ENCODED: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode
_LONG: Final = re.compile(r"\d{19}")

Order = dict[str, Any]


def order_of(paths: Iterable[str]) -> Order:
    """The order of keys that the paths of a robot's signals tell, in the order of their ids."""
    order: Order = {}
    for path in paths:
        level = order
        for key, index in _STEP.findall(path):
            level = level.setdefault(_key(key) if key else index, {})
    return order


def _key(step: str) -> str:
    try:
        return str(json.loads(step)) if step.startswith('"') else step
    except ValueError:
        return step[1:-1]


def in_order(text: str, order: Order) -> str:
    """A state as JSON text with its keys in that order; what the order lacks comes last.

    A whole number beyond those of SQLite was a float, which a pool without exponents spells out.
    """
    try:
        state = json.loads(text, parse_int=_number if _LONG.search(text) else None)
        ordered = _ENCODED(_sorted(state, order))
        ordered.encode()
    except (ValueError, OverflowError, RecursionError):
        return text  # no JSON, or halves of characters: a pool holds it as the text that it was
    return ordered


def _number(digits: str) -> int | float:
    number = int(digits)
    return number if -(2**63) <= number < 2**63 else float(number)


def _sorted(value: Any, order: Order) -> Any:
    if isinstance(value, dict):
        members = cast("dict[str, Any]", value)
        known = {key: _sorted(members[key], order[key]) for key in order if key in members}
        return known if len(known) == len(members) else known | members | known
    if isinstance(value, list) and any(order.values()):
        items = cast("list[Any]", value)
        return [_sorted(item, order.get(str(at), {})) for at, item in enumerate(items)]
    return cast("Any", value)
