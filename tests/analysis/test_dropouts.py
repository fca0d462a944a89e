"""Short dropouts are bridged by straight lines; long ones, and rare signals, stay as they are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from webots_mcp.analysis.arrays import Array, with_lost_rows, without_dropouts

INTERVAL_S = 0.032
ROWS = 400


def times_of(rows: int = ROWS, interval_s: float = INTERVAL_S) -> Array:
    return np.arange(1, rows + 1, dtype=np.float64) * interval_s


@given(st.sets(st.integers(0, ROWS - 1), max_size=90), st.floats(-5, 5), st.floats(-5, 5))
def test_a_line_stays_a_line(lost: set[int], slope: float, start: float) -> None:
    line = start + slope * times_of()
    values = np.array(line)
    values[sorted(lost)] = math.nan
    found = without_dropouts(values, times_of())
    known = np.isfinite(found)
    np.testing.assert_allclose(found[known], line[known], atol=1e-9)
    assert not (np.isfinite(values) & ~known).any()


@pytest.mark.parametrize(("lost", "bridged"), [(1, True), (6, True), (8, False), (100, False)])
def test_only_short_dropouts_are_bridged(lost: int, bridged: bool) -> None:
    values = np.sin(times_of())
    values[200 : 200 + lost] = math.nan
    assert np.isfinite(without_dropouts(values, times_of())).all() == bridged


@pytest.mark.parametrize("interval_s", [0.5, 10.0])
def test_of_slow_rows_a_single_one_is_bridged(interval_s: float) -> None:
    times, values = times_of(100, interval_s), np.zeros(100)
    values[[50, 70, 71]] = math.nan
    assert np.flatnonzero(np.isnan(without_dropouts(values, times))).tolist() == [70, 71]


def test_a_signal_that_comes_in_every_second_row_is_not_made_up() -> None:
    values = np.sin(times_of())
    values[1::2] = math.nan
    np.testing.assert_array_equal(without_dropouts(values, times_of()), values)


def test_what_is_missing_at_the_ends_is_not_made_up() -> None:
    values = np.ones(ROWS)
    values[[0, -1]] = math.nan
    found = without_dropouts(values, times_of())
    assert np.isnan(found[[0, -1]]).all()


@given(st.sets(st.integers(1, ROWS - 2), max_size=60))
def test_lost_rows_come_back_unless_too_many_are_lost_in_a_row(lost: set[int]) -> None:
    times = times_of()
    kept = np.delete(times, sorted(lost))
    found = with_lost_rows(kept, INTERVAL_S)
    assert np.isin(kept, found).all()
    longest_s = float(np.diff(kept).max())
    if longest_s <= 0.25:
        np.testing.assert_allclose(found, times)


@pytest.mark.slow
@given(st.lists(st.floats(0.02, 0.029), min_size=50, max_size=200))
def test_rows_that_come_unevenly_stay_as_they_are(intervals: list[float]) -> None:
    times = np.cumsum(intervals)
    np.testing.assert_array_equal(with_lost_rows(times, float(np.median(intervals))), times)


def test_a_long_gap_stays() -> None:
    times = np.delete(times_of(), slice(100, 150))
    np.testing.assert_array_equal(with_lost_rows(times, INTERVAL_S), times)
