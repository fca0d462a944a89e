"""A client without a model: it makes the calls of the plan and reads its answer out of theirs.

On the command line, `planned CONFIG QUESTION` asks the server that the file names.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import anyio
from mcp import Client, StdioServerParameters

from tests.evaluations.asking import Call, data_of
from tests.evaluations.scenario import Field, read_scenarios
from tests.server.story import rows_of

_STEP: Final = re.compile(r"([^.\[\]]+)|\[([^=\]]+)=([^\]]*)\]|\[(\d+)\]")


async def answer_by_plan(question: str, schema: dict[str, Any], call: Call) -> dict[str, Any]:
    """Answer a question as its scenario plans it."""
    (scenario,) = [each for each in read_scenarios() if each.text() == question]
    answers = [await call(tool, arguments) for tool, arguments in scenario.plan]
    return {field.name: found_value(field, answers) for field in scenario.fields}


def found_value(field: Field, answers: Sequence[Any]) -> Any:
    """Return the value of a field: what is found first, or what the plan says otherwise."""
    searched = answers if field.call is None else [answers[field.call - 1]]
    found = [each for answer in searched for each in values_at(answer, field.found_at)]
    values = [each for each in found if each is not None] if field.found_at else []
    if field.pattern:
        matches = [re.search(field.pattern, str(each)) for each in values]
        values = [match[1] for match in matches if match]
    if not values:
        return field.otherwise
    text = json.dumps(values[0])
    return next((said for part, said in field.words.items() if part in text), values[0])


def values_at(answer: Any, path: str) -> list[Any]:
    """Return what a path leads to: `events[kind=stuck].start_s`; of rows that match, each one."""
    reached: list[Any] = [answer]
    for name, column, value, place in _STEP.findall(path):
        if place:
            lists: list[list[Any]] = [_items(each) for each in reached]
            reached = [each[int(place)] for each in lists if int(place) < len(each)]
        elif column:
            rows = [row for each in reached for row in _items(each)]
            reached = [row for row in rows if str(row.get(column)) == value]
        else:
            reached = [each[name] for each in reached if isinstance(each, dict) and name in each]
    return reached


def _items(value: Any) -> list[Any]:
    """Return the items of a list, or the rows of a table."""
    return rows_of(value) if "columns" in value else list(value)


async def main(config: str, question: str) -> None:
    """Print the answer to a question, asked of the server that a file names."""
    server = json.loads(Path(config).read_text("utf-8"))["mcpServers"]["webots"]
    server["env"] = {**os.environ, **server["env"]}
    async with Client(StdioServerParameters(**server)) as client:

        async def call(tool: str, arguments: dict[str, Any]) -> dict[str, Any]:
            return data_of(await client.call_tool(tool, arguments))

        print(json.dumps(await answer_by_plan(question, {}, call)))


if __name__ == "__main__":
    anyio.run(main, sys.argv[1], sys.argv[2])
