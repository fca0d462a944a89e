"""The noise is told from the course, and smoothing takes most of it away."""

from __future__ import annotations

import numpy as np
import pytest

from webots_mcp.store.analysis.arrays import noise_of
from webots_mcp.store.analysis.track import smooth

TIMES = np.arange(0, 60, 0.032)


@pytest.mark.parametrize("deviation", [0.001, 0.03])
def test_the_noise_of_a_driving_robot_is_that_of_its_sensor(deviation: float) -> None:
    course = np.sin(0.7 * TIMES) + 0.2 * TIMES
    noisy = course + np.random.default_rng(1).normal(0, deviation, len(TIMES))
    assert noise_of(noisy) == pytest.approx(deviation, rel=0.1)


def test_a_smooth_course_has_no_noise_and_a_few_outliers_are_none() -> None:
    course = np.sin(0.7 * TIMES)
    assert noise_of(course) < 1e-6
    course[::200] = 9.0
    assert noise_of(course) < 1e-6
    assert noise_of(course[:5]) == 0.0


def test_smoothing_leaves_the_course_and_says_what_it_leaves_of_the_noise() -> None:
    course = np.sin(0.7 * TIMES)
    noise = np.random.default_rng(2).normal(0, 0.02, len(TIMES))
    smoothed, left = smooth(course + noise, 31)
    assert np.std(smoothed - course) == pytest.approx(0.02 * left, rel=0.2)
    assert left < 0.3
    assert smooth(course[:3], 31)[1] == 1.0
