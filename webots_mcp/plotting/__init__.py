"""Pictures of a recording: signals over time, and the way of a robot; PNG or SVG."""

from webots_mcp.plotting.canvas import (
    HEIGHT_PX,
    LEAST_HEIGHT_PX,
    LEAST_WIDTH_PX,
    MOST_PX,
    WIDTH_PX,
    ImageFormat,
    Picture,
    Sheet,
    image_format_of,
)
from webots_mcp.plotting.question import PlotKind, plot
from webots_mcp.plotting.signals import plot_signals
from webots_mcp.plotting.trajectory import plot_trajectory
from webots_mcp.plotting.trials import plot_trials

__all__ = [
    "HEIGHT_PX",
    "LEAST_HEIGHT_PX",
    "LEAST_WIDTH_PX",
    "MOST_PX",
    "WIDTH_PX",
    "ImageFormat",
    "Picture",
    "PlotKind",
    "Sheet",
    "image_format_of",
    "plot",
    "plot_signals",
    "plot_trajectory",
    "plot_trials",
]
