"""Two ranges that adjoin hold everything once; a time that was shown finds what it was shown of."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.memory import memory_connection
from tests.recordings.rover import start_run
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.reading.segment import moment_of, shown_time
from webots_mcp.store.signal_history import query_rows

STEP_S = 0.032
ROWS = 700


def clock_times() -> list[float]:
    """What a clock that adds up its steps comes to; 0.0625 s is half way between two of ours."""
    times = [0.0]
    while len(times) < ROWS:
        times.append(times[-1] + STEP_S)
    return sorted([*times, 0.0625, 0.1875])


TIMES = clock_times()


@pytest.fixture(scope="module", params=["raw", "chunked"])
def clock(request: pytest.FixtureRequest) -> Iterator[sqlite3.Connection]:
    """A mode that changes in every 7th row, and a log line in every 5th."""
    with memory_connection() as connection:
        recorder = start_run(connection)
        for row, time_s in enumerate(TIMES):
            recorder.publish(time_s, {"mode": "ab"[row // 7 % 2], "row": row})
            if row % 5 == 0:
                line = {"level": "warning", "source": "controller", "message": str(row)}
                recorder.insert("log", **recorder.at(time_s), **line)
        if request.param == "chunked":
            assert make_chunks(connection, 100_000).done
        yield connection


def rows_of(connection: sqlite3.Connection, **bounds: Any) -> list[int]:
    found = query_rows(connection, find_range(connection, Scope(**bounds)), ["row"], limit=1000)
    return [int(str(value)) for value in found.values["row"]]


def happened(connection: sqlite3.Connection, **bounds: Any) -> list[Event]:
    options = EventOptions(kinds=("change", "log", "run"))
    asked = find_range(connection, Scope(**bounds))
    return list(find_events(connection, asked, options, limit=9999, group=False).events)


@pytest.fixture(scope="module")
def all_happened(clock: sqlite3.Connection) -> list[Event]:
    """What happened in the whole run."""
    return happened(clock)


def test_clocks_that_add_up_are_meant() -> None:
    assert sum(time_s != shown_time(time_s) for time_s in TIMES) > ROWS / 2


@pytest.mark.slow
@settings(deadline=None, max_examples=12)
@given(time_s=st.sampled_from(TIMES), beside_s=st.floats(-0.002, 0.002))
def test_adjoining_ranges_hold_every_row_change_and_event_once(
    clock: sqlite3.Connection, all_happened: list[Event], time_s: float, beside_s: float
) -> None:
    for border_s in {shown_time(time_s), time_s, shown_time(time_s + beside_s)}:
        if moment_of(border_s) <= 0 or border_s > TIMES[-1]:
            continue
        before, after = {"end_s": border_s}, {"start_s": border_s}
        assert rows_of(clock, **before) + rows_of(clock, **after) == list(range(len(TIMES)))
        parts = [*happened(clock, **before), *happened(clock, **after)]
        assert [(e.kind, e.start_s, e.details) for e in parts] == [
            (e.kind, e.start_s, e.details) for e in all_happened
        ]


@pytest.mark.slow
@settings(deadline=None, max_examples=30)
@given(st.sampled_from(range(1, len(TIMES) - 1)))
def test_a_shown_time_finds_its_row_and_no_other_within_the_millisecond(
    clock: sqlite3.Connection, row: int
) -> None:
    shown_s = shown_time(TIMES[row])
    assert rows_of(clock, start_s=shown_s)[0] == row
    assert rows_of(clock, start_s=shown_s, end_s=shown_s + 0.001) == [row]
    assert rows_of(clock, end_s=shown_s)[-1] == row - 1


def test_a_range_that_begins_with_the_first_row_is_within_the_recording(
    clock: sqlite3.Connection,
) -> None:
    assert find_range(clock, Scope(start_s=0.0)).notes == ()
    assert "begins at 0 s" in find_range(clock, Scope(start_s=-0.001)).notes[0]
