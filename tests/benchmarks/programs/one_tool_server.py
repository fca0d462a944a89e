"""The smallest MCP server of the same library: what ours is compared with."""

from __future__ import annotations

from mcp.server import MCPServer

server = MCPServer("one tool")


@server.tool()
def add(a: int, b: int) -> int:
    """Add two numbers."""
    return a + b


if __name__ == "__main__":
    server.run()
