"""Single items of long arrays can be asked; where one has no value the answer says why."""

from __future__ import annotations

import sqlite3

import pytest

from tests.recordings.rover import start_run
from webots_mcp.errors import UnknownSignalError
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.trends import trends
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.signal_history import query_history

ROWS = 200


@pytest.fixture(params=["rows", "chunks"])
def scanned(empty: sqlite3.Connection, request: pytest.FixtureRequest) -> sqlite3.Connection:
    """Beam 12 counts up by 0.1 m each row; beam 3 is never there."""
    recorder = start_run(empty)
    empty.execute("BEGIN")
    for row in range(ROWS):
        beams: list[float | None] = [1.0] * 20
        beams[12], beams[3] = row / 10, None
        recorder.publish(row / 10, {"scan": beams, "accelerometer": [0.0, 0.1, row / 100]})
    recorder.end_run("finished")
    empty.execute("COMMIT")
    if request.param == "chunks":
        make_chunks(empty, 100_000)
    return empty


@pytest.mark.parametrize("name", ["scan[12]", "scan.12"])
def test_an_item_has_a_history_and_a_trend(scanned: sqlite3.Connection, name: str) -> None:
    asked = find_range(scanned, Scope())
    (columns,) = query_history(scanned, asked, [name], max_points=4).runs[0].numbers
    assert (columns.name, columns.whole.min, columns.whole.max) == ("scan.12", 0.0, 19.9)
    (trend,) = trends(scanned, asked, [name]).runs[0].numbers
    assert trend.says.startswith("rises from 0 to 19.9")


def test_an_item_of_a_short_array_is_asked_in_brackets_too(scanned: sqlite3.Connection) -> None:
    asked = find_range(scanned, Scope())
    (columns,) = query_history(scanned, asked, ["accelerometer[2]"]).runs[0].numbers
    assert columns.name == "accelerometer.2" and columns.whole.max == 1.99


def test_a_condition_asks_an_item(scanned: sqlite3.Connection) -> None:
    options = EventOptions(kinds=("condition",), where="scan[12] > 15")
    (event,) = find_events(scanned, find_range(scanned, Scope()), options).events
    assert event.start_s == pytest.approx(15.1)


def test_an_item_beyond_the_end_is_said_to_be_so(scanned: sqlite3.Connection) -> None:
    history = query_history(scanned, find_range(scanned, Scope()), ["scan[20]"])
    assert not history.runs[0].numbers[0].whole.present
    assert any("scan has 20 items" in note for note in history.notes)


def test_an_item_that_is_always_null_has_no_value(scanned: sqlite3.Connection) -> None:
    found = trends(scanned, find_range(scanned, Scope()), ["scan[3]"]).runs[0]
    assert found.without_value == ("scan.3",)


def test_items_of_deleted_rows_are_said_to_be_gone(scanned: sqlite3.Connection) -> None:
    make_chunks(scanned, 100_000)
    scanned.execute("DELETE FROM state WHERE sim_time_s < 19")
    history = query_history(scanned, find_range(scanned, Scope()), ["scan[12]"])
    assert any("and single items of scan" in n for n in history.notes), history


def test_what_is_no_array_has_no_items(scanned: sqlite3.Connection) -> None:
    with pytest.raises(UnknownSignalError):
        query_history(scanned, find_range(scanned, Scope()), ["speed[2]"])
