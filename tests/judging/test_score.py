"""What recorded runs come to."""

from __future__ import annotations

import json
import sqlite3

import pytest

from tests.recordings.rover import start_run
from webots_mcp.errors import InvalidInputError, UnknownRunError, UnknownSignalError
from webots_mcp.judging.run_score import score_run, unseen


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("max(pose[0])", 0.2 * 29.9),
        ("last(battery_v)", 12.6 - 0.0299),
        ("count(stuck) + count(dropped)", 0.0),
        ("duration", 29.9),
        ("time(pose[0] >= 1) + time(not pose[0] >= 1)", 29.9),
    ],
)
def test_a_run_is_scored_over_its_signals_its_events_and_its_duration(
    rover: sqlite3.Connection, text: str, value: float
) -> None:
    found = score_run(rover, 2, text)

    assert found.value == pytest.approx(value)
    assert (found.why, found.rows) == (None, 300)


def test_events_that_are_detected_and_those_that_were_stored_are_counted(
    rover: sqlite3.Connection,
) -> None:
    assert score_run(rover, 1, "count(stuck)").value == 1
    assert score_run(rover, 1, "count(dropped)").value == 1


def test_only_what_came_up_to_the_end_is_scored(rover: sqlite3.Connection) -> None:
    found = score_run(rover, 1, "max(pose[0]) + count(stuck)", end_s=20.0)

    assert found.value == pytest.approx(0.2 * 20.0)
    assert (found.duration_s, found.rows) == (20.0, 201)


def test_a_kind_that_cannot_be_looked_for_leaves_the_run_without_a_score(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty, "lamp")
    for step in range(20):
        recorder.publish(step * 0.1, {"light": step})

    found = score_run(empty, recorder.run_id, "last(light) - count(stuck)")

    assert found.value is None
    assert "count(stuck) is not known" in str(found.why)


def test_a_run_without_rows_and_one_with_purged_rows_have_no_score(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    run_id = recorder.run_id

    found = score_run(empty, run_id, "duration")
    assert (found.value, found.why) == (
        None,
        f"run {run_id} has no state row: its controller published nothing",
    )

    recorder.publish(1.0, {"x": 1})
    empty.execute("UPDATE run SET purged_rows = 7")
    found = score_run(empty, run_id, "last(x)")
    assert found.value is None
    assert "deleted by retention" in str(found.why)


def test_what_scores_do_not_see_of_their_runs_is_told_once_for_runs_that_are_alike(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    recorder.publish(0.0, {"x": 1})
    whole = recorder.run_id
    empty.execute("UPDATE session SET throttle_interval = 1")
    assert unseen(empty, [whole, None]) == []

    robot_id = recorder.robot("second")
    throttled = recorder.session(robot_id, "b")
    empty.execute("UPDATE session SET throttle_interval = 10 WHERE id = ?", (throttled,))
    for peak in (None, None, 9):
        recorder.run(throttled, robot_id)
        recorder.publish(0.0, {"x": 1})
        if peak is not None:
            recorder.insert(
                "kept_stretch", run_id=recorder.run_id, uuid="k", wall_time_s=0.0,
                start_sim_time_s=0.0, end_sim_time_s=1.0, reason="hit",
            )  # fmt: skip
            recorder.insert("kept_state", **recorder.at(0.5), data=json.dumps({"x": peak}))
    recorder.insert("event", **{**recorder.at(0.0), "run_id": whole}, kind="dropped")

    assert score_run(empty, recorder.run_id, "max(x)").value == 1
    between = "one publish() call in 10 is a row: what happened in between is not seen"
    assert unseen(empty, [1, 2, 3, 4]) == [
        "scores of run 1: rows were dropped, so their values are missing",
        f"scores of run 2, 3: {between}",
        f"scores of run 4: {between}; rows that only full-rate segments have do not count",
    ]
    assert unseen(empty, [2, 3]) == [f"scores: {between}"]


@pytest.mark.parametrize(
    ("error", "run_id", "text", "said"),
    [
        (UnknownRunError, 9, "duration", "No run 9"),
        (UnknownSignalError, 2, "mean(batery_v)", "column 6: no signal 'batery_v'.*battery_v"),
        (
            InvalidInputError,
            2,
            "1 + count(stuk)",
            "column 11: .*'stuk'. Kinds, the nearest first: stuck",
        ),
    ],
)
def test_what_cannot_be_asked_is_refused_with_the_place(
    rover: sqlite3.Connection, error: type[Exception], run_id: int, text: str, said: str
) -> None:
    with pytest.raises(error, match=said):
        score_run(rover, run_id, text)
