"""A score over the runs of a robot as a picture: how a training went."""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Sequence
from typing import Any, Final

from webots_mcp.analysis.arrays import Array, np
from webots_mcp.errors import InvalidRangeError, NothingRecordedError
from webots_mcp.judging.run_series import ScoreSeries, score_series
from webots_mcp.plotting.axes import AxesBox, axis_range, ticks
from webots_mcp.plotting.canvas import Canvas, PlotImage, Sheet, fitted, width_of
from webots_mcp.plotting.colours import FAINT, LINES
from webots_mcp.plotting.painting import (
    LINE_PX,
    LegendEntry,
    line_sample,
    mark_sample,
    paint_grid,
    paint_mark,
    paint_rows,
    paint_title,
    paint_x_axis,
    paint_y_axis,
    paint_y_label,
    rows_of,
)
from webots_mcp.plotting.signal_plot import line_through
from webots_mcp.store.reading.ranges import Scope
from webots_mcp.store.robots import resolve_robot
from webots_mcp.store.run_rows import fetch_run

DEADLINE_S: Final = 5.0
_BELOW_PX: Final = 42.0
_WINDOW_SHARE: Final = 0.05  # of the runs that a running median is made of
_SMALLEST_WINDOW: Final = 5
_SCORE: Final = LINES[0]
_LEVEL: Final = LINES[1]


def plot_run_scores(
    connection: sqlite3.Connection,
    score: str | None = None,
    *,
    scope: Scope,
    run_ids: Sequence[int] = (),
    sheet: Sheet | None = None,
) -> PlotImage:
    """Return the score of each run, its running median, the spread around it, and its levels.

    Args:
        connection: Any.
        score: As for trials; None for the published reward of each run.
        scope: Its robot is the one whose runs are drawn, or the robot of its run.
        run_ids: Which runs; none for all.
        sheet: Size and format; None for a PNG of 900 x 500 pixels.

    Raises:
        InvalidRangeError: The scope has times.
        NothingRecordedError: No run has a score.
        WebotsMCPError: Its other kinds, as `score_series` raises them.
    """
    sheet = sheet or Sheet()
    series, name = compose_run_scores(connection, score, scope, run_ids)
    canvas = paint_run_scores(series, name, sheet.width_px, sheet.height_px)
    scored = len(series.ranked)
    left = len(series.runs) - scored
    notes = [f"{left} of {len(series.runs)} runs have no score"] if left else []
    best = series.ranked[0]
    caption = (
        f"{series.score} of {scored} runs of {name}: each, running median and middle 80 %; best: "
        f"run {best.run_id} ({best.value:.4g})"
    )
    return canvas.picture(sheet.image_format, caption, notes)


def compose_run_scores(
    connection: sqlite3.Connection,
    score: str | None,
    scope: Scope,
    run_ids: Sequence[int] = (),
) -> tuple[ScoreSeries, str]:
    """Return what `plot_run_scores` paints: the series and the robot; errors as there."""
    if scope.last_s is not None or scope.in_simulation_time or scope.in_wall_time:
        raise InvalidRangeError(
            "A plot of a score shows whole runs, not a range of time. Leave out the times, and "
            "name runs with run_ids where only some of them are asked for."
        )
    if scope.robot is None and scope.run_id is not None:
        robot_id = fetch_run(connection, scope.run_id).robot_id
        query = "SELECT name FROM robot WHERE id = ?"
        name = str(connection.execute(query, (robot_id,)).fetchone()[0])
    else:
        robot = resolve_robot(connection, scope.robot, time.time())
        robot_id, name = robot.id, robot.name
    series = score_series(
        connection, robot_id, name, run_ids or None, score=score, deadline_s=DEADLINE_S
    )
    if not series.ranked:
        raise NothingRecordedError(f"No run has the score {series.score!r}: {series.runs[0].why}.")
    return series, name


def paint_run_scores(series: ScoreSeries, robot: str, width_px: int, height_px: int) -> Canvas:
    """Paint it."""
    canvas = Canvas(width_px, height_px)
    runs = [run for run in series.runs if run.value is not None]
    ids = np.array([run.run_id for run in runs], np.float64)
    values = np.array([run.value for run in runs], np.float64)
    top = paint_title(canvas, f"{robot}, {len(runs)} runs: {series.score}")
    entries = [
        LegendEntry("one run", mark_sample("circle", 2.2, fill=FAINT)),
        LegendEntry("running median, middle 80 %", line_sample(_SCORE, width=2.2)),
        LegendEntry("best run", mark_sample("circle", 7.0, **_ring())),
    ]
    if len(series.levels) > 1:
        entries.append(LegendEntry("levels", line_sample(_LEVEL, "5 4")))
    legend = rows_of(entries, width_px - 20, height_px)
    y = axis_range(float(values.min()), float(values.max()))
    x = axis_range(float(ids.min()), float(ids.max()), 0.02)
    left = 34 + max(width_of(text) for _, text in ticks(*y, 8))
    height = max(20.0, height_px - top - _BELOW_PX - LINE_PX * len(legend))
    frame = AxesBox(left, top, width_px - left - 16, height, x, y)
    marks = _whole(ticks(*x, frame.width / 80)), ticks(*y, height / 40)
    paint_grid(canvas, frame, *marks)
    _paint_runs(canvas, frame, ids, values)
    _paint_running(canvas, frame, ids, values)
    for level in series.levels if len(series.levels) > 1 else ():
        across = np.array([frame.px(level.first_run), frame.px(level.last_run)])
        at = np.full(2, float(frame.py(level.mean)))
        canvas.add("path", d=line_through(across, at), fill="none", stroke=_LEVEL,
                   stroke_width=1.8, stroke_dasharray="5 4")  # fmt: skip
    best = series.ranked[0]
    place = float(frame.px(best.run_id)), float(frame.py(best.value or 0.0))
    paint_mark(canvas, "circle", place, 7.0, **_ring())
    paint_x_axis(canvas, frame, marks[0], ["run"])
    paint_y_axis(canvas, frame, marks[1])
    paint_y_label(canvas, frame, fitted(series.score, height))
    paint_rows(canvas, legend, height_px - LINE_PX * len(legend) - 2)
    return canvas


def _ring() -> dict[str, Any]:
    return {"fill": "none", "stroke": LINES[2], "stroke_width": 2.2}


def _whole(marks: list[tuple[float, str]]) -> list[tuple[float, str]]:
    """Return the ticks at numbers of runs."""
    return [(at, text) for at, text in marks if at == int(at)]


def _paint_runs(canvas: Canvas, frame: AxesBox, ids: Array, values: Array) -> None:
    """Paint a dot for each run, all in one path."""
    places = zip(frame.px(ids).tolist(), frame.py(values).tolist(), strict=True)
    dots = "".join(f"M{x:.1f} {y:.1f}h.01" for x, y in places)
    size = 3.0 if len(ids) <= 500 else 2.0
    canvas.add("path", d=dots, fill="none", stroke=FAINT, stroke_opacity=0.6, stroke_width=size,
               stroke_linecap="round")  # fmt: skip


def _paint_running(canvas: Canvas, frame: AxesBox, ids: Array, values: Array) -> None:
    """Paint the running median, and the area between a tenth and nine tenths of the scores."""
    window = min(len(values), max(_SMALLEST_WINDOW, math.ceil(_WINDOW_SHARE * len(values))))
    windows = np.lib.stride_tricks.sliding_window_view(values, window)
    step = max(1, len(windows) // 400)  # more points than pixels show nothing
    low, middle, high = np.percentile(windows[::step], (10, 50, 90), axis=1)
    centres = np.lib.stride_tricks.sliding_window_view(ids, window)[::step].mean(axis=1)
    x = frame.px(centres)
    around = np.concatenate([x, x[::-1]]), np.concatenate([frame.py(high), frame.py(low)[::-1]])
    canvas.add("path", d=f"{line_through(*around)}Z", fill=_SCORE, fill_opacity=0.2)
    canvas.add("path", d=line_through(x, frame.py(middle)), fill="none", stroke=_SCORE,
               stroke_width=2.2)  # fmt: skip
