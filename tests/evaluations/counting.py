"""`webots-mcp serve` that notes each call of a tool: `counting FILE [OPTION...]`."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mcp.types import CallToolResult, TextContent

from tests.evaluations.asking import noted
from webots_mcp.cli import main
from webots_mcp.server.mcp_server import ToolServer


def count_into(file: Path) -> None:
    """Have each server of this process write a line for each call."""
    answer = ToolServer.call_tool

    def note(tool: str, arguments: dict[str, Any], result: CallToolResult) -> None:
        with file.open("a", encoding="utf-8") as calls:
            calls.write(json.dumps(asdict(noted(tool, arguments, result))) + "\n")

    async def counted(
        self: ToolServer, name: str, arguments: dict[str, Any], *context: Any, **others: Any
    ) -> Any:
        try:
            result = await answer(self, name, arguments, *context, **others)
        except Exception as error:
            text = TextContent(type="text", text=str(error))
            note(name, arguments, CallToolResult(content=[text], is_error=True))
            raise
        if isinstance(result, CallToolResult):
            note(name, arguments, result)
        return result

    ToolServer.call_tool = counted


if __name__ == "__main__":
    calls_file, *options = sys.argv[1:]
    count_into(Path(calls_file))
    sys.exit(main(["serve", *options]))
