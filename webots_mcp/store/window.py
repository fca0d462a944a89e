"""The stretch of a run that a question about its log is about, in simulation seconds.

Its bounds are compared as those of the ranges of `store.reading.ranges`, but other than they it is
not bounded by the state rows: the last lines of a controller often come after its last state, and
some controllers only log.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from webots_mcp.errors import InvalidRangeError
from webots_mcp.store.reading.moments import moment_of


class Window(NamedTuple):
    """From `start_s` up to, not including, `end_s`."""

    start_s: float
    end_s: float


def resolve_window(
    newest_s: float, *, last_s: float | None, start_s: float | None, end_s: float | None
) -> Window:
    """The window that was asked for; without any bound the whole run.

    Args:
        newest_s: Simulation time of the newest row of the run.
        last_s: That long back from the newest row, which is included.
        start_s: From here on.
        end_s: Up to, not including, here.

    Raises:
        InvalidRangeError: The bounds are reversed, empty, not finite, or `last_s` comes together
            with another.
    """
    for name, value in (("last_s", last_s), ("start_s", start_s), ("end_s", end_s)):
        if value is not None and not math.isfinite(value):
            raise InvalidRangeError(f"{name}={value} is not a finite number of seconds")
    if last_s is not None:
        if start_s is not None or end_s is not None:
            raise InvalidRangeError("give either last_s or start_s and end_s, not both")
        if last_s <= 0:
            raise InvalidRangeError(f"last_s={last_s} must be greater than 0")
        return Window(moment_of(newest_s - last_s), math.inf)
    start = -math.inf if start_s is None else moment_of(start_s)
    window = Window(start, math.inf if end_s is None else moment_of(end_s))
    if window.start_s >= window.end_s:
        raise InvalidRangeError(
            f"start_s={start_s} must be less than end_s={end_s} (the end is not included)"
        )
    return window
