"""Which numbers are angles, so that their means and trends go the short way round."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.recordings.rover import start_run
from webots_mcp.analysis.arrays import Array
from webots_mcp.analysis.summary import unwrap
from webots_mcp.judging.trends import Trend, trends
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.ranges import Scope, find_range


def turning(time_s: float) -> dict[str, Any]:
    yaw_rad = math.remainder(0.3 * time_s, math.tau)
    return {
        "pose": [time_s, 0.0, yaw_rad],
        "arm": {"pose": [0.1, 0.2, 0.05 * time_s]},
        "drone": {"pose": [time_s, 0.0, 1.5, 0.0, 0.0, yaw_rad]},
    }


def test_the_third_item_of_a_planar_pose_is_an_angle(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    for second in range(200):
        recorder.publish(float(second), turning(float(second)))
    before = known_signals(empty, find_range(empty, Scope()))
    make_chunks(empty, 100_000)
    for known in (before, known_signals(empty, find_range(empty, Scope()))):
        assert (known["pose.2"].kind, known["pose.2"].unit) == ("angle", "rad")
        assert known["arm.pose.2"].kind == "num"  # goes up to 10
        assert known["drone.pose.2"].kind == "num"  # of six items the third is z


@given(st.lists(st.floats(-50, 50), min_size=1, max_size=50).map(np.array))
def test_unwrapping_is_numpys(angles: Array) -> None:
    assert unwrap(angles).tolist() == pytest.approx(np.unwrap(angles).tolist())
    assert unwrap(angles, 360.0).tolist() == pytest.approx(np.unwrap(angles, period=360.0).tolist())


@given(st.lists(st.floats(-50, 50) | st.just(math.nan), min_size=1, max_size=50))
def test_what_is_no_angle_does_not_change_the_others(listed: list[float]) -> None:
    angles = np.array(listed)
    known = np.isfinite(angles)
    found = unwrap(angles)
    assert found[known].tolist() == pytest.approx(unwrap(angles[known]).tolist())
    np.testing.assert_array_equal(found[~known], angles[~known])


def trend_of(connection: sqlite3.Connection, name: str, course: Callable[[float], float]) -> Trend:
    """One minute of it, a row each 0.1 s."""
    recorder = start_run(connection)
    for step in range(600):
        recorder.publish(step * 0.1, {name: course(step * 0.1)})
    make_chunks(connection, 100_000)
    return trends(connection, find_range(connection, Scope())).runs[0].numbers[0]


@pytest.mark.parametrize(("name", "turn"), [("heading", math.tau), ("heading_deg", 360.0)])
def test_a_heading_about_the_end_of_its_scale_is_one_course_in_the_means_of_a_long_run(
    empty: sqlite3.Connection, name: str, turn: float
) -> None:
    heading = trend_of(
        empty, name, lambda t: (turn / 36 * math.sin(t * math.tau / 60) + turn * (t > 0)) % turn
    )
    low, high = heading.summary.min, heading.summary.max
    assert low is not None and high is not None and heading.mean is not None
    assert not heading.fast and high - low == pytest.approx(turn / 18, rel=0.15)
    assert math.remainder(heading.mean, turn) == pytest.approx(0, abs=turn / 360)


@pytest.mark.parametrize(("name", "turn"), [("heading", math.tau), ("heading_deg", 360.0)])
def test_a_heading_that_swings_across_the_end_of_its_scale_has_narrow_extremes(
    empty: sqlite3.Connection, name: str, turn: float
) -> None:
    heading = trend_of(
        empty, name, lambda t: math.remainder(turn / 2 + turn / 60 * math.sin(t), turn)
    )
    low, high = heading.summary.min, heading.summary.max
    assert low is not None and high is not None and heading.mean is not None
    assert high - low == pytest.approx(turn / 30, rel=0.02)
    assert heading.deviation == pytest.approx(turn / 60 / 2**0.5, rel=0.05)
    assert abs(heading.mean) == pytest.approx(turn / 2, rel=0.01)


def test_degrees_are_turned_by_more_than_a_turn(empty: sqlite3.Connection) -> None:
    heading = trend_of(empty, "heading_deg", lambda t: (20 * t) % 360)
    assert heading.says == "turns by 1.2e+03 deg (20 deg/s)"
    assert heading.turned == pytest.approx(20 * 59.9)


def test_a_bearing_to_the_nearest_of_several_things_does_not_turn(
    empty: sqlite3.Connection,
) -> None:
    nearest = (0.3, 2.4, -1.8)
    bearing = trend_of(empty, "bearing", lambda t: nearest[int(t / 2) % 3] + 0.01 * math.sin(t))
    assert bearing.turned is None
    assert "turns are not counted" in bearing.says and "turns by" not in bearing.says
    assert (bearing.summary.min, bearing.summary.max) == (
        pytest.approx(-1.8, abs=0.02), pytest.approx(2.4, abs=0.02),
    )  # fmt: skip


@pytest.mark.parametrize(("name", "turn"), [("bearing_rad", math.tau), ("bearing_deg", 360.0)])
def test_where_turns_are_not_counted_neither_extremes_nor_deviation_count_them(
    empty: sqlite3.Connection, looked_at: str, name: str, turn: float
) -> None:
    places = [0.45, -0.45, 0.1]
    bearing = trend_of(empty, f"lidar.{name}", lambda t: turn * places[int(10 * t) % 7 % 3])
    assert (bearing.turned, bearing.fast) == (None, True)
    assert (bearing.summary.min, bearing.summary.max) == pytest.approx((-0.45 * turn, 0.45 * turn))
    assert bearing.deviation is not None
    assert 0.1 * turn < bearing.deviation < 0.4 * turn


@pytest.mark.parametrize("name", ["heading", "heading_deg"])
def test_the_deviation_of_a_course_is_that_of_its_values_in_a_long_range_too(
    empty: sqlite3.Connection, looked_at: str, name: str
) -> None:
    half = 180.0 if name == "heading_deg" else math.pi
    heading = trend_of(
        empty, name, lambda t: math.remainder(0.99 * half + 0.03 * half * math.sin(t / 5), 2 * half)
    )
    assert heading.deviation == pytest.approx(0.03 * half / 2**0.5, rel=0.12)
    assert heading.summary.min is not None and heading.summary.min > 0.9 * half
