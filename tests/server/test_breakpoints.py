"""Breakpoints by tool: a real client, a real server, a real bridge, a robot of the stand-in."""

from __future__ import annotations

import json
from typing import Any

import pytest
from mcp import Client

from tests.server.conftest import Connect, Driver, ask, ask_until, fail
from tests.waiting import wait_for

pytestmark = pytest.mark.anyio


async def newest_state(client: Client) -> dict[str, Any]:
    """The answer about the robot's state, once there is one."""
    return await ask_until(client, "webots_get_robot_state", lambda told: "state" in told)


@pytest.mark.slow
async def test_a_breakpoint_pauses_at_the_step_and_is_listed_and_removed(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        at = (await newest_state(client))["state"]["steps"] + 60
        answer = await ask(client, "webots_breakpoint", condition=f"steps == {at}")
        assert answer["armed"] is True
        assert "notes" not in answer and "hint" not in answer
        state = await ask_until(
            client, "webots_get_robot_state", lambda told: told["status"] == "paused"
        )
        assert state["state"]["steps"] == at
        assert state["why"] == f"breakpoint at {state['sim_time_s']:.3f} s: steps == {at}"

        listed = await ask(client, "webots_list_breakpoints")
        row = dict(zip(listed["breakpoints"]["columns"], listed["breakpoints"]["rows"][0]))  # noqa: B905
        assert row["id"] == answer["breakpoint_id"]
        assert (row["hit_count"], row["newest_hit_s"]) == (1, state["sim_time_s"])

        events = await ask(client, "webots_find_events", kinds=["bridge_event"])
        assert f"steps == {at}" in json.dumps(events["events"])

        removed = await ask(
            client, "webots_remove_breakpoint", breakpoint_id=answer["breakpoint_id"]
        )
        assert removed["armed"] is False and "hint" not in removed
        assert "hint" in await ask(client, "webots_list_breakpoints")
        await ask(client, "webots_simulation_control", command="resume")


async def test_it_says_what_is_not_there_and_refuses_what_is_no_condition(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        await newest_state(client)
        answer = await ask(
            client, "webots_breakpoint", condition="stesp > 5 and pose[0] > 1e9", action="log"
        )
        (note,) = answer["notes"]
        assert note.startswith("No signal 'stesp' is published. The nearest of ")
        assert "write ==" in await fail(client, "webots_breakpoint", condition="steps = 5")
        known = answer["breakpoint_id"]
        wrong = await fail(client, "webots_remove_breakpoint", breakpoint_id=known + 7)
        assert f"Its breakpoints are {known}." in wrong


async def test_one_that_would_go_off_at_once_says_so(connect: Connect, driver: Driver) -> None:
    async with connect() as client:
        await newest_state(client)
        answer = await ask(client, "webots_breakpoint", condition="mode > 1", action="log")
        (note,) = answer["notes"]
        assert note.startswith("it will be turned off by the next state like the last ones")
        assert "with the number 1 by >" in note


async def test_where_no_controller_runs_it_is_said_that_none_is_asked_and_which_come_back(
    connect: Connect, driver: Driver
) -> None:
    wait_for(lambda: driver.bridge.breakpoint("steps == 1000000"))  # its loop may hold the lock
    async with connect() as client:
        before = await ask(client, "webots_list_breakpoints")
        assert before["breakpoints"]["rows"] and "hint" not in before
        driver.stop()
        listed = await ask(client, "webots_list_breakpoints")
        assert "breakpoints" not in listed
        assert "this robot has none" in listed["hint"]
        assert "those that its code had set ended with it" in listed["hint"]
        await ask(client, "webots_breakpoint", condition="steps == 2000000", action="log")
        listed = await ask(client, "webots_list_breakpoints")
        assert [row[1] for row in listed["breakpoints"]["rows"]] == ["steps == 2000000"]
        assert listed["hint"].startswith("no controller of this robot runs to ask any")
