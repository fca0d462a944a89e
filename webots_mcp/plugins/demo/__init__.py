"""Running robots without Webots: `webots-mcp demo` and `webots-mcp launch --stand-in`."""

from webots_mcp.extras.plugin_registry import Plugin, PluginCommand

PLUGIN = Plugin(
    commands=(PluginCommand("demo", "Start", f"{__name__}.demo_command:demo"),),
    stand_in="webots_mcp.standin.__main__:run_world",
)
