"""Groups of runs differ when they lie farther apart than like runs do."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from webots_mcp.store.analysis.spread import Spread, chance_of, spread_of, verdicts_on

FIGURES = st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=6)


@pytest.mark.parametrize(
    ("runs", "apart"),  # Student's table: two-sided 5 % for 2, 3, 4 and 8 degrees of freedom
    [((2, 2), 4.303), ((2, 3), 3.182), ((3, 3), 2.776), ((5, 5), 2.306)],
)
def test_the_chance_is_that_of_students_table(runs: tuple[int, int], apart: float) -> None:
    first, other = ([float(i) for i in range(n)] for n in runs)
    freedom = sum(runs) - 2
    squares = sum(sum((each - (n - 1) / 2) ** 2 for each in range(n)) for n in runs)
    error = math.sqrt(squares / freedom * sum(1 / n for n in runs))
    shift = apart * error + (runs[0] - 1) / 2 - (runs[1] - 1) / 2
    assert chance_of(first, [each + shift for each in other]) == pytest.approx(0.05, abs=1e-3)


@given(FIGURES, FIGURES)
def test_the_chance_is_a_share_and_the_same_both_ways(one: list[float], other: list[float]) -> None:
    chance = chance_of(one, other)
    assert chance is not None and 0 <= chance <= 1
    assert chance == pytest.approx(chance_of(other, one))


def test_of_one_run_each_nothing_can_be_told() -> None:
    assert chance_of([1.0], [2.0]) is None
    assert verdicts_on([[1.0], [2.0]], tests=1) == [False, None]


def test_runs_that_agree_to_the_last_digit_differ_by_any_change() -> None:
    assert verdicts_on([[1.0, 1.0], [1.0001, 1.0001]], tests=100) == [False, True]
    assert verdicts_on([[1.0, 1.0], [1.0, 1.0]], tests=100) == [False, False]


def test_a_few_counts_that_happen_to_agree_are_not_certain() -> None:
    counts = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
    assert verdicts_on(counts, tests=1, least_variance=0.5) == [False, False]


def test_a_figure_that_one_run_lacks_is_not_told_of_its_group() -> None:
    assert spread_of([1.0, None]) is None
    assert spread_of([]) is None
    assert spread_of([3.0, 1.0, 2.0]) == Spread(2.0, 1.0, 3.0)
    assert verdicts_on([[1.0, None], [9.0, 9.1]], tests=1) == [None, None]
