"""A robot at rest travels nothing, a driving one what it drove, whatever the noise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.analysis.driving import noisy_track
from webots_mcp.analysis.arrays import noise_of
from webots_mcp.analysis.path_length import path_length, smooth, track_of


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


@pytest.mark.slow
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


Phases = list[tuple[float, float, float]]


def turning(lasts_s: float, speed_m_s: float, *turns_rad_s: float) -> Phases:
    return [(lasts_s, speed_m_s, turn) for turn in turns_rad_s]


DRIVE = [
    phase
    for turn in (0.0, 0.6, -0.8, 1.2)
    for phase in ((8.0, 0.25, 0.0), (4.0, 0.25, turn), (6.0, 0.15, 0.0))
]
CIRCLES = (0.0, 1.5, 0.5, -1.5)  # of 20 to 67 mm: at 30 mm of noise places alone show 0.6 to 0.8
SWAYS = (0.0, 0.1, 0.0, -0.1)
# What it goes through, the row interval, the noise, and how far off the told length may be.
WAYS: list[tuple[Phases, float, float, tuple[float, float]]] = [
    *((DRIVE, interval_s, noise_m, (1 - share, 1 + share))
      for interval_s in (0.008, 0.032, 0.1)
      for noise_m, share in ((0.0, 0.02), (0.01, 0.02), (0.03, 0.05))),
    *(([(60.0, 0.3, 1.5)], 0.5, noise_m, (0.985, 1.015)) for noise_m in (0.0, 0.005)),
    *(([(120.0, 0.25, 0.0)], 0.008, noise_m, (0.992, 1.008)) for noise_m in (0.002, 0.02)),
    ([(4.0, 0.16, 1.5), (3.0, 0.16, 0.0), (4.0, 0.16, -1.5), (2.0, 0.16, 0.5)] * 9, 0.5, 0.03,
     (0.95, 1.05)),
    *((turning(10.0, speed_m_s, *SWAYS) * 3, interval_s, 0.03, (0.95, 1.05))
      for speed_m_s in (0.03, 0.2) for interval_s in (0.08, 0.5)),
    *((turning(5.0, speed_m_s, *CIRCLES) * 6, interval_s, 0.03, (0.85, 1.05))
      for speed_m_s, interval_s in ((0.03, 0.08), (0.1, 0.5))),
    *(([(10.0, 0.3, 0.0), (110.0, 0.0, 0.0)], interval_s, 0.03, (0.95, 1.05))
      for interval_s in (0.08, 0.5)),
]  # fmt: skip


@pytest.mark.parametrize(("phases", "interval_s", "noise_m", "ratio"), WAYS)
def test_a_way_is_as_long_as_it_was_whatever_the_noise(
    phases: Phases, interval_s: float, noise_m: float, ratio: tuple[float, float]
) -> None:
    tracks = [noisy_track(phases, interval_s, noise_m, seed) for seed in range(5)]
    ratios = [path_length(track).length_m / length_m for track, length_m in tracks]
    assert ratio[0] <= float(np.median(ratios)) <= ratio[1]


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
