"""Which source of a signal's meaning counts, and that meanings come along with a recording."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.judging.asking import ask
from tests.older_recording import make_older
from tests.recordings.rows import RecordedRobot, insert
from webots_mcp.contract import new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.database.schema_migration import in_current_schema
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import find_motion
from webots_mcp.signals.meaning import Meaning
from webots_mcp.store.meanings import meanings_of
from webots_mcp.store.merging import merge
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.segment import Subject

NAMES = ("a", "b", "front_m", "arm.1", "arm.2")


def state(connection: sqlite3.Connection, robot_id: int | None, name: str, **row: Any) -> None:
    """Store a meaning as one of the sources does."""
    usual = {"source": "declared", "set_by": "controller", "set_wall_time_s": 1.0}
    insert(connection, "meaning", {"robot_id": robot_id, "name": name} | usual | row)


def found(connection: sqlite3.Connection, robot: RecordedRobot) -> dict[str, Meaning]:
    return meanings_of(catalogue(connection, Subject(robot.id, robot.name, robot.run_id)))


@pytest.fixture
def rover(empty: sqlite3.Connection) -> RecordedRobot:
    robot = RecordedRobot(empty, "rover", 1000.0)
    for row in range(3):
        robot.state(0.1 * row, {"a": row, "b": row, "front_m": 1.0, "arm": {"1": 1.0, "2": row}})
    return robot


def test_an_assistant_counts_before_the_project_before_the_code_before_the_device(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    sources: list[tuple[str, dict[str, Any]]] = [
        ("bridge", {"source": "device", "quantity": "distance"}),
        ("controller", {"quantity": "force"}),
        ("project", {"quantity": "light", "robot_name": "*", "robot_id": None}),
        ("cli", {"quantity": "speed"}),
        ("mcp", {"quantity": "pressure", "set_wall_time_s": 2.0}),
    ]
    assert found(empty, rover)["a"].quantity is None
    for set_by, row in sources:
        state(empty, row.pop("robot_id", rover.id), "a", set_by=set_by, **row)
        assert found(empty, rover)["a"].quantity == row["quantity"]
    assert found(empty, rover)["a"].why == "declared with webots_describe_signals"
    assert found(empty, rover)["front_m"].source == "named"


def test_a_name_counts_before_a_pattern_and_a_longer_pattern_before_a_shorter_one(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    state(empty, rover.id, "*", quantity="light")
    state(empty, rover.id, "arm.*", quantity="joint position")
    state(empty, rover.id, "arm.2", quantity="force")
    meanings = found(empty, rover)
    assert [meanings[name].quantity for name in ("a", "arm.1", "arm.2")] == [
        "light", "joint position", "force",
    ]  # fmt: skip


def test_what_is_of_another_robot_does_not_count(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    other = RecordedRobot(empty, "drone", 1000.0)
    state(empty, other.id, "a", quantity="light")
    state(empty, None, "b", quantity="light", set_by="project", robot_name="drone")
    assert {found(empty, rover)[name].quantity for name in ("a", "b")} == {None}


def test_values_that_no_version_writes_are_left_out(
    empty: sqlite3.Connection, rover: RecordedRobot
) -> None:
    state(empty, rover.id, "a", quantity="happiness")
    state(empty, rover.id, "b", quantity="speed", low="a lot")
    assert {found(empty, rover)[name].quantity for name in ("a", "b")} == {None}


def test_a_command_that_is_declared_later_shows_that_a_past_run_was_stuck(
    empty: sqlite3.Connection,
) -> None:
    robot = RecordedRobot(empty, "rover", 1000.0)
    for row in range(600):
        robot.state(0.1 * row, {"e": min(row, 100) * 0.05, "n": 0.0, "u": 0.5})
    robot.end_run("finished")
    assert not ask(empty, "stuck").events
    state(empty, robot.id, "u", quantity="speed", role="commanded", unit="m/s")
    state(empty, robot.id, "e", quantity="x", unit="m")
    state(empty, robot.id, "n", quantity="y", unit="m")
    (stuck,) = ask(empty, "stuck").events
    assert stuck.start_s == pytest.approx(10, abs=1)
    state(empty, robot.id, "u", quantity="force", set_by="mcp")
    assert not ask(empty, "stuck").events


def test_what_is_declared_as_something_else_is_no_position(
    empty: sqlite3.Connection,
) -> None:
    robot = RecordedRobot(empty, "rover", 1000.0)
    robot.state(0.0, {"x": 1.0, "y": 2.0, "east": 3.0, "north": 4.0})
    subject = Subject(robot.id, robot.name, robot.run_id)
    state(empty, robot.id, "x", quantity="force")
    assert find_motion(catalogue(empty, subject), EventOptions()).position is None
    state(empty, robot.id, "east", quantity="x")
    state(empty, robot.id, "north", quantity="y")
    position = find_motion(catalogue(empty, subject), EventOptions()).position
    assert position is not None
    assert [each.name for each in position] == ["east", "north"]


# -- they come along -------------------------------------------------------------------------------


@pytest.fixture
def source(tmp_path: Path) -> Path:
    (tmp_path / "there").mkdir()
    file = tmp_path / "there" / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        robot = RecordedRobot(connection, "rover", 1000.0)
        robot.state(0.0, {"a": 1, "b": 2})
        robot.end_run("finished")
        connection.execute("UPDATE session SET ended_wall_time_s = 1001, uuid = ?", (new_uuid(),))
        connection.execute("UPDATE run SET uuid = ?", (new_uuid(),))
        state(connection, robot.id, "a", quantity="speed", set_by="mcp")
        state(connection, None, "b", quantity="light", set_by="project", robot_name="*")
        state(connection, None, "c", quantity="light", set_by="project", robot_name="drone")
    return file


def test_an_import_brings_what_was_declared_of_its_robots_and_does_so_once(
    source: Path, tmp_path: Path
) -> None:
    (tmp_path / "here").mkdir()
    with closing(connect(tmp_path / "here" / "webots.db", "writer", create=True)) as here:
        create_schema(here)
        for _ in range(2):
            merge(here, tmp_path / "here", source)
            rows = here.execute("SELECT robot_id, name, quantity, robot_name FROM meaning")
            assert rows.fetchall() == [(1, "a", "speed", None), (1, "b", "light", None)]


def test_what_was_declared_here_stays_where_an_import_says_something_else(
    source: Path, tmp_path: Path
) -> None:
    (tmp_path / "here").mkdir()
    with closing(connect(tmp_path / "here" / "webots.db", "writer", create=True)) as here:
        create_schema(here)
        robot = RecordedRobot(here, "rover", 1000.0)
        here.execute("UPDATE session SET ended_wall_time_s = 1001")
        state(here, robot.id, "a", quantity="force", set_by="mcp")
        merge(here, tmp_path / "here", source)
        rows = here.execute("SELECT name, quantity FROM meaning ORDER BY name").fetchall()
        assert rows == [("a", "force"), ("b", "light")]


def test_a_recording_of_the_version_before_has_none_and_comes_in(tmp_path: Path) -> None:
    for folder in ("older", "here"):
        (tmp_path / folder).mkdir()
    make_older(tmp_path / "older" / "webots.db")
    with (
        in_current_schema(tmp_path / "older" / "webots.db") as current,
        closing(connect(tmp_path / "here" / "webots.db", "writer", create=True)) as here,
    ):
        create_schema(here)
        assert merge(here, tmp_path / "here", current) == {}
        assert here.execute("SELECT count(*) FROM meaning").fetchone() == (0,)
