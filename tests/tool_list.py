"""How much of a model's context the list of the tools takes; `./run check` prints it.

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
from typing import NamedTuple

import anyio
from mcp.types import Tool

from webots_mcp.answers.shortening import tokens_in
from webots_mcp.database.location import MemoryDatabase
from webots_mcp.questions.declaration import TIERS
from webots_mcp.server.mcp_server import create_server


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


def main() -> int:
    """Print the size of the three lists, and what `tdqs lint` says."""
    memory = MemoryDatabase()
    try:
        tools: Sequence[Tool] = ()
        for listed in TIERS:
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
    sys.exit(main())
