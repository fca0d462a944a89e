"""Swings are found where they are, whatever else the value does before, after or meanwhile."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from webots_mcp.analysis.arrays import Array
from webots_mcp.analysis.oscillations import Swing, find_swings

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


def noise_of(seed: int, deviation: float, times: Array) -> Array:
    return np.random.default_rng(seed).normal(0, deviation, len(times))


def two_swings(rest_periods: float, slope: float) -> tuple[Array, Array]:
    """Four and a half periods of 3.7 s from 40 s on, a rest, and the same again."""
    times = np.arange(0, 120, 0.16)
    values = slope * times + noise_of(5, 0.02, times)
    for begin_s in (40.0, 40.0 + (4.5 + rest_periods) * 3.7):
        inside = (times >= begin_s) & (times < begin_s + 4.5 * 3.7)
        values += inside * 0.25 * np.sin(2 * np.pi * (times - begin_s) / 3.7)
    return times, values


TIMES = np.arange(0, 120, 0.032)
PAUSED = np.insert(TIMES, 900, np.full(5000, TIMES[900]))
ACROSS_A_GAP = TIMES[(TIMES < 50) | (TIMES > 56.3)]
BESIDE_A_GAP = TIMES[(TIMES < 50) | (TIMES > 56)]
SWITCHED = (TIMES / (2.0 / 3)).astype(np.int64) % 3
# Times and values, and period, amplitude, begin and end of each swing in them.
SWINGS: dict[str, tuple[Array, Array, list[tuple[float, float, float, float]]]] = {
    **{
        f"{course}, a row each {interval_s} s": (
            times, swinging(times, course, period_s),
            [(period_s, HEIGHT, START_S, START_S + PERIODS * period_s)],
        )
        for course in COURSES
        for interval_s, period_s in ((0.008, 1.0), (0.032, 2.0), (0.1, 3.0))
        for times in [np.arange(0, 120, interval_s)]
    },
    "in a tiny unit": (TIMES, 1e-60 * swinging(TIMES, "turns", 2.0), [(2.0, 2e-61, 60, 76)]),
    "in a huge unit": (TIMES, 1e60 * swinging(TIMES, "turns", 2.0), [(2.0, 2e59, 60, 76)]),
    "clipped": (
        TIMES, np.clip(np.sin(2 * np.pi * TIMES / 1.6), -0.1, 0.1) + noise_of(7, 0.001, TIMES),
        [(1.6, 0.1, 0, 120)],
    ),
    "across a gap": (
        ACROSS_A_GAP, 0.1 * ACROSS_A_GAP + HEIGHT * np.sin(np.pi * ACROSS_A_GAP),
        [(2.0, HEIGHT, 0, 120)],
    ),
    "two beside a gap": (
        BESIDE_A_GAP,
        np.where(BESIDE_A_GAP < 50, np.sin(np.pi * BESIDE_A_GAP),
                 0.2 * np.sin(4 * np.pi * BESIDE_A_GAP)),
        [(2.0, 1.0, 0, 50), (0.5, 0.2, 56, 120)],
    ),
    "one right after another": (
        TIMES,
        np.sin(2 * np.pi * TIMES / np.where(TIMES < 60, 3.0, 1.0)) + noise_of(7, 0.1, TIMES),
        [(3.0, 1.0, 0, 60), (1.0, 1.0, 60, 120)],
    ),
    "rows of a pause": (PAUSED, np.sin(np.pi * PAUSED), [(2.0, 1.0, 0, 120)]),
    "switched": (TIMES, np.array([-0.2, -0.2, 0.2])[SWITCHED], [(2.0, 0.2, 0, 120)]),
    **{
        f"a rest of {rest_periods} periods, on a slope of {slope}": (
            *two_swings(rest_periods, slope),
            [(3.7, 0.25, begin_s, begin_s + 4.5 * 3.7)
             for begin_s in (40.0, 40.0 + (4.5 + rest_periods) * 3.7)],
        )
        for rest_periods in (1.3, 2.0) for slope in (0.0, 0.05)
    },
}  # fmt: skip


@pytest.mark.parametrize(("times", "values", "expected"), SWINGS.values(), ids=SWINGS)
def test_swings_are_found_with_their_period_height_and_ends(
    times: Array, values: Array, expected: list[tuple[float, float, float, float]]
) -> None:
    found = swings_of(times, values)
    assert len(found) == len(expected)
    for swing, (period_s, amplitude, start_s, end_s) in zip(found, expected, strict=True):
        assert swing.period_s == pytest.approx(period_s, rel=0.02)
        assert swing.amplitude == pytest.approx(amplitude, rel=0.1)
        assert (swing.start_s, swing.end_s) == pytest.approx((start_s, end_s), abs=period_s)


def staircase(period_s: float, share: float) -> Array:
    whole, part = np.divmod(TIMES / period_s, 1)
    return np.pi / 2 * (whole + np.clip(part / share, 0, 1) + noise_of(8, 0.005, TIMES))


FINE = np.arange(0, 120, 0.008)
WALK = np.linspace(0, 300, 6001)[:-1]
NO_SWINGS: dict[str, tuple[Array, Array]] = {
    **{f"noise {seed}": (TIMES, noise_of(seed, 1, TIMES)) for seed in range(10)},
    "to and fro once": (TIMES, np.where(TIMES % 60 < 30, 1.0, 0.05)),
    "constant": (TIMES, np.ones_like(TIMES)),
    "five rows": (TIMES[:5], TIMES[:5]),
    # Steps of 1 and 2 ten-thousandths follow each other regularly.
    **{f"rounded {v}": (FINE, np.round(v * FINE, 4)) for v in (0.01504, 0.0149, 0.0007)},
    # They look regular for a while.
    **{f"walk {seed}": (WALK, np.cumsum(noise_of(seed, 1, WALK))) for seed in (7, 19, 23, 30, 39)},
    **{
        f"stairs {period_s} {share}": (TIMES, staircase(period_s, share))
        for period_s in (1.0, 2.5, 4.0) for share in (0.1, 0.3, 0.5, 0.7, 0.9)
    },
}  # fmt: skip


@pytest.mark.parametrize(("times", "values"), NO_SWINGS.values(), ids=NO_SWINGS)
def test_what_only_looks_like_it_does_not_swing(times: Array, values: Array) -> None:
    assert swings_of(times, values) == []


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


def test_a_slow_swing_counts_from_six_periods_on() -> None:
    times = np.arange(0, 120, 0.1)
    dither = np.random.default_rng(6).normal(0, 0.01, len(times))
    for periods, count in ((5, 0), (8, 1)):
        inside = (times >= 10) & (times < 10 + 10 * periods)
        values = dither + inside * 0.3 * np.sin(2 * np.pi * (times - 10) / 10)
        found = find_swings(times, values, least_half_swings=6, longest_period_s=20.0)
        assert len(found) == count


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
