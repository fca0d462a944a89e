"""Pictures of a recording: signals, the path of a robot, scores of runs and trials; PNG or SVG.

Questions, the command line, page and report draw with these modules. They read through `store` and
`judging`, and know nothing of answers or tools. A kind of picture is imported when one is drawn: a
server that only lists its tools does without.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

from webots_mcp.errors import InvalidInputError
from webots_mcp.plotting.canvas import HEIGHT_PX, WIDTH_PX, ImageFormat, PlotImage, Sheet
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range

PlotKind = Literal["signals", "trajectory", "runs"]


def plot(
    connection: sqlite3.Connection,
    kind: PlotKind = "signals",
    signals: Sequence[str] = (),
    *,
    scope: Scope | None = None,
    run_ids: Sequence[int] = (),
    trial_set: int | None = None,
    bands: str | None = None,
    width_px: int = WIDTH_PX,
    height_px: int = HEIGHT_PX,
    image_format: ImageFormat = "png",
) -> PlotImage:
    """Return a picture of signals over a range of time, of the robot's path, or of scores.

    Args:
        connection: Any.
        kind: "signals" over time, "trajectory" in the plane, or "runs": a score over all runs.
        signals: Names, with `*`; none for the three that changed most. Of a trajectory the two of
            the position, or none to find them by name. Of runs one score, or none for the reward.
        scope: Robot and time range; None for the whole newest run.
        run_ids: More runs than that of the scope; of several, each from its start, in one picture.
        trial_set: The scores of that set instead, over one or two parameters, which `signals` may
            name; of what else is asked only the form of the picture counts.
        bands: The text signal that stands behind the curves or colours the way; None for the mode,
            where there is one; "" for none (a trajectory is coloured by time then).
        width_px: 400 to 2000.
        height_px: 300 to 2000.
        image_format: "png" or "svg".

    Raises:
        InvalidInputError: And its kin: an unknown signal, run, robot, kind or format; a range that
            contradicts another; a size out of bounds. The text lists what there is.
        NothingRecordedError: There is nothing to draw in the range.
    """
    sheet = Sheet(width_px, height_px, image_format)
    if trial_set is not None:
        from webots_mcp.plotting.trials import plot_trials

        return plot_trials(connection, trial_set, signals, sheet=sheet)
    asked = scope or Scope()
    if kind == "runs":
        from webots_mcp.plotting.run_scores import plot_run_scores

        return plot_run_scores(
            connection, _score(signals), scope=asked, run_ids=run_ids, sheet=sheet
        )
    several = dict.fromkeys((asked.run_id, *run_ids) if asked.run_id is not None else run_ids)
    scopes = [replace(asked, run_id=run_id) for run_id in several] or [asked]
    ranges = [find_range(connection, each) for each in scopes]
    if kind == "signals":
        from webots_mcp.plotting.signal_plot import plot_signals

        names = signals or changed_most(connection, ranges[-1])
        return plot_signals(connection, ranges, names, bands=bands, sheet=sheet)
    if kind != "trajectory":
        raise InvalidInputError(f"Unknown kind={kind!r}. Kinds: {', '.join(get_args(PlotKind))}.")
    from webots_mcp.plotting.trajectory import plot_trajectory

    position = _position(signals)
    return plot_trajectory(connection, ranges, position, bands=bands, sheet=sheet)


def changed_most(connection: sqlite3.Connection, time_range: TimeRange) -> list[str]:
    """Return the three numbers that changed most, which are drawn where none is named."""
    from webots_mcp.judging.trends import trends

    found = trends(connection, time_range, limit=3, shown=0).runs
    return [trend.name for run in found for trend in run.numbers] or ["*"]


def _score(signals: Sequence[str]) -> str | None:
    """Return the score that was asked for; None for the reward."""
    if len(signals) > 1:
        raise InvalidInputError(
            f"kind='runs' draws one score, and {len(signals)} are given. Give one, as in "
            "signals=['max(pose.x)'], or none for the published reward."
        )
    return signals[0] if signals else None


def _position(signals: Sequence[str]) -> tuple[str, str] | None:
    if not signals:
        return None
    if len(signals) != 2:
        raise InvalidInputError(
            f"A trajectory takes two signals, x and y, or none; {len(signals)} are "
            "named. Give both, as in signals=['pose.0', 'pose.1'], or leave signals "
            "out."
        )
    return signals[0], signals[1]
