"""Where rows lie decides no answer: what is left of them in chunks says the same of a moment."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rover import Recorder, start_run
from tests.store.questions.asking import ask
from webots_mcp.store.detection.events import find_events
from webots_mcp.store.purge import prune
from webots_mcp.store.reading.ranges import Scope, find_range, recorded_bounds
from webots_mcp.store.retention import Limit, Retention

LEFT = pytest.mark.parametrize("left", [40, 0])


def around_a_purge(
    connection: sqlite3.Connection, folder: Path, left: int, asked: Callable[[], Any]
) -> tuple[Any, Any]:
    """The answer before rows are deleted, and where only so many are left."""
    before = asked()
    prune(connection, folder, Retention(state=Limit(rows=left), outlive=0), rest=False)
    assert connection.execute("SELECT count(*) FROM state").fetchone() == (left,)
    return before, asked()


@pytest.fixture
def paused(empty: sqlite3.Connection) -> Recorder:
    """From 5 s on a row each 10 s; wall time stands still for an hour after 1,000 s."""
    recorder = start_run(empty)
    for step in range(300):
        time_s = 5.0 + 10.0 * step
        recorder.publish(time_s, {"mode": "ab"[step // 60 % 2], "x": step})
    sql = "UPDATE state SET wall_time_s = wall_time_s + 3600 WHERE sim_time_s > 1000"
    empty.execute(sql)
    recorder.end_run("finished")
    empty.execute("UPDATE run SET last_wall_time_s = last_wall_time_s + 3600")
    return recorder


@LEFT
def test_events_have_the_wall_times_of_their_rows(
    paused: Recorder, tmp_path: Path, left: int
) -> None:
    def asked() -> list[float]:
        return [event.wall_time_s for event in ask(paused.connection, "change").events]

    before, after = around_a_purge(paused.connection, tmp_path, left, asked)
    assert after == before and len(before) == 4


@LEFT
def test_a_range_in_wall_time_holds_the_same_rows(
    paused: Recorder, tmp_path: Path, left: int
) -> None:
    since = paused.run_start_s + 1000.0  # in the pause

    def asked() -> tuple[float, float]:
        scope = Scope(run_id=1, since_wall_time=since, until_wall_time=since + 3600)
        (segment,) = find_range(paused.connection, scope).segments
        return segment.start_s, segment.end_s

    before, after = around_a_purge(paused.connection, tmp_path, left, asked)
    assert after == pytest.approx(before)


@LEFT
def test_a_run_begins_with_its_first_row(paused: Recorder, tmp_path: Path, left: int) -> None:
    before, after = around_a_purge(
        paused.connection, tmp_path, left, lambda: recorded_bounds(paused.connection, 1)
    )
    assert after == before == (5.0, 2995.0)


@LEFT
def test_a_range_between_two_rows_is_said_to_be_one(
    paused: Recorder, tmp_path: Path, left: int
) -> None:
    def asked() -> tuple[str, ...]:
        return find_range(paused.connection, Scope(run_id=1, start_s=506, end_s=514)).notes

    before, after = around_a_purge(paused.connection, tmp_path, left, asked)
    assert after == before == ("no row: nothing was recorded between 505 and 515 s of run 1",)


@LEFT
def test_a_change_in_the_first_row_of_a_range_is_seen_beside_the_row_before(
    paused: Recorder, tmp_path: Path, left: int
) -> None:
    paused.connection.execute("DELETE FROM state WHERE sim_time_s = 595")

    def asked() -> list[float]:
        bounds = {"run_id": 1, "start_s": 605.0, "end_s": 700.0}
        found = ask(paused.connection, "condition", bounds=bounds, where="changed(mode)")
        return [event.start_s for event in found.events]

    before, after = around_a_purge(paused.connection, tmp_path, left, asked)
    assert after == before == [605.0]


@LEFT
def test_a_bound_holds_the_row_that_is_shown_as_of_it(
    empty: sqlite3.Connection, tmp_path: Path, left: int
) -> None:
    recorder = start_run(empty)
    for step in range(100):
        recorder.publish(step - 1e-9, {"x": step})
    recorder.end_run("finished")

    def asked() -> float:
        return find_range(empty, Scope(run_id=1, start_s=50, end_s=60)).segments[0].start_s

    before, after = around_a_purge(empty, tmp_path, left, asked)
    assert after == before == 50 - 1e-9


@LEFT
def test_rows_that_hits_have_added_are_counted_among_all_rows(
    paused: Recorder, tmp_path: Path, left: int
) -> None:
    paused.connection.execute("UPDATE session SET throttle_interval = 5")
    for time_s in (505.0, 515.0):
        paused.insert("event", **paused.at(time_s), kind="breakpoint", name="x > 3", data="{}")

    def asked() -> tuple[str, ...]:
        return find_range(paused.connection, Scope(run_id=1, end_s=1000)).notes

    before, after = around_a_purge(paused.connection, tmp_path, left, asked)
    assert after == before and "up to 2 of 100 rows of run 1" in before[-1]


@LEFT
def test_a_command_that_nobody_claimed_lies_where_it_was_given(
    paused: Recorder, tmp_path: Path, left: int
) -> None:
    paused.insert(
        "command", robot_id=1, action="grasp", params="{}", status="expired",
        created_wall_time_s=paused.run_start_s + 250, expires_wall_time_s=paused.run_start_s + 260,
    )  # fmt: skip

    def asked() -> list[float]:
        return [event.start_s for event in ask(paused.connection, "command").events]

    before, after = around_a_purge(paused.connection, tmp_path, left, asked)
    assert after == before == [495.0]


def test_rows_that_came_late_and_outlived_newer_ones_stand_for_none_of_these(
    empty: sqlite3.Connection, tmp_path: Path
) -> None:
    recorder = start_run(empty)
    for step in [*range(100), *range(140, 400), *range(100, 140)]:
        recorder.publish(step * 1.0, {"mode": "ab"[step // 60 % 2], "x": step, "y": 0})
    recorder.end_run("finished")
    empty.execute("UPDATE run SET last_sim_time_s = 399")

    def asked() -> tuple[Any, ...]:
        found = find_range(empty, Scope(run_id=1, start_s=150.2, end_s=150.8))
        events = find_events(empty, find_range(empty, Scope(run_id=1))).events
        return found.notes, [(e.wall_time_s, e.around) for e in events if e.kind == "change"]

    before, after = around_a_purge(empty, tmp_path, 40, asked)
    assert after == before
    assert before[0] == ("no row: nothing was recorded between 150 and 151 s of run 1",)
