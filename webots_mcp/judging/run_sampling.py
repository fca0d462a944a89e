"""The rows of a run at even intervals of simulation time, so that each second counts the same.

Means, shares and deviations of runs are compared by them: rows that a breakpoint, an expectation or
a full-rate segment has added shift no figure, and neither do rows that are missing.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from webots_mcp.analysis.arrays import Array, Indexes, np, usual_interval_s
from webots_mcp.analysis.summary import Summary, summarise_numbers, usable_part
from webots_mcp.signals.conditions.functions import SAME_TIME_S
from webots_mcp.store.chunks import Statistics
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.reading.frame_summary import FULL_ROWS, summary_of
from webots_mcp.store.registered_signals import RegisteredSignal

_FEW_UNEVEN: Final = 1e-3  # of the rows of a long run: so few hardly move a mean
_SAME_INTERVAL: Final = 0.01  # of the interval


@dataclass(frozen=True)
class SampledRun:
    """The rows that are in force at even moments of a run, from its first row on.

    Attributes:
        frame: The rows of the run.
        interval_s: Between two moments.
        until_s: The last moment lies before it.
    """

    frame: Frame
    interval_s: float | None
    until_s: float

    @cached_property
    def moments(self) -> Array:
        """Simulation times in s; those of the rows where no interval is known."""
        times = self.frame.times
        times = times[: int(np.searchsorted(times, self.until_s))]
        if self.interval_s is None or len(times) < 2 or self._is_even(times):
            return times
        count = math.floor((float(times[-1] - times[0]) + SAME_TIME_S) / self.interval_s) + 1
        return np.asarray(times[0] + self.interval_s * np.arange(count), np.float64)

    def _is_even(self, times: Array) -> bool:
        """Whether the rows themselves follow each other at the interval."""
        assert self.interval_s is not None
        off = np.abs(np.diff(times) - self.interval_s) > _SAME_INTERVAL * self.interval_s
        most = _FEW_UNEVEN * len(times) if len(times) > FULL_ROWS else 0
        return int(np.count_nonzero(off)) <= most

    @cached_property
    def _rows(self) -> Indexes | slice:
        """The place of the newest row at each moment."""
        times, moments = self.frame.times, self.moments
        if len(moments) <= len(times) and np.array_equal(times[: len(moments)], moments):
            return slice(0, len(moments))
        return np.searchsorted(times, moments + SAME_TIME_S, "right") - 1

    def numbers(self, name: str) -> Array:
        """The number of a signal that is in force at each moment, NaN where it has none."""
        return self.frame.numbers(name)[self._rows]

    def summary_of(self, signal: RegisteredSignal) -> Summary:
        """Counts, mean, deviation and extremes; the extremes are those of all rows."""
        rows = self._rows
        statistics_of_chunks = self._of_chunks
        if isinstance(rows, slice) and signal.turn is None and statistics_of_chunks is not None:
            found = statistics_of_chunks.get(signal.name)
            return Summary(len(self.moments)) if found is None else _as_summary(found)
        inside = self.frame.rows(0, int(np.searchsorted(self.frame.times, self.until_s)))
        if isinstance(rows, slice):
            return summary_of(inside, signal)
        numbers = usable_part(self.moments, self.numbers(signal.name))
        even = summarise_numbers(*numbers, rows=len(self.moments), turn=signal.turn)
        held = inside.usable(signal.name)[1]
        if not len(held) or even.min is None:
            return even
        return even._replace(min=float(held.min()), max=float(held.max()))

    @cached_property
    def _of_chunks(self) -> dict[str, Statistics] | None:
        """What the chunks come to, where all rows are those of one group."""
        is_whole = len(self.frame) == len(self.moments)
        return self.frame.whole_statistics() if is_whole else None


def _as_summary(found: Statistics) -> Summary:
    return Summary(
        found.row_count,
        found.value_count,
        found.change_count,
        first=found.first,
        last=found.last,
        min=found.min,
        max=found.max,
        sum=found.sum,
        squares=found.squared_deviations,
    )


def shared_interval_s(groups: Sequence[Sequence[Frame]]) -> float | None:
    """Return the interval at which runs can be compared: the usual one of the slowest group."""
    usual = [[usual_interval_s(frame.times) for frame in group] for group in groups]
    known = [[each for each in group if each] for group in usual]
    return max((statistics.median(group) for group in known if group), default=None)
