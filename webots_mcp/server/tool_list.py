"""The list of tools, read from a file, so that a server imports no question before it is asked.

Making the list from the questions would lengthen the start of a server by a fifth.
`python -m tests.tool_list --write` makes the file `tool_list.json` from them, a tool on each line.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from mcp.types import Tool

from webots_mcp.contract import ToolTier

if TYPE_CHECKING:
    from webots_mcp.questions.declaration import Question

FILE: Final = Path(__file__).with_name("tool_list.json")
_TOOL_NAME: Final = re.compile(r"\bwebots_[a-z_]+\b")


class ListedTool(NamedTuple):
    """A tool as the file describes it.

    Attributes:
        name: Its name.
        module: The module that declares its question.
        tier: The smallest tier that lists it.
        reads: Whether it changes nothing.
        tool: Its entry in the list, as JSON. The description may name tools that are not listed;
            `entry_among` removes those.
    """

    name: str
    module: str
    tier: ToolTier
    reads: bool
    tool: dict[str, Any]

    @property
    def question(self) -> Question:
        """Import its module and return its question."""
        return cast("Question", getattr(import_module(self.module), self.name))

    def entry_among(self, listed: Collection[str]) -> Tool:
        """Return the tool for a list with these tools: its description names no other one."""
        description = naming_only(listed, self.tool["description"])
        return Tool.model_validate(self.tool | {"description": description})


@cache
def listed_tools() -> tuple[ListedTool, ...]:
    """Return all tools in the order of `questions.MODULES`; those of plugins follow."""
    return tuple(ListedTool(**each) for each in json.loads(FILE.read_text("utf-8")))


def naming_only(listed: Collection[str], text: str) -> str:
    """Return a description without the clauses that name tools that are not listed.

    A model cannot call what its client does not list.
    """
    return "\n\n".join(
        kept for part in text.split("\n\n") if (kept := _clauses_naming_only(listed, part))
    )


def _clauses_naming_only(listed: Collection[str], text: str) -> str:
    kept = ""
    for clause in re.split(r"(?<=[.;]) +", " ".join(text.split())):
        if not set(_TOOL_NAME.findall(clause)) <= set(listed):
            if clause.endswith(".") and kept.endswith(";"):
                kept = f"{kept[:-1]}."
            continue
        begins = not kept or kept.endswith(".")
        is_word = begins and not _TOOL_NAME.match(clause)
        kept += (" " if kept else "") + (clause[0].upper() + clause[1:] if is_word else clause)
    return f"{kept[:-1]}." if kept.endswith(";") else kept
