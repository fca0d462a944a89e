"""Draw the pictures for a page: SVG with its values, which `figure.js` shows.

A page that shows them has the script, and the custom properties --ink, --faint, --grid and
--ground.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as File
from typing import Any, Final

from webots_mcp.plotting.axes import AxesBox
from webots_mcp.plotting.canvas import Room
from webots_mcp.plotting.colours import ON_A_PAGE
from webots_mcp.plotting.curves import Curve
from webots_mcp.plotting.intervals import Lane
from webots_mcp.plotting.robot_path import thinned_with_headings
from webots_mcp.plotting.signal_plot import SignalAxes, paint_signals
from webots_mcp.plotting.trajectory import Obstacle, PlottedPath, TrajectoryAxes, paint_trajectory
from webots_mcp.signals.naming import spelled_out
from webots_mcp.store.signal_history import MOST_POINTS

ROOM: Final = Room(points=MOST_POINTS, panels=8, lanes=8, rows=16)
WIDTH_PX: Final = 900


@dataclass(frozen=True)
class FigureLayout:
    """The height of a figure, in pixels.

    Attributes:
        panel_px: Each panel.
        row_px: Each row of intervals.
        around_px: Axis and legend.
    """

    panel_px: int = 150
    row_px: int = 18
    around_px: int = 90


_LAYOUT: Final = FigureLayout()


@dataclass(frozen=True)
class Figure:
    """A picture for a page.

    Attributes:
        data: Where its axes are, and the values that are shown at the cursor.
        title: What it shows, in one line.
        notes: What is not in it, or what its reader should know.
    """

    svg: str
    data: dict[str, Any]
    title: str
    notes: tuple[str, ...]

    @property
    def markup(self) -> str:
        """SVG and values; nothing that was recorded ends the element that holds them."""
        values = json.dumps(self.data, separators=(",", ":")).replace("<", "\\u003c")
        stage = f'<div class="stage">{self.svg}</div>'
        return f'{stage}<script type="application/json">{values}</script>'


def figure_part(name: str) -> str:
    """Return what a page with figures has in it: `figure.js`, `figure.css`."""
    return (File(__file__).parent / name).read_text("utf-8")


def signals_figure(
    plot: SignalAxes, notes: Sequence[str] = (), *, width_px: int = WIDTH_PX,
    height_px: int | None = None,
) -> Figure:  # fmt: skip
    """Signals over time, as `compose_signals` gathers them; as high as it needs, or as given."""
    needed_px = (
        _LAYOUT.around_px + _LAYOUT.panel_px * len(plot.panels) + _LAYOUT.row_px * len(plot.rows)
    )
    canvas, frames = paint_signals(
        plot, width_px, max(height_px or 0, needed_px), ON_A_PAGE, titled=False
    )
    data = {
        "kind": "time",
        "frames": [_placed(frame) for frame in frames],
        "curves": [
            _curve(curve, number, plot.colour_by_run.get(curve.run_id))
            for number, panel in enumerate(plot.panels)
            for curve in panel.curves
        ],
        "lanes": [_lane(lane) for lane in [*([plot.bands] if plot.bands else []), *plot.lanes]],
        "events": [_lane(lane) for lane in plot.events],
        "panels": [panel.names for panel in plot.panels],
    }
    return Figure(canvas.svg(), data, plot.title, tuple(notes))


def way_figure(
    plot: TrajectoryAxes, notes: Sequence[str] = (), obstacles: Sequence[Obstacle] = (), *,
    width_px: int = WIDTH_PX, height_px: int = 460,
) -> Figure:  # fmt: skip
    """Ways in the plane, as `compose_trajectory` gathers them, and what stands there."""
    canvas, frame = paint_trajectory(
        plot, width_px, height_px, ON_A_PAGE, obstacles=obstacles, titled=False
    )
    tracks = [_track(each) for each in plot.tracks]
    data = {"kind": "plane", "frames": [_placed(frame)], "tracks": tracks}
    return Figure(canvas.svg(), data, plot.title, tuple(notes))


def _placed(frame: AxesBox) -> dict[str, Any]:
    return {
        "left": frame.left, "top": frame.top, "width": frame.width, "height": frame.height,
        "x": list(frame.x), "y": list(frame.y),
    }  # fmt: skip


def _curve(curve: Curve, frame: int, run: str | None) -> dict[str, Any]:
    points = [point for point in curve.points if not math.isnan(point[0])]
    columns: dict[str, Any] = dict(
        zip(("t", "mean", "low", "high"), map(_numbers, zip(*points, strict=True)), strict=True)
    )
    if columns["low"] == columns["high"]:  # each point is one row: the mean says it all
        del columns["low"], columns["high"]
    name = spelled_out(f"{curve.name}, {run}" if run else curve.name)
    part = f"run {curve.run_id}" if run else f"curve {name}"
    return {"name": name, "part": part, "unit": curve.unit or "", "frame": frame, **columns}


def _numbers(values: Sequence[float]) -> list[float | None]:
    return [float(f"{each:.12g}") if math.isfinite(each) else None for each in values]


def _lane(lane: Lane) -> dict[str, Any]:
    held = [[spelled_out(each.value), each.start_s, each.end_s] for each in lane.intervals]
    return {"name": spelled_out(lane.name), "held": held}


def _track(track: PlottedPath) -> dict[str, Any]:
    places = thinned_with_headings(track.path.places) if track.path.places else []
    columns = zip(*places, strict=True) if places else ((), (), (), ())
    named = zip(("t", "x", "y", "heading"), map(_numbers, columns), strict=True)
    return {"name": spelled_out(track.name), **dict(named), "body": list(track.body)}
