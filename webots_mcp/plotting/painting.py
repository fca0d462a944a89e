"""Painting what surrounds the data of a picture: title, axes, grid, legend, scale and marks.

Samples in a legend are functions that draw at a position.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeAlias

from webots_mcp.plotting.axes import AxesBox, ticks
from webots_mcp.plotting.canvas import TEXT_PX, Canvas, width_of, wrapped
from webots_mcp.plotting.colours import Area, scaled

LINE_PX: Final = 16.0  # from line to line
SCALE_PX: Final = 78.0  # what a scale of colours takes


@dataclass(frozen=True)
class LegendLayout:
    """The layout of legends and scales of colours.

    Attributes:
        sample_px: Width of a sample with its gap.
        gap_px: Gap between two entries.
        height_share: Share of the picture that a legend may take.
        bar_px: Width of a scale of colours.
        bar_steps: Steps of colour in a scale.
        title_px: Size of the letters of a title.
    """

    sample_px: float = 26.0
    gap_px: float = 14.0
    height_share: float = 0.25
    bar_px: float = 12.0
    bar_steps: int = 64
    title_px: float = 13.0


_LEGEND: Final = LegendLayout()


def _star(outer: float, inner: float) -> str:
    """Return the outline of a star with five points, as an SVG path."""
    corners = (
        f"{r * math.sin(i * math.pi / 5):.2f} {-r * math.cos(i * math.pi / 5):.2f}"
        for i, r in enumerate([outer, inner] * 5)
    )
    return f"M{'L'.join(corners)}Z"


# Outlines around the origin, about one unit large.
SHAPES: Final = {
    "circle": "M-1 0A1 1 0 1 1 1 0A1 1 0 1 1-1 0Z",
    "square": "M-.9-.9H.9V.9H-.9Z",
    "diamond": "M0-1.2L.7 0 0 1.2-.7 0Z",
    "cross": "M-1-.6L-.6-1 0-.4.6-1 1-.6.4 0 1 .6 .6 1 0 .4-.6 1-1 .6-.4 0Z",
    "plus": "M-.35-1H.35V-.35H1V.35H.35V1H-.35V.35H-1V-.35H-.35Z",
    "triangle": "M0-1.1L1 .8H-1Z",
    "star": _star(1.2, 0.5),
    "arrow": "M1 0L-.9.9V-.9Z",
    "nose": "M2.9 0L1.3 .85V-.85Z",
}
Sample: TypeAlias = "Callable[[Canvas, float, float], None]"


class LegendEntry(NamedTuple):
    """A line of a legend.

    Attributes:
        draw: Draws its sample around a place; None without one.
        hides: The name of the elements that a click on it hides in a page.
    """

    text: str
    draw: Sample | None = None
    hides: str = ""

    @property
    def width_px(self) -> float:
        """With its sample."""
        return width_of(self.text) + (_LEGEND.sample_px if self.draw else 0.0) + _LEGEND.gap_px


def line_sample(colour: str, dash: str = "none", width: float = 1.6) -> Sample:
    """Draw a segment of a line."""

    def draw(canvas: Canvas, x: float, y: float) -> None:
        canvas.add("path", d=f"M{x - 10:g} {y:g}h20", stroke=colour, stroke_width=width,
                   stroke_dasharray=dash)  # fmt: skip

    return draw


def area_sample(area: Area, opacity: float = 1.0) -> Sample:
    """Draws an area."""

    def draw(canvas: Canvas, x: float, y: float) -> None:
        paint_area(canvas, area, (x - 10, y - 5, 20.0, 10.0), opacity)

    return draw


def paint_area(
    canvas: Canvas, area: Area, box: tuple[float, float, float, float], opacity: float = 1.0
) -> None:
    """A rectangle (left, top, width, height) in the style of an area."""
    left, top, width, height = box
    place = {"x": left, "y": top, "width": width, "height": height}
    opaque = {} if opacity == 1.0 else {"fill_opacity": opacity}
    canvas.add("rect", **place, fill=area.colour, **opaque)
    if area.dotted:
        canvas.add("rect", **place, fill="url(#hatch-dots)", fill_opacity=opacity / 2)


def hatch_sample(pattern: str) -> Sample:
    """Draws a hatched area."""

    def draw(canvas: Canvas, x: float, y: float) -> None:
        canvas.add("rect", x=x - 10, y=y - 5, width=20, height=10, fill=f"url(#{pattern})")

    return draw


def rows_of(
    entries: Sequence[LegendEntry], width_px: float, height_px: float
) -> list[list[LegendEntry]]:
    """Return the entries in rows, up to a quarter of the height; the rest are counted."""
    most = max(1, int(_LEGEND.height_share * height_px / LINE_PX))
    rows: list[list[LegendEntry]] = []
    for index, entry in enumerate(entries):
        if rows and sum(each.width_px for each in rows[-1]) + entry.width_px <= width_px:
            rows[-1].append(entry)
        elif len(rows) < most:
            rows.append([entry])
        else:
            rows[-1][-1] = LegendEntry(f"and {len(entries) - index + 1} more")
            break
    return rows


def paint_rows(
    canvas: Canvas, rows: Sequence[Sequence[LegendEntry]], top: float, left: float | None = None
) -> None:
    """Rows of a legend from a height downwards: centred, or from the left."""
    for row, entries in enumerate(rows):
        width = sum(each.width_px for each in entries) - _LEGEND.gap_px
        x = max(4.0, (canvas.width_px - width) / 2) if left is None else left
        y = top + (row + 0.5) * LINE_PX
        for entry in entries:
            hides = {"data_hides": entry.hides} if entry.hides else {}
            canvas.open(class_="entry", **hides)
            if entry.draw:
                entry.draw(canvas, x + 10, y)
            canvas.text(x + (_LEGEND.sample_px if entry.draw else 0.0), y + 4, entry.text)
            canvas.close()
            x += entry.width_px


def paint_title(canvas: Canvas, title: str) -> float:
    """At the top left, in as many lines as it needs; returns how high it is."""
    lines = wrapped(title, canvas.width_px - 16, _LEGEND.title_px * 1.1)
    for row, line in enumerate(lines):
        canvas.text(
            8, _LEGEND.title_px + 4 + row * LINE_PX, line, size=_LEGEND.title_px, font_weight="bold"
        )
    return 10 + LINE_PX * len(lines)


def paint_x_axis(
    canvas: Canvas, frame: AxesBox, marks: Sequence[tuple[float, str]], label: Sequence[str] = ()
) -> None:
    """A line below the frame, with ticks, their labels, and what the axis is."""
    canvas.open(class_="x-axis")
    pen = {"stroke": canvas.theme.faint, "stroke_width": 0.8}
    canvas.add("path", d=f"M{frame.left:.1f} {frame.bottom:.1f}H{frame.right:.1f}", **pen)
    canvas.open(class_="ticks")
    for value, text in marks:
        x = float(frame.px(value))
        canvas.add("path", d=f"M{x:.1f} {frame.bottom:.1f}v4", **pen)
        half = width_of(text) / 2
        inside = min(max(x, half), canvas.width_px - half)
        canvas.text(inside, frame.bottom + 16, text, anchor="middle")
    canvas.close()
    for row, line in enumerate(label):
        y = frame.bottom + 33 + row * LINE_PX
        canvas.text(frame.left + frame.width / 2, y, line, anchor="middle")
    canvas.close()


def paint_y_axis(canvas: Canvas, frame: AxesBox, marks: Sequence[tuple[float, str]]) -> None:
    """A line at the left of the frame, with ticks, their labels, and lines through the frame."""
    canvas.open(class_="y-axis")
    faint = {"stroke": canvas.theme.faint, "stroke_width": 0.8}
    canvas.add("path", d=f"M{frame.left:.1f} {frame.top:.1f}V{frame.bottom:.1f}", **faint)
    canvas.open(class_="ticks")
    for value, text in marks:
        y = float(frame.py(value))
        canvas.add("path", d=f"M{frame.left:.1f} {y:.1f}h-4", **faint)
        canvas.text(frame.left - 7, y + 4, text, anchor="end")
    canvas.close()
    canvas.close()


def paint_grid(
    canvas: Canvas, frame: AxesBox, x: Sequence[tuple[float, str]], y: Sequence[tuple[float, str]]
) -> None:
    """Light lines at the ticks."""
    lines = [f"M{frame.px(value):.1f} {frame.top:.1f}V{frame.bottom:.1f}" for value, _ in x]
    lines += [f"M{frame.left:.1f} {frame.py(value):.1f}H{frame.right:.1f}" for value, _ in y]
    canvas.add("path", class_="grid", d="".join(lines), stroke=canvas.theme.grid, stroke_width=0.7)


def paint_y_label(canvas: Canvas, frame: AxesBox, label: str) -> None:
    """What the vertical axis is, along it."""
    x, y = TEXT_PX + 2, frame.top + frame.height / 2
    canvas.text(0, 0, label, anchor="middle", transform=f"translate({x:g} {y:.1f}) rotate(-90)")


def paint_scale(
    canvas: Canvas, frame: AxesBox, scale: str, bounds: tuple[float, float], label: str
) -> None:
    """A scale of colours at the right of the frame, and what it means."""
    left, height = frame.right + 12, frame.height / _LEGEND.bar_steps
    for step in range(_LEGEND.bar_steps):
        colour = scaled(step / (_LEGEND.bar_steps - 1), scale)
        y = frame.bottom - (step + 1) * height
        canvas.add("rect", x=left, y=y, width=_LEGEND.bar_px, height=height + 0.5, fill=colour)
    bar = AxesBox(left, frame.top, _LEGEND.bar_px, frame.height, (0, 1), bounds)
    for value, text in ticks(*bounds, frame.height / 40):
        canvas.text(left + _LEGEND.bar_px + 4, float(bar.py(value)) + 4, text)
    x, y = canvas.width_px - 6, frame.top + frame.height / 2
    canvas.text(0, 0, label, anchor="middle", transform=f"translate({x:g} {y:.1f}) rotate(-90)")


def paint_mark(
    canvas: Canvas, shape: str, place: tuple[float, float], size: float, *, degrees: float = 0.0,
    **style: Any,
) -> None:  # fmt: skip
    """A mark at a place in pixels, so large from its middle; in a page it keeps its size."""
    x, y = place
    canvas.open(class_="at", data_x=x, data_y=y, transform=f"translate({x:.2f} {y:.2f})")
    turned = f" rotate({degrees:.1f})" if degrees else ""
    scaled_by = {"transform": f"scale({size:g}){turned}"}
    width = style.pop("stroke_width", 0.0) / size
    canvas.add("path", d=SHAPES[shape], stroke_width=f"{width:.3f}", **scaled_by, **style)
    canvas.close()


def mark_sample(shape: str, size: float, **style: Any) -> Sample:
    """Draws a mark."""

    def draw(canvas: Canvas, x: float, y: float) -> None:
        paint_mark(canvas, shape, (x, y), size, **style)

    return draw
