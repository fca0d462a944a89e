"""The timeline holds everything once, in order."""

from __future__ import annotations

import sqlite3

import pytest

from tests.recordings.rover import WALL_START_S, start_run
from webots_mcp.errors import InvalidInputError
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.events import timeline
from webots_mcp.store.reading.ranges import Scope, find_range


def test_the_timeline_merges_all_sources_in_order(rover: sqlite3.Connection) -> None:
    answer = timeline(rover, find_range(rover, Scope(run_id=1)))
    told = [(event.kind, round(event.start_s, 1)) for event in answer.events]
    assert told == [
        ("run", 0.0), ("log", 10.0), ("command", 20.0), ("image", 30.0), ("change", 40.0),
        ("log", 45.0), ("change", 52.0), ("change", 52.0), ("change", 60.0), ("bridge_event", 61.0),
        ("gap", 89.9), ("change", 95.0), ("log", 104.0), ("run", 119.9),
    ]  # fmt: skip
    assert answer.cursor is None


@pytest.mark.parametrize("limit", [1, 3, 7])
def test_pages_hold_every_event_once(rover: sqlite3.Connection, limit: int) -> None:
    span = find_range(
        rover, Scope(since_wall_time=WALL_START_S, until_wall_time=WALL_START_S + 1000)
    )
    whole = timeline(rover, span).events
    found: list[Event] = []
    cursor = None
    while True:
        page = timeline(rover, span, limit=limit, after=cursor)
        assert len(page.events) <= limit
        found += page.events
        cursor = page.cursor
        if cursor is None:
            break
    assert tuple(found) == whole


def test_a_cursor_that_is_none_is_refused(rover: sqlite3.Connection) -> None:
    for wrong in ("x", "[]", "5", "[1, 2]", "null"):
        with pytest.raises(InvalidInputError, match="cursor"):
            timeline(rover, find_range(rover, Scope(run_id=1)), after=wrong)


def test_what_was_logged_after_the_last_row_is_told(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    recorder.publish(1.0, {"x": 1})
    recorder.insert("log", **recorder.at(1.5), level="error", source="controller", message="bye")
    empty.execute("UPDATE run SET ended_wall_time_s = 2e9, last_sim_time_s = 1.6")
    whole = timeline(empty, find_range(empty, Scope())).events
    assert [event.kind for event in whole] == ["run", "log", "run"]
    closed = timeline(empty, find_range(empty, Scope(start_s=0.5, end_s=1.2))).events
    assert closed == ()
