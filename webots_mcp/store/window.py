"""The stretch of a run that a question about its log is about, in simulation seconds.

Its bounds are compared as those of the ranges of `store.reading.ranges`, but other than they it is
not bounded by the state rows: the last lines of a controller often come after its last state, and
some controllers only log.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from webots_mcp.store.reading.moments import moment_of
from webots_mcp.store.reading.ranges import Scope


class Window(NamedTuple):
    """From `start_s` up to, not including, `end_s`."""

    start_s: float
    end_s: float


def window_of(scope: Scope, newest_s: float) -> Window:
    """The window that was asked for in simulation time; without any bound the whole run.

    Args:
        scope: Its `last_s` counts back from the newest row, which is included.
        newest_s: Simulation time of the newest row of the run.
    """
    if scope.last_s is not None:
        return Window(moment_of(newest_s - scope.last_s), math.inf)
    start_s = -math.inf if scope.start_s is None else moment_of(scope.start_s)
    return Window(start_s, math.inf if scope.end_s is None else moment_of(scope.end_s))
