"""Whether groups of runs differ by more than like runs do."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, TypeAlias

MOST_CHANCE: Final = 0.002  # that any of the figures compared at once differs among like runs
MOST_REPEATED: Final = 10  # runs of each group: who asks for more of them has no answer


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


class Verdict(NamedTuple):
    """Whether a group differs from the first by more than like runs do.

    Attributes:
        different: None where that cannot be told; False where even 10 runs of each that went on
            like these would not show a difference.
        runs_wanted: So many runs of each would show it, if they went on like these; None where
            they need not, or would not.
    """

    different: bool | None
    runs_wanted: int | None = None


Chance: TypeAlias = Callable[[Sequence[float], Sequence[float]], "float | None"]


def chance_of(first: Sequence[float], other: Sequence[float]) -> float | None:
    """How often two groups of like runs would lie as far apart as these: Student's t test.

    Two-sided, with the pooled variance (Student, The probable error of a mean, Biometrika 6,
    1908). 0 where like runs agree to the last digit and the groups do not. None for one run each:
    then nothing tells how much like runs differ.
    """
    freedom = len(first) + len(other) - 2
    if freedom < 1 or not first or not other:
        return None
    apart = abs(statistics.fmean(other) - statistics.fmean(first))
    squares = sum(statistics.pvariance(group) * len(group) for group in (first, other))
    variance = squares / freedom * (1 / len(first) + 1 / len(other))
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


def chance_of_counts(first: Sequence[float], other: Sequence[float]) -> float | None:
    """The same of counted events in stretches of one length.

    Neither chance alone makes such counts (the conditional test of two Poisson means, J.
    Przyborowski, H. Wilenski, Biometrika 31, 1940: of all events each falls on a group as often as
    the group has runs), nor the spread of like runs, which may be larger than that of chance.
    """
    chance = chance_of(first, other)
    if chance is None:
        return None
    share = len(first) / (len(first) + len(other))
    return max(chance, _chance_of_split(round(sum(first)), round(sum(other)), share))


def may_differ(groups: Sequence[Sequence[float]]) -> bool:
    """Whether any split of so many events on two groups would show that counts differ.

    A test whose least chance is above the limit adds nothing to the chance of a false claim (R. E.
    Tarone, A modified Bonferroni method for discrete data, Biometrics 46, 1990).
    """
    first = groups[0]
    for other in groups[1:]:
        events = round(sum(first) + sum(other))
        share = min(len(first), len(other)) / (len(first) + len(other))
        if _chance_of_split(events, 0, share) < MOST_CHANCE:
            return True
    return False


def _chance_of_split(first: int, other: int, share: float) -> float:
    """How often so many events fall as unevenly on two groups: twice the lesser binomial tail."""
    events = first + other
    fewer, part = (first, share) if first <= events * share else (other, 1 - share)
    ways = math.lgamma(events + 1) - math.lgamma(first + 1) - math.lgamma(other + 1)
    chance = math.exp(ways + first * math.log(share) + other * math.log(1 - share))
    tail = 0.0
    for count in range(fewer, -1, -1):  # each of fewer events is less likely than the one before
        tail += chance
        chance *= count / (events - count + 1) * (1 - part) / part
    return min(1.0, 2 * tail)


def verdicts_on(
    groups: Sequence[Sequence[float | None]],
    tests: int,
    chance: Chance = chance_of,
    tests_of_more: int = 0,
) -> list[Verdict]:
    """Of each group whether it differs from the first by more than like runs do.

    False for the first; None where that cannot be told, or a figure of any run is missing.

    Args:
        groups: A figure of each run of each group.
        tests: How many such questions are asked at once: the more, the surer each has to be.
        chance: How often like runs lie as far apart.
        tests_of_more: How many are asked once there are more runs, if not as many.
    """
    known = [[each for each in group if each is not None] for group in groups]
    if any(len(a) < len(b) for a, b in zip(known, groups, strict=True)):
        return [Verdict(None)] * len(groups)
    limits = [MOST_CHANCE / max(each, 1) for each in (tests, tests_of_more or tests)]
    others = (_verdict(known[0], other, limits, chance) for other in known[1:])
    return [Verdict(False), *others]


def _verdict(
    first: Sequence[float], other: Sequence[float], limits: Sequence[float], chance: Chance
) -> Verdict:
    limit, of_more = limits
    found = chance(first, other)
    if found is None or found < limit:
        return Verdict(None if found is None else True)
    wanted = _runs_wanted(first, other, of_more, chance)
    return Verdict(None if wanted else False, wanted)


def _runs_wanted(
    first: Sequence[float], other: Sequence[float], limit: float, chance: Chance
) -> int | None:
    """The fewest runs of each that would show a difference, if they went on like these."""

    def shows(runs: int) -> bool:
        found = chance(_so_many(first, runs), _so_many(other, runs))
        return found is not None and found < limit

    if not shows(MOST_REPEATED):
        return None
    fewest = min(len(first), len(other)) + 1
    return next((runs for runs in range(fewest, MOST_REPEATED) if shows(runs)), MOST_REPEATED)


def _so_many(figures: Sequence[float], runs: int) -> list[float]:
    """Figures of at least so many runs, of which the further ones are as the first were."""
    return [figures[index % len(figures)] for index in range(max(runs, len(figures)))]


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
