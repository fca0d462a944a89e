"""A range means one thing, and says so where it leaves the recording."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator
from datetime import datetime, timezone
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.memory import memory_connection
from tests.recordings.rover import WALL_START_S, Recorder, start_run
from webots_mcp.errors import (
    AmbiguousRobotError,
    InvalidRangeError,
    NothingRecordedError,
    UnknownRobotError,
    UnknownRunError,
)
from webots_mcp.store.reading import ranges
from webots_mcp.store.reading.ranges import Scope, find_range, parse_wall_time
from webots_mcp.store.reading.segment import Segment

IN_SEGMENT = (
    "SELECT id FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ? "
    "AND wall_time_s >= ? AND wall_time_s < ?"
)


def rows_in(connection: sqlite3.Connection, segment: Segment) -> list[int]:
    bounds = (segment.run_id, segment.start_s, segment.end_s)
    walls = (segment.wall_start_s, segment.wall_end_s)
    return [row for (row,) in connection.execute(IN_SEGMENT, (*bounds, *walls))]


def test_without_bounds_a_range_is_the_whole_newest_run(rover: sqlite3.Connection) -> None:
    found = find_range(rover, Scope())
    (segment,) = found.segments
    assert (found.robot, segment.run_id, segment.start_s) == ("rover", 3, 0.0)
    assert len(rows_in(rover, segment)) == 600
    assert found.notes == ()


def test_the_end_is_not_in_the_range(rover: sqlite3.Connection) -> None:
    (segment,) = find_range(rover, Scope(run_id=1, start_s=1.0, end_s=2.0)).segments
    assert len(rows_in(rover, segment)) == 10


def test_seconds_back_hold_the_newest_row(rover: sqlite3.Connection) -> None:
    (segment,) = find_range(rover, Scope(run_id=1, last_s=1.0)).segments
    assert segment.start_s == pytest.approx(118.9)
    assert len(rows_in(rover, segment)) == 11


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ({"start_s": -5.0, "end_s": 10.0}, "begins at 0 s"),
        ({"start_s": 100.0, "end_s": 500.0}, "ends at 119.9 s"),
        ({"start_s": 500.0}, "no row: the range begins after"),
        ({"start_s": -9.0, "end_s": -1.0}, "no row: the range ends before"),
    ],
)
def test_a_range_that_leaves_the_recording_says_so(
    rover: sqlite3.Connection, bounds: dict[str, Any], words: str
) -> None:
    assert words in find_range(rover, Scope(run_id=1, **bounds)).notes[0]


def test_more_seconds_back_than_a_run_has_lasted_name_the_run_before(
    rover: sqlite3.Connection,
) -> None:
    asked = find_range(rover, Scope(run_id=2, last_s=60.0))
    (told,) = asked.notes
    assert asked.segments == find_range(rover, Scope(run_id=2)).segments
    assert "run 2 (started by reset) has lasted only 29.9 s" in told and "run 1" in told
    assert "run 1" not in " ".join(find_range(rover, Scope(run_id=2, last_s=29.9)).notes)


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ({"start_s": 5.0, "end_s": 5.0}, "empty"),
        ({"start_s": 5.0, "end_s": 1.0}, "reversed"),
        ({"end_s": 0.0}, "no row before end_s=0: it reaches from 0 s to"),
        ({"start_s": 0.0, "last_s": 1.0}, "two ways"),
        ({"last_s": 1.0, "since_wall_time": 5.0}, "two ways"),
        ({"last_s": 0.0}, "above 0"),
        ({"start_s": math.nan}, "finite"),
        ({"since_wall_time": "yesterday"}, "ISO 8601"),
        ({"since_wall_time": "inf"}, "finite"),
        ({"since_wall_time": 5.0, "until_wall_time": 2.0}, "reversed"),
    ],
)
def test_a_range_without_sense_is_refused_with_the_reason(
    rover: sqlite3.Connection, bounds: dict[str, Any], words: str
) -> None:
    with pytest.raises(InvalidRangeError, match=words):
        find_range(rover, Scope(run_id=1, **bounds))


def test_wall_time_reaches_across_runs(rover: sqlite3.Connection) -> None:
    start, end = WALL_START_S + 50, WALL_START_S + 65
    found = find_range(rover, Scope(since_wall_time=start, until_wall_time=end))
    assert [segment.run_id for segment in found.segments] == [1, 2]
    first, second = found.segments
    assert first.start_s == pytest.approx(100.0)
    assert second.end_s == pytest.approx(10.0, abs=0.11)
    rows = [row for segment in found.segments for row in rows_in(rover, segment)]
    expected = rover.execute(
        "SELECT id FROM state WHERE wall_time_s >= ? AND wall_time_s < ?", (start, end)
    )
    assert sorted(rows) == [row for (row,) in expected]


@given(st.floats(-5, 200), st.floats(0.01, 100))
def test_a_wall_range_holds_exactly_its_rows(
    paused: sqlite3.Connection, start: float, length: float
) -> None:
    walls = (WALL_START_S + start, WALL_START_S + start + length)
    found = find_range(paused, Scope(since_wall_time=walls[0], until_wall_time=walls[1]))
    rows = [row for segment in found.segments for row in rows_in(paused, segment)]
    expected = paused.execute(
        "SELECT id FROM state WHERE wall_time_s >= ? AND wall_time_s < ?", walls
    )
    assert rows == [row for (row,) in expected]


@pytest.fixture(scope="module")
def paused() -> Iterator[sqlite3.Connection]:
    """Simulation time stands still now and then, wall time goes on."""
    with memory_connection() as connection:
        recorder = Recorder(connection)
        robot_id = recorder.robot("r")
        session_id = recorder.session(robot_id, "x")
        for run in range(2):
            recorder.run(session_id, robot_id)
            for step in range(60):
                wall_s = WALL_START_S + run * 100 + step
                values = {"run_id": recorder.run_id, "sim_time_s": float(step // 7 * 3)}
                recorder.insert("state", **values, wall_time_s=wall_s, data="{}")
            recorder.wall_s = WALL_START_S + 100
        yield connection


def test_wall_time_may_be_iso_text() -> None:
    moment = datetime(2026, 5, 4, 13, 30, tzinfo=timezone.utc)
    assert parse_wall_time("2026-05-04T13:30:00Z") == moment.timestamp()
    assert parse_wall_time("2026-05-04T15:30:00+02:00") == moment.timestamp()
    assert parse_wall_time("12.5") == 12.5


def test_what_was_never_recorded_is_named_as_such(
    rover: sqlite3.Connection, empty: sqlite3.Connection
) -> None:
    with pytest.raises(UnknownRobotError, match="rover"):
        find_range(rover, Scope(robot="rovre"))
    with pytest.raises(UnknownRunError, match="99"):
        find_range(rover, Scope(run_id=99))
    with pytest.raises(NothingRecordedError):
        find_range(empty, Scope())
    for name in ("a", "b"):
        start_run(empty, name)
    with pytest.raises(AmbiguousRobotError):
        find_range(empty, Scope())
    with pytest.raises(NothingRecordedError, match="no state row"):
        find_range(empty, Scope(robot="a"))


def test_a_wall_range_over_hundreds_of_runs_holds_all_of_them(empty: sqlite3.Connection) -> None:
    recorder = Recorder(empty)
    robot_id = recorder.robot("r")
    session_id = recorder.session(robot_id, "x")
    for _ in range(300):
        recorder.run(session_id, robot_id)
        recorder.publish(1.0, {"x": 1})
    found = find_range(empty, Scope(since_wall_time=0.0))
    assert [segment.run_id for segment in found.segments] == list(range(1, 301))
    assert found.notes == ()


def test_a_wall_range_over_very_many_runs_takes_the_newest(
    empty: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ranges, "MOST_RUNS", 50)
    recorder = Recorder(empty)
    robot_id = recorder.robot("r")
    session_id = recorder.session(robot_id, "x")
    for _ in range(60):
        recorder.run(session_id, robot_id)
        recorder.publish(1.0, {"x": 1})
    found = find_range(empty, Scope(since_wall_time=0.0))
    assert [segment.run_id for segment in found.segments] == list(range(11, 61))
    assert "newest 50 runs" in found.notes[0]


def test_a_range_within_a_recording_gap_says_what_is_missing(rover: sqlite3.Connection) -> None:
    (note,) = find_range(rover, Scope(run_id=1, start_s=91.0, end_s=93.0)).notes
    assert note == "no row: nothing was recorded between 89.9 and 95 s of run 1"
    start, end = WALL_START_S + 45.5, WALL_START_S + 46.5
    found = find_range(rover, Scope(run_id=1, since_wall_time=start, until_wall_time=end))
    assert (found.segments, found.notes) == ((), ("no row of robot 'rover' in that wall time",))
