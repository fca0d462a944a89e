"""Shortens what a lidar or a range finder measures to the nearest distances that a state records.

A scan has hundreds of ranges. A state gets their count, the smallest one, and the minimum of eight
sectors from left to right. `devices` reads all other devices.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, Final

SECTORS: Final = 8


def summarise_lidar(device: Any) -> dict[str, object] | None:
    """Return a lidar's ranges; its image is layer after layer, each from left to right."""
    return _summarise_ranges(device, device.getHorizontalResolution())


def summarise_range_finder(device: Any) -> dict[str, object] | None:
    """Return a range finder's ranges; its image is row after row, each from left to right."""
    return _summarise_ranges(device, device.getWidth())


def _summarise_ranges(device: Any, columns: int) -> dict[str, object] | None:
    """Return the smallest distance, its index, and the minimum of eight sectors; None before data.

    The raw pointer is tested first: reading a null pointer can crash the interpreter.
    """
    if not device.range_image:
        return None
    ranges: list[float] = device.getRangeImage()
    directions = _column_minima(ranges, columns)
    sectors = _sector_minima(directions)
    nearest = min(sectors)
    if not math.isfinite(nearest) or math.isnan(sum(sectors)):  # a minimum ends at a NaN
        nearest = min(filter(math.isfinite, directions), default=None)
    return {
        "count": len(ranges),
        "min_m": math.inf if nearest is None else nearest,
        "min_index": None if nearest is None else ranges.index(nearest),
        "sector_min_m": sectors,
    }


def _column_minima(ranges: list[float], columns: int) -> list[float]:
    """Return the smallest distance in each direction, over all layers or rows."""
    if not 0 < columns < len(ranges):
        return ranges
    rows = [ranges[i : i + columns] for i in range(0, len(ranges), columns)]
    return list(map(min, zip(*rows, strict=False)))


def _sector_minima(directions: list[float]) -> list[float]:
    """Return the sectors' minima from left to right; with fewer than eight directions, one each."""
    count = min(SECTORS, len(directions))
    bounds = [len(directions) * i // count for i in range(count + 1)]
    return [min(directions[i:j]) for i, j in pairwise(bounds)]
