"""Swings are found where they are, whatever else the value does before, after or meanwhile."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from webots_mcp.store.analysis.arrays import Array
from webots_mcp.store.analysis.swings import Swing, find_swings

START_S, PERIODS, HEIGHT = 60.0, 8, 0.2
COURSES: dict[str, Callable[[Array], Array]] = {
    "constant": np.zeros_like,
    "ramp": lambda times: 0.15 * times,
    "turns": lambda times: np.interp(times, [0, 30, 65, 70, 90, 200], [0, 9, 9, 12, 12, -20]),
    "far away": lambda times: np.where(times < 30, 40.0, 0.0),
}


def swinging(times: Array, course: str, period_s: float, noise: float = 0.003) -> Array:
    """Eight periods from 60 s on."""
    inside = (times >= START_S) & (times < START_S + PERIODS * period_s)
    swing = np.where(inside, HEIGHT * np.sin(2 * np.pi * (times - START_S) / period_s), 0)
    dither = np.random.default_rng(len(times)).normal(0, noise, len(times))
    return COURSES[course](times) + swing + dither


def swings_of(times: Array, values: Array) -> list[Swing]:
    return find_swings(times, values, least_half_swings=6, longest_period_s=5.0)


@pytest.mark.parametrize("course", COURSES)
@pytest.mark.parametrize(("interval_s", "period_s"), [(0.008, 1.0), (0.032, 2.0), (0.1, 3.0)])
def test_eight_periods_within_two_minutes_are_found(
    course: str, interval_s: float, period_s: float
) -> None:
    times = np.arange(0, 120, interval_s)
    (swing,) = swings_of(times, swinging(times, course, period_s))
    assert swing.period_s == pytest.approx(period_s, rel=0.05)
    assert swing.amplitude == pytest.approx(HEIGHT, rel=0.1)
    assert swing.start_s == pytest.approx(START_S, abs=period_s)
    assert swing.end_s == pytest.approx(START_S + PERIODS * period_s, abs=period_s)


@pytest.mark.parametrize("unit", [1e-60, 1e60])
def test_a_swing_is_found_whatever_its_unit_is(unit: float) -> None:
    times = np.arange(0, 120, 0.032)
    (swing,) = swings_of(times, unit * swinging(times, "turns", 2.0))
    assert swing.amplitude == pytest.approx(unit * HEIGHT, rel=0.1)


@pytest.mark.parametrize("course", ["constant", "ramp", "turns"])
def test_more_time_never_finds_less(course: str) -> None:
    times = np.arange(0, 600, 0.032)
    values = swinging(times, course, 2.0)
    for start_s, end_s in ((55, 80), (30, 120), (0, 300), (0, 600)):
        part = (times >= start_s) & (times < end_s)
        assert len(swings_of(times[part], values[part])) == 1, (start_s, end_s)


@pytest.mark.parametrize(("before_s", "after_s"), [(3.0, 1.0), (1.0, 3.0)])
def test_a_swing_of_another_period_right_after_hides_none(before_s: float, after_s: float) -> None:
    times = np.arange(0, 200, 0.032)
    swing = np.sin(2 * np.pi * times / np.where(times < 60, before_s, after_s))
    noise = np.random.default_rng(7).normal(0, 0.1, len(times))
    found = swings_of(times, swing + noise)
    assert [each.period_s for each in found] == pytest.approx([before_s, after_s], rel=0.05)
    assert [found[0].end_s, found[1].start_s] == pytest.approx([60.0, 60.0], abs=1.0)


@pytest.mark.parametrize("limit", [1.0, 0.5, 0.01])
def test_a_swing_that_meets_a_limit_reaches_no_farther(limit: float) -> None:
    times = np.arange(0, 60, 0.032)
    swing = np.clip(np.sin(2 * np.pi * times / 1.6), -limit, limit)
    noise = np.random.default_rng(7).normal(0, limit / 100, len(times))
    (found,) = swings_of(times, swing + noise)
    assert found.amplitude == pytest.approx(limit, rel=0.1)


@pytest.mark.parametrize("phase", np.arange(0.25, 2 * np.pi, 0.5))
@pytest.mark.parametrize("at_end", [False, True])
def test_a_swing_that_reaches_an_end_of_the_range_is_told_up_to_there(
    phase: float, at_end: bool
) -> None:
    times = np.arange(0, 30, 0.1)
    values = np.sin(2 * np.pi * times / 2.0 + phase) * (times < 10)
    (swing,) = swings_of(times, values[::-1] if at_end else values)
    from_end_s = float(times[-1]) - swing.end_s if at_end else swing.start_s
    assert from_end_s <= 0.75  # of a period of 2 s: less than a half swing is left out


@pytest.mark.parametrize("period_s", [2.013, 2.031, 2.057, 2.079])
def test_the_period_of_a_swing_without_noise_is_told_within_a_fifth_of_a_percent(
    period_s: float,
) -> None:
    times = np.arange(0, 120, 0.032)
    inside = (times > START_S) & (times < START_S + 8.6 * period_s)
    (swing,) = swings_of(times, np.sin(2 * np.pi * (times - START_S) / period_s) * inside)
    assert swing.period_s == pytest.approx(period_s, rel=0.002)


def zigzag(rng: np.random.Generator, times: Array) -> Array:
    """Straight pieces of 2 to 8 s, as the heading of a robot that turns."""
    places = np.cumsum(rng.uniform(2, 8, 60))
    slopes = rng.choice([0.0, 0.8, -0.8, 0.3], 60)
    course = np.concatenate(([0.0], np.cumsum(np.diff(places) * slopes[1:])))
    return np.interp(times, places, course)


@pytest.mark.parametrize("seed", range(12))
def test_a_swing_is_found_over_turns_that_follow_each_other_as_fast_as_its_periods(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    times = np.arange(0, 120, 0.08)
    course = zigzag(rng, times) + rng.normal(0, 0.01, len(times))
    inside = (times >= START_S) & (times < START_S + 6 * 4.0)
    swing = np.where(inside, HEIGHT * np.sin(2 * np.pi * (times - START_S) / 4.0), 0)
    assert swings_of(times, course) == []
    (found,) = swings_of(times, course + swing)
    assert found.period_s == pytest.approx(4.0, rel=0.05)
    assert found.amplitude == pytest.approx(HEIGHT, rel=0.1)
    assert found.start_s == pytest.approx(START_S, abs=5.0)
    assert found.end_s == pytest.approx(START_S + 24.0, abs=5.0)


def test_periods_of_almost_5_s_are_looked_for_over_turns_as_well() -> None:
    times = np.arange(0, 120, 0.08)
    swing = swinging(times, "constant", 4.7, 0.01)
    ways = [zigzag(np.random.default_rng(seed), times) for seed in range(12)]
    found = [each for way in ways for each in swings_of(times, way + swing)]
    assert 10 <= len(found) <= 12  # some turns hide it
    for each in found:
        assert each.period_s == pytest.approx(4.7, rel=0.05)
        assert each.amplitude == pytest.approx(HEIGHT, rel=0.1)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_pieces_of_which_none_is_as_high_as_their_median_swing_without_a_warning() -> None:
    rng = np.random.default_rng(43)
    times = np.arange(0, 60, 0.1)
    low, high = rng.uniform(0.05, 0.5, 2).tolist()
    swing = np.sin(2 * np.pi * times / float(rng.uniform(2, 4.8)))
    swing *= np.select([times <= 10, times < 30, times < 50], [0.0, low, high])
    swings_of(times, zigzag(rng, times) + swing)


def test_a_swing_goes_on_across_a_gap() -> None:
    times = np.arange(0, 120, 0.032)
    values = 0.1 * times + HEIGHT * np.sin(np.pi * times)
    recorded = (times < 50) | (times > 56.3)
    (swing,) = swings_of(times[recorded], values[recorded])
    assert (swing.start_s, swing.end_s) == (pytest.approx(0, abs=1), pytest.approx(120, abs=1))
    assert swing.period_s == pytest.approx(2.0, rel=0.02)
    assert swing.amplitude == pytest.approx(HEIGHT, rel=0.05)


def test_two_different_swings_beside_a_gap_are_two() -> None:
    times = np.arange(0, 120, 0.032)
    values = np.where(times < 50, np.sin(np.pi * times), 0.2 * np.sin(4 * np.pi * times))
    recorded = (times < 50) | (times > 56)
    before, after = swings_of(times[recorded], values[recorded])
    assert (before.period_s, after.period_s) == (
        pytest.approx(2.0, rel=0.02), pytest.approx(0.5, rel=0.02),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(10))
def test_noise_and_what_goes_to_and_fro_once_do_not_swing(seed: int) -> None:
    times = np.arange(0, 120, 0.032)
    assert swings_of(times, np.random.default_rng(seed).normal(0, 1, len(times))) == []
    assert swings_of(times, np.where(times % 60 < 30, 1.0, 0.05)) == []
    assert swings_of(times, np.ones_like(times)) == []
    assert swings_of(times[:5], times[:5]) == []


def test_rows_of_a_paused_simulation_count_once() -> None:
    times = np.arange(0, 60, 0.032)
    paused = np.insert(times, 900, np.full(5000, times[900]))
    (swing,) = swings_of(paused, np.sin(np.pi * paused))
    assert swing.period_s == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("speed", [0.01504, 0.0149, 0.0007])
def test_a_steady_course_that_is_rounded_does_not_swing(speed: float) -> None:
    """Steps of 1 and 2 ten-thousandths follow each other regularly."""
    times = np.arange(0, 120, 0.008)
    assert swings_of(times, np.round(speed * times, 4)) == []


@pytest.mark.parametrize("levels", [(-0.2, 0.2), (-0.2, -0.2, 0.2)])
def test_what_is_switched_to_and_fro_swings(levels: tuple[float, ...]) -> None:
    times = np.arange(0, 120, 0.032)
    at = (times / (2.0 / len(levels))).astype(np.int64) % len(levels)
    (swing,) = swings_of(times, np.array(levels)[at])
    assert swing.period_s == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("seed", [7, 19, 23, 30, 32, 39])
def test_a_random_walk_that_looks_regular_for_a_while_does_not_swing(seed: int) -> None:
    steps = np.random.default_rng(seed).normal(0, 1, 6000)
    assert swings_of(np.linspace(0, 300, 6001)[:-1], np.cumsum(steps)) == []


@pytest.mark.parametrize("rest_periods", [1.3, 2.0])
@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_two_swings_with_a_rest_between_them_are_two(rest_periods: float, slope: float) -> None:
    times, period_s = np.arange(0, 120, 0.16), 3.7
    lasts_s = 4.5 * period_s
    begins_s = 40.0, 40.0 + lasts_s + rest_periods * period_s
    values = slope * times + np.random.default_rng(5).normal(0, 0.02, len(times))
    for begin_s in begins_s:
        inside = (times >= begin_s) & (times < begin_s + lasts_s)
        values += inside * 0.25 * np.sin(2 * np.pi * (times - begin_s) / period_s)
    found = swings_of(times, values)
    assert [each.start_s for each in found] == pytest.approx(begins_s, abs=period_s / 2)
    assert [each.end_s - each.start_s for each in found] == pytest.approx([lasts_s] * 2, rel=0.15)


def test_a_slow_swing_counts_from_six_periods_on() -> None:
    times = np.arange(0, 120, 0.1)
    dither = np.random.default_rng(6).normal(0, 0.01, len(times))
    for periods, count in ((5, 0), (8, 1)):
        inside = (times >= 10) & (times < 10 + 10 * periods)
        values = dither + inside * 0.3 * np.sin(2 * np.pi * (times - 10) / 10)
        found = find_swings(times, values, least_half_swings=6, longest_period_s=20.0)
        assert len(found) == count


@pytest.mark.parametrize("share", np.arange(0.1, 0.95, 0.1))
@pytest.mark.parametrize("period_s", [1.0, 2.5, 4.0])
def test_a_staircase_of_ramps_never_turns_back_and_does_not_swing(
    share: float, period_s: float
) -> None:
    times = np.arange(0, 120, 0.032)
    whole, part = np.divmod(times / period_s, 1)
    steps = whole + np.clip(part / share, 0, 1)
    noise = np.random.default_rng(8).normal(0, 0.005, len(times))
    assert swings_of(times, np.pi / 2 * (steps + noise)) == []


def test_a_swing_within_one_that_is_much_slower_is_found_beside_it() -> None:
    times = np.arange(0, 600, 0.05)
    inside = (times > 200) & (times < 220)
    fast = np.where(inside, 0.1 * np.sin(np.pi * times), 0)
    noise = np.random.default_rng(9).normal(0, 0.01, len(times))
    values = np.sin(2 * np.pi * times / 30) + fast + noise
    found = find_swings(times, values, least_half_swings=6, longest_period_s=100.0)
    assert sorted(each.period_s for each in found) == pytest.approx([2.0, 30.0], rel=0.03)


def test_a_weave_within_a_staircase_does_not_make_all_of_it_a_swing() -> None:
    times = np.arange(0, 400, 0.05)
    whole, part = np.divmod(times / 14, 1)
    stairs = np.pi / 2 * (whole + np.clip(part / 0.1, 0, 1))
    inside = (times >= 200) & (times < 230)
    weave = np.where(inside, 0.3 * np.sin(2 * np.pi * (times - 200) / 3), 0)
    noise = np.random.default_rng(3).normal(0, 0.005, len(times))
    (swing,) = find_swings(
        times, stairs + weave + noise, least_half_swings=6, longest_period_s=60.0
    )
    assert swing.period_s == pytest.approx(3.0, rel=0.03)
    assert (swing.start_s, swing.end_s) == pytest.approx((200, 230), abs=1.5)
