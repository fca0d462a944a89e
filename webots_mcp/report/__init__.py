"""Reports: one or two runs as one HTML file that needs nothing else, to read and to send.

Jinja2 and Bokeh, the extra `view`, are imported with the first report, never with this package.
"""

from webots_mcp.report.making import MAX_MB, MIN_MB, MOST_RUNS, Report, make_report
from webots_mcp.report.writing import file_name, require_folder, require_free, write_report

__all__ = [
    "MAX_MB",
    "MIN_MB",
    "MOST_RUNS",
    "Report",
    "file_name",
    "make_report",
    "require_folder",
    "require_free",
    "write_report",
]
