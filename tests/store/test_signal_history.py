"""A question over any stretch of time is answered with the true extremes and the true gaps."""

from __future__ import annotations

import math
import sqlite3
from typing import Any

import pytest

from tests.recordings.rover import start_run
from webots_mcp.errors import InvalidInputError, UnknownSignalError
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.signal_history import NumberColumns, query_history, query_rows


def ask(connection: sqlite3.Connection, *names: str, max_points: int = 50, **bounds: Any):
    found = find_range(connection, Scope(run_id=1, **bounds))
    (run,) = query_history(connection, found, names, max_points=max_points).runs
    return run


def column(run: Any, name: str) -> NumberColumns:
    return next(each for each in run.numbers if each.name == name)


def test_an_extreme_of_a_single_row_survives_any_bucket(
    rover: sqlite3.Connection, looked_at: str
) -> None:
    for max_points in (1, 3, 12, 200):
        ir = column(ask(rover, "ir", max_points=max_points), "ir")
        assert max(value for value in ir.max if value is not None) == 5.0
        assert (ir.whole.max, ir.whole.max_sim_time_s) == (5.0, 70.0)
        assert len(ir.max) <= max_points


def test_counts_are_exact_at_both_ends(rover: sqlite3.Connection, looked_at: str) -> None:
    run = ask(rover, "pose.0", start_s=3.05, end_s=61.05)
    pose = column(run, "pose.0")
    assert sum(pose.count) == pose.whole.present == 580
    assert (pose.whole.first_sim_time_s, pose.whole.last_sim_time_s) == (3.1, 61.0)
    assert pose.whole.max == pytest.approx(8.0)


def test_a_recording_gap_is_visible_as_such(rover: sqlite3.Connection, looked_at: str) -> None:
    run = ask(rover, "ir", max_points=500)
    (gap,) = run.gaps
    assert (gap.start_s, gap.end_s) == (pytest.approx(89.9), 95.0)
    assert run.interval_s == pytest.approx(0.1)
    empty = [t for t, n in zip(run.sim_time_s, column(run, "ir").count, strict=True) if n == 0]
    assert empty and all(90 <= t < 95 for t in empty)


def test_modes_come_as_change_points(rover: sqlite3.Connection, looked_at: str) -> None:
    run = ask(rover, "mode", "sensors.bumper", start_s=45.0)
    mode, bumper = run.changes
    assert mode.points == [(0.0, "cruise"), (52.0, "back_up"), (60.0, "avoid"), (95.0, "cruise")]
    assert mode.time_by_value_s == pytest.approx({"avoid": 35.0, "cruise": 31.9, "back_up": 8.0})
    assert bumper.points == [(40.0, True), (52.0, False)]


def test_a_value_that_is_no_number_is_named_within_its_array(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    for step in range(30):
        state = {"short": [None, step, None if step < 9 else 1], "long": [1.0] * 30 + [None]}
        replaced = {"short.*": "nan", "long.*": "inf"}
        recorder.publish(float(step), state, replaced if step < 20 else {"short.0": "inf"})
    make_chunks(empty)
    run = ask(empty, "short", "long.mean")
    assert column(run, "short.0").replaced == {"nan": 20, "inf": 10}
    assert column(run, "short.1").replaced == {}
    assert column(run, "short.2").replaced == {"nan": 9}
    assert column(run, "long.mean").replaced == {}, "it is the mean of the others"


def test_a_deadline_that_passed_is_admitted(rover: sqlite3.Connection) -> None:
    found = find_range(rover, Scope(run_id=1))
    (run,) = query_history(rover, found, ["lidar.min"], deadline_s=0.0).runs
    # The statistics of chunks take no time.
    is_whole = max(run.sim_time_s, default=0) >= 117
    assert is_whole is (run.cut_at_s is None)


def test_pages_hold_every_row_once(rover: sqlite3.Connection) -> None:
    found = find_range(rover, Scope(run_id=1, start_s=5.0, end_s=40.0))
    cursor, ids, xs = 0, list[int](), list[Any]()
    while True:
        page = query_rows(rover, found, ["pose.0"], limit=99, after_id=cursor)
        ids += page.ids
        xs += page.values["pose.0"]
        if page.cursor is None:
            break
        cursor = page.cursor
    assert len(ids) == len(set(ids)) == 350
    assert xs[0] == pytest.approx(1.0) and xs[-1] == pytest.approx(7.98)


def test_absurd_questions_are_refused(rover: sqlite3.Connection) -> None:
    found = find_range(rover, Scope(run_id=1))
    for max_points in (0, -1, 501, 10**9):
        with pytest.raises(InvalidInputError, match="max_points"):
            query_history(rover, found, ["ir"], max_points=max_points)
    with pytest.raises(UnknownSignalError):
        query_history(rover, found, ["nothing"])
    with pytest.raises(InvalidInputError, match="limit"):
        query_rows(rover, found, ["ir"], limit=0)


def test_integers_beyond_64_bits_stay_what_they_are_in_rows(empty: sqlite3.Connection) -> None:
    numbers = [2**63 - 1, 2**63, -(2**63) - 1, 10**30 + 1]
    recorder = start_run(empty)
    for step, number in enumerate(numbers):
        recorder.publish(float(step), {"ticks": number})
    assert list(query_rows(empty, find_range(empty, Scope()), ["ticks"]).values["ticks"]) == numbers


@pytest.mark.parametrize(("name", "turn"), [("heading_deg", 360.0), ("yaw", math.tau)])
@pytest.mark.parametrize("around", [0.0, 0.25, 0.5])
def test_the_mean_of_an_angle_is_circular_in_degrees_as_in_radians(
    empty: sqlite3.Connection, looked_at: str, name: str, turn: float, around: float
) -> None:
    recorder = start_run(empty)
    for step in range(200):
        share = around + (0.02 if step % 2 else -0.02)
        value = share % 1.0 if name == "heading_deg" else math.remainder(share, 1.0)
        recorder.publish(float(step), {name: value * turn})
    if looked_at == "chunks":
        make_chunks(empty, 1000)
    angle = column(ask(empty, name, max_points=10), name)
    for mean in (*angle.mean, angle.whole.centre(turn)):
        assert mean is not None
        assert math.remainder(mean / turn - around, 1.0) == pytest.approx(0.0, abs=1e-9)
        assert 0.0 <= mean <= turn or name == "yaw"
