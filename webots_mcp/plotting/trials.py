"""The scores of trials as a picture: over one parameter, or over two."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.analysis.arrays import np
from webots_mcp.analysis.summary import Outcome, Ranked, rank
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.plotting.axes import AxesBox, axis_range, ticks
from webots_mcp.plotting.canvas import Canvas, PlotImage, Sheet, fitted, short, width_of
from webots_mcp.plotting.colours import INK, LINES, scaled
from webots_mcp.plotting.painting import (
    LINE_PX,
    SCALE_PX,
    LegendEntry,
    line_sample,
    mark_sample,
    paint_grid,
    paint_mark,
    paint_rows,
    paint_scale,
    paint_title,
    paint_x_axis,
    paint_y_axis,
    paint_y_label,
    rows_of,
)
from webots_mcp.plotting.signal_plot import line_through
from webots_mcp.signals.naming import listed, nearest_first
from webots_mcp.store.trial_sets import TrialRecord, best_of, fetch_trial_set, trials_of

_BELOW_PX: Final = 42.0
_RING: Final[dict[str, Any]] = {"fill": "none", "stroke": LINES[1], "stroke_width": 2.4}
_DOT: Final[dict[str, Any]] = {"fill": INK}
_MEAN: Final[dict[str, Any]] = {"fill": LINES[0]}
_FAILED: Final[dict[str, Any]] = {"fill": LINES[1]}


def plot_trials(
    connection: sqlite3.Connection,
    set_id: int,
    names: Sequence[str] = (),
    *,
    sheet: Sheet | None = None,
) -> PlotImage:
    """Return the scores of a trial set: each, their mean and their spread; the best is marked.

    Args:
        connection: Any.
        set_id: The trial set.
        names: One or two parameters; none for the first one or two that were varied.
        sheet: Size and format; None for a PNG of 900 x 500 pixels.

    Raises:
        InvalidInputError: There is no such set, or it did not try a parameter of that name.
        NothingRecordedError: No trial has a score yet.
    """
    sheet = sheet or Sheet()
    plot, notes = compose_trials(connection, set_id, names)
    canvas = paint_trials(plot, sheet.width_px, sheet.height_px)
    caption = f"{plot.title}: {plot.score} over {' and '.join(plot.names)}"
    return canvas.picture(sheet.image_format, caption, notes)


def compose_trials(
    connection: sqlite3.Connection, set_id: int, names: Sequence[str] = ()
) -> tuple[TrialAxes, tuple[str, ...]]:
    """Return what `plot_trials` paints, and its notes; arguments and errors as there."""
    over = [each for each in trials_of(connection, set_id) if each.is_over]
    if not any(each.score is not None for each in over):
        raise NothingRecordedError(
            f"No trial of set {set_id} has a score yet, so there is nothing to draw. "
            f"webots_get_trials(trial_set={set_id}) shows how far it is."
        )
    plan = json.loads(fetch_trial_set(connection, set_id).plan)
    varied = _varied(over)
    chosen = _chosen(over, names) or varied[:2] or list(over[0].values)[:1]
    ranking = rank([_outcome(each, chosen) for each in over], best_of(plan))
    others = [name for name in varied if name not in chosen]
    notes = [f"each over all values of {listed(others)}"] * bool(others)
    best = ranking.sets[0].parameters if ranking.sets[0].score else None
    title = f"trial set {set_id}, {len(over)} trials"
    return TrialAxes(title, chosen, str(plan.get("score")), ranking.sets, best), tuple(notes)


def _varied(trials: Sequence[TrialRecord]) -> list[str]:
    """Return the parameters that had more than one value."""
    names = dict.fromkeys(name for each in trials for name in each.values)
    return [name for name in names if len({repr(each.values.get(name)) for each in trials}) > 1]


def _chosen(trials: Sequence[TrialRecord], names: Sequence[str]) -> list[str]:
    known = list(dict.fromkeys(name for each in trials for name in each.values))
    for name in names:
        if name not in known:
            near = ", ".join(nearest_first(name, known)[:5])
            raise InvalidInputError(f"These trials did not try {name!r:.80}. They tried {near}.")
    if len(names) > 2:
        raise InvalidInputError(
            f"{len(names)} parameters are named, but only one or two can be drawn. Leave some out."
        )
    return list(names)


def _outcome(trial: TrialRecord, names: Sequence[str]) -> Outcome:
    values: dict[str, Any] = {name: trial.values.get(name) for name in names}
    return Outcome(values, trial.score, trial.error, pruned=trial.status == "pruned")


@dataclass(frozen=True)
class TrialAxes:
    """What is to be painted.

    Attributes:
        names: One or two parameters.
        sets: Their values, with the scores and failures that those had.
        best: The values of the best set.
    """

    title: str
    names: Sequence[str]
    score: str
    sets: Sequence[Ranked]
    best: dict[str, Any] | None


def paint_trials(plot: TrialAxes, width_px: int, height_px: int) -> Canvas:
    """Paint it."""
    canvas = Canvas(width_px, height_px)
    top = paint_title(canvas, f"{plot.title}: {plot.score}")
    (_paint_scores if len(plot.names) == 1 else _paint_grid)(canvas, plot, top)
    return canvas


def _legend(*, has_best: bool, has_failures: bool) -> list[LegendEntry]:
    """Return the entries of the legend of scores over one parameter."""
    entries = [
        LegendEntry("mean, and least to greatest", _mean_sample),
        LegendEntry("one trial", mark_sample("circle", 2.2, **_DOT)),
    ]
    if has_best:
        entries.append(LegendEntry("best", mark_sample("circle", 8.0, **_RING)))
    if has_failures:
        entries.append(LegendEntry("with failures", mark_sample("cross", 5.0, **_FAILED)))
    return entries


def _paint_scores(canvas: Canvas, plot: TrialAxes, top: float) -> None:
    """Over one parameter: each score, and the mean of each value with its range."""
    (name,) = plot.names
    places, named = _places([each.parameters[name] for each in plot.sets])
    reported = sorted(((places[repr(each.parameters[name])], each) for each in plot.sets),
                  key=lambda pair: pair[0])  # fmt: skip
    scored = [(place, each, each.score) for place, each in reported if each.score is not None]
    failed = [place for place, each in reported if each.failures]
    entries = _legend(has_best=bool(plot.best), has_failures=bool(failed))
    legend = rows_of(entries, canvas.width_px - 20, canvas.height_px)
    y = axis_range(min(s.low for *_, s in scored), max(s.high for *_, s in scored))
    x = axis_range(min(places.values()), max(places.values()), 0.05)
    left = 34 + max(width_of(text) for _, text in ticks(*y, 8))
    height = max(20.0, canvas.height_px - top - _BELOW_PX - LINE_PX * len(legend))
    frame = AxesBox(left, top, canvas.width_px - left - 16, height, x, y)
    marks = named or ticks(*x, frame.width / 80), ticks(*y, height / 40)
    paint_grid(canvas, frame, *marks)
    for place, _, score in scored:
        at, low, high = float(frame.px(place)), float(frame.py(score.low)), frame.py(score.high)
        canvas.add("path", d=f"M{at:.1f} {low:.1f}V{high:.1f}", stroke=LINES[0], stroke_width=5,
                   stroke_opacity=0.3)  # fmt: skip
    means = np.array([(frame.px(place), frame.py(score.mean)) for place, _, score in scored])
    line = line_through(means[:, 0], means[:, 1])
    canvas.add("path", d=line, fill="none", stroke=LINES[0], stroke_width=1.6)
    for place, each, score in scored:
        at = float(frame.px(place))
        paint_mark(canvas, "circle", (at, float(frame.py(score.mean))), 4.0, **_MEAN)
        for value in each.scores:
            paint_mark(canvas, "circle", (at, float(frame.py(value))), 2.2, **_DOT)
        if each.parameters == plot.best:
            paint_mark(canvas, "circle", (at, float(frame.py(score.mean))), 9.0, **_RING)
    for place in failed:
        paint_mark(canvas, "cross", (float(frame.px(place)), frame.bottom - 9), 5.0, **_FAILED)
    paint_x_axis(canvas, frame, marks[0], [fitted(name, frame.width)])
    paint_y_axis(canvas, frame, marks[1])
    paint_y_label(canvas, frame, "score")
    paint_rows(canvas, legend, canvas.height_px - LINE_PX * len(legend) - 2)


def _mean_sample(canvas: Canvas, x: float, y: float) -> None:
    line_sample(LINES[0])(canvas, x, y)
    paint_mark(canvas, "circle", (x, y), 4.0, **_MEAN)


def _paint_grid(canvas: Canvas, plot: TrialAxes, top: float) -> None:
    """Over two parameters: a cell for each pair of values, coloured by its mean."""
    first, second = plot.names
    x = _ordered([each.parameters[first] for each in plot.sets])
    y = _ordered([each.parameters[second] for each in plot.sets])
    means = [each.score.mean for each in plot.sets if each.score is not None]
    bounds = (min(means), max(means))
    bounds = bounds if bounds[0] < bounds[1] else axis_range(*bounds)
    left = 34 + min(0.3 * canvas.width_px, max(24.0, *(width_of(_text(value)) for value in y)))
    width = canvas.width_px - left - SCALE_PX
    height = max(20.0, canvas.height_px - top - _BELOW_PX - LINE_PX)
    frame = AxesBox(left, top, width, height, (-0.5, len(x) - 0.5), (-0.5, len(y) - 0.5))
    cell_px = width / len(x), height / len(y)
    # Seen where no trial has a score.
    canvas.add("rect", x=left, y=top, width=width, height=height, fill="#EEEEEE")
    for each in plot.sets:
        column, row = x.index(each.parameters[first]), y.index(each.parameters[second])
        corner = left + column * cell_px[0], frame.bottom - (row + 1) * cell_px[1]
        share = (each.score.mean - bounds[0]) / (bounds[1] - bounds[0]) if each.score else None
        # More texts in a grid would not fit.
        _paint_cell(canvas, each, corner, cell_px, share, reported=len(plot.sets) <= 60)
        if each.parameters == plot.best:
            canvas.add("rect", x=corner[0] + 3, y=corner[1] + 3, width=cell_px[0] - 6,
                       height=cell_px[1] - 6, **_RING)  # fmt: skip
    room = cell_px[0] - 4
    paint_x_axis(canvas, frame, [(i, fitted(_text(v), room)) for i, v in enumerate(x)],
                 [fitted(first, width)])  # fmt: skip
    paint_y_axis(canvas, frame, [(i, fitted(_text(v), left - 30)) for i, v in enumerate(y)])
    paint_y_label(canvas, frame, fitted(second, height))
    paint_scale(canvas, frame, "score", bounds, "mean score")
    entry = LegendEntry("best; cells: mean, spread", _frame_sample)
    paint_rows(canvas, [[entry]], canvas.height_px - LINE_PX - 2)


def _frame_sample(canvas: Canvas, x: float, y: float) -> None:
    canvas.add("rect", x=x - 10, y=y - 5, width=20, height=10, **_RING)


def _paint_cell(
    canvas: Canvas, ranked: Ranked, corner: tuple[float, float], size: tuple[float, float],
    share: float | None, *, reported: bool,
) -> None:  # fmt: skip
    lines = [f"{len(ranked.failures)} failed"] if ranked.failures else []
    if ranked.score is not None and share is not None:
        colour = scaled(share, "score")
        canvas.add("rect", x=corner[0], y=corner[1], width=size[0] + 0.3, height=size[1] + 0.3,
                   fill=colour)  # fmt: skip
        low, mean, high = ranked.score.low, ranked.score.mean, ranked.score.high
        spread = [f"{low:.3g} to {high:.3g}"] if low != high else []
        lines = [f"{mean:.4g}", *spread, *lines]
    ink = "#FFFFFF" if share is not None and share < 0.5 else INK  # white on dark cells
    for row, line in enumerate(lines if reported else ()):
        y = corner[1] + size[1] / 2 + 4 + (row - (len(lines) - 1) / 2) * (LINE_PX - 3)
        canvas.text(corner[0] + size[0] / 2, y, line, colour=ink, anchor="middle")


def _places(values: Sequence[Any]) -> tuple[dict[str, float], list[tuple[float, str]]]:
    """Return the position of each value on an axis, and ticks; texts stand in a row."""
    if all(isinstance(each, (int, float)) and not isinstance(each, bool) for each in values):
        return {repr(each): float(each) for each in values}, []
    ordered = _ordered(values)
    places = {repr(value): float(place) for place, value in enumerate(ordered)}
    return places, [(place, _text(value)) for place, value in enumerate(ordered)]


def _ordered(values: Sequence[Any]) -> list[Any]:
    """Return each value once, numbers before texts."""
    each = {repr(value): value for value in values}
    numbers = [value for value in each.values() if isinstance(value, (int, float))]
    return sorted(numbers) + sorted(
        (value for value in each.values() if not isinstance(value, (int, float))), key=str
    )


def _text(value: Any) -> str:
    if value is None:
        return "not set"
    return f"{value:g}" if isinstance(value, float) else short(str(value))
