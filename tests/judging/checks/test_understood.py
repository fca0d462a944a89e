"""A check says which signals no other check could judge, and changes nothing else."""

from __future__ import annotations

import sqlite3
from typing import Any

import pytest

from tests.recordings.rows import RecordedRobot
from tests.store.test_meanings import state
from webots_mcp.cli.judging_commands import _as_typed  # pyright: ignore[reportPrivateUsage]
from webots_mcp.judging.checks.check import Finding
from webots_mcp.judging.checks.check_run import UNDERSTOOD, check_run
from webots_mcp.signals.meaning import DECLARED_WORDS


@pytest.fixture
def rover(empty: sqlite3.Connection) -> RecordedRobot:
    return RecordedRobot(empty, "rover", 1000.0)


def last_of(connection: sqlite3.Connection) -> Finding:
    return check_run(connection, 1).findings[-1]


def drive(robot: RecordedRobot, **constant: Any) -> None:
    for row in range(20):
        robot.state(0.1 * row, {"front_m": 1.0 + row % 3, "mode": "drive", **constant})
    robot.end_run("finished")


def test_signals_of_unknown_meaning_are_counted_and_those_that_change_most_come_first(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    for row in range(20):
        rover.state(0.1 * row, {"k": 3.5, "u": row // 5, "w": [row, -row], "front_m": 1.0})
    found = last_of(empty)
    assert (found.name, found.outcome, found.often) == (UNDERSTOOD, "not judged", 4)
    assert found.evidence == (
        f"4 signals of unknown meaning: w.*, u, k; "
        f"declare them with webots_describe_signals(...): {DECLARED_WORDS}"
    )
    assert found.more == ("webots_describe_signals(signals=['w.*'], quantity='...', role='...')")


def test_once_they_are_declared_it_passes_for_the_same_run(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    drive(rover, u=0.5, v=0.1)
    assert "2 signals of unknown meaning" in last_of(empty).evidence
    state(empty, rover.id, "u", quantity="torque", set_by="mcp")
    assert last_of(empty).evidence.startswith("1 signal of unknown meaning: v;")
    state(empty, rover.id, "v", quantity="torque", set_by="mcp")
    found = last_of(empty)
    assert (found.outcome, found.evidence) == (
        "pass", "3 numeric signals, the meanings of all are known",
    )  # fmt: skip


def test_times_texts_flags_and_reductions_of_arrays_are_not_asked_for(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    drive(rover, time=1.0, name="a", ready=True, scan_m=[1.0] * 20)
    assert last_of(empty).outcome == "pass"


def test_it_never_changes_what_the_run_comes_to(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    drive(rover)
    assert last_of(empty).outcome == "pass"
    before = check_run(empty, 1).outcome
    other = RecordedRobot(empty, "other", 1000.0)
    for row in range(20):
        other.state(0.1 * row, {"front_m": 1.0 + row % 3, "mode": "drive", "u": 1.0})
    other.end_run("finished")
    checked = check_run(empty, other.run_id)
    assert (checked.findings[-1].outcome, checked.outcome) == ("not judged", before)


def test_a_run_without_numbers_is_not_asked(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    rover.state(0.0, {"mode": "drive"})
    assert last_of(empty).outcome == "not applicable"


def test_a_person_reads_the_command_that_declares_them(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    drive(rover, u=0.5)
    found = last_of(empty)
    table = {"columns": ["evidence", "more"], "rows": [[found.evidence, found.more]]}
    (row,) = _as_typed({"checks": table})["checks"]["rows"]
    assert row == [
        "1 signal of unknown meaning: u; declare them with webots-mcp signals --describe: "
        f"{DECLARED_WORDS}",
        "webots-mcp signals --describe u quantity=... role=...",
    ]
