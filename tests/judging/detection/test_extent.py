"""Since when, and how long: an event is told whole, also by a range that holds only a part."""

from __future__ import annotations

import math
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import WALL_START_S, Recorder, start_run
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range

STOPS_S = 200.0  # the robot drives, then stands, at 300 s it drives on
GOES_ON_S = 300.0


@pytest.fixture(scope="module")
def _standing() -> Iterator[sqlite3.Connection]:
    """For 100 s the robot is stuck, its sensor silent, its battery low, its heading flat, and its
    steering swings; only read."""
    with memory_connection() as connection:
        _stand(connection)
        yield connection


@pytest.fixture
def standing(_standing: sqlite3.Connection) -> sqlite3.Connection:
    return _standing


def _stand(connection: sqlite3.Connection) -> None:
    recorder = start_run(connection)
    for step in range(4000):
        time_s = round(step * 0.1, 6)
        stands = STOPS_S <= time_s < GOES_ON_S
        state = {
            "pose": [STOPS_S if stands else time_s, 0.0],
            "commanded_m_s": 1.0,
            "front_m": None if stands else 1.0 + step % 7,
            "battery_v": 3.0 if stands else 12.0,
            "heading_deg": 5.0 if stands else float(step % 90),
            "mode": "waits for help" if stands else "cruise",
            "steering_rad": 0.3 * math.sin(math.pi * time_s) if stands else 0.0,
        }
        recorder.publish(time_s, state)
    recorder.end_run("finished")
    make_chunks(connection, 100_000)


def told(connection: sqlite3.Connection, kind: str, **bounds: Any) -> list[Event]:
    names = {"missing": "front_m", "flat": "heading_deg", "change": "mode"}
    name = (names | {"oscillation": "steering_rad"}).get(kind, "*")
    options = EventOptions(kinds=(kind,), signals=(name,), where="battery_v < 5")
    return list(find_events(connection, find_range(connection, Scope(**bounds)), options).events)


@pytest.mark.parametrize("kind", ["stuck", "condition", "missing", "flat", "oscillation"])
@pytest.mark.parametrize(
    ("start_s", "end_s"), [(250.0, 255.0), (250.0, 250.5), (150.0, 250.0), (295.0, 350.0)]
)
def test_a_range_that_holds_a_part_tells_the_true_begin_and_end(
    standing: sqlite3.Connection, kind: str, start_s: float, end_s: float
) -> None:
    (event,) = told(standing, kind, start_s=start_s, end_s=end_s)
    assert event.start_s == pytest.approx(STOPS_S, abs=0.9)
    assert event.end_s == pytest.approx(GOES_ON_S, abs=0.9)
    assert event.wall_time_s == pytest.approx(WALL_START_S + STOPS_S / 2, abs=0.5)
    assert not event.ongoing


@pytest.mark.parametrize("kind", ["stuck", "condition", "missing", "flat"])
def test_what_was_over_before_the_range_is_not_in_it(
    standing: sqlite3.Connection, kind: str
) -> None:
    assert told(standing, kind, start_s=302.0, end_s=330.0) == []
    assert told(standing, kind, start_s=150.0, end_s=198.0) == []


def test_a_change_lasts_until_the_next_one_also_beyond_the_range(
    standing: sqlite3.Connection,
) -> None:
    (help_needed,) = told(standing, "change", start_s=150.0, end_s=220.0)
    assert (help_needed.start_s, help_needed.end_s, help_needed.ongoing) == (200.0, 300.0, False)
    (cruise,) = told(standing, "change", start_s=290.0, end_s=310.0)
    assert (cruise.start_s, cruise.end_s, cruise.ongoing) == (300.0, 399.9, False)


def test_what_a_short_stretch_costs_does_not_grow_with_the_run(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    costs = [after_so_many_rows(recorder, empty, rows) for rows in (2048, 10_240)]
    assert costs[1] < 1.5 * costs[0]


def after_so_many_rows(recorder: Recorder, connection: sqlite3.Connection, rows: int) -> int:
    """What the last second of the run costs; its mode rests, and one value is never there."""
    (first,) = connection.execute("SELECT count(*) FROM state").fetchone()
    for step in range(first, rows):
        state = {"pose": [step * 0.02, 0.0], "mode": "drive", "text": f"row {step}", "none": None}
        recorder.publish(step * 0.1, state)
    make_chunks(connection, 100_000)
    return calls(connection)


def calls(connection: sqlite3.Connection) -> int:
    """How many functions of Python and, in SQLite, rows of JSON the last second takes."""
    counted = [0]

    def count(frame: object, event: str, argument: object) -> None:
        counted[0] += event == "call"

    with closing(sqlite3.connect(":memory:")) as other:

        def json_extract(*asked: object) -> Any:
            query = f"SELECT json_extract({', '.join('?' * len(asked))})"
            return other.execute(query, asked).fetchone()[0]

        connection.create_function("json_extract", -1, json_extract)
        asked = find_range(connection, Scope(last_s=1.0))
        find_events(connection, asked)
        before = sys.getprofile()
        sys.setprofile(count)
        try:
            find_events(connection, asked)
        finally:
            sys.setprofile(before)
    return counted[0]
