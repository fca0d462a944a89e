"""How much of a model's context the list of the tools takes; `./run check` prints it.

    python -m tests.tool_list            print the sizes
    python -m tests.tool_list --write    make the list of the server anew from the questions

Tokens are counted by the rule of `webots_mcp.answers.shortening.tokens_in`. Where the package
`tdqs` is installed, its `tdqs lint` judges the list as well.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import anyio
from mcp.server.mcpserver.tools import Tool as ServerTool
from mcp.types import Tool

from webots_mcp.answers.shortening import tokens_in
from webots_mcp.contract import TOOL_TIERS
from webots_mcp.database.location import MemoryDatabase
from webots_mcp.questions import all_questions
from webots_mcp.server.mcp_server import create_server
from webots_mcp.server.tool_list import FILE, ListedTool
from webots_mcp.server.tools import tool_of
from webots_mcp.store.recording import RecordingAccess


class Counts(NamedTuple):
    """The size of a list."""

    tools: int
    bytes: int
    tokens: int


def as_listed(tools: Sequence[Tool]) -> str:
    """The list as a client gets it, in compact JSON."""
    told = [tool.model_dump(mode="json", by_alias=True, exclude_none=True) for tool in tools]
    return json.dumps(told, separators=(",", ":"), ensure_ascii=False)


def counts_of(tools: Sequence[Tool]) -> Counts:
    """How large the list of these tools is."""
    text = as_listed(tools)
    return Counts(len(tools), len(text.encode()), tokens_in(text))


def made_anew() -> str:
    """The content of the file of `server.tool_list`, made from the questions."""
    memory = MemoryDatabase()
    recording = RecordingAccess(memory, memory.data_dir)
    lines = [
        ListedTool(
            name=question.name,
            module=question.function.__module__,
            tier=question.tier,
            reads=question.effect.reads,
            tool=entry_of(tool_of(question, recording)),
        )._asdict()
        for question in all_questions()
    ]
    memory.close()
    return "[\n" + ",\n".join(json.dumps(line, ensure_ascii=False) for line in lines) + "\n]\n"


def entry_of(tool: ServerTool) -> dict[str, Any]:
    """A tool as a client's list has it."""
    entry = Tool(
        name=tool.name,
        title=tool.title,
        description=tool.description,
        input_schema=tool.parameters,
        annotations=tool.annotations,
    )
    return entry.model_dump(mode="json", by_alias=True, exclude_none=True)


def main(arguments: Sequence[str]) -> int:
    """Print the size of the three lists, and what `tdqs lint` says; or make the file anew."""
    if arguments == ["--write"]:
        FILE.write_text(made_anew(), "utf-8")
        return 0
    memory = MemoryDatabase()
    try:
        tools: Sequence[Tool] = ()
        for listed in TOOL_TIERS:
            tools = anyio.run(create_server(memory, memory.data_dir, tools=listed).list_tools)
            counted = counts_of(tools)
            print(
                f"tools listed by 'serve --tools {listed}': {counted.tools}, "
                f"{counted.bytes:,} bytes, about {counted.tokens:,} tokens (by tokens_in)"
            )
    finally:
        memory.close()
    lint = shutil.which("tdqs", path=str(Path(sys.executable).parent))
    if lint is None:
        print("tdqs lint: not run, the package tdqs is not installed")
        return 0
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tools.json"
        file.write_text(f'{{"tools": {as_listed(tools)}}}', "utf-8")
        return subprocess.run([lint, "lint", str(file)], check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
