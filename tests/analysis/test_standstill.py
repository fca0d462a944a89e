"""One standstill is one, begins when it begins, and a creep is none."""

from __future__ import annotations

from itertools import accumulate

import numpy as np
import pytest

from tests.analysis.driving import noisy_track
from webots_mcp.analysis.path_length import noise_of, track_of
from webots_mcp.analysis.standstills import find_standstills

RADIUS_M = 0.05
LEAST_S = 3.0
NOISES_M = [0.0, 0.005, 0.01, 0.015, 0.02, 0.03]


@pytest.mark.parametrize("noise_m", NOISES_M)
@pytest.mark.parametrize("interval_s", [0.032, 0.1])
def test_each_standstill_is_one_with_its_begin_and_end(interval_s: float, noise_m: float) -> None:
    phases = [(12.0, 0.25, 0.0), (20.0, 0.0, 0.0), (10.0, 0.2, 0.4), (6.0, 0.0, 0.0)]
    phases += [(9.0, 0.3, -0.3), (40.0, 0.0, 0.0)]
    track, _ = noisy_track(phases, interval_s, noise_m)
    found = find_standstills(track, RADIUS_M, LEAST_S)
    ends = list(accumulate(seconds for seconds, _, _ in phases))
    slack_s = (4 if noise_m > 0.01 else 2.1) * interval_s + noise_m / 0.2
    assert len(found) == 3
    for at, each in enumerate(found):
        assert track.times[each.start] == pytest.approx(ends[2 * at], abs=slack_s)
        assert track.times[each.last] == pytest.approx(ends[2 * at + 1], abs=slack_s)


@pytest.mark.parametrize(
    "creep", [(60, 0.005, 0.0), (60, 0.018, 0.0), (90, 0.002, 0.03)], ids=["slow", "fast", "bends"]
)
@pytest.mark.parametrize("noise_m", [0.0, 0.002, 0.01])
def test_a_steady_creep_is_slow_and_no_standstill(
    noise_m: float, creep: tuple[float, float, float]
) -> None:
    track, _ = noisy_track([(10, 0.2, 0.0), creep, (10, 0.2, 0.0)], 0.1, noise_m)
    assert find_standstills(track, RADIUS_M, LEAST_S) == []


CREEPS = (60.0, 0.001, 0.0)
RESTS = (40.0, 0.0, 0.0)


@pytest.mark.parametrize("noise_m", [0.0, 0.0005, 0.002, 0.005])
@pytest.mark.parametrize("interval_s", [0.032, 0.1])
@pytest.mark.parametrize(
    ("phases", "ends_s"),
    [
        ([CREEPS, RESTS], (60, 100)),
        ([RESTS, CREEPS], (0, 40)),
        ([CREEPS, RESTS, CREEPS], (60, 100)),
        ([(10.0, 0.2, 0.0), CREEPS, RESTS, (10.0, 0.2, 0.0)], (70, 110)),
    ],
    ids=["then rests", "rested", "rests between", "between drives"],
)
def test_who_creeps_stands_once_and_only_while_it_rests(
    phases: list[tuple[float, float, float]],
    ends_s: tuple[float, float],
    interval_s: float,
    noise_m: float,
) -> None:
    track, _ = noisy_track(phases, interval_s, noise_m, 3)
    (found,) = find_standstills(track, RADIUS_M, LEAST_S)
    told_s = track.times[found.start], track.times[found.last]
    # At 1 mm/s three deviations of the noise are that many milliseconds; a place has a width.
    assert told_s == pytest.approx(ends_s, abs=10)


@pytest.mark.slow
def test_who_creeps_for_an_hour_stands_where_it_rests_and_is_not_searched_beyond_its_time() -> None:
    creeps, short = (1800.0, 0.01, 0.0), (8.0, 0.0, 0.0)
    track, _ = noisy_track([creeps, RESTS, creeps, short, creeps], 0.1, 0.004)
    found = [track.times[each.start] for each in find_standstills(track, RADIUS_M, LEAST_S)]
    assert found == pytest.approx([1800, 3640], abs=5)
    looks = iter(range(10_000))
    found = find_standstills(track, RADIUS_M, LEAST_S, lambda: next(looks) > 50)
    assert len(found) < 2 and next(looks) < 1000  # each stay may be looked at once more


@pytest.mark.parametrize("noise_m", [0.0, 0.001])
@pytest.mark.parametrize("twitches_m", [[0.005, 0.025], [0.012] * 3, [0.004] * 8])
def test_who_twitches_in_a_place_stands_once(twitches_m: list[float], noise_m: float) -> None:
    pause_s = 44.0 / (len(twitches_m) + 1)
    phases = [(50.0, 0.2, 0.0), (pause_s, 0.0, 0.0)]
    for twitch_m in twitches_m:
        phases += [(0.1, 10 * twitch_m, 0.0), (pause_s, 0.0, 0.0)]
    track, _ = noisy_track([*phases, (30.0, 0.2, 0.0)], 0.1, noise_m)
    ends_s = 50.0, 94.0 + 0.1 * len(twitches_m)
    (found,) = find_standstills(track, RADIUS_M, LEAST_S)
    told_s = track.times[found.start], track.times[found.last]
    assert told_s == pytest.approx(ends_s, abs=0.25)


@pytest.mark.slow
def test_few_rows_with_long_gaps_between_them_are_judged_by_rows_alone() -> None:
    random = np.random.default_rng(0)
    for _ in range(300):
        count = int(random.integers(3, 60))
        steps_s = random.choice([0.016, 0.1, 0.5, 2.0, 7.0], count, p=[0.5, 0.3, 0.1, 0.05, 0.05])
        x = np.cumsum(random.choice([0.0, 0.001, 0.02, 0.3], count) * steps_s)
        x += random.normal(0, random.choice([0, 0.001, 0.01]), count)
        track = track_of(np.cumsum(steps_s), x, np.zeros(count), noise_of(x))
        found = find_standstills(track, RADIUS_M, float(random.choice([0.5, 2.0, 4.0])))
        assert all(each.start <= each.last for each in found)
