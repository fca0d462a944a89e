"""Runs are told apart, found and compared by their parameters."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.bridge.conftest import STEP_MS
from webots_mcp import MCPBridge
from webots_mcp.database.connection import connect
from webots_mcp.errors import InvalidInputError
from webots_mcp.judging.comparison import compare_runs
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.runs import list_runs


def drive(database: Path) -> None:
    """Four runs: kp is 2.0, as declared; 3.0; 3.0 and from 0.176 s on 4.0; 2.0 again."""
    robot = InProcessSupervisor("rover")
    with MCPBridge(robot, throttle_interval=1, database=database) as bridge:
        kp, gait = bridge.parameter("kp", 2.0), bridge.parameter("gait", "trot")
        bridge.parameter("ki", 0.5)
        for number, at_start in enumerate((2.0, 3.0, 3.0, 2.0)):
            if number:
                robot.simulationReset()
            for step in range(20):
                robot.step(STEP_MS)
                bridge.publish({"error": kp.value * step})
                if step == 0:
                    kp.set(at_start)
                    gait.set("walk")
                elif step == 10 and number == 2:
                    kp.set(4.0)
                bridge.get_command()


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    database = tmp_path_factory.mktemp("parameters") / "webots.db"
    drive(database)
    return database


@pytest.fixture
def connection(file: Path) -> Iterator[sqlite3.Connection]:
    with closing(connect(file, "reader")) as opened:
        yield opened


def test_runs_show_what_is_not_as_declared_and_what_differs_between_them(
    connection: sqlite3.Connection,
) -> None:
    found = {run.run_id: run.parameters for run in list_runs(connection).runs}
    assert found == {
        1: {"kp": 2.0, "gait": '"trot", then "walk" from 0.016 s on'},
        2: {"kp": "2, then 3 from 0.016 s on", "gait": "walk"},
        3: {"kp": "3, then 4 from 0.176 s on", "gait": "walk"},
        4: {"kp": "4, then 2 from 0.016 s on", "gait": "walk"},
    }
    assert [run.parameters for run in list_runs(connection, limit=1).runs] == [
        {"kp": "4, then 2 from 0.016 s on", "gait": "walk"}
    ]


@pytest.mark.parametrize(
    ("wanted", "run_ids"),
    [
        ({"kp": 3}, [3, 2]),
        ({"kp": 4.0}, [4, 3]),
        ({"kp": 2.0, "gait": "trot"}, [1]),
        ({"ki": 0.5}, [4, 3, 2, 1]),
        ({"ki": 9}, []),
        ({"gait": 1}, []),
        ({"gait": True}, []),
    ],
)
def test_runs_are_found_by_the_values_that_they_had(
    connection: sqlite3.Connection, wanted: dict[str, float | str], run_ids: list[int]
) -> None:
    found = list_runs(connection, parameters=wanted)
    assert [run.run_id for run in found.runs] == run_ids
    assert found.total == len(run_ids)
    newest = list_runs(connection, parameters=wanted, limit=1)
    assert (len(newest.runs), newest.total) == (min(len(run_ids), 1), len(run_ids))


def test_a_name_that_no_controller_declared_is_refused_with_the_nearest(
    connection: sqlite3.Connection,
) -> None:
    with pytest.raises(InvalidInputError, match=r"No parameter .kpp.*nearest of .*: kp"):
        list_runs(connection, parameters={"kpp": 1})
    with pytest.raises(InvalidInputError, match="No run has such a value"):
        list_runs(connection, parameters={"kp": float("nan")})


def test_a_comparison_names_the_parameters_in_which_the_runs_differ(
    connection: sqlite3.Connection,
) -> None:
    first, third = compare_runs(connection, [1, 3]).groups
    assert first.parameters["kp"] == (2.0,)
    assert third.parameters["kp"] == ("3, then 4 from 0.176 s on",)
    assert "ki" not in first.parameters
    second, fourth = compare_runs(connection, [2, 4]).groups
    assert "gait" not in second.parameters | fourth.parameters
