"""A value that no bridge has written is an error that says so."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, fail
from tests.server.malformed import NOT_UTF8, Damage
from webots_mcp.cli import main


@pytest.mark.anyio
@pytest.mark.parametrize(
    "damage",
    [
        Damage("state", "data", "nonsense"),
        Damage("state", "data", NOT_UTF8),
        Damage("state", "sim_time_s", "late"),
    ],
    ids=str,
)
async def test_a_value_that_no_bridge_has_written_is_said_to_be_one(
    connect: Connect, recorded: Recorded, damage: Damage
) -> None:
    robot = recorded.robot()
    for step in range(3):
        robot.state(step, {"x": step})
    damage.apply(recorded.connection)
    async with connect() as client:
        told = await fail(client, "webots_get_robot_state")
    assert "rows that it did not write" in told or "holds a value" in told, told


def test_so_it_is_on_the_command_line_in_one_line(
    recorded: Recorded, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    Damage("state", "sim_time_s", "late").apply(recorded.connection)
    assert main(["status", "--database", str(file)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("webots-mcp: a row holds what no bridge has written, or ")
    assert said.count("\n") == 1


@pytest.mark.anyio
@pytest.mark.parametrize("value", ["nonsense", NOT_UTF8])
async def test_it_is_said_of_which_run_and_row_it_is(
    connect: Connect, recorded: Recorded, value: str
) -> None:
    robot = recorded.robot()
    robot.begin_run("reset")
    row = 0
    for step in range(3):
        row = robot.state(step, {"x": step})
    Damage("state", "data", value).apply(recorded.connection)
    async with connect() as client:
        told = await fail(client, "webots_get_robot_state")
        assert f"run {robot.run_id}: row {row} of table state holds a value" in told
        if value is NOT_UTF8:
            told = await fail(client, "webots_query_history", signals=["x"])
            assert f"run {robot.run_id}: row {row} of table state has a time that is no" in told
