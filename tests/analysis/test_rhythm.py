"""What is a gap in the recording, and what only jitter or another rate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from webots_mcp.analysis.arrays import Array, Gap, find_gaps, rhythm_of

FAST = [round(step * 0.032, 3) for step in range(1000)]
SLOW = [round(32 + step * 0.5, 3) for step in range(60)]


def test_rows_that_come_at_a_slower_rate_for_a_while_have_no_gaps() -> None:
    assert rhythm_of([*FAST, *SLOW]).gaps == ()


def test_a_gap_within_a_slower_rate_is_one() -> None:
    assert rhythm_of([*FAST, *SLOW, 70.0, 70.5]).gaps == (Gap(SLOW[-1], 70.0),)


def test_a_gap_within_the_faster_of_two_rates_is_one() -> None:
    fast = [time_s for time_s in FAST if not 10 < time_s < 10.4]
    slow = [round(32 + step * 0.5, 3) for step in range(2000)]
    assert rhythm_of([*fast, *slow]).gaps == (Gap(9.984, 10.4),)


def test_a_few_lost_rows_one_after_the_other_are_gaps() -> None:
    assert len(rhythm_of([*FAST[:500], 16.5, 17.0, 17.5, *FAST[560:]]).gaps) == 4


def test_a_gap_of_any_length_is_found_however_often_there_is_one() -> None:
    for lost in range(3, 60):
        times = [step * 0.017 for step in range(6000) if step % 80 >= lost]
        assert len(find_gaps(times)) == 74, lost


def test_one_late_row_is_no_gap() -> None:
    assert find_gaps([*FAST[:500], *FAST[501:]]) == ()


JITTERS: dict[str, Callable[[np.random.Generator], Array]] = {
    "lognormal": lambda draws: draws.lognormal(0.0, 0.5, 100_000),
    "exponential": lambda draws: draws.exponential(1.0, 100_000),
    "normal": lambda draws: np.maximum(0.01, draws.normal(1.0, 0.3, 100_000)),
    "steps": lambda draws: draws.choice(np.array([1.0, 2.0, 3.0]), 100_000),
}


@pytest.mark.parametrize("name", JITTERS)
def test_jitter_is_hardly_ever_taken_for_gaps(name: str) -> None:
    intervals = JITTERS[name](np.random.default_rng(7))
    assert len(find_gaps(np.cumsum(intervals))) <= 2  # of 100,000


@pytest.mark.parametrize("spread", [0.05, 0.2])
def test_a_gap_in_rows_that_jitter_is_found(spread: float) -> None:
    intervals = np.random.default_rng(3).lognormal(0.0, spread, 2000)
    intervals[1000] = 12.0
    (gap,) = find_gaps(np.cumsum(intervals))
    assert gap.end_s - gap.start_s == pytest.approx(12.0)
