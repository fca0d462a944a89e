"""The whole way: a real client, a real server, a real bridge, a robot of the stand-in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client

from tests.server.conftest import STEP_MS, Connect, Driver, ask, fail, pictures_of, text_of
from tests.waiting import until

pytestmark = pytest.mark.anyio


async def control(client: Client, command: str, **arguments: object) -> dict[str, object]:
    return await ask(client, "webots_simulation_control", command=command, **arguments)


async def test_a_custom_action_answers_or_fails_with_its_own_words(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        actions = (await ask(client, "webots_list_commands"))["actions"]
        assert actions["set_speed"] == "Set the speed: `speed` in rad/s."
        answer = await ask(client, "webots_send_command", action="set_speed", params={"speed": 3.5})
        assert answer["result"] == {"speed": 3.5}
        assert driver.speed == 3.5
        failed = json.loads(await fail(client, "webots_send_command", action="break_down"))
        assert "the gear is gone" in failed["error"]
        again = await ask(client, "webots_reset_controller_state")
        assert again["result"] == {"callbacks": 1}
        assert driver.speed == 1.0


async def test_a_screenshot_is_a_picture_with_a_caption(
    connect: Connect, driver: Driver, file: Path
) -> None:
    async with connect() as client:
        result = await client.call_tool("webots_take_screenshot", {})
    caption = json.loads(text_of(result))
    assert caption["outcome"] == "done"
    assert len(pictures_of(result)) == 1
    assert Path(caption["file"]).is_file()
    assert Path(caption["file"]).is_relative_to(file.parent)
    assert driver.is_alive()


async def test_a_frame_is_taken_now_though_the_controller_saves_none(
    connect: Connect, driver: Driver, file: Path
) -> None:
    async with connect() as client:
        disabled = await fail(client, "webots_get_camera", camera="camera", fresh=True)
        assert "robot.getDevice('camera').enable(time_step)" in disabled
        driver.bridge.register_command("look", lambda _: enable(driver.robot))
        await ask(client, "webots_send_command", action="look")
        result = await client.call_tool("webots_get_camera", {"camera": "camera", "fresh": True})
        lidar = await client.call_tool("webots_get_camera", {"camera": "lidar", "fresh": True})
        recorded = await client.call_tool("webots_get_camera", {"camera": "lidar"})
    caption = json.loads(text_of(result))
    assert caption["result"]["camera"] == "camera"
    assert Path(caption["file"]).is_relative_to(file.parent)
    assert "a ring each" in json.loads(text_of(lidar))["result"]["scale"]
    assert [len(pictures_of(each)) for each in (result, lidar, recorded)] == [1, 1, 1]
    assert driver.is_alive()


def enable(robot: Any) -> None:
    """And wait for the first picture."""
    for name in ("camera", "lidar"):
        robot.devices[name].enable(STEP_MS)
    robot.step(STEP_MS)


async def test_a_frame_that_is_taken_now_is_not_one_of_the_past(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        await ask(client, "webots_get_robot_state")
        for past in ({"at_s": 1.0}, {"frames": 2}, {"run_id": 1}):
            assert "it excludes at_s" in await fail(client, "webots_get_camera", fresh=True, **past)
    async with connect(read_only=True) as client:
        assert "--read-only" in await fail(client, "webots_get_camera", fresh=True)


@pytest.mark.slow
async def test_watching_reports_what_was_recorded_meanwhile(
    connect: Connect, driver: Driver
) -> None:
    reports: list[str] = []

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        assert total is not None
        assert progress <= total
        reports.append(message or "")

    answer: dict[str, Any] = {}
    async with connect() as client, anyio.create_task_group() as tasks:
        tasks.start_soon(_steer, client, driver, reports)
        arguments = {"duration_wall_s": 3}
        watch = client.call_tool("webots_monitor", arguments, progress_callback=on_progress)
        answer |= json.loads(text_of(await watch))
    assert answer["row_count"] > 10
    assert answer["movement"]["position"] == ["pose.0", "pose.1"]
    assert answer["movement"]["distance_m"] > 0
    (trend,) = answer["trends"]
    assert trend["row_count"] == answer["row_count"]
    assert {row[0] for row in trend["numbers"]["rows"]} == {"pose.0", "steps"}
    columns, rows = answer["events"]["columns"], answer["events"]["rows"]
    events = [dict(zip(columns, row, strict=True)) for row in rows]
    changes = json.dumps([event["details"] for event in events if event["name"] == "mode"])
    assert '"turn"' in changes  # each change by itself, or all together where a fast machine
    assert '"cruise"' in changes  # has made many
    noticed = [event["details"]["what"] for event in events if event["kind"] == "bridge_event"]
    assert noticed == ["pause", "resume"]
    assert [e["name"] for e in events if e["kind"] == "command"] == ["pause", "resume"]
    logs = [event["details"]["message"] for event in events if event["kind"] == "log"]
    assert logs == ["too close"]
    assert all(report.startswith("rover: ") for report in reports)


async def _steer(client: Client, driver: Driver, reports: list[str]) -> None:
    await until(lambda: reports)
    driver.bridge.log("too close", level="warning")
    driver.bridge.log("all is well")
    await control(client, "pause")
    await control(client, "resume")


@pytest.mark.slow
async def test_watching_a_paused_robot_says_that_nothing_was_recorded_and_why(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        await control(client, "pause")
        answer = await ask(client, "webots_monitor", duration_wall_s=1)
        assert answer["row_count"] == 0
        assert "paused" in answer["hint"]
        assert driver.is_alive()
