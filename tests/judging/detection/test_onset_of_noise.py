"""Noise that grew for good is dated when it grew, whatever the order of the blocks before."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cases.columns import Array, Random, noise
from tests.cases.situations import Columns, Situation, recorded


@pytest.mark.slow
@pytest.mark.parametrize("interval_s", [0.02, 0.064, 0.15])
@pytest.mark.parametrize("factor", [4.0, 10.0])
def test_the_onset_is_exact_to_a_few_rows(interval_s: float, factor: float) -> None:
    dice = np.random.default_rng(11)
    for number in range(10):
        onset_s = float(dice.uniform(52, 68))

        def draw(t: Array, random: Random) -> Columns:
            grown = np.where(t < onset_s, 1.0, factor)  # noqa: B023
            return {"front_distance_m": 2 + 0.5 * np.sin(t / 7) + grown * noise(random, t, 0.003)}

        drawn = Situation(f"noisy {number}", draw, (), 120, interval_s)
        with recorded(drawn) as asked:
            (found,) = asked.events("degradation").events
        assert found.start_s == pytest.approx(onset_s, abs=max(0.5, 12 * interval_s))


@pytest.mark.slow
@pytest.mark.parametrize("interval_s", [0.02, 0.064, 0.15])
def test_noise_that_stays_is_no_event(interval_s: float) -> None:
    def draw(t: Array, random: Random) -> Columns:
        return {"front_distance_m": 2 + 0.5 * np.sin(t / 7) + noise(random, t, 0.003)}

    for number in range(10):
        with recorded(Situation(f"steady noise {number}", draw, (), 120, interval_s)) as asked:
            assert asked.events("degradation").events == ()


def test_noise_in_few_rows_is_not_searched() -> None:
    def draw(t: Array, random: Random) -> Columns:
        grown = np.where(t < 60, 1.0, 10.0)
        return {"front_distance_m": 2 + grown * noise(random, t, 0.003)}

    with recorded(Situation("few rows", draw, (), 120, 0.2)) as asked:
        verdicts = asked.events("degradation").verdicts
    assert "640 rows" in str(verdicts.reasons["degradation"])


def test_judged_signals_come_in_the_order_in_which_they_were_published() -> None:
    names = [f"{place}_{device}" for device in ("gyro", "accel") for place in "bfacedgh"]

    def draw(t: Array, random: Random) -> Columns:
        steady = {"front_distance_m": 2 + noise(random, t, 0.003)}
        return {name: noise(random, t, 0.01) for name in names} | steady

    with recorded(Situation("many gyros", draw, (), 60, 0.05)) as asked:
        verdicts = asked.events("degradation").verdicts
    judged = list(verdicts.coverage["degradation"].signals)
    assert [name for name in judged if name in names] == names
