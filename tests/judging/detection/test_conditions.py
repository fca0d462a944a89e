"""The past is asked with the same conditions: where they held, how often, from when to when."""

from __future__ import annotations

import sqlite3
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.recordings.rover import Recorder, start_run
from webots_mcp.errors import InvalidConditionError, InvalidInputError, UnknownSignalError
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Events, find_events
from webots_mcp.signals.conditions.functions import SAME_TIME_S
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import chunk_whole_run
from webots_mcp.store.reading.ranges import Scope, find_range


def ask(connection: sqlite3.Connection, where: str, **bounds: Any) -> Events:
    found = find_range(connection, Scope(**(bounds or {"run_id": 1})))
    options = EventOptions(kinds=("condition",), where=where)
    return find_events(connection, found, options, group=False)


def spans(events: Events) -> list[tuple[float, float]]:
    return [(round(event.start_s, 1), round(event.end_s, 1)) for event in events.events]


@pytest.fixture
def counting(empty: sqlite3.Connection) -> Recorder:
    """A run in which `n` counts, a row each 0.1 s."""
    return start_run(empty)


def test_each_stretch_is_told_with_begin_end_and_values(rover: sqlite3.Connection) -> None:
    found = ask(rover, "sensors.bumper and mode == 'cruise'")

    assert spans(found) == [(40.0, 51.9)]
    assert found.events[0].name == "sensors.bumper and mode == 'cruise'"
    assert found.events[0].details == {"sensors.bumper": True, "mode": "cruise"}
    assert found.verdicts.found == {"condition": 1}


def test_a_duration_begins_when_it_is_over(rover: sqlite3.Connection) -> None:
    assert spans(ask(rover, "sensors.bumper for 5")) == [(45.0, 51.9)]
    ((start_s, end_s),) = spans(ask(rover, "mode == 'cruise' and displacement(2) < 0.01"))
    assert (start_s, end_s) == (42.0, 51.9)


def test_what_reaches_out_of_the_range_is_told_whole(rover: sqlite3.Connection) -> None:
    bounds = {"run_id": 1, "start_s": 48.0, "end_s": 49.0}

    assert spans(ask(rover, "sensors.bumper", **bounds)) == [(40.0, 51.9)]
    assert spans(ask(rover, "sensors.bumper for 5", **bounds)) == [(45.0, 51.9)]


def test_what_began_before_the_range_is_remembered(rover: sqlite3.Connection) -> None:
    found = ask(rover, "changed(mode)", run_id=1, start_s=52.0, end_s=52.05)

    assert spans(found) == [(52.0, 52.0)]


def test_several_runs_are_several_pasts(rover: sqlite3.Connection) -> None:
    everything = {"since_wall_time": 0.0, "until_wall_time": 2e9}
    found = ask(rover, "not missing(target) for 25", **everything)

    assert [event.run_id for event in found.events] == [1, 2, 3]
    assert {round(event.start_s, 1) for event in found.events} == {25.0}


def test_without_a_position_a_displacement_is_refused_rather_than_never_short(
    counting: Recorder,
) -> None:
    for step in range(50):
        counting.publish(step / 10, {"n": step})
    with pytest.raises(UnknownSignalError, match="displacement has no value: no position is known"):
        ask(counting.connection, "displacement(3) < 0.05 or n > 5")


def test_where_it_never_held_the_answer_says_how_many_rows_were_looked_at(
    rover: sqlite3.Connection,
) -> None:
    found = ask(rover, "pose.0 > 1e6")

    assert found.verdicts.not_found["condition"] == (
        "'pose.0 > 1e6' was true in none of 1150 rows; nearest: pose.0 12.78 at 119.9 s"
    )


@pytest.mark.parametrize(
    ("where", "named"),
    [
        ("blind < 3", "blind"),
        ("displacement(1) < 0.05", "the position"),
        ("n > 9 and blind", "bli"),
    ],
)
def test_what_never_had_a_value_was_not_looked_for(
    counting: Recorder, where: str, named: str
) -> None:
    for step in range(50):
        counting.publish(step * 0.1, {"n": step % 5, "blind": None, "pose": [None, None]})
    verdicts = ask(counting.connection, where).verdicts

    assert verdicts.not_found == {}
    assert verdicts.not_searched["condition"].startswith(named)
    assert "had no value in any row" in verdicts.not_searched["condition"]
    assert ask(counting.connection, "n > 9 and missing(blind)").verdicts.not_found == {
        "condition": "'n > 9 and missing(blind)' was true in none of 50 rows"
    }


def test_of_several_runs_all_rows_are_counted_and_the_same_is_said_once(
    rover: sqlite3.Connection,
) -> None:
    found = ask(rover, "target > 1e6", since_wall_time=0.0, until_wall_time=2e9)

    assert found.verdicts.not_found["condition"] == (
        "'target > 1e6' was true in none of 2050 rows; nearest: target 3 at 0 s"
    )
    dropped, others = (note for note in found.notes if "row" in note)
    assert dropped.startswith("run 1: ") and "some were dropped" in dropped
    assert others.startswith("run 2, 3: ")


@pytest.mark.parametrize(
    ("interval", "said"),
    [(1, "nothing was missed"), (5, "one publish() call in 5 is a row"), (None, "may be fewer")],
)
def test_the_answer_says_whether_the_rows_are_all_that_was_published(
    counting: Recorder, interval: int | None, said: str
) -> None:
    counting.publish(0.0, {"n": 1})
    counting.connection.execute("UPDATE session SET throttle_interval = ?", (interval,))

    notes = ask(counting.connection, "n > 0").notes

    assert any(said in note for note in notes)


def test_a_wrong_question_is_refused_with_what_would_do(rover: sqlite3.Connection) -> None:
    with pytest.raises(InvalidConditionError, match="column 16"):
        ask(rover, "sensors.bumper = true")
    with pytest.raises(UnknownSignalError, match="No signal 'bmuper' is recorded"):
        ask(rover, "bmuper")
    with pytest.raises(
        InvalidInputError, match=r"cannot compare the text 'cruise' with the number 3.*\(in run 1"
    ):
        ask(rover, "mode < 3")
    found = find_events(rover, find_range(rover, Scope()), EventOptions(kinds=("condition",)))
    assert "give where" in found.verdicts.not_searched["condition"]


@settings(
    deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(st.sampled_from([0.0, 1.0, 2.0, None]), min_size=1, max_size=30),
    st.sampled_from([0.1, 0.2, 0.5]),
    st.sampled_from(["<", ">"]),
)
def test_a_duration_leaves_out_what_is_shorter_and_begins_when_it_is_over(
    empty: sqlite3.Connection, values: list[float | None], for_s: float, sign: str
) -> None:
    empty.execute("DELETE FROM robot")
    recorder = start_run(empty)
    for step, value in enumerate([*values, 1.0]):
        recorder.publish(step * 0.1, {"x": value})

    found = ask(empty, f"x {sign} 1", run_id=recorder.run_id)
    lasting = ask(empty, f"x {sign} 1 for {for_s}", run_id=recorder.run_id)

    assert [(event.start_s, event.end_s) for event in lasting.events] == [
        (pytest.approx(event.start_s + for_s), event.end_s)
        for event in found.events
        if event.duration_s >= for_s - SAME_TIME_S
    ]


def test_where_a_condition_could_not_be_asked_of_a_damaged_chunk_is_said(
    counting: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunk_making, "GROUP_ROWS", 100)
    connection = counting.connection
    for step in range(400):
        counting.publish(step * 0.1, {"n": step, "m": step})
    assert chunk_whole_run(connection, 1)
    connection.execute("DELETE FROM state")
    of_m = "signal_id = (SELECT id FROM signal WHERE name = 'm')"
    connection.execute(f"UPDATE chunk SET numbers = x'00' WHERE group_id = 2 AND {of_m}")

    assert spans(ask(connection, "n < m + 1")) == [(0.0, 9.9), (20.0, 39.9)]
    never = ask(connection, "missing(m)").verdicts
    assert never.not_found["condition"] == ("'missing(m)' was true in none of 300 rows")
    assert "from 10.000 to 19.900 s: the chunk of m is damaged" in never.not_searched["condition"]

    connection.execute(f"UPDATE chunk SET numbers = x'00' WHERE {of_m}")
    assert "condition" not in ask(connection, "missing(m)").verdicts.not_found


def test_a_gap_is_no_time_in_which_it_held_and_a_lasting_one_says_since_when(
    counting: Recorder,
) -> None:
    for step in [*range(200), *range(260, 400)]:
        counting.publish(step * 0.1, {"n": step})
    found = ask(counting.connection, "n > 9 for 0.5")

    (event,) = found.events
    assert (event.details["true_from_s"], event.details["fulfilled_s"]) == (1.0, 1.5)
    assert event.details["not_recorded_s"] == pytest.approx(6.1)
    assert event.start_s == pytest.approx(1.5)
    assert any("32.3 s; " in note and "6.1 s in between" in note for note in found.notes)
