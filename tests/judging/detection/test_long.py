"""A long run is searched as a short one is, as far as there is time for it."""

from __future__ import annotations

import math
import sqlite3
from typing import Any

import pytest

from tests.recordings.rover import Recorder, start_run
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range

SWING_S = (100.0, 130.0)
BORDER_S = 307.2  # of two chunks of 1,024 rows
LEAP_S = 60.0


@pytest.fixture
def long(empty: sqlite3.Connection) -> sqlite3.Connection:
    """500 s in several chunks: a leap and a swing are in the oldest part, another at a border."""
    recorder = start_run(empty)
    for step in range(5000):
        recorder.publish(step * 0.1, state(step * 0.1))
    make_chunks(empty, 100_000)
    return empty


def state(time_s: float) -> dict[str, Any]:
    swings = SWING_S[0] <= time_s < SWING_S[1] or BORDER_S - 6 <= time_s < BORDER_S + 6
    x = 0.2 * time_s + (2.0 if time_s >= LEAP_S else 0.0)
    return {"pose": [x, 0.0], "steering": 0.3 * math.sin(math.pi * time_s) * swings}


def test_swings_and_leaps_are_searched_in_the_whole_of_a_long_run(long: sqlite3.Connection) -> None:
    found = find_events(
        long, find_range(long, Scope()), EventOptions(kinds=("jump", "oscillation"))
    )
    swings = [each for each in found.events if each.kind == "oscillation"]
    assert [(round(each.start_s), round(each.end_s)) for each in swings] == [(100, 130), (301, 313)]
    (leap,) = (each for each in found.events if each.kind == "jump")
    assert leap.start_s == pytest.approx(LEAP_S)
    assert "not before" not in str(found.verdicts.not_searched)


def test_the_position_of_a_run_is_the_one_that_it_published(empty: sqlite3.Connection) -> None:
    """Another run of the robot named it otherwise, after an edit."""
    recorder = Recorder(empty)
    robot_id = recorder.robot("rover")
    for name in ("pose", "gps"):
        recorder.run(recorder.session(robot_id, name[0] * 64), robot_id)
        for step in range(300):
            recorder.publish(step * 0.1, {name: [min(step, 200) * 0.02, 0.0]})
    make_chunks(empty, 100_000)
    for run_id in (1, 2):
        found = find_events(
            empty, find_range(empty, Scope(run_id=run_id)), EventOptions(kinds=("standstill",))
        )
        assert [round(each.start_s) for each in found.events] == [20], run_id


@pytest.fixture
def stopping(empty: sqlite3.Connection) -> sqlite3.Connection:
    """A robot that stands for 30 s of each 60 s, in a run that is long."""
    recorder = Recorder(empty)
    robot_id = recorder.robot("rover")
    recorder.run(recorder.session(robot_id, "a" * 64), robot_id)
    x = 0.0
    for step in range(6000):
        moving = step % 600 < 300
        x += 0.02 * moving
        recorder.publish(step * 0.1, {"pose": [round(x, 4), 0.0], "ticks": step * moving})
    make_chunks(empty, 100_000)
    return empty


def test_standstills_of_a_long_run_that_are_told_begin_and_end_to_the_row(
    stopping: sqlite3.Connection,
) -> None:
    asked, options = find_range(stopping, Scope()), EventOptions(kinds=("standstill",))
    found = find_events(stopping, asked, options, limit=3, group=False)
    assert found.verdicts.found == {"standstill": 10}
    ends = [(each.start_s, each.end_s) for each in found.events]
    expected = [(60.0 * at + 29.9, 60.0 * at + 59.9) for at in (7, 8, 9)]
    assert ends == [pytest.approx(each, abs=0.11) for each in expected]
