"""Webots' console, as who asks the server or the command line reads it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcp import Client

from tests.recordings.rows import Recorded, insert
from tests.server.conftest import Connect, ask, fail, text_of
from tests.simulator.conftest import (
    CONTROLLER,
    StartWebots,
    free_port,
    wait_for_line,
    write_project,
)
from tests.waiting import until
from webots_mcp.server.mcp_server import create_server
from webots_mcp.simulator import console
from webots_mcp.simulator.instances import instances
from webots_mcp.simulator.own_webots import belongs
from webots_mcp.store.recording import RecordingAccess

pytestmark = pytest.mark.anyio

FAILS = """
print("about to fail")
import nothing_of_that_name
"""


@pytest.fixture(autouse=True)
def looked_for_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """A Webots that starts is followed at once, not five seconds later."""
    often = replace(console._TIMES, first_search_s=0.2, search_s=0.5)
    monkeypatch.setattr(console, "_TIMES", often)


Lines = list[list[Any]]


def of_a_run(lines: Lines) -> bool:
    return bool(lines) and lines[0][3] is not None


async def lines_with(
    client: Client, text: str, reached: Callable[[Lines], bool] = bool, **arguments: object
) -> Lines:
    """Rows of log lines with a text, as soon as there is one."""

    async def look() -> Lines | None:
        answer = await client.call_tool("webots_get_logs", {"filter_text": text, **arguments})
        return (answer.structured_content or {}).get("lines", {}).get("rows")

    return await until(look, reached)


@pytest.mark.slow
async def test_a_server_records_what_the_controllers_of_its_project_print(
    tmp_path: Path, start_webots: StartWebots
) -> None:
    world = write_project(tmp_path / "project", CONTROLLER)
    data = tmp_path / "project" / "mcp_data"
    async with Client(create_server(data / "webots.db", data)) as client:
        wait_for_line(start_webots("--stdout", f"--port={free_port()}", world), "ready")
        found = await lines_with(client, "ready", of_a_run, source="console")
        assert [row[1:] for row in found] == [["info", "console: ready", 1]]
        own = await lines_with(client, "Starting controller", source="webots")
        assert own[0][2].startswith("webots: INFO: ")
        answer = await ask(client, "webots_get_logs", source="console")
        assert "is followed; it was started without --stream" in answer["hint"]
        assert "is followed" not in (await ask(client, "webots_get_logs")).get("hint", "")


@pytest.mark.slow
async def test_why_a_controller_never_recorded_is_told_before_there_is_a_run(
    tmp_path: Path, start_webots: StartWebots
) -> None:
    world = write_project(tmp_path / "project", FAILS)
    data = tmp_path / "project" / "mcp_data"
    RecordingAccess(data / "webots.db", data).create()
    async with Client(create_server(data / "webots.db", data)) as client:
        process = start_webots("--stdout", "--stderr", f"--port={free_port()}", world)
        wait_for_line(process, "about to fail")
        ((time_s, _, message, run_id),) = await lines_with(client, "ModuleNotFoundError")
        assert "nothing_of_that_name" in message
        assert (time_s, run_id) == (None, None)
        answer = await ask(client, "webots_get_logs")
        assert "before a run began" in answer["hint"]
    arguments = [sys.executable, "-m", "webots_mcp", "logs", "--data-dir", str(data)]
    told = subprocess.run(arguments, capture_output=True, text=True, check=True, env=os.environ)
    assert "console: ModuleNotFoundError" in told.stdout


async def test_a_webots_whose_controllers_record_elsewhere_is_not_followed(
    tmp_path: Path, start_webots: StartWebots, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = write_project(tmp_path / "project", CONTROLLER)
    data = tmp_path / "project" / "mcp_data"
    monkeypatch.setenv("WEBOTS_MCP_DATA_DIR", str(tmp_path / "trial"))
    wait_for_line(start_webots("--stdout", f"--port={free_port()}", world), "ready")
    (elsewhere,) = instances()
    for folder, is_its in ((data, False), (tmp_path / "trial", True)):
        RecordingAccess(folder / "webots.db", folder).create()
        assert belongs(elsewhere, RecordingAccess(folder / "webots.db", folder)) == is_its


@pytest.mark.slow
async def test_a_server_that_only_reads_follows_nothing_and_says_so(
    tmp_path: Path, start_webots: StartWebots
) -> None:
    world = write_project(tmp_path / "project", CONTROLLER)
    data = tmp_path / "project" / "mcp_data"
    wait_for_line(start_webots("--stdout", f"--port={free_port()}", world), "ready")
    async with Client(create_server(data / "webots.db", data, read_only=True)) as client:
        answer = await ask(client, "webots_get_logs", source="console")
    assert "is not followed: a server with --read-only does not" in answer["hint"]


async def test_a_line_that_may_be_of_any_robot_of_a_simulation_is_told_of_each(
    connect: Connect, recorded: Recorded
) -> None:
    rover, referee = recorded.robot("rover"), recorded.robot("referee")
    elsewhere = recorded.robot("elsewhere", instance="another")
    for source, message in (("console", "foul"), ("webots", "WARNING: slow"), ("bridge", "its")):
        stamp = {"run_id": referee.run_id, "sim_time_s": 1.0, "wall_time_s": referee.now}
        line = {"level": "info", "source": source, "message": message}
        insert(recorded.connection, "log", stamp | line)
    rover.log(2.0, "mine")
    async with connect() as client:
        for scope in ({}, {"run_id": rover.run_id}):
            answer = await ask(client, "webots_get_logs", robot="rover", **scope)
            told = [row[2] for row in answer["lines"]["rows"]]
            assert told == ["console: foul", "webots: WARNING: slow", "mine"]
            assert answer["total"] == 3
        other = await ask(client, "webots_get_logs", robot=elsewhere.name)
        assert other["lines"]["rows"] == []
        assert "'x'" in await fail(client, "webots_get_logs", source="x")


async def test_what_waits_for_a_run_is_told_beside_several_robots_of_the_past(
    connect: Connect, recorded: Recorded
) -> None:
    said = {"instance": "here:1234", "wall_time_s": time.time(), "level": "info"}
    insert(recorded.connection, "console_line", {
        **said, "source": "console", "message": "No module named 'arm'", "logger": "stdout"
    })  # fmt: skip
    robots = [recorded.robot(name) for name in ("hunter", "runner")]
    async with connect() as client:
        assert "2 robots are live" in await fail(client, "webots_get_logs")
        for robot in robots:
            robot.beat(ended_wall_time_s=robot.now, end_reason="finished")
        answer = await ask(client, "webots_get_logs")
    assert answer["lines"]["rows"] == [[None, "info", "console: No module named 'arm'", None]]


async def test_what_the_console_says_of_a_controller_that_never_recorded_is_named(
    connect: Connect, recorded: Recorded
) -> None:
    insert(recorded.connection, "console_line", {
        "instance": "here:1234", "wall_time_s": time.time(), "level": "warning",
        "source": "webots", "message": "WARNING: bot exited with status: 1.",
    })  # fmt: skip
    named = "bot exited with status: 1.': a controller may have failed before it recorded anything"
    async with connect() as client:
        for tool in ("list_robots", "get_robot_state", "find_events", "check_run", "diagnose"):
            answer = await client.call_tool(f"webots_{tool}", {})
            assert named in text_of(answer), tool
        told = await ask(client, "webots_get_logs", level="error")
        assert (told["total"], told["hint"][:25]) == (0, "no robot has recorded yet")
        assert [row[2] for row in told["lines"]["rows"]] == [
            "webots: WARNING: bot exited with status: 1."
        ]
        none = await ask(client, "webots_get_logs", filter_text="no such words")
        assert "lines" not in none and none["total"] == 0


async def test_a_controller_that_failed_after_another_run_is_named_until_one_records_again(
    connect: Connect, recorded: Recorded
) -> None:
    begun_s = time.time()
    past = recorded.robot(
        started_wall_time_s=begun_s, ended_wall_time_s=begun_s, end_reason="finished"
    )
    past.state(1.0, {"x": 1})
    for source, message in (
        ("console", "[bot] ModuleNotFoundError: No module named 'arm'"),
        ("webots", "WARNING: bot exited with status: 1."),
    ):
        insert(recorded.connection, "console_line", {
            "instance": "here:1234", "wall_time_s": begun_s + 1.0, "level": "warning",
            "source": source, "message": message,
        })  # fmt: skip
    async with connect() as client:
        for tool in ("get_robot_state", "find_events", "check_run", "get_trends"):
            why = (await ask(client, f"webots_{tool}"))["why"]
            assert "No module named 'arm'\" and 'WARNING: bot exited with status: 1.'" in why, tool
        assert "No module named 'arm'" in (await ask(client, "webots_list_robots"))["hint"]
        later_s = begun_s + 2.0
        past.beat(ended_wall_time_s=later_s)
        recorded.robot(
            "later", started_wall_time_s=later_s, ended_wall_time_s=later_s, end_reason="finished"
        )
        answer = await ask(client, "webots_check_run", robot="later")
        assert "console" not in answer.get("why", "")


@pytest.mark.slow
async def test_the_command_line_follows_what_comes(recorded: Recorded, file: Path) -> None:
    robot = recorded.robot()
    robot.log(1.0, "first")
    arguments = [sys.executable, "-m", "webots_mcp", "logs", "--follow", "--database", str(file)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
        wait_for_line(process, "first")
        robot.log(2.0, "second")
        assert wait_for_line(process, "second") == "2 info 1 second\n"
        process.terminate()


@pytest.mark.slow
async def test_programs_follow_an_object_for_each_line(recorded: Recorded, file: Path) -> None:
    robot = recorded.robot()
    robot.log(1.0, "first")
    arguments = [sys.executable, "-m", "webots_mcp", "logs", "--follow", "--json", "--database"]
    with subprocess.Popen([*arguments, file], stdout=subprocess.PIPE, text=True) as process:
        assert json.loads(wait_for_line(process, "first"))["message"] == "first"
        robot.log(2.0, "second", level="error")
        row = json.loads(wait_for_line(process, "second"))
        assert (row["sim_time_s"], row["level"], row["run_id"]) == (2.0, "error", 1)
        process.terminate()


@pytest.mark.slow
async def test_following_goes_on_with_its_robot_when_another_one_begins_to_record(
    recorded: Recorded, file: Path
) -> None:
    robot = recorded.robot("rover")
    robot.log(1.0, "first")
    arguments = [sys.executable, "-m", "webots_mcp", "logs", "--follow", "--database", str(file)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
        wait_for_line(process, "first")
        recorded.robot("arm").log(1.0, "of the arm")
        robot.log(2.0, "second")
        assert wait_for_line(process, "second") == "2 info 1 second\n"
        process.terminate()
