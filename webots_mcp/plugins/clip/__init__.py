"""Clips: the seconds around a moment of a run as an animated picture, and as a contact sheet.

A clip shows what a camera recorded, or where the robot was on the map, above the curves of signals.
Pillow encodes it.
"""

from webots_mcp.extras.plugin_registry import Plugin, PluginCommand

PLUGIN = Plugin(
    commands=(PluginCommand("clip", "Ask", f"{__name__}.clip_command:clip"),),
    questions=(f"{__name__}.get_clip",),
)
