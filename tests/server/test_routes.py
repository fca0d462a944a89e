"""Steering past the controller: Webots' WebSocket, its keys, and what is said where none works."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcp import Client

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, Driver, ask, ask_until, fail
from tests.simulator.conftest import (
    CONTROLLER,
    StartWebots,
    free_port,
    wait_for_line,
    write_project,
)
from tests.simulator.webots_server import WebotsServer
from webots_mcp.contract import host_name
from webots_mcp.server.mcp_server import create_server

pytestmark = pytest.mark.anyio

HANGS = """
import time
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot, throttle_interval=1)
while robot.step(16) != -1:
    bridge.publish({"time_s": robot.getTime()})
    bridge.get_command()
    if robot.getTime() > 0.2:
        print("hangs", flush=True)
        time.sleep(600)
"""
PLAIN = CONTROLLER.replace("Supervisor", "Robot")


async def control(client: Client, command: str, **arguments: object) -> dict[str, Any]:
    return await ask(client, "webots_simulation_control", command=command, **arguments)


@pytest.fixture
def in_project(
    tmp_path: Path, start_webots: StartWebots
) -> Callable[..., tuple[subprocess.Popen[str], Client]]:
    """A Webots with this controller, and a client of a server on what it records."""

    def begin(controller: str, *options: str, ready: str = "ready") -> Any:
        world = write_project(tmp_path / "project", controller)
        process = start_webots("--stdout", *options, f"--port={free_port()}", world)
        wait_for_line(process, ready)
        data = tmp_path / "project" / "mcp_data"
        return process, Client(create_server(data / "webots.db", data))

    return begin


@pytest.mark.slow
async def test_a_robot_that_is_no_supervisor_is_steered_by_webots_itself(in_project: Any) -> None:
    process, client = in_project(PLAIN, "--stream")
    async with client:
        paused = await control(client, "pause")
        assert (paused["outcome"], paused["route"]) == ("done", "websocket")
        assert paused["evidence"] == "Webots replied 'paused by client'"
        assert wait_for_line(process, "pause") == "pause\n"
        stepped = await control(client, "step", steps=3, timeout_wall_s=30)
        assert stepped["evidence"].startswith("Webots made 3 of 3 basic time steps; ")
        resumed = await control(client, "resume", timeout_wall_s=30)
        assert resumed["evidence"].startswith(
            "Webots replied 'real-time'; simulation time advanced to "
        )
        fast = await control(client, "fast", timeout_wall_s=30)
        assert fast["evidence"].startswith("Webots replied 'fast'; simulation time advanced")


@pytest.mark.slow
async def test_a_controller_that_hangs_is_freed_by_a_reload_of_webots(in_project: Any) -> None:
    _, client = in_project(HANGS, "--stream", "--mode=fast", ready="hangs")
    async with client:
        state = await ask(client, "webots_get_robot_state")
        await _until_its_loop_is_silent(client)
        answer = await control(client, "reload", timeout_wall_s=60)
        assert (answer["outcome"], answer["route"]) == ("done", "websocket")
        assert answer["evidence"].endswith(f"run {answer['run_id']} began")
        assert answer["run_id"] > state["run_id"]
        await _until_its_loop_is_silent(client)
        again = await ask(client, "webots_world_reset", timeout_wall_s=60)
        assert again["evidence"].endswith(f"run {again['run_id']} began")
        assert again["run_id"] > answer["run_id"]


async def _until_its_loop_is_silent(client: Client) -> None:
    await ask_until(client, "webots_get_world_info", lambda told: told["status"] != "running")


async def test_a_loop_that_turns_is_asked_itself(in_project: Any) -> None:
    process, client = in_project(HANGS.replace("> 0.2", "> 1e9"), "--stream", ready="Starting")
    async with client:
        await ask_until(client, "webots_get_robot_state", lambda told: told["status"] == "running")
        answer = await control(client, "pause")
        assert (answer["route"], answer["status"]) == ("bridge", "paused")
        assert "command_id" in answer
    assert process.poll() is None


@pytest.mark.slow
async def test_without_stream_each_way_says_why_it_does_not_work(in_project: Any) -> None:
    _, client = in_project(PLAIN)
    async with client:
        text = await fail(client, "webots_simulation_control", command="resume", timeout_wall_s=5)
    assert "bridge: resume needs a Supervisor" in text
    assert "websocket: Webots at 127.0.0.1:" in text
    assert "was started without --stream" in text
    assert "keyboard: not tried: it presses keys" in text
    assert "Press Ctrl+2 in Webots, start Webots with --stream, or open the world with an" in text


async def test_a_webots_without_any_controller_of_ours_is_found_and_steered(
    in_project: Any,
) -> None:
    _, client = in_project("print('ready', flush=True)", "--stream")
    async with client:
        answer = await control(client, "pause")
    assert (answer["route"], answer["outcome"]) == ("websocket", "done")
    assert "run_id" not in answer


@pytest.mark.slow
async def test_a_reset_that_nothing_shows_is_not_told_as_a_start_without_stream(
    in_project: Any,
) -> None:
    _, client = in_project("print('ready', flush=True)", "--stream")
    async with client:
        assert (await control(client, "pause"))["route"] == "websocket"
        result = await client.call_tool("webots_simulation_control", {"command": "reset"})
    assert "was started without --stream" not in str(result.content)
    assert not result.is_error or "it may have obeyed" in str(result.content)


async def test_a_webots_of_another_project_is_steered_only_if_its_port_is_named(
    tmp_path: Path, start_webots: StartWebots, connect: Connect
) -> None:
    world = write_project(tmp_path / "another", "print('ready', flush=True)")
    port = free_port()
    process = start_webots("--stdout", "--stream", f"--port={port}", world)
    wait_for_line(process, "ready")
    async with connect() as client:
        text = await fail(client, "webots_simulation_control", command="pause", force=True)
        for way in ("websocket", "keyboard"):
            assert f"{way}: the Webots that runs here is not of this recording's project" in text
        assert f"{world} at port {port}" in text
        answer = await control(client, "pause", port=port)
        (world.parents[1] / "webots-mcp.toml").write_text("[allow]\nactions = ['resume']\n")
        text = await fail(client, "webots_simulation_control", command="pause", port=port)
        assert "another/webots-mcp.toml, line 2: actions = ['resume']" in Path(text).as_posix()
    assert (answer["route"], answer["outcome"]) == ("websocket", "done")


async def test_a_webots_that_took_the_port_of_a_session_that_is_over_is_not_taken_for_it(
    tmp_path: Path, start_webots: StartWebots, connect: Connect, recorded: Recorded
) -> None:
    world = write_project(tmp_path / "another", "print('ready', flush=True)")
    port = free_port()
    wait_for_line(start_webots("--stdout", "--stream", f"--port={port}", world), "ready")
    robot = recorded.robot(instance=f"{host_name()}:{port}")
    robot.beat(ended_wall_time_s=robot.now, end_reason="finished")
    async with connect() as client:
        text = await fail(client, "webots_simulation_control", command="pause", timeout_wall_s=5)
    assert "is not of this recording's project" in text


async def test_a_port_that_is_not_that_of_the_robot_is_not_steered_by_its_controller(
    tmp_path: Path, start_webots: StartWebots, connect: Connect, driver: Driver
) -> None:
    world = write_project(tmp_path / "another", "print('ready', flush=True)")
    port = free_port()
    wait_for_line(start_webots("--stdout", "--stream", f"--port={port}", world), "ready")
    async with connect() as client:
        answer = await control(client, "pause", port=port)
        state = await ask(client, "webots_get_world_info")
    assert (answer["route"], state["status"]) == ("websocket", "running")
    assert driver.is_alive()


@pytest.mark.slow
async def test_a_reset_that_webots_says_nothing_of_is_proven_by_the_run_that_begins(
    connect: Connect, recorded: Recorded
) -> None:
    def reset(word: str) -> None:
        assert word == "reset"
        robot.end_run("reset")
        robot.begin_run("reset")

    with WebotsServer(streams=True, on_order=reset) as server:
        robot = recorded.robot(supervisor=False)
        recorded.connection.execute(
            "UPDATE session SET instance = ?", (f"{host_name()}:{server.port}",)
        )
        async with connect() as client:
            answer = await ask(client, "webots_world_reset", timeout_wall_s=20)
    assert (answer["route"], answer["evidence"]) == ("websocket", "run 2 began")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="each system has its own keys")
async def test_forced_keys_without_a_window_say_so(
    connect: Connect, recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    with WebotsServer(streams=False) as server:
        recorded.robot(supervisor=False)
        recorded.connection.execute(
            "UPDATE session SET instance = ?", (f"{host_name()}:{server.port}",)
        )
        async with connect() as client:
            text = await fail(client, "webots_world_reset", force=True, timeout_wall_s=1)
    assert "keyboard: No Webots of this machine listens at" in text
    assert json.dumps(text).count("keyboard: ") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere 127.0.0.2 is nobody, for long")
async def test_a_webots_of_another_machine_is_not_taken_for_one_here_on_the_same_port(
    tmp_path: Path, start_webots: StartWebots, connect: Connect, recorded: Recorded
) -> None:
    port = free_port()
    world = write_project(tmp_path / "project", "print('ready', flush=True)")
    wait_for_line(start_webots("--stdout", f"--port={port}", world), "ready")
    recorded.robot(supervisor=False)
    recorded.connection.execute("UPDATE session SET instance = ?", (f"127.0.0.2:{port}",))
    async with connect() as client:
        text = await fail(client, "webots_world_reset", force=True, timeout_wall_s=1)
    assert f"keyboard: No Webots of this machine listens at 127.0.0.2:{port}" in text
