"""The features of a signal, beside the same in plain Python."""

from __future__ import annotations

import math
import statistics
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from webots_mcp.analysis.arrays import Array
from webots_mcp.analysis.summary import (
    find_spikes,
    fit_line,
    flat_since,
    is_monotonic,
    leaps_in,
    summarise_numbers,
    time_effect,
)

numbers = st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=50).map(np.array)
few = st.lists(st.sampled_from([0.0, 1.0, 2.0, 7.0]), min_size=1, max_size=40).map(np.array)
hundred = np.arange(100, dtype=np.float64)


def times_of(course: Array) -> Array:
    return 0.5 * np.arange(len(course), dtype=np.float64)


@given(few, st.integers(0, 3), st.booleans())
def test_a_summary_is_what_the_statistics_module_says(
    course: Array, missing: int, angle: bool
) -> None:
    times, plain = times_of(course), course.tolist()
    rows, turn = len(plain) + missing, math.tau if angle else None
    found = summarise_numbers(times, course, rows=rows, turn=turn)
    changes = sum(before != after for before, after in pairwise(plain))
    assert found[:3] == (rows, len(plain), changes)
    assert (found.first, found.last, found.min, found.max) == (
        plain[0], plain[-1], min(plain), max(plain),
    )  # fmt: skip
    assert found.min_sim_time_s == 0.5 * plain.index(min(plain))
    assert found.max_sim_time_s == 0.5 * plain.index(max(plain))
    assert found.mean == pytest.approx(statistics.fmean(plain))
    deviation = statistics.stdev(plain) if len(plain) > 1 else None
    assert found.deviation == (deviation if deviation is None else pytest.approx(deviation))
    if angle:
        assert found.sines == pytest.approx(sum(map(math.sin, plain)), abs=1e-9)
        assert found.cosines == pytest.approx(sum(map(math.cos, plain)), abs=1e-9)


@given(numbers)
def test_the_fitted_line_is_that_of_the_statistics_module(course: Array) -> None:
    times = times_of(course)
    line = fit_line(times, course, statistics.fmean(course.tolist()))
    assert line is not None
    expected = statistics.linear_regression(times.tolist(), course.tolist())
    assert line.slope_per_s == pytest.approx(expected.slope, abs=1e-6, rel=1e-6)
    assert 0 <= line.r2 <= 1


@pytest.mark.parametrize("seed", range(20))
def test_noise_has_no_spikes(seed: int) -> None:
    white = np.random.default_rng(seed).normal(size=1000)
    for course in (white, white.cumsum()):
        assert find_spikes(times_of(course), course) == []


def test_a_spike_is_found_and_a_step_is_none() -> None:
    course = np.where(hundred < 50, 0.0, 1.0)
    assert find_spikes(hundred, course) == []
    course[20] = 3.0
    (spike,) = find_spikes(hundred, course)
    assert (spike.sim_time_s, spike.value) == (20.0, 3.0)


@given(few)
def test_the_time_effect_is_that_of_eight_stretches(course: Array) -> None:
    times, mean = times_of(course), statistics.fmean(course.tolist())
    squares = sum((value - mean) ** 2 for value in course.tolist())
    stretches: dict[int, list[float]] = {}
    for time, value in zip(times.tolist(), course.tolist(), strict=True):
        place = next((b for b in range(8, 0, -1) if time >= times[-1] / 8 * b), 0)
        stretches.setdefault(min(7, place), []).append(value)
    between = sum(len(s) * (statistics.fmean(s) - mean) ** 2 for s in stretches.values())
    expected = min(1.0, between / squares) if squares and times[-1] else 0.0
    assert time_effect(times, course, mean, squares) == pytest.approx(expected)


def test_flat_since_is_the_begin_of_the_rest() -> None:
    assert flat_since(hundred, np.minimum(hundred, 60.0)) == 60.0
    assert flat_since(hundred, hundred) is None
    assert flat_since(hundred, np.full(100, 2.0)) == 0.0


def test_a_small_step_between_two_rests_ends_the_first() -> None:
    course = np.where(hundred >= 80, 60.1, np.minimum(hundred, 60.0))
    assert flat_since(hundred, course) == 80.0
    flickering = np.where(hundred % 7 == 0, 60.1, np.minimum(hundred, 60.0))
    assert flat_since(hundred, flickering) == 60.0


@given(few)
def test_what_rises_or_falls_never_goes_back(course: Array) -> None:
    steps = [after - before for before, after in pairwise(course.tolist())]
    rises, falls = all(step >= 0 for step in steps), all(step <= 0 for step in steps)
    assert is_monotonic(course) == ((rises or falls) and any(steps))


@given(st.lists(st.floats(-3.1, 3.1), min_size=1, max_size=20).map(np.array))
def test_a_leap_is_more_than_a_quarter_turn_the_short_way_round(angles: Array) -> None:
    steps = [math.remainder(b - a, math.tau) for a, b in pairwise(angles.tolist())]
    largest = max(map(abs, steps), default=0.0)
    if abs(largest - math.tau / 4) > 1e-9:
        assert leaps_in(angles, math.tau) == (largest > math.tau / 4)


def test_a_noisy_heading_that_passes_north_has_no_spike_there() -> None:
    times = np.arange(0.0, 60.0, 0.5)
    noise = np.random.default_rng(7).normal(0.0, 1.0, len(times))
    headings = 340.0 + times + noise
    headings[36], headings[100] = 361.5, 410.0  # for one row beyond north; a spike
    assert 1.5 in [each.value for each in find_spikes(times, headings % 360)]
    assert [each.value for each in find_spikes(times, headings % 360, turn=360.0)] == [50.0]
