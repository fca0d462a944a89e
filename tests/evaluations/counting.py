"""`webots-mcp serve` that notes each call of a tool: `counting FILE [OPTION...]`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from webots_mcp.cli import main
from webots_mcp.server.mcp_server import ToolServer

if __name__ == "__main__":
    file, *options = sys.argv[1:]
    answer = ToolServer.call_tool

    async def counted(
        self: ToolServer, name: str, arguments: dict[str, Any], *context: Any, **others: Any
    ) -> Any:
        with Path(file).open("a", encoding="utf-8") as calls:
            calls.write(json.dumps({"tool": name, "arguments": arguments}) + "\n")
        return await answer(self, name, arguments, *context, **others)

    ToolServer.call_tool = counted
    sys.exit(main(["serve", *options]))
