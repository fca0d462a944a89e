"""How regularly rows were recorded, and where some are missing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Indexes, median, np

GAP_INTERVALS: Final = 3.0  # a gap is longer than so many usual intervals
ANOTHER_RATE: Final = 5  # so many long intervals one after the other are no gaps


@dataclass(frozen=True)
class Gap:
    """No row between two rows of a run, for longer than usual."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class Rhythm:
    """How regularly rows were recorded.

    Attributes:
        interval_s: The median simulated time between rows; None for fewer than two rows.
        gaps: In order.
    """

    interval_s: float | None
    gaps: tuple[Gap, ...]


def rhythm_of(times: Sequence[float] | Array) -> Rhythm:
    """The rhythm of the given times; a gap is an interval of more than three median ones."""
    interval_s = usual_interval_s(times)
    return Rhythm(interval_s, interruptions(gaps_in(times, interval_s)) if interval_s else ())


def interruptions(gaps: Sequence[Gap]) -> tuple[Gap, ...]:
    """The gaps without those that are the intervals of another, slower rate.

    Where five or more follow one another directly, only what is longer than three of them is one.
    """
    cuts = [at for at in range(1, len(gaps)) if gaps[at].start_s != gaps[at - 1].end_s]
    edges = pairwise([0, *cuts, len(gaps)]) if gaps else ()
    return tuple(gap for start, end in edges for gap in _longest(gaps[start:end]))


def _longest(chain: Sequence[Gap]) -> Iterator[Gap]:
    lengths_s = sorted(gap.end_s - gap.start_s for gap in chain)
    usual_s = lengths_s[len(chain) // 2] if len(chain) >= ANOTHER_RATE else 0.0
    return (gap for gap in chain if gap.end_s - gap.start_s > GAP_INTERVALS * usual_s * (1 + 1e-6))


def usual_interval_s(times: Sequence[float] | Array) -> float | None:
    """The median interval; those of zero, while a simulation is paused, do not count."""
    intervals: Array = np.diff(np.asarray(times, np.float64))
    moving = intervals[intervals > 0]
    return median(moving) if len(moving) else None


def gaps_in(times: Sequence[float] | Array, interval_s: float) -> tuple[Gap, ...]:
    """The gaps between rows that usually come at such intervals."""
    moments: Array = np.asarray(times, np.float64)
    rows = gap_borders(moments, interval_s)
    return tuple(
        Gap(*pair) for pair in zip(moments[rows - 1].tolist(), moments[rows].tolist(), strict=True)
    )


def gap_borders(times: Array, interval_s: float) -> Indexes:
    """The indexes of the rows right after a gap."""
    return np.flatnonzero(np.diff(times) > GAP_INTERVALS * interval_s * (1 + 1e-6)) + 1
