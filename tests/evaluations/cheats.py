"""Clients that do not earn their answers; an evaluation that rewards them is worthless."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final, cast

from tests.evaluations.asking import Call
from tests.evaluations.scenario import CANNOT_TELL
from tests.server.story import rows_of

_NUMBER: Final = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?")
FIXED_CALLS: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    ("webots_list_robots", {}),
    ("webots_check_run", {}),
    ("webots_find_events", {}),
)

COPIED_CALLS: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    *FIXED_CALLS,
    ("webots_list_runs", {}),
    ("webots_get_parameters", {}),
)


async def lie(question: str, schema: dict[str, Any], call: Call) -> dict[str, Any]:
    """Answer plausibly without a call: numbers and names of the question, the first option."""
    told = question.split("\n\n")[0]
    numbers = [float(each) for each in _NUMBER.findall(told)] or [40.0]
    words = re.findall(r"\b[a-z]+_[a-z_]+\b", told) or ["rover"]
    return guess(schema, numbers[-1], words[0], 0)


async def call_alike(question: str, schema: dict[str, Any], call: Call) -> dict[str, Any]:
    """Make the same three calls whatever is asked, and give the same values."""
    for tool, arguments in FIXED_CALLS:
        await call(tool, arguments)
    return guess(schema, 0.0, "rover", 0)


async def copy(question: str, schema: dict[str, Any], call: Call) -> dict[str, Any]:
    """Make the same calls, and copy the first value whose name is that of a member, or ends it.

    The question is not read. Members without such a value get a fixed one.
    """
    found = dict[str, Any]()
    for tool, arguments in COPIED_CALLS:
        for name, value in _values(await call(tool, arguments)):
            found.setdefault(name, value)
    answer = guess(schema, 0.0, "rover", 0)
    for member in answer:
        names = [name for name in found if member == name or member.endswith(f"_{name}")]
        names += [name for name in found if name.endswith(member[-4:]) and name not in names]
        if names and "enum" not in schema["properties"][member]:
            answer[member] = found[names[0]]
    return answer


def _values(answer: Any) -> Iterator[tuple[str, Any]]:
    """Yield all names with their values, those of rows included."""
    if isinstance(answer, list):
        for item in cast("list[Any]", answer):
            yield from _values(item)
    elif isinstance(answer, dict):
        table = cast("dict[str, Any]", answer)
        if "columns" in table:
            yield from _values(rows_of(table))
            return
        for name, value in table.items():
            if isinstance(value, (dict, list)):
                yield from _values(value)
            elif value is not None:
                yield name, value


async def know_nothing(question: str, schema: dict[str, Any], call: Call) -> dict[str, Any]:
    """Say of everything that it cannot be told, after one call."""
    await call(*FIXED_CALLS[0])
    return dict.fromkeys(schema["properties"], CANNOT_TELL)


def guess(schema: dict[str, Any], number: float, name: str, option: int) -> dict[str, Any]:
    """Return an answer with the same number, name and option for all members of their kind."""
    answer = dict[str, Any]()
    for member, form in schema["properties"].items():
        options = form.get("enum")
        if options:
            answer[member] = options[option % len(options)]
        else:
            answer[member] = number if form["anyOf"][0]["type"] == "number" else name
    return answer


CHEATS: Final = {
    "a liar": lie,
    "a client of fixed calls": call_alike,
    "a client that copies": copy,
    "a client that knows nothing": know_nothing,
}
