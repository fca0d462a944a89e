"""Statistical tests of counts: whether rare events differ between groups of runs.

How many runs of two groups have an event is compared by Fisher's exact test and by intervals of
differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from webots_mcp.analysis.summary import MOST_CHANCE, MOST_REPEATED, Verdict

_NORMAL_90: float = 1.6448536  # a normal figure lies within that many deviations nine times of ten
_SAME_CHANCE: float = 1 + 1e-7  # two tables are as likely if they differ by rounding only


def is_rare(groups: Sequence[Sequence[float | None]]) -> bool:
    """Return whether at least half of the runs have none of the events.

    Which group a run is in does not matter, so that the choice of a test favours no answer.
    """
    known = [count for group in groups for count in group if count is not None]
    return 2 * sum(count == 0 for count in known) >= len(known)


def chance_of_shares(first: int, of_first: int, other: int, of_other: int) -> float:
    """Return how often chance alone splits the runs with an event as unevenly on two groups.

    Fisher's exact test, two-sided: all tables with the same sums that are at most as likely (R. A.
    Fisher, Statistical Methods for Research Workers, 5th ed. 1934, section 21.02).

    Args:
        first: Runs of the first group that have it.
        of_first: All runs of the first group.
        other: Runs of the other group that have it.
        of_other: All runs of the other group.
    """
    having = first + other
    ways = [
        math.comb(of_first, count) * math.comb(of_other, having - count)
        for count in range(max(0, having - of_other), min(of_first, having) + 1)
    ]
    found = math.comb(of_first, first) * math.comb(of_other, other)
    return sum(each for each in ways if each <= found * _SAME_CHANCE) / sum(ways)


def interval_of_shares(first: int, of_first: int, other: int, of_other: int) -> tuple[float, float]:
    """Return where the difference of two shares of runs lies nine times of ten: other less first.

    R. G. Newcombe, Interval estimation for the difference between independent proportions,
    Statistics in Medicine 17, 1998, method 10: from the score intervals of both shares.
    """
    low1, high1 = _score_interval(first, of_first)
    low2, high2 = _score_interval(other, of_other)
    share1, share2 = first / of_first, other / of_other
    by = share2 - share1
    return (
        by - math.hypot(share2 - low2, high1 - share1),
        by + math.hypot(high2 - share2, share1 - low1),
    )


def _score_interval(having: int, runs: int) -> tuple[float, float]:
    """Return where a share lies nine times of ten.

    E. B. Wilson, Probable inference, the law of succession, and statistical inference, Journal of
    the American Statistical Association 22, 1927.
    """
    share, square = having / runs, _NORMAL_90**2
    middle = (share + square / (2 * runs)) / (1 + square / runs)
    half = _NORMAL_90 * math.sqrt(share * (1 - share) / runs + square / (4 * runs**2))
    half /= 1 + square / runs
    return max(0.0, middle - half), min(1.0, middle + half)


def may_shares_differ(groups: Sequence[Sequence[float]]) -> bool:
    """Return whether any split of the runs with an event could show that shares differ.

    See `summary.may_differ`.
    """
    having, first = [sum(map(bool, group)) for group in groups], groups[0]
    for other, others_having in zip(groups[1:], having[1:], strict=True):
        both = having[0] + others_having
        most = min(both, len(first))
        extremes = [(most, both - most), (both - min(both, len(other)), min(both, len(other)))]
        chances = (chance_of_shares(a, len(first), b, len(other)) for a, b in extremes)
        if min(chances) < MOST_CHANCE:
            return True
    return False


def verdicts_on_shares(
    groups: Sequence[Sequence[float | None]],
    tests: int,
    tests_of_more: int,
    min_effect_sd: float,
) -> list[Verdict]:
    """Return of each group whether another share of its runs has an event than of the first.

    Args:
        groups: How many events each run has.
        tests: How many questions are asked at once: the more, the surer True has to be.
        tests_of_more: How many are asked once there are more runs.
        min_effect_sd: The smallest difference that matters, in deviations of one run from the
            share of all.

    Returns:
        True where Fisher's test shows a difference. False where the interval of the difference
        lies within what does not matter. None where neither holds, or a figure is missing.
        The interval is that of the difference of the shares.
    """
    if any(count is None for group in groups for count in group):
        return [Verdict(None)] * len(groups)
    shares = [(sum(map(bool, group)), len(group)) for group in groups]
    limits = [MOST_CHANCE / max(each, 1) for each in (tests, tests_of_more)]
    verdicts = [Verdict(False)]
    for other in shares[1:]:
        interval = interval_of_shares(*shares[0], *other)
        different = _differ(shares[0], other, limits[0], min_effect_sd)
        wanted = None if different is not None else _wanted(shares[0], other, limits[1])
        verdicts.append(Verdict(different, wanted, interval))
    return verdicts


def _differ(
    first: tuple[int, int], other: tuple[int, int], limit: float, min_effect_sd: float
) -> bool | None:
    low, high = interval_of_shares(*first, *other)
    if chance_of_shares(*first, *other) < limit and not low <= 0 <= high:
        return True
    share = (first[0] + other[0]) / (first[1] + other[1])
    margin = min_effect_sd * math.sqrt(share * (1 - share))
    return False if -margin < low and high < margin else None


def _wanted(first: tuple[int, int], other: tuple[int, int], limit: float) -> int | None:
    """Return how many runs of each would show a difference, if they went on like these."""
    shares = [having / runs for having, runs in (first, other)]
    for runs in range(min(first[1], other[1]) + 1, MOST_REPEATED + 1):
        having = [round(share * runs) for share in shares]
        if chance_of_shares(having[0], runs, having[1], runs) < limit:
            return runs
    return None
