"""How a client starts the servers that are compared."""

from __future__ import annotations

import sys
from pathlib import Path

from mcp import StdioServerParameters

from tests.benchmarks.processes import environment


def our_server(database: Path) -> StdioServerParameters:
    """`webots-mcp serve`."""
    return _module("webots_mcp", "serve", "--database", str(database))


def one_tool_server() -> StdioServerParameters:
    """The smallest server of the same library."""
    return _module("tests.benchmarks.programs.one_tool_server")


def _module(*arguments: str) -> StdioServerParameters:
    line = ["-m", *arguments]
    return StdioServerParameters(command=sys.executable, args=line, env=environment())
