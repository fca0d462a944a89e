"""A robot at rest travels nothing, a driving one what it drove, whatever the noise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.store.analysis.driving import noisy_track
from webots_mcp.store.analysis.arrays import noise_of
from webots_mcp.store.analysis.track import path_length, smooth, track_of

DRIVE = [
    phase
    for turn in (0.0, 0.6, -0.8, 1.2)
    for phase in ((8.0, 0.25, 0.0), (4.0, 0.25, turn), (6.0, 0.15, 0.0))
]
INTERVALS_S = (0.008, 0.032, 0.1)


@given(st.integers(0, 1000), st.floats(0.001, 10), st.floats(-5, 5))
def test_the_noise_is_told_whatever_steady_motion_lies_under_it(
    seed: int, deviation: float, speed: float
) -> None:
    rows = np.arange(1000)
    values = speed * rows + np.random.default_rng(seed).normal(0, deviation, len(rows))
    assert noise_of(values) == pytest.approx(deviation, rel=0.3)


@given(st.floats(-10, 10), st.floats(-1, 1), st.floats(-0.01, 0.01))
def test_a_smooth_course_has_no_noise_and_smoothing_leaves_it_as_it_is(
    offset: float, slope: float, bend: float
) -> None:
    rows = np.arange(200.0)
    course = offset + slope * rows + bend * rows**2
    assert noise_of(course) == pytest.approx(0, abs=1e-9)
    assert smooth(course, 21)[0] == pytest.approx(course, abs=1e-7)


def test_an_outlier_is_no_noise() -> None:
    values = np.zeros(500)
    values[[100, 300]] = 50.0
    assert noise_of(values) == 0


@pytest.mark.parametrize("rows", range(7))
def test_the_shortest_tracks_are_tracks(rows: int) -> None:
    times = np.arange(rows, dtype=np.float64)
    track = track_of(times, times, 0 * times)
    assert path_length(track).length_m == max(0, rows - 1)


@pytest.mark.parametrize("interval_s", INTERVALS_S)
@pytest.mark.parametrize("noise_m", [0.0, 0.01, 0.03])
def test_a_robot_at_rest_for_two_minutes_has_not_travelled(
    interval_s: float, noise_m: float
) -> None:
    track, _ = noisy_track([(120.0, 0.0, 0.0)], interval_s, noise_m)
    assert path_length(track).length_m <= (0.1 if noise_m <= 0.01 else 0.5)


@pytest.mark.parametrize("interval_s", INTERVALS_S)
@pytest.mark.parametrize(("noise_m", "share"), [(0.0, 0.02), (0.01, 0.02), (0.03, 0.05)])
def test_the_way_of_a_driving_robot_is_as_long_as_it_was(
    interval_s: float, noise_m: float, share: float
) -> None:
    track, length_m = noisy_track(DRIVE, interval_s, noise_m)
    assert path_length(track).length_m == pytest.approx(length_m, rel=share)


@given(st.integers(0, 50), st.floats(-100, 100), st.floats(-100, 100), st.floats(0, 6.28))
def test_the_length_of_a_way_hangs_neither_on_where_nor_on_whither(
    seed: int, east_m: float, north_m: float, angle: float
) -> None:
    track, _ = noisy_track([(5.0, 0.3, 0.5), (5.0, 0.0, 0.0)], 0.05, 0.005, seed)
    cos, sin = np.cos(angle), np.sin(angle)
    x = cos * track.raw_x - sin * track.raw_y + east_m
    y = sin * track.raw_x + cos * track.raw_y + north_m
    elsewhere = path_length(track_of(track.times, x, y)).length_m
    assert elsewhere == pytest.approx(path_length(track).length_m, rel=0.05)


@pytest.mark.parametrize("noise_m", [0.0, 0.002, 0.005])
def test_in_bends_the_way_is_longer_than_the_straight_lines_between_its_rows(
    noise_m: float,
) -> None:
    track, length_m = noisy_track([(60.0, 0.3, 1.5)], 0.5, noise_m)
    assert path_length(track).length_m == pytest.approx(length_m, rel=0.015)


@pytest.mark.parametrize("noise_m", [0.002, 0.005, 0.02])
def test_noise_across_the_way_adds_nothing_to_it(noise_m: float) -> None:
    track, length_m = noisy_track([(120.0, 0.25, 0.0)], 0.008, noise_m)
    assert path_length(track).length_m == pytest.approx(length_m, rel=0.008)


def test_narrow_bends_of_a_slow_robot_are_no_turns_on_the_spot() -> None:
    """At 30 mm of noise a leg between two places that differ is a second long: 1.5 rad of turn."""
    bends = [(4.0, 0.16, 1.5), (3.0, 0.16, 0.0), (4.0, 0.16, -1.5), (2.0, 0.16, 0.5)] * 9
    tracks = [noisy_track(bends, 0.5, 0.03, seed) for seed in range(8)]
    ratios = [path_length(track).length_m / length_m for track, length_m in tracks]
    assert float(np.median(ratios)) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("noise_m", [0.005, 0.01, 0.03])
def test_of_many_robots_at_rest_hardly_one_is_said_to_have_moved(noise_m: float) -> None:
    tracks = [noisy_track([(120.0, 0.0, 0.0)], 0.008, noise_m, seed)[0] for seed in range(15)]
    moved_m = [path_length(track).length_m for track in tracks]
    assert np.count_nonzero(moved_m) <= 1


@given(
    seed=st.integers(0, 1000),
    speed_m_s=st.floats(0.03, 0.4),
    noise_m=st.sampled_from([0.002, 0.005, 0.01, 0.03]),
    interval_s=st.sampled_from([0.032, 0.08, 0.16, 0.5]),
)
def test_a_way_is_nowhere_longer_than_told_to_be_possible(
    seed: int, speed_m_s: float, noise_m: float, interval_s: float
) -> None:
    """Bends of 1.5 rad/s are 20 mm narrow at 0.03 m/s."""
    bends = [(4.0, speed_m_s, turn) for turn in (0.0, 1.5, 0.5, -0.8, 0.0, -1.5)] * 5
    track, length_m = noisy_track(bends, interval_s, noise_m, seed)
    told = path_length(track)
    assert told.length_m < 1.2 * length_m
    assert told.length_m + told.longer_m > 0.85 * length_m


@pytest.mark.parametrize("speed_m_s", [0.03, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("interval_s", [0.08, 0.5])
def test_slow_ways_without_narrow_bends_are_as_long_as_they_were(
    speed_m_s: float, interval_s: float
) -> None:
    turns = [(10.0, speed_m_s, turn) for turn in (0.0, 0.1, 0.0, -0.1)] * 3
    track, length_m = noisy_track(turns, interval_s, 0.03)
    assert path_length(track).length_m == pytest.approx(length_m, rel=0.05)


@pytest.mark.parametrize(("speed_m_s", "interval_s"), [(0.03, 0.08), (0.05, 0.08), (0.1, 0.5)])
def test_most_of_the_bends_that_noise_hides_are_counted(
    speed_m_s: float, interval_s: float
) -> None:
    """Circles with a radius of 20 to 67 mm at 30 mm of noise: places alone show 0.6 to 0.8."""
    bends = [(5.0, speed_m_s, turn) for turn in (0.0, 1.5, 0.5, -1.5)] * 6
    tracks = [noisy_track(bends, interval_s, 0.03, seed) for seed in range(8)]
    ratios = [path_length(track).length_m / length_m for track, length_m in tracks]
    assert 0.85 < float(np.median(ratios)) < 1.05


@pytest.mark.parametrize("interval_s", [0.08, 0.5])
def test_who_drove_and_then_rested_travels_no_farther_meanwhile(interval_s: float) -> None:
    phases = [(10.0, 0.3, 0.0), (110.0, 0.0, 0.0)]
    tracks = [noisy_track(phases, interval_s, 0.03, seed)[0] for seed in range(15)]
    lengths_m = [path_length(track).length_m for track in tracks]
    assert float(np.median(lengths_m)) == pytest.approx(3.0, rel=0.05)
    assert max(lengths_m) < 3.5
