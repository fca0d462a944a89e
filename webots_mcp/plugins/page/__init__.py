"""A live page of a recording in the browser: `webots-mcp view`.

A server on loopback. It asks the same questions as the tools, on connections that cannot
write; what a button does goes the way that the tools' commands go.
"""

from webots_mcp.extras.plugins import Plugin, PluginCommand

PLUGIN = Plugin(
    commands=(PluginCommand("view", "What is recorded now", f"{__name__}.view_command:view"),)
)
