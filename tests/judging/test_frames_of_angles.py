"""What is an angle, and that one row of an answer has its figures in one frame."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable

import numpy as np
import pytest

from tests.recordings.rover import start_run
from webots_mcp.analysis.summary import may_wrap, wraps
from webots_mcp.judging.trends import Trend, trends
from webots_mcp.signals.meaning import declare_meaning
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.meanings import set_meanings
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.signal_history import TURNS_COUNTED, query_history

Course = Callable[[float], float]


def record(connection: sqlite3.Connection, name: str, course: Course) -> None:
    recorder = start_run(connection)
    connection.execute("BEGIN")
    for step in range(1200):
        recorder.publish(round(step / 10, 3), {name: course(step / 10)})
    connection.execute("COMMIT")
    make_chunks(connection, 100_000)


def trend_of(connection: sqlite3.Connection, name: str) -> Trend:
    return trends(connection, find_range(connection, Scope()), [name]).runs[0].numbers[0]


def turning(time_s: float) -> float:
    """Three and a half turns in two minutes, between -pi and pi."""
    return math.remainder(math.tau * 3.5 * time_s / 119.9, math.tau)


@pytest.mark.parametrize("name", ["yaw", "azimuth", "nav.facing"])
def test_all_figures_of_an_angle_count_its_turns(
    empty: sqlite3.Connection, looked_at: str, name: str
) -> None:
    record(empty, name, turning)
    trend = trend_of(empty, name)
    whole = math.tau * 3.5
    assert trend.summary.first == pytest.approx(0.0)
    assert trend.summary.last == trend.summary.max == pytest.approx(whole)
    assert trend.turned == pytest.approx(whole)
    assert trend.slope_per_s == pytest.approx(whole / 119.9)
    assert trend.mean is not None and 0 <= trend.mean <= whole
    assert ("taken for an angle" in trend.says) == (name != "yaw")
    history = query_history(empty, find_range(empty, Scope()), [name], max_points=12)
    (columns,) = history.runs[0].numbers
    rising = [each for each in columns.last if each is not None]
    assert rising == sorted(rising) and rising[-1] == pytest.approx(whole)
    for low, mean, high in zip(columns.min, columns.mean, columns.max, strict=True):
        assert low is not None and mean is not None and high is not None and low <= mean <= high
    assert columns.whole.max == pytest.approx(whole)
    assert TURNS_COUNTED in history.notes


@pytest.mark.parametrize(
    ("unit", "turn"), [("deg", 360.0), ("rad", math.tau)], ids=["degrees", "radians"]
)
def test_what_is_declared_a_heading_is_an_angle(
    empty: sqlite3.Connection, unit: str, turn: float
) -> None:
    record(empty, "richtung", lambda t: (turn / 40 * math.sin(t)) % turn)
    set_meanings(empty, 1, [declare_meaning("richtung", quantity="heading", unit=unit)], "cli")
    trend = trend_of(empty, "richtung")
    assert trend.mean is not None and trend.summary.max is not None
    assert math.remainder(trend.mean, turn) == pytest.approx(0.0, abs=turn / 400)
    assert trend.summary.max - (trend.summary.min or 0.0) == pytest.approx(turn / 20, rel=0.01)


def test_what_is_declared_to_be_no_angle_is_none(empty: sqlite3.Connection) -> None:
    record(empty, "pitch", turning)
    set_meanings(empty, 1, [declare_meaning("pitch", quantity="distance", unit="m")], "cli")
    trend = trend_of(empty, "pitch")
    assert trend.turned is None and (trend.summary.max or 9.0) <= math.pi


NO_ANGLES: dict[str, Course] = {
    "switching speed": lambda t: 3.0 if t % 10 < 5 else -3.0,
    "swing": lambda t: 3.0 * math.sin(t),
    "two values": lambda t: 350.0 if t % 10 < 5 else 2.0,
    "saw": lambda t: (t * 20) % 300,
    "noisy flag": lambda t: 355.0 * (t % 2 < 1) + math.sin(31 * t),
}


@pytest.mark.parametrize("name", NO_ANGLES)
def test_what_only_jumps_is_no_angle(name: str) -> None:
    numbers = np.array([NO_ANGLES[name](step / 10) for step in range(1200)])
    turn = may_wrap(float(numbers.min()), float(numbers.max()))
    assert turn is None or not wraps(numbers, turn)
