"""One question, one picture: what the MCP tool and the command line ask."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import Final, Literal, get_args

from webots_mcp.errors import InvalidInputError
from webots_mcp.plotting.canvas import HEIGHT_PX, WIDTH_PX, ImageFormat, Picture, Sheet
from webots_mcp.plotting.signals import plot_signals
from webots_mcp.plotting.trajectory import plot_trajectory
from webots_mcp.store.questions.trends import trends
from webots_mcp.store.reading.ranges import TimeRange, resolve_range

PlotKind = Literal["signals", "trajectory"]

_DEFAULT_SIGNALS: Final = 3


def plot(
    connection: sqlite3.Connection,
    kind: PlotKind = "signals",
    signals: Sequence[str] = (),
    *,
    robot: str | None = None,
    run_ids: Sequence[int] = (),
    start_s: float | None = None,
    end_s: float | None = None,
    last_s: float | None = None,
    since: float | str | None = None,
    until: float | str | None = None,
    bands: str | None = None,
    events: bool = True,
    width_px: int = WIDTH_PX,
    height_px: int = HEIGHT_PX,
    image_format: ImageFormat = "png",
) -> Picture:
    """A picture of signals over a range of time, or of the way that the robot took.

    Args:
        connection: Any.
        kind: "signals" over time, or "trajectory" in the plane.
        signals: Names, with `*`; none for the three that changed most. Of a trajectory the two of
            the position, or none to find them by name.
        robot: Whose; may be left out where only one is meant.
        run_ids: None for the robot's newest run; of several, each from its start, in one picture.
        start_s: The range, as of `resolve_range`; without any the whole run.
        end_s: See there.
        last_s: See there.
        since: See there.
        until: See there.
        bands: The text signal that stands behind the curves or colours the way; None for the mode,
            where there is one; "" for none (a trajectory is coloured by time then).
        events: Whether to mark events.
        width_px: 300 to 2000.
        height_px: 300 to 2000.
        image_format: "png" or "svg".

    Raises:
        InvalidInputError: And its kin: an unknown signal, run, robot, kind or format; a range that
            makes no sense; a size out of bounds. The text tells what there is.
        NothingRecordedError: There is nothing to draw in the range.
    """
    sheet = Sheet(width_px, height_px, image_format)
    ranges = [
        resolve_range(
            connection,
            robot=robot,
            run_id=run_id,
            start_s=start_s,
            end_s=end_s,
            last_s=last_s,
            since=since,
            until=until,
        )
        for run_id in (tuple(dict.fromkeys(run_ids)) or (None,))
    ]
    if kind == "signals":
        names = signals or _changed_most(connection, ranges[-1])
        return plot_signals(connection, ranges, names, bands=bands, events=events, sheet=sheet)
    if kind != "trajectory":
        raise InvalidInputError(f"kind={kind!r}: there is {', '.join(get_args(PlotKind))}")
    position = _position(signals)
    return plot_trajectory(connection, ranges, position, bands=bands, events=events, sheet=sheet)


def _changed_most(connection: sqlite3.Connection, time_range: TimeRange) -> list[str]:
    found = trends(connection, time_range, limit=_DEFAULT_SIGNALS).runs
    return [trend.name for run in found for trend in run.numbers] or ["*"]


def _position(signals: Sequence[str]) -> tuple[str, str] | None:
    if not signals:
        return None
    if len(signals) != 2:
        raise InvalidInputError(
            f"a trajectory takes two signals, x and y, or none: {len(signals)} are named"
        )
    return signals[0], signals[1]
