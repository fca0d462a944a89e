"""Clients that do not earn their answers; an evaluation that rewards them is worthless."""

from __future__ import annotations

import re
from typing import Any, Final

from tests.evaluations.asking import Call
from tests.evaluations.scenario import CANNOT_TELL

_NUMBER: Final = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?")
FIXED_CALLS: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    ("webots_list_robots", {}),
    ("webots_check_run", {}),
    ("webots_find_events", {}),
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
    "a client that knows nothing": know_nothing,
}
