"""The main job from end to end on the stand-in: `webots-mcp demo`."""

from webots_mcp.plugins import Plugin

PLUGIN = Plugin(commands=(f"{__name__}.demo_command",))
