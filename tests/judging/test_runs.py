"""Runs are listed with their code and their end, and compared by what they did."""

from __future__ import annotations

import math
import random
import sqlite3
import statistics
from typing import Any

import pytest

from tests.recordings.rover import WALL_PER_SIM, Recorder, record_rover, start_run
from webots_mcp.analysis.summary import Spread
from webots_mcp.errors import (
    InvalidInputError,
    NothingRecordedError,
    UnknownRunError,
)
from webots_mcp.judging.comparison import Comparison, Difference, compare_runs
from webots_mcp.store.runs import annotate_run, list_runs, run_info


def test_runs_are_listed_with_code_duration_and_end(rover: sqlite3.Connection) -> None:
    listed = list_runs(rover)
    assert (listed.total, listed.cursor) == (3, None)
    third, second, first = listed.runs
    assert (first.run_id, first.controller_sha256, first.git_commit) == (1, "a" * 64, "c0ffee")
    assert (first.duration_s, first.row_count) == (pytest.approx(119.9), 1150)
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
    recorder = start_run(empty)
    for step in range(20):
        recorder.publish(float(step), {"x": step})
        if step == 9:
            beat = "UPDATE run SET row_count = 10, last_sim_time_s = 9.0, last_wall_time_s = ?"
            empty.execute(beat, (recorder.wall_s,))
    run = run_info(empty, recorder.run_id)
    assert (run.row_count, run.duration_s, run.wall_duration_s) == (20, 19.0, 19.0 * WALL_PER_SIM)


def test_a_pause_is_no_part_of_the_real_time_factor(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    recorder.publish(0.0, {"x": 0})
    assert run_info(empty, recorder.run_id).real_time_factor is None
    recorder.insert("event", **recorder.at(2.0), kind="pause")
    recorder.run_start_s += 20
    recorder.insert("event", **recorder.at(2.0), kind="resume")
    recorder.publish(5.0, {"x": 1})
    run = run_info(empty, recorder.run_id)
    assert (run.held_s, run.real_time_factor) == (20.0, 1 / WALL_PER_SIM)


def test_a_note_stays_with_its_run(empty: sqlite3.Connection) -> None:
    record_rover(empty)
    annotate_run(empty, 2, label="baseline", note="before tuning")
    assert (run_info(empty, 2).label, run_info(empty, 2).note) == ("baseline", "before tuning")
    annotate_run(empty, 2, note="")
    assert (run_info(empty, 2).label, run_info(empty, 2).note) == ("baseline", None)
    with pytest.raises(InvalidInputError, match="Give a label, a note or both"):
        annotate_run(empty, 2)
    with pytest.raises(InvalidInputError, match="101 characters"):
        annotate_run(empty, 2, label="x" * 101)
    with pytest.raises(UnknownRunError):
        annotate_run(empty, 9, label="x")


def difference(comparison: Comparison, name: str) -> Difference:
    return next(each for each in comparison.differences if each.name == name)


def measures(comparison: Comparison) -> dict[str, list[float | None]]:
    """The medians of each group, by what is measured."""
    return {
        each.name: [None if one is None else one.median for one in each.spread]
        for each in comparison.measures
    }


def medians(spreads: list[Spread | None]) -> list[float | None]:
    return [None if each is None else each.median for each in spreads]


def test_two_runs_differ_in_what_was_changed(rover: sqlite3.Connection, looked_at: str) -> None:
    comparison = compare_runs(rover, [2, 3])
    assert comparison.compared_s == pytest.approx(29.9, abs=0.01)
    x = difference(comparison, "pose.0")
    slow = [0.2 * 0.1 * step for step in range(300)]
    fast = [0.3 * 0.1 * step for step in range(300)]
    assert medians(x.mean) == [pytest.approx(statistics.fmean(each)) for each in (slow, fast)]
    pooled = math.sqrt((statistics.variance(slow) + statistics.variance(fast)) / 2)
    d = (statistics.fmean(fast) - statistics.fmean(slow)) / pooled
    assert x.effect == [0.0, pytest.approx(d)]
    assert x.deviation_ratio == [1.0, pytest.approx(1.5)]
    assert x.count == [300, 300]
    assert difference(comparison, "battery_v").effect == [0.0, pytest.approx(0.0, abs=1e-9)]
    assert comparison.differences[0].name == "commanded_m_s"  # constant at 0.2, constant at 0.3
    assert comparison.differences[0].effect == [0.0, None]


def test_runs_are_measured_over_the_same_stretch(rover: sqlite3.Connection) -> None:
    comparison = compare_runs(rover, [1, 3])
    assert comparison.compared_s == pytest.approx(59.9, abs=0.01)
    found = measures(comparison)
    assert found["distance_m"] == [pytest.approx(8.7, abs=0.3), pytest.approx(0.3 * 59.9)]
    assert found["mean_speed_m_s"][1] == pytest.approx(0.3, abs=0.001)
    assert found["share of back_up"] == [pytest.approx(8.0 / 59.9, abs=0.005), 0.0]
    assert found["stuck per min"] == [pytest.approx(1.0, abs=0.01), 0.0]


def record_group(
    recorder: Recorder, robot_id: int, code: str, runs: int, speed_m_s: float, dice: random.Random
) -> None:
    """Runs of 30 s that drive about as fast, with some bumps by chance and a noisy sensor."""
    for _ in range(runs):
        recorder.run(recorder.session(robot_id, code * 64), robot_id)
        speed = speed_m_s * (1 + dice.gauss(0, 0.01))
        swing = dice.gauss(0.2, 0.01)
        for step in range(150):
            time_s = 0.2 * step
            bumped = dice.random() < 0.005
            recorder.publish(
                time_s,
                {
                    "pose": [speed * time_s, 0.0],
                    "mode": "back_up" if bumped else "cruise",
                    "error": swing * math.sin(time_s),
                    "noise": dice.gauss(0, 1),
                },
            )


def claimed(comparison: Comparison) -> set[str]:
    found = (*comparison.measures, *comparison.differences)
    return {each.name for each in found if each.different[1]}


@pytest.mark.slow
def test_between_like_runs_no_difference_is_claimed(empty: sqlite3.Connection) -> None:
    dice = random.Random(4)
    recorder = Recorder(empty)
    for pair in range(20):
        robot_id = recorder.robot(f"r{pair}")
        empty.execute("BEGIN")
        for code in "ab":
            record_group(recorder, robot_id, code, 3, 0.2, dice)
        empty.execute("COMMIT")
        assert claimed(compare_runs(empty, robot=f"r{pair}")) == set()


@pytest.mark.parametrize("seed", range(10))
def test_a_tenth_more_speed_is_found(empty: sqlite3.Connection, seed: int) -> None:
    dice = random.Random(seed)
    recorder = Recorder(empty)
    robot_id = recorder.robot("r")
    empty.execute("BEGIN")
    record_group(recorder, robot_id, "a", 5, 0.2, dice)
    record_group(recorder, robot_id, "b", 5, 0.22, dice)
    empty.execute("COMMIT")
    comparison = compare_runs(empty)
    assert {"distance_m", "mean_speed_m_s"} <= claimed(comparison)
    assert "noise" not in claimed(comparison)
    assert difference(comparison, "pose.0").different == [False, True]


def test_what_is_one_fact_or_the_same_in_all_runs_makes_no_other_figure_less_certain(
    empty: sqlite3.Connection,
) -> None:
    """Distance and mean speed are one fact; modes and events are as many and as long each time."""
    recorder = Recorder(empty)
    robot_id = recorder.robot("r")
    groups = {"a": (0.1747, 0.1755, 0.1798, 0.1774), "b": (0.1958, 0.1877, 0.191, 0.1908)}
    empty.execute("BEGIN")
    for code, speeds in groups.items():
        for speed in speeds:
            recorder.run(recorder.session(robot_id, code * 64), robot_id)
            for step in range(200):
                driven_s = 0.2 * (min(step, 100) + max(0, step - 130))
                mode = "scan" if 100 <= step < 130 else "explore"
                recorder.publish(0.2 * step, {"pose": [speed * driven_s, 0.0], "mode": mode})
    empty.execute("COMMIT")
    assert {"distance_m", "mean_speed_m_s"} <= claimed(compare_runs(empty))


def test_a_run_of_one_moment_is_named_as_what_the_others_are_cut_to(
    empty: sqlite3.Connection,
) -> None:
    recorder = Recorder(empty)
    robot_id = recorder.robot("r")
    for rows in (100, 1):
        recorder.run(recorder.session(robot_id, "x"), robot_id)
        for step in range(rows):
            recorder.publish(step * 0.1, {"front_m": step * 0.01})
    assert (
        "all figures are about the first moment of each run, for run 2 has no other: ask again "
        "without it"
    ) in compare_runs(empty, [1, 2]).notes


@pytest.mark.parametrize("name", ["bearing_rad", "heading_deg", "level_m"])
def test_what_is_left_of_adding_equal_numbers_is_no_difference(
    empty: sqlite3.Connection, name: str
) -> None:
    recorder = Recorder(empty)
    robot_id = recorder.robot("r")
    for rows in (25, 75):
        recorder.run(recorder.session(robot_id, "x"), robot_id)
        for step in range(100):
            value = -1.3862943611198906 if step < rows else -1.386294361119891
            recorder.publish(step * 0.1, {name: value})
    (found,) = compare_runs(empty, [1, 2], names=[name]).differences
    assert medians(found.deviation) == [0, 0]
    assert (found.effect, found.deviation_ratio) == ([0, 0], [None, None])


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
        compare_runs(empty)


@pytest.mark.parametrize("run_ids", [[], [1, 1], list(range(1, 302))])
def test_a_comparison_without_sense_is_refused(
    rover: sqlite3.Connection, run_ids: list[Any]
) -> None:
    with pytest.raises(InvalidInputError, match="1 to 300 different runs"):
        compare_runs(rover, run_ids)


@pytest.mark.parametrize(("name", "turn"), [("heading", math.tau), ("heading_deg", 360.0)])
def test_headings_on_both_sides_of_the_end_of_a_scale_are_near_each_other(
    empty: sqlite3.Connection, name: str, turn: float
) -> None:
    recorder = Recorder(empty)
    robot_id = recorder.robot("rover")
    for mean in (-turn / 180, turn / 180):
        recorder.run(recorder.session(robot_id, "a" * 64), robot_id)
        for step in range(200):
            heading = mean + turn / 60 * math.sin(step)
            recorder.publish(step * 0.1, {name: heading % turn})
    (difference,) = compare_runs(empty, [1, 2], names=[name]).differences
    before, after = difference.mean
    assert before is not None and after is not None
    assert after.median - before.median == pytest.approx(turn / 90, rel=0.05)
    deviation = difference.deviation[0]
    assert deviation is not None and deviation.median == pytest.approx(turn / 60 / 2**0.5, rel=0.02)
