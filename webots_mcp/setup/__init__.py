"""What `webots-mcp init` does: it makes a Webots project and its MCP clients ready."""
