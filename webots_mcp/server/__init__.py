"""The MCP server: tools over stdio and HTTP, access tokens and limits.

It publishes the questions as MCP tools. Only the command line and plugins import it.
"""
