"""A robot is stuck where its signals show it, whatever its mode is called."""

from __future__ import annotations

import math
import random
import sqlite3
from typing import Any

import pytest

from tests.judging.asking import ask, spans
from tests.recordings.rover import start_run
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.detection.search import ModeUses, RunNoise, Search
from webots_mcp.judging.detection.standstill import judge_standstills
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.reading.segment import Deadline


def publish_stuck(empty: sqlite3.Connection, **moving_and_standing: Any) -> tuple[Event, ...]:
    """Ten seconds of driving and ten of standing; each signal has a value for either."""
    recorder = start_run(empty)
    for step in range(200):
        state = {name: pair[step > 100] for name, pair in moving_and_standing.items()}
        recorder.publish(step * 0.1, state | {"gps": {"x": min(step, 100) * 0.02, "y": 0}})
    return ask(empty, "stuck").events


def test_a_mode_of_an_earlier_run_in_which_it_moved_is_evidence(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    for run in range(3):
        if run:
            recorder.run(1, 1)
        for step in range(200):
            recorder.publish(step * 0.1, {"mode": "S3", "gps": {"x": 0.02 * step, "y": 0}})
    recorder.run(1, 1)
    for step in range(100):
        recorder.publish(step * 0.1, {"mode": "S3", "gps": {"x": 1, "y": 0}})
    (stuck,) = ask(empty, "stuck", bounds={"run_id": 4}).events
    assert stuck.details["evidence_for"] == "in mode S3, in which it moved at 0.2 m/s in run 3"


@pytest.mark.parametrize("period_s", [0.6, 1.5, 2.0])
def test_a_stuck_robot_that_wiggles_is_so_from_its_first_row_to_its_last(
    empty: sqlite3.Connection, period_s: float
) -> None:
    recorder = start_run(empty)
    for step in range(400):
        time_s, travelled_m = step * 0.1, 0.02 * min(step, max(100, step - 60))
        yaw = 0.2 * math.sin(math.tau * time_s / period_s)
        recorder.publish(time_s, {"pose": [travelled_m, 0.0, yaw], "cmd_vel": 0.2})
    (stuck,) = ask(empty, "stuck").events
    assert (stuck.start_s, stuck.end_s) == pytest.approx((10.0, 16.0), abs=0.2)


def test_where_nothing_stood_the_answer_says_what_came_nearest(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    for step in range(300):
        recorder.publish(step * 0.1, {"gps": {"x": step * 0.03, "y": 0}})
    assert "in 3 s was 0.9 m" in ask(empty, "stuck").verdicts.not_found["stuck"]


def test_a_recording_gap_ends_a_standstill(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    for step in (*range(100), *range(200, 300)):
        recorder.publish(step * 0.1, {"gps": {"x": 1.0, "y": 0.0}})
    assert spans(ask(empty, "standstill")) == [(0.0, 9.9), (20.0, 29.9)]


def test_without_a_position_stuck_cannot_be_searched_and_the_answer_says_so(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    recorder.publish(0.0, {"mode": "drive", "range": 1.0})
    told = ask(empty, "stuck", bounds={"run_id": 1}).verdicts
    assert "no position is known" in told.not_searched["stuck"] and not told.not_found


def test_a_short_command_within_a_long_standstill_is_told_as_evidence(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for step in range(2000):
        told = 100 <= step * 0.1 < 110
        state = {"gps": {"x": 1.0, "y": 0}, "commanded_m_s": 0.2 if told else 0.0}
        recorder.publish(step * 0.1, state)
    (stuck,) = ask(empty, "stuck").events
    assert (stuck.start_s, stuck.end_s) == pytest.approx((100.0, 109.9))
    assert stuck.details["evidence_for"] == "commanded_m_s 0.2"


def test_a_mode_that_was_not_looked_at_in_time_is_not_said_to_be_one_in_which_it_stands(
    empty: sqlite3.Connection,
) -> None:
    publish_stuck(empty, mode=("go", "go"))
    asked = find_range(empty, Scope(run_id=1))
    known, options, unhurried = known_signals(empty, asked), EventOptions(), Deadline(math.inf)
    search = Search(empty, asked.segments[0], known, (), options, unhurried)
    frame, motion = search.frame, search.motion
    uses = ModeUses(empty, frame, motion, options, Deadline(0.0))
    noise, rows = RunNoise(frame, motion), (0, len(frame))
    standstill, _ = judge_standstills(frame, search, uses, noise, rows).events
    why = standstill.details["why_not_stuck"]
    assert why == "not checked whether it moves in mode go: time limit reached"


def test_noise_is_no_motion_in_a_mode_of_which_there_are_few_rows(
    empty: sqlite3.Connection,
) -> None:
    recorder, noise = start_run(empty), random.Random(1)
    x_m = 0.0
    for step in range(240):  # every half second: 10 s of driving, then 5.5 s at the charger
        charging = step % 31 >= 20
        x_m += 0.0 if charging else 0.1
        place = [x_m + noise.gauss(0, 0.01), noise.gauss(0, 0.01)]
        recorder.publish(step * 0.5, {"pose": place, "mode": "charging" if charging else "drive"})
    found = find_events(
        empty, find_range(empty, Scope(run_id=1)), EventOptions(kinds=("standstill", "stuck"))
    )
    assert found.verdicts.found == {"standstill": 7}
