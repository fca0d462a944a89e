"""What the numbers of a signal in a frame come to; of many rows from what its chunks come to."""

from __future__ import annotations

import math
from typing import Final

from webots_mcp.store.analysis.arrays import np
from webots_mcp.store.analysis.summary import Summary, summarise_numbers
from webots_mcp.store.reading.frame import Frame, Zones
from webots_mcp.store.signals.registry import Signal

FULL_ROWS: Final = 120_000  # of which every value is looked at; of more there are 100 chunks


def reads_values(frame: Frame, signal: Signal) -> bool:
    """Whether every value is looked at; the turns of an angle are counted from row to row."""
    return len(frame) <= FULL_ROWS or signal.turn is not None


def summary_of(frame: Frame, signal: Signal) -> Summary:
    """Counts, extremes, mean and deviation of all rows; those of an angle are circular as well."""
    if reads_values(frame, signal):
        numbers = frame.usable(signal.name)
        return summarise_numbers(*numbers, rows=len(frame), turn=signal.turn)
    return summary_of_zones(frame, signal.name, frame.zones(signal.name))


def summary_of_zones(frame: Frame, name: str, zones: Zones) -> Summary:
    """The same from chunks; only those with the ends and the extremes are opened.

    The squares are combined by the formula of T. F. Chan, G. H. Golub, R. J. LeVeque, "Algorithms
    for computing the sample variance", The American Statistician 37 (1983): each chunk's own plus
    count * (its mean - the mean) ** 2.
    """
    held = np.flatnonzero(~np.isnan(zones.sum))
    if not len(held):
        return Summary(len(frame))
    counts, sums = zones.value_count[held], zones.sum[held]
    present, total = int(counts.sum()), math.fsum(sums.tolist())
    shifts = sums / counts - total / present
    squares = zones.squared_deviations[held] + counts * shifts * shifts
    stepped = zones.last[held][:-1] != zones.first[held][1:]
    low, high = int(np.nanargmin(zones.min)), int(np.nanargmax(zones.max))
    return Summary(
        rows=len(frame),
        present=present,
        changes=int(zones.change_count[held].sum() + np.count_nonzero(stepped)),
        first=float(zones.first[held[0]]),
        first_sim_time_s=_time_of(frame, name, zones, int(held[0]), None),
        last=float(zones.last[held[-1]]),
        last_sim_time_s=_time_of(frame, name, zones, int(held[-1]), None, last=True),
        min=float(zones.min[low]),
        min_sim_time_s=_time_of(frame, name, zones, low, float(zones.min[low])),
        max=float(zones.max[high]),
        max_sim_time_s=_time_of(frame, name, zones, high, float(zones.max[high])),
        sum=total,
        squares=math.fsum(squares.tolist()),
    )


def _time_of(
    frame: Frame, name: str, zones: Zones, place: int, value: float | None, *, last: bool = False
) -> float:
    """When a chunk first had a value, or any; or its last one."""
    start = int(zones.first_row[place])
    times, numbers = frame.rows(start, start + int(zones.row_count[place])).usable(name)
    rows = np.flatnonzero(numbers == value) if value is not None else np.arange(len(times))
    return float(times[rows[-1 if last else 0]])
