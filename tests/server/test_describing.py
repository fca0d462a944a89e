"""What signals mean, asked and declared over MCP."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rows import Recorded, RecordedRobot
from tests.server.conftest import Connect, ask, fail
from tests.store.test_meanings import state
from webots_mcp.contract import PROJECT_FILE
from webots_mcp.database.connection import connect as open_database

pytestmark = pytest.mark.anyio


def rows_of(answer: dict[str, Any]) -> dict[str, dict[str, Any]]:
    table = answer["signals"]
    rows = [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]
    return {row["signal"]: row for row in rows}


def stored(file: Path) -> list[Any]:
    with closing(open_database(file, "reader")) as connection:
        query = "SELECT name, quantity, set_by FROM meaning ORDER BY name"
        return connection.execute(query).fetchall()


@pytest.fixture
def rover(recorded: Recorded) -> RecordedRobot:
    robot = recorded.robot()
    robot.state(1.0, {"u": 0.5, "q": [0.1, 0.2], "front_m": 1.0, "mode": "drive"})
    return robot


@pytest.mark.usefixtures("rover")
async def test_meanings_are_listed_with_their_source_and_why_and_the_unknown_are_named(
    connect: Connect,
) -> None:
    async with connect() as client:
        for tool, arguments in (
            ("webots_describe_signals", {}),
            ("webots_get_trends", {"what": "meanings"}),
            ("webots_list_meanings", {}),
        ):
            answer = await ask(client, tool, **arguments)
            found = rows_of(answer)
            assert found["front_m"]["quantity"] == "distance"
            assert found["front_m"]["source"] == "named"
            assert "distance" in found["front_m"]["why"]
            assert found["u"]["source"] == "unknown"
            assert answer["unknown"] == ["q.0, q.1, u"]
            assert "webots_describe_signals(signals=['q.0'], quantity=" in answer["hint"]


@pytest.mark.usefixtures("rover")
async def test_the_list_of_signals_shows_what_each_is_taken_for(connect: Connect) -> None:
    async with connect() as client:
        await ask(
            client, "webots_describe_signals", signals=["u"], quantity="speed", role="commanded",
            unit="m/s",
        )  # fmt: skip
        found = rows_of(await ask(client, "webots_list_signals"))
        assert (found["u"]["meaning"], found["u"]["source"]) == ("commanded speed", "declared")
        assert found["u"]["unit"] == "m/s"
        assert (found["q.0"]["meaning"], found["q.0"]["source"]) == (None, "unknown")


@pytest.mark.usefixtures("rover")
async def test_a_pattern_is_the_names_that_are_known_and_the_answer_says_which(
    connect: Connect, file: Path
) -> None:
    async with connect() as client:
        answer = await ask(
            client, "webots_describe_signals", signals=["q.*"], quantity="joint position", low=-1
        )
        assert answer["changed"] == ["q.0, q.1"]
        assert rows_of(answer)["q.1"] == {
            "signal": "q.1", "quantity": "joint position", "role": "measured", "low": -1.0,
            "source": "declared", "why": "declared with webots_describe_signals",
        }  # fmt: skip
        assert stored(file) == [("q.0", "joint position", "mcp"), ("q.1", "joint position", "mcp")]
        answer = await ask(client, "webots_describe_signals", signals=["q.1"], quantity="force")
        assert rows_of(answer)["q.1"]["quantity"] == "force"
        assert len(stored(file)) == 2


async def test_undo_brings_back_what_the_code_declares_and_then_what_the_name_says(
    connect: Connect, file: Path, rover: RecordedRobot
) -> None:
    state(rover.connection, rover.id, "front_m", quantity="height")
    async with connect() as client:
        asked = {"signals": ["front_m"]}
        await ask(client, "webots_describe_signals", **asked, quantity="force")
        for quantity in ("height", "distance"):
            answer = await ask(client, "webots_describe_signals", **asked, undo=True)
            assert answer["changed"] == ["front_m"]
            assert rows_of(answer)["front_m"]["quantity"] == quantity
        assert stored(file) == []
        refused = await fail(client, "webots_describe_signals", **asked, undo=True)
        assert "No meaning is declared for signal 'front_m'" in refused
        state(rover.connection, None, "u", quantity="force", set_by="project", robot_name="*")
        refused = await fail(client, "webots_describe_signals", signals=["u"], undo=True)
        assert (
            "declared in webots-mcp.toml, which this tool does not change. Edit its table [signals]"
            in refused
        )


@pytest.mark.usefixtures("rover")
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"quantity": "speed"}, "signals is missing. Give names of recorded signals"),
        ({"signals": ["u"], "quantity": "speed", "undo": True}, "undo=true removes a description"),
        ({"signals": ["nope"], "quantity": "speed"}, "No signal 'nope' is recorded"),
        ({"signals": ["u"], "target_of": "nope"}, "No signal 'nope' is recorded"),
        ({"signals": ["u"], "target_of": "u"}, "must be the name of one other signal"),
        ({"signals": ["u"], "quantity": "velocity"}, "quantity must be"),
        ({"signals": ["u"], "side": "up"}, "Use one of left, right"),
        ({"signals": ["u"], "low": 2, "high": 1}, "low=2 is greater than high=1"),
    ],
)
async def test_a_wrong_description_is_refused_and_nothing_is_stored(
    connect: Connect, file: Path, arguments: dict[str, Any], said: str
) -> None:
    async with connect() as client:
        assert said in await fail(client, "webots_describe_signals", **arguments)
        assert stored(file) == []


@pytest.mark.usefixtures("rover")
async def test_a_project_may_forbid_it_and_the_refusal_is_recorded(
    connect: Connect, file: Path
) -> None:
    (file.parent / PROJECT_FILE).write_text('[allow]\ntools = ["*", "!webots_describe_signals"]\n')
    async with connect() as client:
        refused = await fail(client, "webots_describe_signals", signals=["u"], quantity="speed")
        assert "webots_describe_signals is not allowed" in refused
        assert stored(file) == []
        assert rows_of(await ask(client, "webots_list_meanings"))
    with closing(sqlite3.connect(file)) as connection:
        (rule,) = connection.execute("SELECT rule FROM request").fetchone()
    assert "webots-mcp.toml, line 2" in rule


@pytest.mark.usefixtures("rover")
async def test_a_server_that_only_reads_lists_but_does_not_declare(connect: Connect) -> None:
    async with connect(read_only=True) as client:
        assert rows_of(await ask(client, "webots_list_meanings"))["u"]
        refused = await fail(client, "webots_describe_signals", signals=["u"], quantity="speed")
        assert "this server is --read-only" in refused


async def test_before_anything_is_recorded_the_answer_says_what_to_do(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot()
    async with connect() as client:
        refused = await fail(client, "webots_describe_signals", signals=["u"], quantity="speed")
        assert "No signal has been recorded yet" in refused


async def test_a_unit_of_something_else_than_the_quantity_is_warned_of(
    recorded: Recorded, connect: Connect
) -> None:
    robot = recorded.robot()
    for step in range(20):
        robot.state(step * 0.1, {"arm": {"angle_rad": 0.1 * step}})
    async with connect() as client:
        asked = {"signals": ["arm.angle_rad"], "role": "measured"}
        wrong = await ask(client, "webots_describe_signals", quantity="x", **asked)
        right = await ask(client, "webots_describe_signals", quantity="angle", **asked)
    assert wrong["notes"] == ["arm.angle_rad is in rad, which is no unit of x"]
    assert "notes" not in right
