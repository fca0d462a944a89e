"""Every answer says about which robot and run it is, and as of when."""

from __future__ import annotations

import json
import time

import pytest

from tests.recordings.rows import Recorded
from tests.server.conftest import DATA_TOOLS, Connect, ask, fail, text_of

pytestmark = pytest.mark.anyio


async def test_every_answer_names_robot_run_time_age_and_status(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    written_s = time.time() - 0.5
    for step in (2, 1, 0):  # rows 10 s apart: a slow test still finds the robot running
        robot.state(12.34567 - step, {"x": 1}, at=written_s - 10 * step)
    async with connect() as client:
        for tool in DATA_TOOLS:
            asked_s = time.time()
            answer = await ask(client, tool)
            header = [answer[name] for name in ("robot", "run_id", "sim_time_s", "status")]
            assert header == ["rover", robot.run_id, 12.3457, "running"], tool
            assert asked_s - written_s - 0.01 < answer["age_s"] < time.time() - written_s + 0.01


async def test_a_new_run_without_a_state_points_to_the_one_before(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    earlier = robot.run_id
    robot.begin_run("reset")
    async with connect() as client:
        answer = await ask(client, "webots_get_robot_state")
    assert f"in an earlier one (run_id={earlier})" in answer["hint"]


async def test_several_live_robots_are_listed_until_one_is_named(
    connect: Connect, recorded: Recorded
) -> None:
    for name in ("rover", "crane"):
        recorded.robot(name).state(1.0, {"i am": name})
    async with connect() as client:
        assert "'rover' (Supervisor, live)" in await fail(client, "webots_get_robot_state")
        answer = await ask(client, "webots_get_robot_state", robot="crane")
        assert answer["state"] == {"i am": "crane"}
        assert "Did you mean 'crane'" in await fail(client, "webots_get_robot_state", robot="crne")
        rows = (await ask(client, "webots_list_robots"))["robots"]["rows"]
        assert [row[0] for row in rows] == ["rover", "crane"]


async def test_a_time_that_is_infinite_is_null_and_the_answer_still_json(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    robot.state(float("inf"), {"x": 2})
    async with connect() as client:
        for tool in DATA_TOOLS:
            result = await client.call_tool(tool)
            assert not result.is_error, text_of(result)
            assert json.loads(text_of(result), parse_constant=pytest.fail)["sim_time_s"] is None
