"""What a run came to, and what of it is not known: that is never 0, and no equal."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from typing import Any

import pytest

from tests.recordings.rover import Recorder
from webots_mcp.judging.comparison import Comparison, compare_runs
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.run_measures import Measure

State = Callable[[float], dict[str, Any]]
DURATION_S = 40


def record(connection: sqlite3.Connection, code: str, state: State, end_s: float = DURATION_S):
    recorder = Recorder(connection)
    known = connection.execute("SELECT id FROM robot WHERE name = 'r'").fetchone()
    robot_id = known[0] if known else recorder.robot("r")
    connection.execute("BEGIN")
    recorder.run(recorder.session(robot_id, code * 64), robot_id)
    for step in range(round(end_s * 10)):
        recorder.publish(step * 0.1, state(step * 0.1))
    recorder.end_run("finished")
    connection.execute("COMMIT")


def driving(time_s: float) -> dict[str, Any]:
    return {"pose": [0.3 * time_s, 0.0], "cmd_speed": 0.3, "mode": "drive"}


def stuck_twice(time_s: float) -> dict[str, Any]:
    stood_s = sum(min(max(time_s - start_s, 0.0), 6.0) for start_s in (10.0, 28.0))
    return driving(time_s) | {"pose": [0.3 * (time_s - stood_s), 0.0]}


def without_position(time_s: float) -> dict[str, Any]:
    return {"cmd_speed": 0.3, "mode": "drive", "battery": 12 - 0.01 * time_s}


def without_mode(time_s: float) -> dict[str, Any]:
    return {"pose": [0.3 * time_s, 0.0], "modus": "fahren"}


def measure(comparison: Comparison, name: str) -> Measure:
    return next(each for each in comparison.measures if each.name == name)


def medians(found: Measure) -> list[float | None]:
    return [each and each.median for each in found.spread]


def test_what_was_not_looked_for_in_a_run_is_not_known_of_it(empty: sqlite3.Connection) -> None:
    record(empty, "a", stuck_twice)
    record(empty, "b", without_position)
    found = compare_runs(empty, [1, 2])
    stuck = measure(found, "stuck per min")
    assert medians(stuck) == [pytest.approx(3.0, abs=0.02), None]
    (why,) = (why for names, why in found.unknown.items() if "stuck per min" in names)
    assert why.startswith("run 2: no position is known")


def test_what_no_run_has_is_told_as_not_known(empty: sqlite3.Connection) -> None:
    record(empty, "a", without_position)
    record(empty, "b", without_position)
    found = compare_runs(empty, [1, 2])
    assert "distance_m" not in {each.name for each in found.measures}
    (names,) = (names for names, why in found.unknown.items() if "no position is known" in why)
    assert names.split(", ") == [
        "distance_m",
        "mean_speed_m_s",
        "standstill per min",
        "stuck per min",
    ]


def test_runs_that_are_too_short_for_a_kind_share_one_reason(empty: sqlite3.Connection) -> None:
    record(empty, "a", driving)
    for seconds in (0.5, 0.9, 2.0):
        record(empty, "b", driving, end_s=seconds)
    found = compare_runs(empty, [1, 2, 3, 4]).unknown
    (why,) = (why for names, why in found.items() if "stuck per min" in names)
    assert why.startswith("run 2 lasted only") and why.endswith("; likewise run 3, 4")
    assert "run 2: run 2" not in str(found)


def with_names_of_its_own(time_s: float) -> dict[str, Any]:
    """In millimetres, with a mode that is a number; it stands from 10 to 16 and 28 to 34 s."""
    x, y = stuck_twice(time_s)["pose"]
    return {
        "rail": {"alongMm": 1000 * x, "acrossMm": 1000 * y},
        "betriebsart": 1 if time_s < 30 else 2,
    }


def test_who_asks_names_the_position_and_a_mode_that_is_a_number(
    empty: sqlite3.Connection,
) -> None:
    record(empty, "a", with_names_of_its_own)
    (why,) = (why for names, why in compare_runs(empty, [1]).unknown.items() if "stuck" in names)
    assert "position=[x, y]" in why
    options = EventOptions(position=("rail.alongMm", "rail.acrossMm"), mode="betriebsart")
    found = compare_runs(empty, [1], options=options)
    assert medians(measure(found, "distance_m")) == [pytest.approx(0.3 * 28, rel=0.05)]
    assert medians(measure(found, "stuck per min")) == [pytest.approx(3.0, abs=0.02)]
    assert medians(measure(found, "share of 1")) == [pytest.approx(0.75, abs=0.01)]
    assert medians(measure(found, "share of 2")) == [pytest.approx(0.25, abs=0.01)]


def test_metres_that_no_robot_drives_are_doubted(empty: sqlite3.Connection) -> None:
    record(empty, "a", lambda time_s: {"pose": [300.0 * time_s, 0.0]})
    record(empty, "a", driving)
    why = compare_runs(empty, [1, 2]).unknown["distance_m, mean_speed_m_s"]
    assert why.startswith("run 1: pose.0 is taken as metres")
    assert "pose_mm" in why


def test_a_run_without_a_mode_was_in_no_mode_for_no_known_time(empty: sqlite3.Connection) -> None:
    record(empty, "a", driving)
    record(empty, "a", without_mode)
    record(empty, "a", lambda time_s: driving(time_s) | {"mode": "turn"})
    found = compare_runs(empty, [1, 2, 3])
    assert medians(measure(found, "share of drive")) == [1.0, None, 0.0]
    assert found.unknown["share of each mode"].startswith("run 2: no mode is known")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("runs", "different", "wanted"), [(2, None, 7), (5, None, 7), (7, True, None)]
)
def test_a_rare_event_that_is_gone_is_a_difference_of_enough_runs(
    empty: sqlite3.Connection, runs: int, *, different: bool | None, wanted: int | None
) -> None:
    for code, state in (("a", stuck_twice), ("b", driving)):
        for _ in range(runs):
            record(empty, code, state)
    stuck = measure(compare_runs(empty), "stuck per min")
    assert medians(stuck) == [pytest.approx(3.0, abs=0.02), 0.0]
    assert (stuck.different, stuck.runs_wanted) == ([False, different], [None, wanted])


def test_of_one_run_it_is_told_how_fast_and_in_which_modes_it_went(
    empty: sqlite3.Connection,
) -> None:
    record(empty, "a", lambda time_s: driving(time_s) | {"mode": "drive" if time_s < 30 else "x"})
    found = compare_runs(empty, [1])
    assert medians(measure(found, "mean_speed_m_s")) == [pytest.approx(0.3, abs=0.001)]
    assert medians(measure(found, "distance_m")) == [pytest.approx(0.3 * DURATION_S, abs=0.05)]
    assert medians(measure(found, "share of drive")) == [pytest.approx(0.75, abs=0.01)]
    assert (found.differences, found.notes) == ((), ())


def test_what_is_behind_the_compared_stretch_is_said_to_be_left_out(
    empty: sqlite3.Connection,
) -> None:
    record(empty, "a", driving)
    record(empty, "b", driving, end_s=20.0)
    (note,) = (note for note in compare_runs(empty, [1, 2]).notes if "the rest of" in note)
    assert "the first 19.9 s; for the rest of run 1 (39.9 s)" in note


@pytest.mark.parametrize(
    ("run_ids", "groups"),
    [
        ([1, 2, 3, 4, 5], {"runs 1, 2": [1, 2], "runs 3, 5": [3, 5], "run 4": [4]}),
        ([4, 2, 1], {"run 4": [4], "runs 2, 1": [2, 1]}),
        ([1, 2], {"run 1": [1], "run 2": [2]}),
        ([1, 3], {"run 1": [1], "run 3": [3]}),
    ],
)
def test_repeats_among_given_runs_are_one_group(
    empty: sqlite3.Connection, run_ids: list[int], groups: dict[str, list[int]]
) -> None:
    for code in "aabcb":
        record(empty, code, driving)
    told = {
        each.name: [run.run_id for run in each.runs] for each in compare_runs(empty, run_ids).groups
    }
    assert (told, list(told)) == (groups, list(groups))


def test_runs_of_one_code_with_other_parameters_are_no_repeats(empty: sqlite3.Connection) -> None:
    for code in "aab":
        record(empty, code, driving)
    empty.execute(
        "INSERT INTO parameter_value (run_id, name, sim_time_s, wall_time_s, value, is_default, "
        "set_by) VALUES (2, 'kp', 0.0, 0.0, '3.0', 0, 'command')"
    )
    assert [each.name for each in compare_runs(empty, [1, 2, 3]).groups] == [
        "run 1", "run 2", "run 3",
    ]  # fmt: skip


def test_of_what_was_not_read_in_time_no_figure_is_told(empty: sqlite3.Connection) -> None:
    """A way that a deadline cut had a length of 0.0 m, and modes took the time that was read."""
    for code in "aabb":
        record(empty, code, driving, end_s=300)
    found = compare_runs(empty, deadline_s=0.0)
    assert all(spread is None for each in found.measures for spread in each.spread)
    assert {verdict for each in found.differences for verdict in each.different} == {None}
    assert all(mean is None for each in found.differences for mean in each.mean)
    assert found.only_in == {}
    told = {name for names in found.unknown for name in names.split(", ")}
    unread = {"distance_m", "mean_speed_m_s", "share of each mode", "events per min"}
    assert told == unread | {"means of signals"}
    assert all(why.startswith("time limit reached") for why in found.unknown.values())


def test_of_a_run_whose_first_half_was_deleted_with_its_chunks_no_figure_is_told(
    empty: sqlite3.Connection,
) -> None:
    """Its way was that of the second half, over the time of both, and so were shares and means.

    So were events per minute; and extremes of a group were those of its other runs.
    """

    def with_spikes(time_s: float) -> dict[str, Any]:
        return driving(time_s) | {"front_m": 1.0 if round(time_s * 10) % 50 else 9.0}

    for code in "aab":
        record(empty, code, with_spikes)
    empty.execute("DELETE FROM state WHERE run_id = 1 AND sim_time_s < 20")
    empty.execute("UPDATE run SET purged_rows = 200 WHERE id = 1")
    found = compare_runs(empty, [1, 2, 3])
    assert [len(group.runs) for group in found.groups] == [2, 1]
    for name in ("distance_m", "mean_speed_m_s", "share of drive", "jump per min"):
        assert [median is None for median in medians(measure(found, name))] == [True, False], name
    assert {e for each in found.differences for e in (each.mean[0], each.max[0])} == {None}
    told = ("distance_m", "mean_speed_m_s", "share of each mode", "means of signals", "gap per min")
    for name in told:
        (why,) = (why for names, why in found.unknown.items() if name in names.split(", "))
        assert "run 1: not read from 0.000 to 20.000 s: deleted by retention" in why
