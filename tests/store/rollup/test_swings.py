"""Swings that are stored with coarse rollups are those that the rows show."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import Recorder, start_run
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.questions.events import find_events
from webots_mcp.store.reading import rows, views
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.retention.policy import Limit, Retention
from webots_mcp.store.retention.purge import prune
from webots_mcp.store.rollup import findings
from webots_mcp.store.rollup.rolling import roll

# In a bucket of 500 s, across the border of two, and after the last that is over.
SWINGS_S = ((100.0, 130.0), (488.0, 512.0), (1205.0, 1230.0))
END_S = 1300.0


@pytest.fixture(scope="module")
def _long() -> Iterator[sqlite3.Connection]:
    with memory_connection() as connection:
        with pytest.MonkeyPatch.context() as patch:
            _shorten(patch)
            _record(connection)
        yield connection


@pytest.fixture
def long(
    _long: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> Iterator[sqlite3.Connection]:
    """1300 s, of which two coarse buckets are over."""
    _shorten(monkeypatch)
    with memory_connection(_long) as connection:
        yield connection


def _shorten(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(rows, "RAW_ROWS", 1000)
    patch.setattr(findings, "STRETCH_ROWS", 1500)
    patch.setattr(views, "STRETCH_ROWS", 1500)


def _record(connection: sqlite3.Connection) -> None:
    recorder = Recorder(connection)
    robot_id = recorder.robot("rover")
    recorder.run(recorder.session(robot_id, "a" * 64), robot_id)
    for step in range(round(END_S / 0.1)):
        recorder.publish(step * 0.1, state(step * 0.1))
    connection.execute("UPDATE run SET last_sim_time_s = ?", (END_S,))
    while not roll(connection, 100_000).done:
        pass


def state(time_s: float) -> dict[str, Any]:
    swinging = any(start_s <= time_s < end_s for start_s, end_s in SWINGS_S)
    swing = 0.3 * math.sin(math.pi * time_s) * swinging
    return {"pose": [0.2 * time_s, 0.0, 0.0], "steering": swing, "lidar": swing}


def swings_of(connection: sqlite3.Connection, **asked: Any) -> list[tuple[float, ...]]:
    options = EventOptions(kinds=("oscillation",), **asked)
    found = find_events(connection, find_range(connection, Scope()), options, deadline_s=60.0)
    assert "not before" not in found.verdicts.not_searched.get("oscillation", "")
    figures = ("period_s", "amplitude", "half_periods")
    return [
        (each.start_s, each.end_s, *(each.details[name] for name in figures))
        for each in found.events
    ]


def rows_read(connection: sqlite3.Connection, **asked: Any) -> int:
    """How many statements read values of rows."""
    statements: list[str] = []
    connection.set_trace_callback(statements.append)
    swings_of(connection, **asked)
    connection.set_trace_callback(None)
    return sum("json_extract(data" in each for each in statements)


def test_stored_swings_are_told_as_the_rows_tell_them_and_the_rows_are_not_read(
    long: sqlite3.Connection,
) -> None:
    stored, few = swings_of(long), rows_read(long)
    long.execute("UPDATE coarse_rollup SET swings = NULL")  # as older versions left them
    read = swings_of(long)
    assert [(round(start_s), round(end_s)) for start_s, end_s, *_ in read] == [
        (round(start_s), round(end_s)) for start_s, end_s in SWINGS_S
    ]
    for one, other in zip(stored, read, strict=True):
        assert one == pytest.approx(other, rel=0.02)
    assert few < rows_read(long) / 2


def test_swings_of_other_lengths_or_of_other_signals_are_looked_for_in_the_rows(
    long: sqlite3.Connection,
) -> None:
    assert len(swings_of(long, signals=("lidar",))) == len(SWINGS_S)
    assert len(swings_of(long, min_half_periods=26)) == 1
    assert rows_read(long, min_half_periods=26) > rows_read(long)


def test_stored_swings_outlast_the_rows(long: sqlite3.Connection, tmp_path: Path) -> None:
    before = swings_of(long)
    long.execute("UPDATE run SET ended_wall_time_s = last_wall_time_s")
    prune(long, tmp_path, Retention(state=Limit(rows=4000), outlive=0), rest=False)
    assert long.execute("SELECT count(*) FROM state").fetchone()[0] < 5000
    assert swings_of(long) == before


def test_of_rows_that_were_gone_before_500_s_were_over_no_swings_are_claimed(
    long: sqlite3.Connection,
) -> None:
    long.execute("DELETE FROM state WHERE sim_time_s < 300")
    long.execute("UPDATE run SET coarse_end = NULL")
    roll(long, 100_000)
    stored = long.execute(
        "SELECT bucket, swings IS NOT NULL FROM coarse_rollup WHERE signal_id = "
        "(SELECT id FROM signal WHERE name = 'steering') ORDER BY bucket"
    )
    assert stored.fetchall() == [(0, 0), (1, 1)]


@pytest.mark.parametrize("name", ["headingDeg", "steeringAngle", "rollDeg", "imu.pitch"])
def test_what_swings_is_found_however_its_name_is_written(
    empty: sqlite3.Connection, name: str
) -> None:
    branch, _, last = name.rpartition(".")
    recorder = start_run(empty)
    for step in range(300):
        value = 5.0 * math.sin(math.pi * step * 0.1)
        recorder.publish(step * 0.1, {branch: {last: value}} if branch else {last: value})
    ((_, _, period_s, amplitude, _),) = swings_of(empty)
    assert (period_s, amplitude) == pytest.approx((2.0, 5.0), rel=0.05)


def test_slow_swings_are_looked_for_where_the_rows_are_read_else_the_answer_says_that_they_are_not(
    empty: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = start_run(empty)
    for step in range(3000):
        time_s = step / 10
        swing = 0.5 * math.sin(math.tau * time_s / 12) if 60 <= time_s < 180 else 0.0
        recorder.publish(time_s, {"yaw_rate": 0.0, "pitch": swing})
    ((start_s, end_s, period_s, amplitude, _),) = swings_of(empty)
    assert (start_s, end_s) == pytest.approx((60, 180), abs=3)
    assert (period_s, amplitude) == pytest.approx((12, 0.5), rel=0.05)
    monkeypatch.setattr(rows, "RAW_ROWS", 1000)
    asked = EventOptions(kinds=("oscillation",))
    (why,) = find_events(empty, find_range(empty, Scope()), asked).verdicts.gaps.values()
    assert "not with a period over 5 s in so long a range: ask for less time" in why
