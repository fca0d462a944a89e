"""Where a level changes for good."""

from __future__ import annotations

import numpy as np

from webots_mcp.analysis.rank_and_count_tests import level_changes


def test_changes_are_found_where_they_are() -> None:
    draws = np.random.default_rng(1)
    values = np.concatenate([draws.normal(level, 0.05, 40) for level in (1.0, 0.5, 1.0)])
    places = level_changes(values, 1e-3)
    assert len(places) == 2
    assert abs(places[0] - 40) <= 1 and abs(places[1] - 80) <= 1


def test_one_level_is_hardly_ever_divided() -> None:
    draws = np.random.default_rng(2)
    divided = sum(bool(level_changes(draws.lognormal(0, 1, 60), 1e-3)) for _ in range(3000))
    assert divided <= 9


def test_a_value_that_stands_out_divides_nothing() -> None:
    assert level_changes(np.array([1.0] * 30 + [50.0] + [1.0] * 30), 1e-3) == []
