"""The controller's variables by tool: a real client, a real server, a real bridge."""

from __future__ import annotations

from typing import Any

import pytest

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, Driver, ask, ask_until, fail
from tests.waiting import wait_for

pytestmark = pytest.mark.anyio


async def test_events_lead_to_the_variables_of_a_hit(connect: Connect, driver: Driver) -> None:
    async with connect(tools="all") as client:
        await ask_until(client, "webots_get_robot_state", lambda told: "state" in told)
        await ask(client, "webots_breakpoint", condition="mode == 'cruise'", action="log")
        found = await ask_until(
            client, "webots_get_timeline", lambda told: "inspection" in str(told.get("events"))
        )
        event_id = _last_inspection(found)
        answer = await ask(client, "webots_inspect_controller", event_id=event_id)
        assert answer["event_id"] == event_id
        assert answer["cause"] == "breakpoint: mode == 'cruise'"
        assert answer["frames"][0]["function"] == "run"
        assert answer["summary"].startswith(f"At {answer['at_s']:.12g} s (breakpoint: mode")
        assert "variables" in answer["frames"][0]
        speed = await ask(client, "webots_inspect_controller", path="self.speed", event_id=event_id)
        assert (speed["path"], speed["value"]) == ("self.speed", 1.0)
        assert (speed["line"], speed["event_id"]) == (answer["frames"][0]["at"], event_id)
        assert "frames" not in speed
        error = await fail(client, "webots_inspect_controller", path="self.sped", event_id=event_id)
        assert "'sped' of self was not recorded; recorded of it: " in error


async def test_now_a_path_and_a_watch(connect: Connect, driver: Driver) -> None:
    async with connect(tools="all") as client:
        await ask_until(client, "webots_get_robot_state", lambda told: "state" in told)
        now = await ask(client, "webots_inspect_controller")
        assert now["summary"].startswith("Now: ")
        assert any("self" in each["variables"] for each in now["frames"])
        speed = await ask(client, "webots_inspect_controller", path="self.speed")
        assert (speed["path"], speed["value"]) == ("self.speed", 1.0)
        watch = await ask(client, "webots_watch", path="self.speed")
        assert watch["result"]["signal"] == "watched.self.speed"
        await ask_until(
            client,
            "webots_get_robot_state",
            lambda told: told["state"].get("watched") == {"self.speed": 1.0},
        )
        error = await fail(client, "webots_inspect_controller", path="self.sped")
        assert "Driver has no 'sped'" in error
        error = await fail(client, "webots_inspect_controller", path="self.speed", run_id=1)
        assert "Give event_id" in error


async def test_of_a_recording_without_inspections_it_says_when_there_are_any(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot("rover", ended_wall_time_s=1.0, end_reason="finished").state(0.0, {"x": 1})
    async with connect(tools="all") as client:
        answer = await ask(client, "webots_inspect_controller")
        assert "no variables are recorded in this run" in answer["hint"]
        assert "and none runs" in await fail(client, "webots_inspect_controller", path="x")
        error = await fail(client, "webots_inspect_controller", event_id=1)
        assert "event 1 has no variables of the controller" in error


async def test_a_rule_of_the_project_forbids_it(connect: Connect, driver: Driver) -> None:
    file = driver.bridge.data_dir / "webots-mcp.toml"
    file.write_text('[allow]\nactions = ["*", "!inspect", "!watch"]\n', "utf-8")
    wait_for(lambda: driver.bridge.run_id)
    async with connect(tools="all") as client:
        for tool, given in (("webots_inspect_controller", {}), ("webots_watch", {"path": "self"})):
            assert "not allowed" in await fail(client, tool, **given)


def _last_inspection(found: dict[str, Any]) -> int:
    events = found["events"]
    columns = events["columns"]
    details = [dict(zip(columns, row, strict=True)).get("details") for row in events["rows"]]
    return next(each["event_id"] for each in details[::-1] if each and "event_id" in each)
