"""Rows one after the other in which the same holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, np

MOSTLY: Final = 0.5  # of the rows


class Run(NamedTuple):
    """One of them: rows [start, stop) of a frame, and the times of its first and last row."""

    start: int
    stop: int
    start_s: float
    end_s: float

    @property
    def duration_s(self) -> float:
        """From the first row to the last."""
        return self.end_s - self.start_s


@dataclass(frozen=True)
class Runs:
    """All of them, in order: rows [start, stop) of each, and their times."""

    starts: Indexes
    stops: Indexes
    starts_s: Array
    ends_s: Array

    @property
    def durations_s(self) -> Array:
        """From the first row of each to its last."""
        return self.ends_s - self.starts_s

    def only(self, wanted: Flags) -> Runs:
        """Some of them."""
        rows, times = (self.starts[wanted], self.stops[wanted]), (self.starts_s, self.ends_s)
        return Runs(*rows, times[0][wanted], times[1][wanted])

    def each(self) -> Iterator[Run]:
        """One by one."""
        columns = (self.starts, self.stops, self.starts_s, self.ends_s)
        return map(Run, *(column.tolist() for column in columns))

    def __len__(self) -> int:
        return len(self.starts)


def runs_of(holds: Flags, times: Array) -> Runs:
    """Where something holds in each row."""
    edges = np.flatnonzero(np.diff(holds, prepend=False, append=False))
    return _runs(edges[::2], edges[1::2], times)


def _runs(starts: Indexes, stops: Indexes, times: Array) -> Runs:
    return Runs(starts, stops, times[starts], times[stops - 1])


def extremes_in(runs: Runs, numbers: Array) -> tuple[Array, Array]:
    """The least and the greatest number of each run, given those of all rows."""
    if not len(runs):
        return np.zeros(0), np.zeros(0)
    edges, padded = np.stack((runs.starts, runs.stops), 1).ravel(), np.append(numbers, 0.0)
    return np.minimum.reduceat(padded, edges)[::2], np.maximum.reduceat(padded, edges)[::2]


def runs_alike(numbers: Array, times: Array) -> Runs:
    """Where a number stays exactly the same in two rows at least; NaN is never the same."""
    edges = np.flatnonzero(np.append(True, numbers[1:] != numbers[:-1]))
    stops = np.append(edges[1:], len(numbers))
    long = stops - edges >= 2
    return _runs(edges[long], stops[long], times)
