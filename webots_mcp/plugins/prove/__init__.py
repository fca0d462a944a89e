"""What is known of Webots from its sources alone, tried on a real one: `webots-mcp prove`."""

from webots_mcp.extras.plugins import Plugin, PluginCommand

PLUGIN = Plugin(
    commands=(PluginCommand("prove", "Setting up and running", f"{__name__}.prove_command:prove"),),
)
