"""Whether groups of runs differ by more than like runs do."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Final, NamedTuple

MOST_CHANCE: Final = 0.002  # that any of the figures compared at once differs among like runs


class Spread(NamedTuple):
    """A figure of each run of a group, in the group: its median, and the least and the greatest."""

    median: float
    low: float
    high: float


def spread_of(figures: Sequence[float | None]) -> Spread | None:
    """None where the figure of any run is not known."""
    known = [figure for figure in figures if figure is not None]
    if not known or len(known) < len(figures):
        return None
    return Spread(statistics.median(known), min(known), max(known))


def chance_of(
    first: Sequence[float], other: Sequence[float], least_variance: float = 0.0
) -> float | None:
    """How often two groups of like runs would lie as far apart as these: Student's t test.

    Two-sided, with the pooled variance (Student, The probable error of a mean, Biometrika 6,
    1908). 0 where like runs agree to the last digit and the groups do not. None for one run each:
    then nothing tells how much like runs differ.

    Args:
        first: A figure of each run of the first group.
        other: Of each run of the other group.
        least_variance: That of counted events is at least their mean, however alike a few counts
            may happen to be.
    """
    freedom = len(first) + len(other) - 2
    if freedom < 1 or not first or not other:
        return None
    apart = abs(statistics.fmean(other) - statistics.fmean(first))
    squares = sum(statistics.pvariance(group) * len(group) for group in (first, other))
    variance = max(squares / freedom, least_variance) * (1 / len(first) + 1 / len(other))
    if math.isclose(apart, 0, abs_tol=1e-9 * max(map(abs, (*first, *other)))):
        return 1.0
    return chance_beyond(apart, variance, freedom)


def chance_beyond(apart: float, variance: float, freedom: int) -> float:
    """How often chance alone makes a difference this large, of a known variance: Student's t.

    Args:
        apart: The difference, 0 or more.
        variance: That of such differences, as far as so many degrees of freedom tell it.
        freedom: 1 or more.
    """
    return _student_tail(apart / math.sqrt(variance), freedom) if variance > 0 else float(not apart)


def verdicts_on(
    groups: Sequence[Sequence[float | None]], tests: int, least_variance: float = 0.0
) -> list[bool | None]:
    """Of each group whether it differs from the first by more than like runs do.

    False for the first; None where that cannot be told, or a figure of any run is missing.

    Args:
        groups: A figure of each run of each group.
        tests: How many such questions are asked at once: the more, the surer each has to be.
        least_variance: See `chance_of`.
    """
    known = [[each for each in group if each is not None] for group in groups]
    if any(len(a) < len(b) for a, b in zip(known, groups, strict=True)):
        return [None] * len(groups)
    chances = [chance_of(known[0], other, least_variance) for other in known[1:]]
    limit = MOST_CHANCE / tests
    return [False, *(None if chance is None else chance < limit for chance in chances)]


def _student_tail(t: float, freedom: int) -> float:
    """The chance of a greater |t|, for a whole number of degrees of freedom.

    M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions (1964), 26.7.3 and 26.7.4.
    """
    angle = math.atan(t / math.sqrt(freedom))
    sine, square = math.sin(angle), math.cos(angle) ** 2
    odd = freedom % 2
    term = math.cos(angle) if odd else 1.0
    total = term if freedom > 1 else 0.0
    for power in range(2 + odd, freedom, 2):
        term *= square * (power - 1) / power
        total += term
    inside = 2 / math.pi * (angle + sine * total) if odd else sine * total
    return max(0.0, 1 - inside)
