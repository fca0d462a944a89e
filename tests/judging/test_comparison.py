"""What a comparison says differs: level, spread, rare events and goals, each for itself."""

from __future__ import annotations

import json
import math
import random
import sqlite3
import uuid
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from tests.recordings.rover import Recorder
from tests.recordings.rows import insert
from webots_mcp.judging.comparison import Comparison, Difference, compare_runs
from webots_mcp.judging.run_measures import MOST_SEARCHED, Measure
from webots_mcp.store.chunk_making import make_chunks

INTERVAL_S = 0.1
State = Callable[[float], dict[str, Any]]
_KEPT = "INSERT INTO kept_state (run_id, sim_time_s, wall_time_s, data) VALUES (?, ?, ?, ?)"
_STRETCH = (
    "INSERT INTO kept_stretch (run_id, uuid, start_sim_time_s, end_sim_time_s, reason, wall_time_s)"
    " VALUES (?, ?, ?, ?, 'violation', 0)"
)


def record(
    connection: sqlite3.Connection,
    code: str,
    state: State,
    times: Sequence[float] = tuple(round(INTERVAL_S * step, 6) for step in range(100)),
    kept: Sequence[float] = (),
) -> int:
    """Record a run of robot `r`; its id.

    Args:
        connection: Where.
        code: Of its controller.
        state: What it publishes at each time.
        times: Of its rows.
        kept: Times of the calls that only a full-rate segment has.
    """
    recorder = Recorder(connection)
    known = connection.execute("SELECT id FROM robot WHERE name = 'r'").fetchone()
    robot_id = known[0] if known else recorder.robot("r")
    connection.execute("BEGIN")
    recorder.run(recorder.session(robot_id, code * 64), robot_id)
    for time_s in times:
        recorder.publish(time_s, state(time_s))
    rows = ((recorder.run_id, each, each, json.dumps(state(each))) for each in kept)
    connection.executemany(_KEPT, rows)
    if kept:
        bounds = (recorder.run_id, str(uuid.uuid4()), kept[0], kept[-1])
        connection.execute(_STRETCH, bounds)
    recorder.end_run("finished")
    connection.execute("COMMIT")
    return recorder.run_id


def signal(comparison: Comparison, name: str) -> Difference:
    return next(each for each in comparison.differences if each.name == name)


def measure(comparison: Comparison, name: str) -> Measure:
    return next(each for each in comparison.measures if each.name == name)


def noisy(dice: random.Random, level: float, spread: float) -> State:
    """A value about a level that differs a little from run to run."""
    level += dice.gauss(0, 0.02)
    spread *= 1 + dice.gauss(0, 0.02)
    return lambda _: {"v": level + dice.gauss(0, spread)}


def test_a_signal_that_is_only_noisier_has_the_same_level_and_another_spread(
    empty: sqlite3.Connection,
) -> None:
    dice = random.Random(1)
    for code, spread in (("a", 0.1), ("b", 0.3)):
        for _ in range(8):
            record(empty, code, noisy(dice, 1.0, spread))
    found = signal(compare_runs(empty), "v")
    assert found.different[1] is not True
    assert found.deviation_different[1] is True
    assert found.deviation_interval[1] is not None
    assert found.deviation_interval[1] == pytest.approx((0.2, 0.2), abs=0.04)


def test_a_signal_on_another_level_has_the_same_spread(empty: sqlite3.Connection) -> None:
    dice = random.Random(1)
    for code, level in (("a", 1.0), ("b", 1.3)):
        for _ in range(8):
            record(empty, code, noisy(dice, level, 0.1))
    found = signal(compare_runs(empty), "v")
    assert found.different[1] is True
    assert found.interval[1] == pytest.approx((0.3, 0.3), abs=0.05)
    assert found.deviation_different[1] is not True


def driving(measured: State, speed_m_s: float) -> State:
    return lambda t: {**measured(t), "pose": [speed_m_s * t, 0.0]}


@pytest.mark.parametrize("seed", range(6))
def test_what_differs_has_an_interval_that_excludes_zero(
    empty: sqlite3.Connection, seed: int
) -> None:
    dice = random.Random(seed)
    levels = [dice.uniform(0, 0.4), dice.uniform(0.6, 1)]
    spreads = [dice.uniform(0.05, 0.3) for _ in range(2)]
    for code, level, spread in zip("ab", levels, spreads, strict=True):
        for _ in range(dice.choice([4, 6, 10])):
            record(empty, code, driving(noisy(dice, level, spread), level + dice.gauss(0, 0.01)))
    found = compare_runs(empty)
    verdicts = [
        *((each.different[1], each.interval[1]) for each in found.measures),
        *((each.different[1], each.interval[1]) for each in found.differences),
        *((each.deviation_different[1], each.deviation_interval[1]) for each in found.differences),
    ]
    certain = [interval for different, interval in verdicts if different]
    assert certain
    assert all(each is not None and (each[0] > 0 or each[1] < 0) for each in certain)


def test_signals_that_are_asked_for_get_a_verdict_or_the_reason_why_not(
    empty: sqlite3.Connection,
) -> None:
    def before(time_s: float) -> dict[str, Any]:
        return {"still": 2.0, "lamp": True, "place": "dock", "old": time_s}

    def after(time_s: float) -> dict[str, Any]:
        return {"still": 2.0, "lamp": time_s < 5, "place": "hall"}

    for code, state in (("a", before), ("b", after)):
        for _ in range(8):
            record(empty, code, state)
    found = compare_runs(empty, names=["still", "lamp", "place", "old"])
    assert {each.name: each.different[1] for each in found.differences} == {
        "still": False,
        "lamp": True,
        "place": None,
        "old": None,
    }
    lamp = signal(found, "lamp").mean
    assert [each and each.median for each in lamp] == [1.0, pytest.approx(0.5)]
    assert signal(found, "old").reasons[1] == (
        "run 9, 10, 11, 12, 13, 14, 15, 16 has no number of it"
    )
    assert "mode='place'" in str(signal(found, "place").reasons[1])
    for each in found.differences:
        assert each.different[1] is not None or each.reasons[1]


def test_of_too_few_runs_the_reason_says_how_many_there_are(empty: sqlite3.Connection) -> None:
    for code in "ab":
        record(empty, code, lambda t: {"v": t})
    (alone,) = compare_runs(empty, names=["v"]).differences
    assert alone.reasons[1] == "one run each: how much repeated runs differ is not known"
    record(empty, "b", lambda t: {"v": t + 0.1})
    (few,) = compare_runs(empty, names=["v"]).differences
    assert few.different[1] is None
    assert "1 and 2 runs" in str(few.reasons[1])


def falling(time_s: float) -> dict[str, Any]:
    """Its sensor drops to 0 for one row."""
    return {"front_m": 0.0 if abs(time_s - 5.0) < 0.01 else 1.0 + 0.05 * math.sin(time_s)}


def steady(time_s: float) -> dict[str, Any]:
    return {"front_m": 1.0 + 0.05 * math.sin(time_s)}


def test_rare_events_are_counted_by_run_and_the_runs_are_named(empty: sqlite3.Connection) -> None:
    for code, states in (("a", [steady] * 5), ("b", [falling, steady, falling, steady, steady])):
        for state in states:
            record(empty, code, state)
    found = measure(compare_runs(empty), "jump per min")
    assert [each and each.median for each in found.spread] == [0.0, 0.0]
    assert (found.compared, found.runs) == ("share of runs", [[], [6, 8]])
    assert found.different[1] is None
    assert found.interval[1] is not None and found.interval[1][0] < 0 < found.interval[1][1]
    assert found.reasons[1]


def test_an_event_that_all_runs_have_after_an_edit_and_none_before_is_a_difference(
    empty: sqlite3.Connection,
) -> None:
    for code, state in (("a", steady), ("b", falling)):
        for _ in range(8):
            record(empty, code, state)
    found = measure(compare_runs(empty), "jump per min")
    assert found.different[1] is True
    assert found.interval[1] is not None and found.interval[1][0] > 0
    assert found.runs == [[], [9, 10, 11, 12, 13, 14, 15, 16]]


def waving(time_s: float) -> dict[str, Any]:
    return {
        "pose": [0.3 * time_s, 0.2 * math.sin(time_s)],
        "v": math.sin(3 * time_s) ** 3,
        "mode": "a" if math.sin(time_s) > 0.3 else "b",
    }


@pytest.mark.parametrize("chunked", [False, True])
def test_rows_that_an_expectation_has_added_shift_nothing(
    empty: sqlite3.Connection, *, chunked: bool
) -> None:
    """A hit is a row of its own between two that the throttle lets through."""
    rows = [round(INTERVAL_S * step, 6) for step in range(100)]
    hits = [round(INTERVAL_S * step + 0.04, 6) for step in range(20, 40, 3)]
    between = [round(2 + 0.02 * step, 6) for step in range(1, 100) if step % 5]
    for _ in range(8):
        record(empty, "a", waving, rows)
    for _ in range(8):
        record(empty, "b", waving, sorted([*rows, *hits]), kept=between)
    if chunked:
        make_chunks(empty, 10_000)
    found = compare_runs(empty, names=["v", "pose.0", "pose.1", "mode"])
    figures = (*found.measures, *found.differences)
    said = {each.name: each.different[1] for each in figures if not each.name.endswith("per min")}
    assert not any(said.values())
    assert said["v"] is False and said["distance_m"] is False and said["share of a"] is False
    assert not any(each.deviation_different[1] for each in found.differences)


def test_means_are_weighted_by_time(empty: sqlite3.Connection) -> None:
    """For 8 s it is 0 with a row per second, then 1 for 2 s with a row each 10 ms."""
    times = [*map(float, range(8)), *(round(8 + 0.01 * step, 6) for step in range(200))]
    even = [round(0.1 * step, 6) for step in range(100)]
    for code, moments in (("a", times), ("b", even)):
        for _ in range(2):
            record(empty, code, lambda t: {"v": float(t >= 8)}, moments)
    (found,) = compare_runs(empty, names=["v"]).differences
    assert [each and each.median for each in found.mean] == [pytest.approx(0.2, abs=0.02)] * 2


def finish(connection: sqlite3.Connection, run_id: int, ended: str, took_s: float) -> None:
    """Enter the run command of a run, and how it ended."""
    robot_id = connection.execute("SELECT robot_id FROM run WHERE id = ?", (run_id,)).fetchone()[0]
    insert(
        connection,
        "command",
        {
            "robot_id": robot_id,
            "action": "run",
            "params": json.dumps({"until": "x > 3"}),
            "result": json.dumps({"ended": ended, "run_id": run_id, "advanced_s": took_s}),
            "status": "done",
            "created_wall_time_s": 0.0,
            "expires_wall_time_s": 1.0,
            "idempotency_key": str(uuid.uuid4()),
        },
    )


def test_a_run_that_never_reached_its_goal_is_not_better_for_having_been_shorter(
    empty: sqlite3.Connection,
) -> None:
    long = [round(INTERVAL_S * step, 6) for step in range(200)]
    for code, times, ended in (("a", long, "condition held"), ("b", long[:80], "time limit")):
        for _ in range(7):
            run_id = record(empty, code, lambda t: {"pose": [0.2 * t, 0.0]}, times)
            finish(empty, run_id, ended, times[-1])
    found = compare_runs(empty)
    first = found.measures[0]
    assert (first.name, first.different[1]) == ("goal reached", True)
    assert first.runs == [[1, 2, 3, 4, 5, 6, 7], []]
    assert first.interval[1] is not None and first.interval[1][1] < 0
    taken = measure(found, "time_to_goal_s")
    assert taken.different[1] is None
    assert "did not reach a goal" in str(taken.reasons[1])
    assert {each.name: each.holds_for for each in found.measures} == {
        "goal reached": "whole runs",
        "time_to_goal_s": "whole runs",
        "duration_s": "whole runs",
        "distance_m": "first 7.9 s of each run",
        "mean_speed_m_s": "first 7.9 s of each run",
    }
    assert measure(found, "distance_m").different[1] is False
    (note,) = (note for note in found.notes if "goal" in note)
    assert "8 (after 7.9 s)" in note and "x > 3" in note


@pytest.mark.slow
def test_hundreds_of_short_runs_are_compared_with_few_statements_each(
    empty: sqlite3.Connection,
) -> None:
    dice = random.Random(3)
    times = [round(INTERVAL_S * step, 6) for step in range(60)]
    names = [f"s{each}" for each in range(20)]
    for run in range(300):
        speed = dice.gauss(0.2, 0.01)
        record(
            empty,
            "ab"[run >= 150],
            lambda t, speed=speed: {"pose": [speed * t, 0.0], **dict.fromkeys(names, speed + t)},
            times,
        )
    make_chunks(empty, 100_000)
    assert empty.execute("SELECT count(*) FROM row_group").fetchone() == (300,)
    statements: list[str] = []
    empty.set_trace_callback(statements.append)
    found = compare_runs(empty, [*range(1, 301)], deadline_s=100)
    empty.set_trace_callback(None)
    assert [len(group.runs) for group in found.groups] == [150, 150]
    assert [group.name for group in found.groups] == [
        "150 runs from 1 to 150",
        "150 runs from 151 to 300",
    ]
    assert signal(found, "s1").different[1] is False
    assert all(each.spread[1] is not None for each in found.measures if "per min" not in each.name)
    assert f"newest {MOST_SEARCHED} runs" in found.unknown["events per min"]
    values_read = [each for each in statements if "numbers" in each]
    assert len(values_read) < 6000  # of 300 runs with 25 signals and times each


def test_the_end_of_a_short_run_is_in_chunks_and_of_very_few_rows_is_not(
    empty: sqlite3.Connection,
) -> None:
    for rows in (60, 20):
        times = [round(INTERVAL_S * step, 6) for step in range(rows)]
        record(empty, "a", lambda t: {"v": t}, times)
    make_chunks(empty, 10_000)
    groups = empty.execute("SELECT run_id, row_count FROM row_group").fetchall()
    assert groups == [(1, 60)]
    (found,) = compare_runs(empty, [1, 2], names=["v"]).differences
    assert found.count == [20, 20]
