"""What is said of kinds of events that were not found: each once, and never a plain nothing."""

from __future__ import annotations

import math
import re
import sqlite3

import numpy as np

from tests.recordings.rover import start_run
from webots_mcp.judging.checks.check_run import check_run
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.detection.fall import NO_ATTITUDE
from webots_mcp.judging.verdicts import Verdicts
from webots_mcp.store.reading.ranges import Scope, find_range


def ask(connection: sqlite3.Connection, rows: int, *kinds: str) -> Verdicts:
    """What is said of a robot that drives on, with a row every 0.1 s."""
    recorder = start_run(connection)
    for row in range(rows):
        time_s = row / 10
        state = {"pose": [0.2 * time_s, 0.0], "heading": 0.0, "temp_c": math.sin(time_s)}
        recorder.publish(time_s, state)
    return find_events(
        connection, find_range(connection, Scope()), EventOptions(kinds=kinds)
    ).verdicts


def test_what_no_run_so_short_can_hold_was_not_searched(empty: sqlite3.Connection) -> None:
    told = ask(empty, 21, "stuck", "standstill", "flat", "missing")
    run = "run 1 lasted only 2 s; this kind needs at least"
    assert told.gaps == {"standstill, stuck": f"{run} 3 s", "flat": f"{run} 20 s"}
    assert told.far == ["missing"]


def test_what_was_searched_in_some_signals_is_named_once_with_the_others(
    empty: sqlite3.Connection,
) -> None:
    told = ask(empty, 400, "oscillation", "gap")
    (why,) = told.gaps.values()
    assert why.startswith("1 of 4 numeric signals was not searched, because its name does not ")
    assert why.endswith("motion: pass signals=['temp_c']; in the rest: none")
    assert (told.far, told.nearest) == (["gap"], {})


def test_of_a_short_run_it_is_said_which_swings_do_not_fit_in(empty: sqlite3.Connection) -> None:
    (why,) = ask(empty, 76, "oscillation").gaps.values()
    too_short = "run 1 lasted only 7.5 s, too short for 6 half periods where a period is over 2.5 s"
    assert too_short in why
    assert why.endswith("; in the rest: none")


def test_where_no_signal_is_searched_for_swings_nothing_is_absent(
    empty: sqlite3.Connection,
) -> None:
    start_run(empty).publish(0.0, {"temp_c": 20.0})
    asked = EventOptions(kinds=("oscillation",))
    told = find_events(empty, find_range(empty, Scope()), asked).verdicts
    assert told.why_unsearched("oscillation") == told.gaps["oscillation"]
    assert "rest" not in told.gaps["oscillation"]


def test_a_sensor_too_noisy_for_its_dropouts_says_from_which_size_on_it_has_jumps(
    empty: sqlite3.Connection,
) -> None:
    recorder, noise = start_run(empty), np.random.default_rng(1).normal(0, 0.05, 400)
    for row, off in enumerate(noise.tolist()):
        state = {"front_m": 0.0 if row in (100, 300) else 0.7 + off, "temp_c": math.sin(row / 50)}
        recorder.publish(row / 10, state)
    told = find_events(empty, find_range(empty, Scope()), EventOptions(kinds=("jump",))).verdicts
    assert re.fullmatch(
        r"front_m: largest step was 0\.\d+ m, one over (0\.[89]|1)\d* m counts",
        told.nearest["jump"],
    )
    recorder.end_run("finished")
    drops = {each.name: each for each in check_run(empty, 1).findings}["sensors drop nothing"]
    assert told.nearest["jump"] in drops.evidence


def test_kinds_that_the_recording_has_no_data_for_are_not_passed_over(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for row in range(300):
        recorder.publish(row / 10, {"gripper_m": math.sin(row / 20)})
    told = find_events(empty, find_range(empty, Scope()), EventOptions()).verdicts
    assert told.reasons["fall"] == (NO_ATTITUDE,)
    assert "publish the position" in told.reasons["slip"][0]
    assert {"off_target", "degradation", "stuck", "standstill"} <= told.reasons.keys()


def test_a_reason_stands_under_one_key_together_with_what_was_found_in_the_rest() -> None:
    few, short, near = "a was not searched", "run 1 lasted only 8 s", "b: largest step was 1 m"
    verdicts = Verdicts(
        not_found={"jump": near, "oscillation": ""},
        reasons={"jump": (few,), "oscillation": (few, short), "flat": (short,)},
    )
    assert verdicts.gaps == {
        "jump, oscillation": f"{few}; in the rest: none ({near})",
        "oscillation, flat": short,
    }
