"""Painting scores over the parameters that gave them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.plotting.canvas import paint_title, short
from webots_mcp.plotting.legend import Entry, paint_legend
from webots_mcp.plotting.palette import INK, LINES
from webots_mcp.store.analysis.spread import Ranked

_MOST_TOLD_CELLS: Final = 60  # more texts in a grid would not fit
_AT_THE_BOTTOM: Final = 0.03  # of the height of the axes
_DARK: Final = 0.5  # of the colour scale: on darker cells texts are white


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


def paint_trials(figure: Any, plot: TrialAxes) -> None:
    """Paint it on an empty figure."""
    paint_title(figure, f"{plot.title}: {plot.score}")
    axes = figure.subplots()
    axes.set_xlabel(short(plot.names[0]))
    (_paint_scores if len(plot.names) == 1 else _paint_grid)(figure, axes, plot)


def _paint_scores(figure: Any, axes: Any, plot: TrialAxes) -> None:
    """Over one parameter: each score, and the mean of each value with its range."""
    (name,) = plot.names
    axes.set_ylabel("score")
    axes.grid(color="#E9E9E9", linewidth=0.6)
    places = _places(axes.xaxis, [each.parameters[name] for each in plot.sets])
    told = [(places[repr(each.parameters[name])], each) for each in plot.sets]
    scored = sorted((pair for pair in told if pair[1].score is not None), key=lambda pair: pair[0])
    entries = [_paint_means(axes, scored), _paint_each(axes, scored)]
    if plot.best is not None:
        entries.append(_paint_best(axes, places[repr(plot.best[name])], plot))
    failed = [place for place, each in told if each.failures]
    if failed:
        entries.append(_paint_failed(axes, failed))
    paint_legend(figure, entries)


def _paint_means(axes: Any, scored: Sequence[tuple[float, Ranked]]) -> Entry:
    spreads = [(place, each.score) for place, each in scored if each.score is not None]
    places = [place for place, _ in spreads]
    low, high = [each.low for _, each in spreads], [each.high for _, each in spreads]
    axes.vlines(places, low, high, color=LINES[0], linewidth=4, alpha=0.3)
    means = [each.mean for _, each in spreads]
    (line,) = axes.plot(places, means, color=LINES[0], marker="o", markersize=6)
    return line, "mean, and least to greatest"


def _paint_each(axes: Any, scored: Sequence[tuple[float, Ranked]]) -> Entry:
    points = [(place, score) for place, each in scored for score in each.scores]
    (dots,) = axes.plot(
        *zip(*points, strict=True), color=INK, marker=".", linestyle="", markersize=5
    )
    return dots, "one trial"


def _paint_best(axes: Any, place: float, plot: TrialAxes) -> Entry:
    (best,) = (each for each in plot.sets if each.parameters == plot.best)
    assert best.score is not None
    (ring,) = axes.plot(
        [place], [best.score.mean], color=LINES[1], marker="o", linestyle="", markersize=14,
        markerfacecolor="none", markeredgewidth=2,
    )  # fmt: skip
    return ring, "best"


def _paint_failed(axes: Any, places: Sequence[float]) -> Entry:
    (crosses,) = axes.plot(
        places, [_AT_THE_BOTTOM] * len(places), color=LINES[1], marker="x", linestyle="",
        transform=axes.get_xaxis_transform(), clip_on=False,
    )  # fmt: skip
    return crosses, "with failures"


def _paint_grid(figure: Any, axes: Any, plot: TrialAxes) -> None:
    """Over two parameters: a cell for each pair of values, coloured by its mean."""
    first, second = plot.names
    axes.set_ylabel(short(second))
    x = _ordered([each.parameters[first] for each in plot.sets])
    y = _ordered([each.parameters[second] for each in plot.sets])
    means = [[math.nan] * len(x) for _ in y]
    for each in plot.sets:
        if each.score is not None:
            column, row = _cell(each.parameters, plot.names, x, y)
            means[row][column] = each.score.mean
    image = axes.imshow(means, cmap="cividis", origin="lower", aspect="auto")
    axes.set_facecolor("#EEEEEE")  # seen where no trial has a score
    figure.colorbar(image, ax=axes, label="mean score")
    for axis, values in ((axes.xaxis, x), (axes.yaxis, y)):
        axis.set_ticks(range(len(values)), [_text(value) for value in values])
    if len(plot.sets) <= _MOST_TOLD_CELLS:
        for each in plot.sets:
            _paint_text(axes, image, each, _cell(each.parameters, plot.names, x, y))
    if plot.best is not None:
        _paint_frame(axes, _cell(plot.best, plot.names, x, y))
    paint_legend(figure, [_frame_entry()])


def _paint_text(axes: Any, image: Any, ranked: Ranked, cell: tuple[int, int]) -> None:
    lines = [f"{len(ranked.failures)} failed"] if ranked.failures else []
    colour = INK
    if ranked.score is not None:
        low, mean, high = ranked.score.low, ranked.score.mean, ranked.score.high
        spread = [f"{low:.3g} to {high:.3g}"] if low != high else []
        lines = [f"{mean:.4g}", *spread, *lines]
        colour = "white" if image.norm(mean) < _DARK else INK
    axes.text(*cell, "\n".join(lines), ha="center", va="center", color=colour, fontsize=8)


def _paint_frame(axes: Any, cell: tuple[int, int]) -> None:
    from matplotlib.patches import Rectangle

    corner = (cell[0] - 0.48, cell[1] - 0.48)
    axes.add_patch(Rectangle(corner, 0.96, 0.96, fill=False, edgecolor=LINES[1], linewidth=2.5))


def _frame_entry() -> Entry:
    from matplotlib.patches import Patch

    return Patch(fill=False, edgecolor=LINES[1], linewidth=2), "best; cells: mean, spread"


def _places(axis: Any, values: Sequence[Any]) -> dict[str, float]:
    """Where each value stands on an axis: numbers by what they are, others in a row."""
    if all(isinstance(each, (int, float)) and not isinstance(each, bool) for each in values):
        return {repr(each): float(each) for each in values}
    ordered = _ordered(values)
    axis.set_ticks(range(len(ordered)), [_text(value) for value in ordered])
    return {repr(value): float(place) for place, value in enumerate(ordered)}


def _ordered(values: Sequence[Any]) -> list[Any]:
    """Each value once, numbers before texts."""
    each = {repr(value): value for value in values}
    numbers = [value for value in each.values() if isinstance(value, (int, float))]
    return sorted(numbers) + sorted(
        (value for value in each.values() if not isinstance(value, (int, float))), key=str
    )


def _cell(
    values: dict[str, Any], names: Sequence[str], x: Sequence[Any], y: Sequence[Any]
) -> tuple[int, int]:
    first, second = names
    return x.index(values[first]), y.index(values[second])


def _text(value: Any) -> str:
    if value is None:
        return "not set"
    return f"{value:g}" if isinstance(value, float) else short(str(value))
