"""A live page of a recording in the browser: `webots-mcp view`.

A server on loopback answers the page with the same questions as the tools, on connections that
cannot write. Its buttons send the same commands as the tools.
"""

from webots_mcp.extras.plugin_registry import Plugin, PluginCommand

PLUGIN = Plugin(commands=(PluginCommand("view", "Watch", f"{__name__}.view_command:view"),))
