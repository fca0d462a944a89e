"""Changes of what a robot does are told; a measurement that is a text now and then is no mode."""

from __future__ import annotations

import math
import sqlite3

import pytest

from tests.recordings.rover import start_run
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Events, find_events
from webots_mcp.judging.detection.search import find_motion
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.ranges import Scope, find_range


def changes(connection: sqlite3.Connection) -> Events:
    return find_events(
        connection,
        find_range(connection, Scope(run_id=1)),
        EventOptions(kinds=("change",)),
        limit=20,
    )


def test_a_text_now_and_then_among_numbers_hides_no_change_of_the_mode(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for step in range(300):
        mixed = "n/a" if 100 <= step < 120 else step * 0.25
        mode = "drive" if step < 50 else "return"
        recorder.publish(step * 0.1, {"mode": mode, "mixed": mixed})
    recorder.end_run("finished")
    make_chunks(empty, 100_000)
    found = changes(empty)
    assert [(each.name, round(each.start_s, 1)) for each in found.events] == [
        ("mode", 5.0),
        ("mixed", 10.0),
        ("mixed", 12.0),
    ]
    assert "not between numbers of mixed" in found.verdicts.not_searched["change"]


def test_of_a_mode_that_is_a_number_the_way_to_its_changes_is_named(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for step in range(90):
        recorder.publish(step * 0.1, {"betriebsart": step // 30})
    assert "where='changed(NAME)'" in changes(empty).verdicts.not_searched["change"]
    options = EventOptions(kinds=("condition",), where="changed(betriebsart)")
    found = find_events(empty, find_range(empty, Scope(run_id=1)), options)
    assert [round(each.start_s, 1) for each in found.events] == [3.0, 6.0]


@pytest.mark.parametrize("in_chunks", [True, False])
def test_few_whole_numbers_that_are_named_like_a_mode_are_one(
    empty: sqlite3.Connection, *, in_chunks: bool
) -> None:
    recorder = start_run(empty)
    for step in range(90):
        phase_rad, command = step * 0.25 % 6.25, max(-1.0, min(1.0, math.sin(step) * 2))
        others = {"phase": phase_rad, "action": command, "loop_status": step}
        recorder.publish(step * 0.1, {"arm": {"driveMode": step // 30}, **others})
    if in_chunks:
        make_chunks(empty, 100_000)
    found = changes(empty)
    assert [(each.name, each.details["after"]) for each in found.events] == [
        ("arm.driveMode", "1"),
        ("arm.driveMode", "2"),
    ]
    known = known_signals(empty, find_range(empty, Scope(run_id=1)))
    mode = find_motion(known, EventOptions()).mode
    assert mode is not None and mode.name == "arm.driveMode"


@pytest.mark.parametrize("group", [True, False])
def test_all_changes_of_a_flag_that_flickers_are_counted(
    empty: sqlite3.Connection, *, group: bool
) -> None:
    recorder = start_run(empty)
    for step in range(1600):
        recorder.publish(step * 0.1, {"contact": step % 4 == 1, "mode": "go"})
    found = find_events(
        empty, find_range(empty, Scope(run_id=1)), EventOptions(kinds=("change",)), group=group
    )
    (flickering,) = found.events
    assert (flickering.count, found.verdicts.found) == (800, {"change": 800})
    assert (flickering.start_s, flickering.details["to"]) == (
        pytest.approx(0.1),
        {"true": "400 times, 40 s", "false": "400 times, 119.8 s"},
    )
    assert "the first at 0.1 s, the last at 159.8 s" in flickering.details["says"]
    assert found.verdicts.not_searched == {}
