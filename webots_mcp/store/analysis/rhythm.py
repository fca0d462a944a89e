"""How regularly rows were recorded, and where some are missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Indexes, np

GAP_INTERVALS: Final = 3.0  # a gap is longer than so many usual intervals


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
    return Rhythm(interval_s, gaps_in(times, interval_s) if interval_s else ())


def usual_interval_s(times: Sequence[float] | Array) -> float | None:
    """The median interval; those of zero, while a simulation is paused, do not count."""
    intervals: Array = np.diff(np.asarray(times, np.float64))
    moving = intervals[intervals > 0]
    return float(np.median(moving)) if len(moving) else None


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
