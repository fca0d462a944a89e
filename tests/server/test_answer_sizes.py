"""How long the answers are: every default one stays under 2,000 tokens, on any recording.

Run with `-s` to see the table. Tokens are counted by the package's own rule, `tokens_in`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import pytest

from tests.recordings.fleet import build_fleet
from tests.recordings.long import build
from tests.recordings.rows import Recorded
from tests.server.conftest import text_of
from tests.server.story import client_on
from webots_mcp.answers.budget import ANSWER_TOKENS, LARGE_ANSWER_TOKENS
from webots_mcp.answers.shortening import tokens_in
from webots_mcp.database.connection import connect
from webots_mcp.questions import all_questions
from webots_mcp.store.chunk_making import make_chunks

pytestmark = pytest.mark.anyio
RICH_TOKENS: Final = 1_500
ROWS: Final = 3_500  # more than one cycle of what it does
LONG_RUN: Final = 2
MORE_SIGNALS: Final = 30  # to the 39 of the long recording
DEFAULTS: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    ("webots_list_robots", {}),
    ("webots_diagnose_setup", {}),
    ("webots_get_world_info", {}),
    ("webots_get_robot_state", {}),
    ("webots_get_sensors", {}),
    ("webots_get_full_state", {}),
    ("webots_get_parameters", {}),
    ("webots_list_breakpoints", {}),
    ("webots_get_trials", {}),
    ("webots_get_logs", {}),
    ("webots_list_commands", {}),
    ("webots_list_signals", {}),
    ("webots_query_history", {"signals": ["pose"]}),
    ("webots_query_history", {"signals": ["*"]}),
    ("webots_query_history", {"signals": ["*"], "raw": True}),
    ("webots_get_trends", {}),
    ("webots_find_events", {}),
    ("webots_get_timeline", {}),
    ("webots_monitor", {"lookback_wall_s": 10}),
    ("webots_monitor", {"lookback_wall_s": 3600}),
    ("webots_list_runs", {}),
    ("webots_compare_runs", {"run_ids": [1, 2]}),
    ("webots_compare_runs", {"run_ids": [1, 2], "first_difference": True}),
    ("webots_plot", {}),
    ("webots_query_sql", {"sql": "SELECT * FROM state"}),
    ("webots_query_sql", {"sql": "SELECT * FROM robot_run"}),
)


@pytest.fixture(scope="module")
def big(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Long names, 69 signals, many log lines and events, two long runs and many short ones."""
    file = tmp_path_factory.mktemp("big") / "webots.db"
    build(file, ROWS, chunked=False)
    more = {f"manipulator_joint_{i}_torque_estimate_nm": 0.5 for i in range(MORE_SIGNALS)}
    with connect(file, "writer") as connection:
        connection.execute("BEGIN IMMEDIATE")
        values = ", ".join(f"'$.{name}', {value} * (id % 97)" for name, value in more.items())
        connection.execute(f"UPDATE state SET data = json_set(data, {values})")
        _add_runs(connection)
        connection.execute("COMMIT")
    while not make_chunks(connection, 100_000).done:
        pass
    connection.close()
    return file


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("fleet") / "webots.db"
    build_fleet(file, robots=2, seconds=900, interval_s=0.5)
    return file


@pytest.mark.slow
async def test_robots_that_do_the_same_again_and_again_are_told_in_1500_tokens(
    fleet: Path,
) -> None:
    async with client_on(fleet) as client:
        for tool, arguments in (
            ("webots_list_signals", {}),
            ("webots_query_history", {"signals": ["*"]}),
            ("webots_query_history", {"signals": ["*"], "raw": True}),
            ("webots_get_trends", {}),
            ("webots_find_events", {}),
            ("webots_find_events", {"kinds": ["standstill", "change", "command"]}),
            ("webots_find_events", {"kinds": ["standstill"], "group": False}),
            ("webots_get_timeline", {}),
            ("webots_monitor", {"lookback_wall_s": 900}),
        ):
            result = await client.call_tool(tool, {"robot": "rover0", **arguments})
            assert not result.is_error, (tool, text_of(result))
            tokens = tokens_in(text_of(result))
            assert tokens < RICH_TOKENS, (tool, arguments, tokens)


def _add_runs(connection: Any) -> None:
    columns = "session_id, robot_id, world, basic_time_step_ms, start_reason"
    for run_id in range(2, 60):
        connection.execute(
            f"INSERT INTO run ({columns}, started_wall_time_s, started_sim_time_s, "
            f"last_wall_time_s, last_sim_time_s, row_count) SELECT {columns}, "
            "started_wall_time_s + ?, 0, started_wall_time_s + ?, 900, 9 FROM run WHERE id = 1",
            (1000 * run_id, 1000 * run_id + 900),
        )
        limit = ROWS if run_id == 2 else 9
        connection.execute(
            "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) SELECT ?, sim_time_s, "
            "wall_time_s + ?, data FROM state WHERE run_id = 1 ORDER BY id LIMIT ?",
            (run_id, 1000 * run_id, limit),
        )
    for step in range(3_000):
        stamp = (2, step * 0.1, 1_700_002_000.0 + step * 0.1)
        connection.execute(
            "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message) "
            "VALUES (?, ?, ?, 'warning', 'controller', ?)",
            (*stamp, f"wheel slip {step}: " + "the estimate and the odometry differ " * 5),
        )
        connection.execute(
            "INSERT INTO event (run_id, sim_time_s, wall_time_s, kind, name, data) "
            "VALUES (?, ?, ?, 'noticed_something', 'a signal', ?)",
            (*stamp, json.dumps({"why": "because " * 30})),
        )


@pytest.mark.slow
async def test_every_default_answer_is_under_2000_tokens(big: Path) -> None:
    async with client_on(big) as client:
        table: list[str] = []
        single = all_questions()
        for tool, arguments in DEFAULTS:
            (asks,) = (each for each in single if each.name == tool)
            takes_run = "run_id" in asks.arguments.model_fields
            asked = arguments | ({"run_id": LONG_RUN} if takes_run else {})
            result = await client.call_tool(tool, asked)
            assert not result.is_error, (tool, text_of(result))
            tokens = tokens_in(text_of(result))
            table.append(f"{tool:24} {json.dumps(asked):55} {tokens:6}")
            assert tokens < ANSWER_TOKENS, table[-1]
        print("\n" + "\n".join(table))


@pytest.mark.slow
async def test_an_answer_that_was_asked_to_be_long_stays_under_what_clients_put_aside(
    big: Path,
) -> None:
    async with client_on(big) as client:
        for tool, arguments in (
            ("webots_query_history", {"signals": ["*"], "max_points": 500}),
            ("webots_query_history", {"signals": ["*"], "max_points": 500, "raw": True}),
            ("webots_get_trends", {"limit": 500}),
            ("webots_find_events", {"limit": 500}),
            ("webots_get_timeline", {"limit": 500}),
            ("webots_query_sql", {"sql": "SELECT * FROM state", "limit": 500}),
        ):
            result = await client.call_tool(tool, arguments if "sql" in arguments else
                                            arguments | {"run_id": 2})  # fmt: skip
            assert not result.is_error, text_of(result)
            assert tokens_in(text_of(result)) < LARGE_ANSWER_TOKENS, tool


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot of 400 numbers, and 60 others beside it."""
    file = tmp_path_factory.mktemp("wide") / "webots.db"
    recorded = Recorded(file)
    for number in range(60):
        recorded.robot(f"a_rover_with_rather_a_long_name_{number}")
    robot = recorded.robot("rover")
    for step in range(50):
        robot.state(step * 0.1, {f"joint_{i}_torque_nm": i * step / 7 for i in range(400)})
    recorded.close()
    return file


@pytest.mark.parametrize(
    ("tool", "arguments", "said"),
    [
        ("webots_list_robots", {}, "61 robots in all, the latest"),
        ("webots_get_world_info", {"robot": "rover"}, ""),
        ("webots_get_robot_state", {"robot": "rover"}, "336 more keys: joint_64"),
        ("webots_get_sensors", {"robot": "rover"}, ""),
        ("webots_get_full_state", {"robot": "rover"}, "not shown: joint_"),
        ("webots_list_signals", {"robot": "rover"}, "of 400: go on with cursor"),
        ("webots_query_history", {"robot": "rover", "signals": ["*"]}, "left out of run"),
        (
            "webots_query_history",
            {"robot": "rover", "signals": ["*"], "raw": True},
            "left out: joint_",
        ),
        ("webots_get_trends", {"robot": "rover"}, "of 399 numbers"),
        ("webots_find_events", {"robot": "rover"}, ""),
        ("webots_get_timeline", {"robot": "rover"}, ""),
        ("webots_monitor", {"robot": "rover", "lookback_wall_s": 60}, "of 399 numbers"),
        ("webots_query_sql", {"sql": "SELECT * FROM state"}, "long values are cut"),
        (
            "webots_query_sql",
            {
                "sql": "SELECT "
                + ", ".join(
                    [
                        f"replace(printf('%.*c', 20, 'a'), 'a', '0123456789') AS a_{i}"
                        for i in range(60)
                    ]
                )
            },
            "texts over",
        ),
    ],
)
async def test_whoever_has_400_signals_reads_what_is_left_out_of_2000_tokens(
    wide: Path, tool: str, arguments: dict[str, Any], said: str
) -> None:
    async with client_on(wide) as client:
        result = await client.call_tool(tool, arguments)
        assert not result.is_error, text_of(result)
        assert tokens_in(text_of(result)) < ANSWER_TOKENS
        assert said in text_of(result)


async def test_the_history_of_several_runs_with_long_names_is_under_2000_tokens(
    tmp_path: Path,
) -> None:
    file = tmp_path / "webots.db"
    recorded = Recorded(file)
    robot = recorded.robot()
    for run in range(4):
        if run:
            robot.begin_run("reset")
        for step in range(60):
            torque = "estimate_of_the_torque_of_the_motor_of_joint_number"
            robot.state(step * 0.1, {f"arm_{i}_{torque}_{i}": i + step / 7 for i in range(60)})
    recorded.close()
    async with client_on(file) as client:
        arguments = {"signals": ["*"], "since_wall_time": 1_500_000_000}
        result = await client.call_tool("webots_query_history", arguments)
    assert not result.is_error, text_of(result)
    assert tokens_in(text_of(result)) < ANSWER_TOKENS
    answer = json.loads(text_of(result))
    assert [run["row_count"] for run in answer["runs"]] == [60] * 4
    assert "left out of one run or more: arm_" in answer["hint"]
