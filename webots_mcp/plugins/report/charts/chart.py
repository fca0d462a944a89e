"""What the interactive figures have in common: how they look, and which tools they have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
from bokeh.models import ColumnDataSource, HoverTool, LayoutDOM, Legend, LegendItem

from webots_mcp.naming import spelled_out
from webots_mcp.plotting.palette import FAINT, INK

Key = TypeVar("Key", bound="tuple[object, ...]")

GRID: Final = "#E6E6E6"
_FONT: Final = "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif"
_LEGEND_PX: Final = 16


@dataclass(frozen=True)
class Chart:
    """Figures that belong together.

    Attributes:
        layout: What to put into a page; as wide as the place that it is put into.
        title: What it shows, in one line.
        notes: What is not in it, or what its reader should know.
    """

    layout: LayoutDOM
    title: str
    notes: tuple[str, ...]


def plain(text: str) -> str:
    """A text that is shown as it is: Bokeh takes what stands between `$$` for a formula."""
    text = spelled_out(text)
    for mark in ("$$", "\\(", "\\["):
        text = text.replace(mark, f"{mark[0]}\u200b{mark[1]}")
    return text


def sources_of(data: Mapping[Key, dict[str, Any]]) -> dict[Key, ColumnDataSource]:
    """Data sources of columns; their names in the browser are such as "curve pose.x 3"."""
    names = {key: " ".join(str(part) for part in key if part != "") for key in data}
    return {key: ColumnDataSource(data=data[key], name=names[key]) for key in data}


def texts(column: Sequence[str]) -> list[str]:
    """A column of texts that were recorded."""
    return [spelled_out(text) for text in column]


def numbers(values: Sequence[float]) -> np.ndarray[Any, Any]:
    """A column of numbers, which goes to the browser as it is in memory."""
    return np.asarray(values, dtype=np.float64)


def style(fig: Any) -> None:
    """Calm axes, a light grid, one font."""
    fig.outline_line_color = None
    fig.toolbar.logo = None
    fig.grid.grid_line_color = GRID
    fig.xaxis.minor_tick_line_color = None
    fig.yaxis.minor_tick_line_color = None
    fig.axis.axis_line_color = FAINT
    fig.axis.major_tick_line_color = FAINT
    fig.axis.major_label_text_color = INK
    fig.axis.major_label_text_font = _FONT
    fig.axis.axis_label_text_color = INK
    fig.axis.axis_label_text_font = _FONT
    fig.axis.axis_label_text_font_style = "normal"
    fig.axis.axis_label_text_font_size = "12px"
    fig.title.text_font = _FONT
    fig.title.text_color = INK
    fig.title.text_font_size = "12px"


def hover(renderers: Sequence[Any], tooltips: Sequence[tuple[str, str]], **options: Any) -> Any:
    """What is told under the pointer; it is one of many and needs no button of its own."""
    tool: Any = HoverTool  # its types do not take a list of renderers of one kind
    told = [(spelled_out(name), value) for name, value in tooltips]
    return tool(renderers=list(renderers), tooltips=told, visible=False, **options)


def legend(items: Sequence[LegendItem]) -> Legend:
    """In one row above a figure, so that figures below each other stay equally wide."""
    return Legend(
        items=list(items),
        orientation="horizontal",
        location="top_left",
        border_line_color=None,
        background_fill_alpha=0,
        margin=2,
        spacing=10,
        label_text_font=_FONT,
        label_text_font_size="11px",
        label_text_color=INK,
        label_height=_LEGEND_PX,
        glyph_height=_LEGEND_PX,
        click_policy="hide",
    )
