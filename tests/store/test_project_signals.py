"""The table [signals] of a project's file says what signals mean."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rows import RecordedRobot
from tests.store.test_meanings import found
from webots_mcp.cli import main
from webots_mcp.database.location import MemoryDatabase
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.policy import policies_of
from webots_mcp.store.project_file import NO_PROJECT, ProjectWatch, compile_project, read_project

FILE = """
[signals]
"motors.left" = {quantity = "wheel speed", role = "commanded", side = "left"}
"q.*" = {quantity = "joint position", unit = "rad", low = -1.5, high = 1.5}

[signals.rover]
u = {quantity = "speed", role = "commanded", unit = "m/s"}

[signals.drone]
u = {quantity = "force"}

[allow]
launch = false
"""
STATE: dict[str, Any] = {"motors": {"left": 1.0}, "q": [0.1, 0.2], "u": 1.0}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "webots-mcp.toml").write_text(FILE)
    return tmp_path / "webots-mcp.toml"


@pytest.fixture
def rover(empty: sqlite3.Connection) -> RecordedRobot:
    robot = RecordedRobot(empty, "rover", 1000.0)
    robot.state(0.0, STATE)
    return robot


def test_the_signals_of_every_robot_and_of_one_are_known_also_of_past_runs(
    empty: sqlite3.Connection, rover: RecordedRobot, file: Path
) -> None:
    compile_project(empty, read_project(file))
    meanings = found(empty, rover)
    left, joint, u = meanings["motors.left"], meanings["q.1"], meanings["u"]
    assert (left.quantity, left.role, left.side) == ("wheel speed", "commanded", "left")
    assert (joint.quantity, joint.unit, joint.low) == ("joint position", "rad", -1.5)
    assert (u.quantity, u.why) == ("speed", "declared in webots-mcp.toml")
    drone = RecordedRobot(empty, "drone", 1000.0)
    drone.state(0.0, STATE)
    assert found(empty, drone)["u"].quantity == "force"


def test_what_the_file_does_not_say_any_more_does_not_count(
    empty: sqlite3.Connection, rover: RecordedRobot, file: Path
) -> None:
    compile_project(empty, read_project(file))
    file.write_text(FILE.replace('"speed"', '"force"').replace('"q.*"', '"r.*"'))
    watch = ProjectWatch(file.parent)
    watch.recompile_if_changed(empty)
    meanings = found(empty, rover)
    assert (meanings["u"].quantity, meanings["q.1"].quantity) == ("force", None)
    rows = empty.execute("SELECT count(*) FROM meaning").fetchone()
    compile_project(empty, read_project(file))
    assert empty.execute("SELECT count(*) FROM meaning").fetchone() == rows == (4,)
    compile_project(empty, NO_PROJECT)
    assert empty.execute("SELECT count(*) FROM meaning").fetchone() == (0,)


@pytest.mark.parametrize(
    ("said", "line", "why"),
    [
        ('[signals]\na = {unit = "m"}\nu = {quantity = "velocity"}', 3, "Use one of x, y"),
        ('[signals]\nu = "speed"', 2, "must be a table such as {quantity"),
        ('[signals.rover]\nu = {speed = "m/s"}', 2, "unknown field 'speed' of signal 'u'"),
        ("[signals]\nu = {}", 2, "Nothing is declared for signal 'u'"),
        ("[signals]\nu = {name = 3}", 2, "unknown field 'name' of signal 'u'"),
        ("signals = 3", 1, "signals must be a table: [signals]"),
        ('[signals.rover]\n"a b" = {unit = 3}', 2, "unit must be a text"),
    ],
)
def test_a_file_that_is_invalid_is_refused_with_its_line_and_changes_nothing(
    empty: sqlite3.Connection, tmp_path: Path, said: str, line: int, why: str
) -> None:
    file = tmp_path / "webots-mcp.toml"
    file.write_text('[signals]\nu = {unit = "m"}')
    watch = ProjectWatch(tmp_path)
    watch.recompile_if_changed(empty)
    file.write_text(f"{said}\n# changed")
    with pytest.raises(InvalidInputError, match=f"line {line}: ") as raised:
        read_project(file)
    assert why in str(raised.value)
    watch.recompile_if_changed(empty)
    assert empty.execute("SELECT name, unit FROM meaning").fetchall() == [("u", "m")]


def test_a_file_that_describes_signals_still_allows_what_it_allows(file: Path) -> None:
    memory = MemoryDatabase()
    try:
        (policy,) = policies_of(memory, file.parent, ())
        assert policy.allow == {"launch": False}
    finally:
        memory.close()


def test_init_says_how_many_signals_are_described(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("worlds", "controllers"):
        (file.parent / folder).mkdir()
    main(["init", str(file.parent)])
    shown = capsys.readouterr().out
    assert "0 expectations and the meaning of 4 signals" in shown
