"""Many events that are alike are told as one, which says how many, when, and what they share."""

from __future__ import annotations

import sqlite3
from typing import Any

import pytest

from tests.recordings.rover import Recorder, start_run
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Events, find_events
from webots_mcp.store.reading.ranges import Scope, find_range

CYCLE_S, STAND_S, CYCLES = 20.0, 6.0, 10


@pytest.fixture
def docking(empty: sqlite3.Connection) -> Recorder:
    """Ten times 14 s on the way and 6 s at a dock; a flag flickers all the while."""
    recorder = start_run(empty)
    travelled_m = 0.0
    for step in range(round(CYCLES * CYCLE_S * 10)):
        time_s = step * 0.1
        is_standing = time_s % CYCLE_S >= CYCLE_S - STAND_S
        travelled_m += 0.0 if is_standing else 0.02
        recorder.publish(
            time_s,
            {
                "mode": "dock" if is_standing else "drive",
                "pose": {"x": travelled_m, "y": 0.0},
                "commanded_m_s": 0.0 if is_standing else 0.2,
                "near": step % 3 == 0,
            },
        )
    return recorder


def found(recorder: Recorder, *kinds: str, **options: Any) -> Events:
    connection = recorder.connection
    asked = EventOptions(kinds=kinds, log_level="info")
    return find_events(connection, find_range(connection, Scope()), asked, **options)


def test_standstills_of_one_mode_are_one_event_with_what_they_share(docking: Recorder) -> None:
    told = found(docking, "standstill")
    group, last = told.events
    assert (group.count, group.details["mode"]) == (CYCLES - 1, "dock")
    assert group.start_s == pytest.approx(14.0, abs=0.2)
    assert group.details["says"].startswith("9 standstills, the first at 1")
    assert "each 6" in group.details["says"] or "median 6" in group.details["says"]
    assert group.details["x_m"] == "2.8 to 25.2"
    assert "commanded_m_s 0" in group.details["why_not_stuck"]
    assert last.ongoing and last.count == 1
    assert told.verdicts.found == {"standstill": CYCLES}


def test_a_mode_that_changes_now_and_then_is_told_change_by_change(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for step in range(100):
        recorder.publish(step * 0.1, {"mode": f"leg {step // 10}"})
    modes = [each.details["after"] for each in found(recorder, "change").events]
    assert modes == [f"leg {leg}" for leg in range(1, 10)]


def test_lines_that_differ_in_their_numbers_only_are_one_event(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    for step in range(50):
        recorder.publish(step * 0.1, {"n": step})
        line = {"level": "warning", "source": "controller", "message": f"slip of {step / 7:.2f} m"}
        recorder.insert("log", **recorder.at(step * 0.1), **line)
    recorder.insert(
        "log", **recorder.at(4.95), level="error", source="controller", message="the gear is gone"
    )
    lines, gone = found(recorder, "log").events
    assert (lines.count, lines.details["message"]) == (50, "slip of 0.00 m")
    assert gone.details["message"] == "the gear is gone"


def test_commands_with_another_outcome_are_not_alike(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    robot_id, session_id = empty.execute("SELECT robot_id, session_id FROM run").fetchone()
    for step in range(100):
        recorder.publish(step * 0.1, {"n": step})
        if step % 10 == 0:
            failed = step == 50
            recorder.insert(
                "command", robot_id=robot_id, session_id=session_id, action="grasp",
                params=f'{{"force_n": {step}, "side": "left"}}',
                status="failed" if failed else "done", error="no object" if failed else None,
                created_wall_time_s=recorder.wall_s, expires_wall_time_s=recorder.wall_s + 9,
                claimed_wall_time_s=recorder.wall_s, claimed_sim_time_s=step * 0.1,
                finished_wall_time_s=recorder.wall_s, finished_sim_time_s=step * 0.1,
            )  # fmt: skip
    done, failed = found(recorder, "command").events
    assert done.count == 9
    assert done.details["params"] == {"force_n": "0 to 90", "side": "left"}
    assert (failed.count, failed.details["error"]) == (1, "no object")
