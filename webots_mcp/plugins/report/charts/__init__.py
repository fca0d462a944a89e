"""Interactive figures: `signals_chart(connection, ranges, names)`, `way_chart(connection, ranges)`.

Both answer with a `Chart`: its `layout` goes into a page (`bokeh.embed`, or a server's document),
its `notes` say what is not in it. They draw what `plotting` gathers for its pictures; a `Chart`
keeps the data sources of its figures, so that a page can go on with them.

Importing this package imports Bokeh, which takes a while.
"""

from webots_mcp.plugins.report.charts.chart import Chart
from webots_mcp.plugins.report.charts.signal_panels import SignalsChart, draw_signals, signals_chart
from webots_mcp.plugins.report.charts.way import WayChart, draw_way, way_chart

__all__ = [
    "Chart",
    "SignalsChart",
    "WayChart",
    "draw_signals",
    "draw_way",
    "signals_chart",
    "way_chart",
]
