"""Groups of runs differ when they lie farther apart than like runs do."""

from __future__ import annotations

import math
import random
from collections import Counter

import pytest

from webots_mcp.analysis.summary import (
    MIN_EFFECT_SD,
    Spread,
    Verdict,
    chance_of,
    chance_of_counts,
    may_differ,
    spread_of,
    verdicts_on,
)


@pytest.mark.parametrize(
    ("runs", "apart"),  # Student's table: two-sided 5 % for 2, 4, 8 and 3 degrees of freedom
    [((2, 2), 4.303), ((3, 3), 2.776), ((5, 5), 2.306), ((1, 4), 3.182)],
)
def test_the_chance_is_that_of_students_table(runs: tuple[int, int], apart: float) -> None:
    """Of groups that scatter alike; of a single run it is taken for granted."""
    first, other = ([float(i) for i in range(n)] for n in runs)
    freedom = sum(runs) - 2
    squares = sum(sum((each - (n - 1) / 2) ** 2 for each in range(n)) for n in runs)
    error = math.sqrt(squares / freedom * sum(1 / n for n in runs))
    shift = apart * error + (runs[0] - 1) / 2 - (runs[1] - 1) / 2
    assert chance_of(first, [each + shift for each in other]) == pytest.approx(0.05, abs=1e-3)


def told(
    groups: list[list[float]], tests: int = 1, min_effect_sd: float = MIN_EFFECT_SD
) -> list[bool | None]:
    return [each.different for each in verdicts_on(groups, tests, min_effect_sd=min_effect_sd)]


def test_of_one_run_each_nothing_can_be_told() -> None:
    assert chance_of([1.0], [2.0]) is None
    assert told([[1.0], [2.0]]) == [False, None]


@pytest.mark.parametrize("other", [1.0, 1.0001])
def test_a_few_runs_that_agree_to_the_last_digit_prove_nothing(other: float) -> None:
    """Like runs may keep to one lane of two: a fourth of such pairs was called different."""
    unsure = Verdict(None, runs_wanted=7)
    assert verdicts_on([[1.0] * 2, [other] * 2], tests=100)[1] == unsure
    assert verdicts_on([[1.0] * 6, [other] * 6], tests=100)[1] == unsure
    assert told([[1.0] * 7, [other] * 7], tests=100) == [False, other != 1.0]


def test_two_clusters_of_few_runs_are_not_two_codes() -> None:
    assert told([[1.0, 1.001, 1.002], [2.0, 2.001, 2.002]]) == [False, None]
    assert told([[1.0, 1.001, 1.002, 1.0], [2.0, 2.001, 2.002, 2.0]]) == [False, True]


def test_groups_that_more_runs_would_tell_apart_are_not_called_equal() -> None:
    near, far = [1.0, 1.2, 0.9], [1.7, 1.9, 1.6]
    unsure = verdicts_on([near, far], tests=10)[1]
    assert unsure.different is None and unsure.runs_wanted is not None
    repeated = (unsure.runs_wanted + 2) // 3
    assert told([near * repeated, far * repeated], tests=10) == [False, True]
    alike = verdicts_on([near, [1.0, 1.2, 0.95]], tests=10)[1]
    assert (alike.different, alike.runs_wanted) == (None, 8)


def test_the_interval_is_that_of_the_textbook() -> None:
    """4 runs of each, a pooled variance of 5 / 3, and 1.943 of the table for 6 degrees."""
    (_, found) = verdicts_on([[1.0, 2.0, 3.0, 4.0], [3.0, 4.0, 5.0, 6.0]], tests=1)
    within = 1.943 * math.sqrt(5 / 3 / 2)
    assert found.interval == pytest.approx((2 - within, 2 + within), abs=1e-3)
    assert verdicts_on([[1.0, 1.0], [2.0, 2.0]], tests=1)[1].interval is None


def rates(runs: int, effect_sd: float) -> dict[bool | None, int]:
    """What is said of 200 pairs of groups."""
    dice = random.Random(runs)
    return Counter(
        told([[100 + dice.gauss(by, 1) for _ in range(runs)] for by in (0, effect_sd)], tests=20)[1]
        for _ in range(200)
    )


@pytest.mark.slow
@pytest.mark.parametrize("runs", [(8, 2), (7, 3), (10, 4)])
@pytest.mark.parametrize("scatter", [0.0, 0.3])
def test_a_few_runs_that_scatter_do_not_differ_from_many_that_do_not(
    runs: tuple[int, int], scatter: float
) -> None:
    """Of one mean; by the deviation of both together up to a third of such pairs differed."""
    dice = random.Random(1)
    pairs = (
        [
            [100 + dice.gauss(0, by) for _ in range(n)]
            for n, by in zip(runs, (scatter, 1), strict=True)
        ]
        for _ in range(1000)
    )
    said = Counter(told(pair)[1] for pair in pairs)
    assert said[True] <= 20 and not said[False]


def test_no_is_said_only_where_a_difference_that_matters_is_excluded() -> None:
    """At 10 runs each two standard deviations were "no" in 62 % of pairs, and in 99 % one."""
    assert rates(4, 0.0)[None] == 200
    assert rates(10, 1.0)[False] <= 20
    assert rates(10, 2.0)[False] == rates(30, 2.0)[False] == 0
    assert rates(30, 0.0)[False] >= 180
    assert rates(30, 2.0)[True] == 200


@pytest.mark.parametrize(
    ("first", "other", "chance"),  # 2 * 0.5**6, and of 8 that split 1:7 2 * 9 / 256
    [([2, 2, 2], [0, 0, 0], 0.03125), ([1, 0, 0], [2, 3, 2], 0.0703125)],
)
def test_the_chance_of_counts_is_that_of_the_exact_test(
    first: list[float], other: list[float], chance: float
) -> None:
    assert chance_of_counts(first, other) == pytest.approx(chance)
    assert chance_of_counts(other, first) == pytest.approx(chance)


def test_counts_of_groups_of_unequal_size_are_expected_by_their_runs() -> None:
    assert chance_of_counts([2, 2, 2, 2], [1]) == pytest.approx(
        2 * sum(math.comb(9, n) * 0.2**n * 0.8 ** (9 - n) for n in (0, 1))
    )
    assert chance_of_counts([2000] * 3, [4000] * 3) == pytest.approx(0, abs=1e-12)


def test_counts_of_few_events_cannot_differ_by_chance_and_do_not_hide_what_does() -> None:
    assert not may_differ([[0, 0, 0, 0], [2, 2, 2, 3]])  # 2 * 0.5**9 is above 0.002
    assert may_differ([[0, 0, 0, 0], [2, 2, 3, 3]])  # 2 * 0.5**10 is not
    assert not may_differ([[3], [0, 0, 0, 0]]) and may_differ([[5], [0, 0, 0, 0]])  # 2 * 0.2**5


def test_counts_that_spread_more_than_chance_need_more_than_chance() -> None:
    assert verdicts_on([[0, 30, 2, 40], [9, 0, 60, 80]], 1, chance_of_counts)[1].different is None


def test_a_figure_that_one_run_lacks_is_not_told_of_its_group() -> None:
    assert spread_of([1.0, None]) is None
    assert spread_of([]) is None
    assert spread_of([3.0, 1.0, 2.0]) == Spread(2.0, 1.0, 3.0)
    assert verdicts_on([[1.0, None], [9.0, 9.1]], tests=1) == [Verdict(None), Verdict(None)]
