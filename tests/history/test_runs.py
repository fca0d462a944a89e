"""Runs are listed with their code and their end, and compared by what they did."""

from __future__ import annotations

import math
import random
import sqlite3
import statistics
from typing import Any

import pytest

from tests.history.recording import WALL_PER_SIM, Recorder, record_rover
from webots_mcp.errors import (
    InvalidInputError,
    NothingRecordedError,
    UnknownRobotError,
    UnknownRunError,
)
from webots_mcp.store.questions.compare import Comparison, Difference, compare_code, compare_runs
from webots_mcp.store.questions.runs import annotate_run, list_runs, run_info


def test_runs_are_listed_with_code_duration_and_end(rover: sqlite3.Connection) -> None:
    listed = list_runs(rover)
    assert (listed.total, listed.cursor) == (3, None)
    third, second, first = listed.runs
    assert (first.run_id, first.controller_sha256, first.git_commit) == (1, "a" * 64, "c0ffee")
    assert (first.duration_s, first.rows) == (pytest.approx(119.9), 1150)
    assert first.real_time_factor == pytest.approx(2.0, rel=0.01)
    assert [run.end_reason for run in (first, second, third)] == ["reset", "crashed", "finished"]
    assert first.notable == {"log warning": 1, "log error": 1, "dropped": 1}
    assert third.notable == {}


def test_a_long_list_comes_in_pages(rover: sqlite3.Connection) -> None:
    page = list_runs(rover, robot="rover", limit=2)
    assert ([run.run_id for run in page.runs], page.cursor) == ([3, 2], 2)
    page = list_runs(rover, limit=2, before_id=page.cursor)
    assert ([run.run_id for run in page.runs], page.cursor) == ([1], None)


def test_a_run_that_goes_on_counts_its_newest_rows(empty: sqlite3.Connection) -> None:
    recorder = Recorder(empty)
    robot_id = recorder.robot("r")
    run_id = recorder.run(recorder.session(robot_id, "x"), robot_id)
    for step in range(20):
        recorder.publish(float(step), {"x": step})
        if step == 9:
            beat = "UPDATE run SET rows = 10, last_sim_time_s = 9.0, last_wall_time_s = ?"
            empty.execute(beat, (recorder.wall_s,))
    run = run_info(empty, run_id)
    assert (run.rows, run.duration_s, run.wall_duration_s) == (20, 19.0, 19.0 * WALL_PER_SIM)


def test_a_pause_is_no_part_of_the_real_time_factor(empty: sqlite3.Connection) -> None:
    recorder = Recorder(empty)
    robot_id = recorder.robot("r")
    run_id = recorder.run(recorder.session(robot_id, "x"), robot_id)
    recorder.publish(0.0, {"x": 0})
    assert run_info(empty, run_id).real_time_factor is None
    recorder.insert("event", **recorder.at(2.0), kind="pause")
    recorder.run_start_s += 20
    recorder.insert("event", **recorder.at(2.0), kind="resume")
    recorder.publish(5.0, {"x": 1})
    run = run_info(empty, run_id)
    assert (run.held_s, run.real_time_factor) == (20.0, 1 / WALL_PER_SIM)


def test_a_note_stays_with_its_run(empty: sqlite3.Connection) -> None:
    record_rover(empty)
    annotate_run(empty, 2, label="baseline", note="before tuning")
    assert (run_info(empty, 2).label, run_info(empty, 2).note) == ("baseline", "before tuning")
    annotate_run(empty, 2, note="")
    assert (run_info(empty, 2).label, run_info(empty, 2).note) == ("baseline", None)
    with pytest.raises(InvalidInputError, match="label or a note"):
        annotate_run(empty, 2)
    with pytest.raises(InvalidInputError, match="101 characters"):
        annotate_run(empty, 2, label="x" * 101)
    with pytest.raises(UnknownRunError):
        annotate_run(empty, 9, label="x")


def difference(comparison: Comparison, name: str) -> Difference:
    return next(each for each in comparison.differences if each.name == name)


def test_two_runs_differ_in_what_was_changed(rover: sqlite3.Connection, tier: str) -> None:
    comparison = compare_runs(rover, [2, 3])
    assert comparison.compared_s == pytest.approx(29.9, abs=0.01)
    x = difference(comparison, "pose.0")
    slow = [0.2 * 0.1 * step for step in range(300)]
    fast = [0.3 * 0.1 * step for step in range(300)]
    assert x.mean == [pytest.approx(statistics.fmean(slow)), pytest.approx(statistics.fmean(fast))]
    pooled = math.sqrt((statistics.variance(slow) + statistics.variance(fast)) / 2)
    d = (statistics.fmean(fast) - statistics.fmean(slow)) / pooled
    assert x.effect == [0.0, pytest.approx(d)]
    assert x.count == [300, 300]
    assert difference(comparison, "battery_v").effect == [0.0, pytest.approx(0.0, abs=1e-9)]
    assert comparison.differences[0].name == "commanded_m_s"  # constant at 0.2, constant at 0.3
    assert comparison.differences[0].effect == [0.0, None]


def test_distance_time_and_events_are_told_per_run(rover: sqlite3.Connection) -> None:
    first, third = compare_runs(rover, [1, 3]).groups
    assert first.distance_m == pytest.approx(8.0 + 0.8 + 0.6 + 5.0 + 1.0, abs=0.3)
    assert third.distance_m == pytest.approx(0.3 * 59.9)
    assert third.duration_s == pytest.approx(59.9)
    assert first.time_by_mode_s == pytest.approx({"cruise": 76.9, "avoid": 35.0, "back_up": 8.0})
    assert first.events["stuck"] == 1 and first.events["gap"] == 1
    assert third.events == {}


@pytest.mark.parametrize(("noise_m", "speed_m_s", "way_m"), [(0.01, 0, 0), (0.0005, 0.1, 14)])
def test_the_noise_of_a_position_is_no_way(
    empty: sqlite3.Connection, noise_m: float, speed_m_s: float, way_m: float
) -> None:
    noise = random.Random(7)
    recorder = Recorder(empty)
    robot_id = recorder.robot("r")
    session_id = recorder.session(robot_id, "x")
    empty.execute("BEGIN")
    for _ in range(2):
        recorder.run(session_id, robot_id)
        for step in range(4376):
            x, y = (noise.gauss(speed_m_s * step * 0.032, noise_m), noise.gauss(1, noise_m))
            recorder.publish(step * 0.032, {"pose": [x, y]})
    empty.execute("COMMIT")
    for group in compare_runs(empty, [1, 2]).groups:
        assert group.distance_m == pytest.approx(way_m, abs=0.03 * way_m + 0.6)


def test_runs_before_and_after_the_last_edit_are_compared(rover: sqlite3.Connection) -> None:
    before, after = compare_code(rover).groups
    assert [run.run_id for run in before.runs] == [1, 2]
    assert [run.run_id for run in after.runs] == [3]
    assert before.events["stuck"] == 1 and "stuck" not in after.events


def test_a_signal_that_only_one_run_has_is_named(empty: sqlite3.Connection) -> None:
    recorder = Recorder(empty)
    robot_id = recorder.robot("r")
    session_id = recorder.session(robot_id, "x")
    for state in ({"x": 1.0, "old": 1.0}, {"x": 2.0, "new": 1.0}):
        recorder.run(session_id, robot_id)
        for step in range(5):
            recorder.publish(float(step), state)
    comparison = compare_runs(empty, [1, 2])
    assert comparison.only_in == {"old": ("run 1",), "new": ("run 2",)}
    assert [each.name for each in comparison.differences] == ["x"]
    with pytest.raises(NothingRecordedError, match="no edit"):
        compare_code(empty)


def test_runs_of_two_robots_can_be_compared(empty: sqlite3.Connection) -> None:
    recorder = Recorder(empty)
    for name, x in (("a", 1.0), ("b", 3.0)):
        robot_id = recorder.robot(name)
        recorder.run(recorder.session(robot_id, "x"), robot_id)
        for step in range(30):
            recorder.publish(float(step), {"filler_" + name: 0, "x": x + step % 2, "scan": None})
    comparison = compare_runs(empty, [1, 2], names=["x", "scan"])
    (x, *_) = comparison.differences
    assert x.mean == [1.5, 3.5]
    assert comparison.notes == ("these are runs of different robots: a, b",)
    assert comparison.only_in == {}


@pytest.mark.parametrize("run_ids", [[], [1], [1, 1], list(range(1, 12))])
def test_a_comparison_without_sense_is_refused(
    rover: sqlite3.Connection, run_ids: list[Any]
) -> None:
    with pytest.raises(InvalidInputError, match="2 to 10 different runs"):
        compare_runs(rover, run_ids)


def test_unknown_runs_and_robots_are_named(rover: sqlite3.Connection) -> None:
    with pytest.raises(UnknownRunError, match="99"):
        compare_runs(rover, [1, 99])
    with pytest.raises(UnknownRobotError):
        list_runs(rover, robot="rovre")
    with pytest.raises(InvalidInputError, match="limit"):
        list_runs(rover, limit=0)
