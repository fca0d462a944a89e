"""A world with an observer: no controller knows of us, and yet all is seen and steered."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from anyio import to_thread
from mcp import Client

from tests.server.conftest import ask
from tests.simulator.conftest import (
    CONTROLLER,
    StartWebots,
    free_port,
    wait_for_line,
    write_project,
)
from tests.waiting import until
from webots_mcp.server.mcp_server import create_server
from webots_mcp.setup.file_change import apply
from webots_mcp.setup.observer_edits import controller_change, with_observer
from webots_mcp.simulator.instances import instances
from webots_mcp.simulator.orders import give_order

pytestmark = pytest.mark.anyio
DRIVES = """
from math import inf
from controller import Robot
robot = Robot()
for name, radps in (("left wheel motor", 3.0), ("right wheel motor", 5.0)):
    robot.getDevice(name).setPosition(inf)
    robot.getDevice(name).setVelocity(radps)
while robot.step(16) != -1:
    pass
"""
PLAIN = CONTROLLER.replace("Supervisor", "Robot")
HANGS = (
    PLAIN
    + """
    while robot.getTime() > 0.2:
        pass
"""
)
HANGS_AT_ONCE = PLAIN.replace("while robot", "while True:\n    pass\nwhile robot")
RESETS = (
    CONTROLLER
    + """
    if robot.getTime() > 0.8:
        robot.simulationReset()
"""
)


@pytest.fixture
def begin(tmp_path: Path, start_webots: StartWebots) -> Callable[..., Client]:
    """A Webots without --stream, whose world has an observer, and a client."""

    def started(controller: str, *options: str) -> Client:
        world = write_project(tmp_path / "project", controller)
        world.write_bytes(with_observer(world.read_bytes()))
        apply(controller_change(tmp_path / "project"))
        process = start_webots("--stdout", *options, f"--port={free_port()}", world)
        wait_for_line(process, "mcp_observer: Starting")
        data = tmp_path / "project" / "mcp_data"
        return Client(create_server(data / "webots.db", data))

    return started


async def once(client: Client, tool: str, reached: Callable[[dict[str, Any]], Any]) -> Any:
    """What a tool answers once it is so."""

    async def look() -> dict[str, Any] | None:
        result = await client.call_tool(tool, {})
        answer = result.structured_content or {}
        return answer if not result.is_error and answer.get("robot") else None

    return await until(look, reached)


def in_world(answer: dict[str, Any]) -> dict[str, dict[str, Any]]:
    table = answer["in_world"]
    rows = [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]
    return {row["key"]: row for row in rows}


def moves(answer: dict[str, Any]) -> bool:
    return bool(answer.get("in_world")) and (in_world(answer)["ROVER"].get("speed_mps") or 0) > 0.05


@pytest.mark.slow
async def test_a_controller_that_knows_nothing_of_us_is_seen_and_asked_about(begin: Any) -> None:
    async with begin(DRIVES, "--mode=fast") as client:
        world = await once(client, "webots_get_world_info", moves)
        assert (world["observer"], world["robot"]) == ("mcp_observer", "mcp_observer")
        assert (
            in_world(world)["ROVER"] | {"type": "Robot", "name": "rover"}
            == in_world(world)["ROVER"]
        )
        assert world["title"]
        await once(client, "webots_get_robot_state", lambda at: at["sim_time_s"] > 5)
        position = ["world.ROVER.x_m", "world.ROVER.y_m"]
        trends = await ask(client, "webots_get_trends", signals=[*position])
        assert trends["robot"] == "mcp_observer"
        both = {"kinds": ["stuck", "standstill"], "position": position}
        events = await ask(client, "webots_find_events", **both)
        assert "found" not in events["verdicts"]  # it drives in circles
        assert len(json.dumps(world)) < 6000


@pytest.mark.slow
async def test_a_robot_that_is_no_supervisor_is_steered_by_the_observer(begin: Any) -> None:
    async with begin(PLAIN) as client:
        await once(client, "webots_get_world_info", lambda at: at.get("in_world"))
        await once(client, "webots_get_robot_state", lambda at: at["robot"] == "rover")
        answers: dict[str, dict[str, Any]] = {}
        for command in ("pause", "resume", "fast", "step", "resume", "reset", "reload"):
            answers[command] = await ask(
                client, "webots_simulation_control", command=command, robot="rover"
            )
        told = {name: (answer["outcome"], answer["route"]) for name, answer in answers.items()}
        assert set(told.values()) == {("done", "observer")}
        assert answers["resume"]["evidence"].startswith("simulation time advanced to ")
        assert answers["reload"]["evidence"].endswith("began")


@pytest.mark.slow
async def test_a_controller_that_hangs_is_told_from_a_pause_and_ended_by_a_reload(
    begin: Any,
) -> None:
    async with begin(HANGS) as client:

        def is_silent(answer: dict[str, Any]) -> bool:
            return answer["robot"] == "rover" and answer["status"].startswith("stopped")

        stopped = await once(client, "webots_get_world_info", is_silent)
        assert "not paused, as robot 'mcp_observer' sees" in stopped["why"]
        found = (await ask(client, "webots_diagnose_setup"))["failed"]
        (simulation,) = [each for each in found if each["check"] == "Simulation"]
        assert "paused by hand" not in simulation["seen"]
        # Of the robot whose loop hangs, or of the observer, whichever was seen last.
        assert "computes" in simulation["seen"]
        assert "rover" in simulation["seen"]
        answer = await ask(
            client, "webots_simulation_control", command="reload", robot="rover", timeout_wall_s=60
        )
        assert (answer["outcome"], answer["route"]) == ("done", "observer")


@pytest.mark.slow
async def test_a_loop_that_hangs_before_its_first_step_does_not_hold_up_the_observer(
    begin: Any,
) -> None:
    async with begin(HANGS_AT_ONCE) as client:

        def is_unseen(answer: dict[str, Any]) -> bool:
            return answer["robot"] == "rover" and answer["status"].startswith("not seen moving")

        await once(client, "webots_get_world_info", is_unseen)
        answer = await ask(
            client, "webots_simulation_control", command="reload", robot="rover", timeout_wall_s=60
        )
        assert (answer["outcome"], answer["route"]) == ("done", "observer")


@pytest.mark.slow
async def test_a_pause_by_hand_is_taken_back_by_the_observer(begin: Any) -> None:
    async with begin(DRIVES, "--stream") as client:
        await once(client, "webots_get_world_info", moves)
        (webots,) = await to_thread.run_sync(instances)
        await to_thread.run_sync(give_order, webots.address, "pause", 10.0)
        stopped = await once(
            client, "webots_get_robot_state", lambda at: at["status"].startswith("stopped")
        )
        assert "paused in Webots, as robot 'mcp_observer' sees" in stopped["why"]
        found = (await ask(client, "webots_diagnose_setup"))["failed"]
        (simulation,) = [each for each in found if each["check"] == "Simulation"]
        assert simulation["fix"].startswith("webots_simulation_control('resume')")
        answer = await ask(client, "webots_simulation_control", command="resume")
        assert (answer["outcome"], answer["route"]) == ("done", "observer")
        assert answer["evidence"].startswith("simulation time advanced to ")


@pytest.mark.slow
async def test_an_observer_makes_exactly_the_steps_that_were_asked_for(begin: Any) -> None:
    async with begin(DRIVES, "--mode=realtime") as client:
        await once(client, "webots_get_world_info", moves)
        paused = await ask(client, "webots_simulation_control", command="pause")
        assert paused["outcome"] == "done"
        for steps in (12, 7):
            before = await ask(client, "webots_simulation_control", command="step", steps=1)
            answer = await ask(client, "webots_simulation_control", command="step", steps=steps)
            result, began = answer["result"], before["result"]
            assert result["steps"] == steps and "warning" not in result
            assert result["mode"] == "pause"
            advanced_s = result["sim_time_s"] - began["sim_time_s"]
            assert advanced_s == pytest.approx(result["advanced_s"]) == steps * 0.016


@pytest.mark.slow
async def test_an_observers_steps_are_counted_across_resets(begin: Any) -> None:
    async with begin(RESETS, "--mode=realtime") as client:
        await once(client, "webots_get_world_info", lambda at: at.get("in_world"))
        asked = {"command": "step", "steps": 120, "robot": "mcp_observer"}
        answer = await ask(client, "webots_simulation_control", **asked)
        assert (answer["outcome"], answer["result"]["steps"]) == ("done", 120)
        assert answer["result"]["advanced_s"] == pytest.approx(120 * 0.016)
        assert answer["result"]["sim_time_s"] < 1.0
