"""To whose run a line of Webots' console belongs, and which lines are there already."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rows import Recorded, RecordedRobot
from webots_mcp.store.logs import MOST_WAITING, ConsoleRows, Said

HERE = "here:1234"
NOW = time.time()


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    recording = Recorded(tmp_path / "webots.db")
    yield recording
    recording.close()


def said(text: str, at_s: float = NOW, **changes: Any) -> Said:
    return Said(at_s, "info", "console", text, "stdout")._replace(**changes)


def robot(recorded: Recorded, name: str = "rover", at_s: float = NOW - 5) -> RecordedRobot:
    file = f"/project/controllers/{name}_code/{name}_code.py"
    return recorded.robot(name, at_s, instance=HERE, controller=file)


def rows_of(recorded: Recorded) -> list[tuple[Any, ...]]:
    query = "SELECT run_id, sim_time_s, source, message FROM log WHERE logger IS 'stdout'"
    return recorded.connection.execute(query).fetchall()


def waiting(recorded: Recorded) -> list[str]:
    found = recorded.connection.execute("SELECT message FROM console_line ORDER BY id")
    return [message for (message,) in found]


def test_a_line_is_of_the_newest_run_that_had_begun_and_of_its_time(recorded: Recorded) -> None:
    rover = robot(recorded)
    rover.state(1.0, {}, at=NOW - 3)
    rover.state(2.0, {}, at=NOW - 1)
    rows = ConsoleRows(HERE, NOW - 10)
    rows.write(recorded.connection, [said("before", NOW - 2), said("after", NOW)])
    assert rows_of(recorded) == [(1, 1.0, "console", "before"), (1, 2.0, "console", "after")]


def test_what_is_said_before_the_first_run_waits_for_it(recorded: Recorded) -> None:
    recorded.robot("other", NOW, instance="here:4321")
    recorded.robot("yesterday", NOW - 86_400, instance=HERE)
    rows = ConsoleRows(HERE, NOW - 10)
    rows.begin(recorded.connection)
    rows.write(recorded.connection, [said("SyntaxError", NOW - 1)])
    assert (waiting(recorded), rows_of(recorded)) == (["SyntaxError"], [])
    assert not rows.may_go_on(recorded.connection)
    rover = robot(recorded, at_s=NOW)
    assert rows.may_go_on(recorded.connection)
    rows.write(recorded.connection, [])
    assert waiting(recorded) == []
    assert rows_of(recorded) == [(rover.run_id, 0.0, "console", "SyntaxError")]


def test_lines_that_wait_outlive_who_followed_and_not_their_webots(recorded: Recorded) -> None:
    rows = ConsoleRows(HERE, NOW - 10)
    rows.write(recorded.connection, [said("lost?", NOW - 1)])
    again = ConsoleRows(HERE, NOW - 10)
    again.begin(recorded.connection)
    assert waiting(recorded) == ["lost?"]
    next_webots = ConsoleRows(HERE, NOW + 60)
    next_webots.begin(recorded.connection)
    assert waiting(recorded) == []


def test_only_so_many_lines_wait_the_newest_and_it_is_said(recorded: Recorded) -> None:
    rows = ConsoleRows(HERE, NOW - 10)
    rows.write(recorded.connection, [said(str(each)) for each in range(MOST_WAITING + 7)])
    assert waiting(recorded)[0] == "7"
    assert len(waiting(recorded)) == MOST_WAITING
    robot(recorded, at_s=NOW)
    rows.write(recorded.connection, [])
    told = recorded.connection.execute("SELECT message FROM log WHERE logger IS NULL").fetchall()
    assert told == [("(7 lines before the first run are not recorded)",)]


def test_what_follows_the_start_of_a_controller_is_of_the_run_that_it_begins(
    recorded: Recorded,
) -> None:
    rover = robot(recorded)
    rows = ConsoleRows(HERE, NOW - 10)
    own = {"source": "webots"}
    starting = "INFO: rover_code: Starting controller: python3 -u rover_code.py"
    rows.write(recorded.connection, [said("bye", NOW - 2), said(starting, NOW, **own)])
    rows.write(recorded.connection, [said("Traceback", NOW + 0.1)])
    assert [row[3] for row in rows_of(recorded)] == ["bye"]
    rover.end_run("reload")
    rover.now = NOW + 0.3
    rover.begin_session(instance=HERE)
    second = rover.begin_run("reload")
    rows.write(recorded.connection, [])
    assert rows_of(recorded)[1:] == [
        (second, 0.0, "webots", starting),
        (second, 0.0, "console", "Traceback"),
    ]


def test_a_start_that_is_told_late_keeps_nothing_waiting(recorded: Recorded) -> None:
    rover = robot(recorded)
    rows = ConsoleRows(HERE, NOW - 10)
    rows.write(recorded.connection, [said("INFO: rover_code: Starting controller: x")])
    assert len(waiting(recorded)) == 1
    recorded.connection.execute("UPDATE run SET last_wall_time_s = ?", (NOW + 1,))
    rows.write(recorded.connection, [said("hello", NOW + 1)])
    assert [row[0] for row in rows_of(recorded)] == [rover.run_id] * 2


def test_the_start_of_a_controller_that_does_not_record_changes_nothing(
    recorded: Recorded,
) -> None:
    robot(recorded)
    rows = ConsoleRows(HERE, NOW - 10)
    rows.write(recorded.connection, [said("INFO: crowd: Starting controller: ./crowd")])
    assert len(rows_of(recorded)) == 1


@pytest.mark.parametrize("name", ["referee", "referee_code"])
def test_a_line_that_names_its_robot_or_controller_is_of_that_one(
    recorded: Recorded, name: str
) -> None:
    robot(recorded, "referee")
    robot(recorded, "rover")
    rows = ConsoleRows(HERE, NOW - 10)
    rows.write(recorded.connection, [said(f"[{name}] foul"), said("[unknown] foul")])
    assert rows_of(recorded) == [
        (1, 0.0, "controller", "foul"),
        (2, 0.0, "console", "[unknown] foul"),
    ]


def test_what_a_bridge_has_recorded_is_not_recorded_twice(recorded: Recorded) -> None:
    rover = robot(recorded)

    def bridge(message: str, logger: str | None) -> None:
        number = rover.log(1.0, message)
        recorded.connection.execute("UPDATE log SET logger = ? WHERE id = ?", (logger, number))

    rows = ConsoleRows(HERE, NOW - 10)
    bridge("tick", "stdout")
    bridge("low battery", "power")
    bridge("it failed\nTraceback:\n  line 3", "power")
    printed = ["tick", "tick", "WARNING:power:low battery", "it failed", "Traceback:", "  line 3",
               "very low battery", "slow battery"]  # fmt: skip
    rows.write(recorded.connection, [said(text, stream="stderr") for text in printed])
    query = "SELECT message FROM log WHERE logger = 'stderr' AND source = 'console'"
    found = [message for (message,) in recorded.connection.execute(query)]
    assert found == ["tick", "very low battery", "slow battery"]
    bridge("tick", "stdout")
    rows.write(recorded.connection, [said("tick")])
    assert rows_of(recorded) == [(1, 1.0, "controller", "tick")] * 2


def test_a_line_is_cut_as_a_bridge_cuts_it(recorded: Recorded) -> None:
    robot(recorded)
    ConsoleRows(HERE, NOW - 10).write(recorded.connection, [said("x" * 20_000)])
    assert len(rows_of(recorded)[0][3]) == 10_000


def test_old_lines_go_to_the_newest_run_whenever_it_began(recorded: Recorded) -> None:
    rover = robot(recorded, at_s=NOW - 50)
    rows = ConsoleRows(HERE, NOW - 60)
    starting = said("INFO: rover_code: Starting controller: x", NOW, is_old=True)
    rows.write(recorded.connection, [starting, said("hello", NOW, is_old=True)])
    assert [row[0] for row in rows_of(recorded)] == [rover.run_id] * 2


def test_a_line_that_names_its_robot_is_met_in_what_that_robots_bridge_recorded(
    recorded: Recorded,
) -> None:
    rover = robot(recorded)
    robot(recorded, "referee")
    rover.log(1.0, "hello")
    recorded.connection.execute("UPDATE log SET logger = 'stderr'")
    recorded.connection.execute("UPDATE log SET source = 'controller'")
    rows = ConsoleRows(HERE, NOW - 10)
    for name in ("silent", "rover"):
        rows.write(recorded.connection, [said(f"[{name}] hello")])
    assert [message for *_, message in rows_of(recorded)] == ["[silent] hello"]
