"""Checks of a real Webots for what is known from its sources only: `webots-mcp prove`."""

from webots_mcp.extras.plugin_registry import Plugin, PluginCommand

PLUGIN = Plugin(
    commands=(PluginCommand("prove", "Server and set-up", f"{__name__}.prove_command:prove"),),
)
