"""Reports: one or two runs as one self-contained HTML file, to read and to send.

Jinja2 is imported with the first report.
"""

from webots_mcp.extras.plugin_registry import Plugin, PluginCommand

PLUGIN = Plugin(
    commands=(PluginCommand("report", "Ask", f"{__name__}.report_command:report"),),
    questions=(f"{__name__}.write_report",),
)
