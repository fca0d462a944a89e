"""The MCP server over a recording."""

from webots_mcp.server.app import create_server

__all__ = ["create_server"]
