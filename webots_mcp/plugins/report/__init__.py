"""Reports: one or two runs as one HTML file that needs nothing else, to read and to send.

Jinja2 and Bokeh are imported with the first report.
"""

from webots_mcp.plugins import Plugin

PLUGIN = Plugin(
    command_modules=(f"{__name__}.report_command",), questions=(f"{__name__}.write_report",)
)
