"""Where a level changes for good."""

from __future__ import annotations

import numpy as np
import pytest

from webots_mcp.analysis.level_changes import level_changes


def test_changes_are_found_where_they_are() -> None:
    draws = np.random.default_rng(1)
    values = np.concatenate([draws.normal(level, 0.05, 40) for level in (1.0, 0.5, 1.0)])
    places = level_changes(values, 1e-3)
    assert len(places) == 2
    assert abs(places[0] - 40) <= 1 and abs(places[1] - 80) <= 1


@pytest.mark.slow
def test_one_level_is_hardly_ever_divided() -> None:
    draws = np.random.default_rng(2)
    divided = sum(bool(level_changes(draws.lognormal(0, 1, 60), 1e-3)) for _ in range(3000))
    assert divided <= 9


def test_a_value_that_stands_out_divides_nothing() -> None:
    assert level_changes(np.array([1.0] * 30 + [50.0] + [1.0] * 30), 1e-3) == []


@pytest.mark.parametrize("length", [7, 18, 60])
@pytest.mark.parametrize("start", [0, 40, 111])
def test_a_level_that_comes_back_is_found_in_the_middle_and_at_the_ends(
    start: int, length: int
) -> None:
    draws = np.random.default_rng([start, length])
    values = draws.normal(1.0, 0.02, 120)
    stop = min(start + length, 120)
    values[start:stop] = draws.normal(0.4, 0.01, stop - start)
    places = level_changes(values, 1e-3)
    wanted = [each for each in (start, stop) if 0 < each < 120]
    assert len(places) == len(wanted)
    assert all(abs(a - b) <= 1 for a, b in zip(places, wanted, strict=True))


@pytest.mark.parametrize("count", [20, 60, 150])
def test_values_of_few_kinds_are_hardly_ever_divided(count: int) -> None:
    draws = np.random.default_rng(count)
    drawn = (draws.integers(0, 3, count).astype(np.float64) for _ in range(1000))
    divided = sum(bool(level_changes(each, 1e-3)) for each in drawn)
    assert divided <= 4
