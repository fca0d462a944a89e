"""The main job without Webots: `webots-mcp demo` and `webots-mcp launch --stand-in`."""

from webots_mcp.plugins import Plugin

PLUGIN = Plugin(
    command_modules=(f"{__name__}.demo_command",),
    stand_in="webots_mcp.standin.__main__:run_world",
)
