"""Rare events are compared by the number of runs that have them."""

from __future__ import annotations

import random

import pytest

from webots_mcp.analysis.rank_and_count_tests import (
    chance_of_shares,
    interval_of_shares,
    is_rare,
    may_shares_differ,
    verdicts_on_shares,
)
from webots_mcp.analysis.summary import MOST_CHANCE


def test_the_chance_is_that_of_fishers_tea_tasting() -> None:
    assert chance_of_shares(3, 4, 1, 4) == pytest.approx(34 / 70)
    assert chance_of_shares(4, 4, 0, 4) == pytest.approx(2 / 70)
    assert chance_of_shares(0, 5, 2, 5) == pytest.approx(4 / 9)
    assert chance_of_shares(0, 5, 0, 5) == 1


def test_the_interval_is_that_of_newcombes_method_10() -> None:
    """56 of 70 and 48 of 80, his table II, case a, here at 90 %."""
    low, high = interval_of_shares(48, 80, 56, 70)
    assert (low, high) == pytest.approx((0.0766, 0.3141), abs=2e-3)


@pytest.mark.parametrize(
    ("groups", "rare"),
    [
        ([[0, 0, 1], [0, 0, 0]], True),
        ([[3, 3], [0, 0]], True),
        ([[1, 2], [1, 0]], False),
        ([[None, 0], [1]], True),
    ],
)
def test_what_at_least_half_of_the_runs_lack_is_rare(
    groups: list[list[float | None]], *, rare: bool
) -> None:
    assert is_rare(groups) == rare


def test_two_of_five_runs_prove_nothing_and_ten_of_ten_do() -> None:
    few = verdicts_on_shares([[0] * 5, [1, 0, 2, 0, 0]], 1, 1, 1.0)[1]
    assert (few.different, few.runs_wanted) == (None, None)
    assert few.interval is not None and few.interval[0] < 0 < few.interval[1]
    all_of_ten = verdicts_on_shares([[0] * 10, [1] * 10], 1, 1, 1.0)[1]
    assert all_of_ten.different is True
    assert all_of_ten.interval is not None and all_of_ten.interval[0] > 0


def test_a_figure_that_is_not_known_of_a_run_has_no_verdict() -> None:
    verdicts = verdicts_on_shares([[0, None], [1, 1]], 1, 1, 1.0)
    assert [each.different for each in verdicts] == [None, None]


def test_many_runs_with_the_event_as_often_are_called_equal() -> None:
    groups = [[float(run % 5 == 0) for run in range(100)]] * 2
    assert verdicts_on_shares(groups, 1, 1, 1.0)[1].different is False


def test_equal_groups_are_called_different_no_more_often_than_stated() -> None:
    dice, claims, draws = random.Random(1), 0, 2000
    for _ in range(draws):
        runs = dice.choice([5, 10, 20])
        groups = [[float(dice.random() < 0.3) for _ in range(runs)] for _ in range(2)]
        claims += verdicts_on_shares(groups, 1, 1, 1.0)[1].different is True
    assert claims <= 3 * MOST_CHANCE * draws


def test_too_few_runs_can_show_no_difference() -> None:
    assert not may_shares_differ([[0.0] * 5, [1.0] * 5])
    assert may_shares_differ([[0.0] * 8, [1.0] * 8])
