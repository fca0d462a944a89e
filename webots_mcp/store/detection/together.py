"""The text of many similar events that are reported as one."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any, Final

MOST_TIMES: Final = 3  # of a group that are named
_SAME_LENGTH: Final = 0.05  # of the longest: so near each other they last equally long


def told_together(
    what: str, starts_s: Sequence[float], lengths_s: Sequence[float], within_s: float = 0.0
) -> dict[str, Any]:
    """How many there are, when, and how long they lasted, as details of an event.

    Args:
        what: What they are, in the plural.
        starts_s: When each began, in order.
        lengths_s: How long each lasted.
        within_s: How exactly begins and ends are known; 0 for to the row.
    """
    times_s = [round(start_s, 3) for start_s in starts_s]
    says = (
        f"{len(times_s)} {what}, the first at {times_s[0]:.6g} s, the last at {times_s[-1]:.6g} s"
        f"{_lengths(lengths_s)}"
    )
    known = {"within_s": within_s} if within_s else {}
    return {**known, "says": says, "first_times_s": times_s[:MOST_TIMES]}


def _lengths(lengths_s: Sequence[float]) -> str:
    """How long they lasted, where they did."""
    least_s, most_s, middle_s = min(lengths_s), max(lengths_s), median(lengths_s)
    if not most_s:
        return ""
    if most_s - least_s <= _SAME_LENGTH * most_s:
        return f", each {middle_s:.3g} s long"
    return (
        f", {least_s:.3g} to {most_s:.3g} s long (median {middle_s:.3g} s), "
        f"{sum(lengths_s):.4g} s in total"
    )
