"""What a client sees before it asks anything, in both eras, in memory and over stdio."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import pytest
from mcp import Client, StdioServerParameters

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, ask

pytestmark = pytest.mark.anyio

READING = {
    "webots_list_robots",
    "webots_diagnose",
    "webots_get_world_info",
    "webots_get_robot_state",
    "webots_get_sensors",
    "webots_get_full_state",
    "webots_get_camera",
    "webots_get_logs",
    "webots_monitor",
    "webots_list_commands",
    "webots_get_parameters",
    "webots_get_trials",
    "webots_wait_for_command",
    "webots_list_signals",
    "webots_query_history",
    "webots_get_trends",
    "webots_find_events",
    "webots_get_timeline",
    "webots_list_runs",
    "webots_compare_runs",
    "webots_plot",
    "webots_query_sql",
    "webots_list_breakpoints",
    "webots_get_scene",
    "webots_get_field",
}
ACTING = {
    "webots_annotate_run",
    "webots_report",
    "webots_set_parameters",
    "webots_take_screenshot",
    "webots_simulation_control",
    "webots_run",
    "webots_run_trials",
    "webots_world_reload",
    "webots_world_reset",
    "webots_reset_controller_state",
    "webots_send_command",
    "webots_breakpoint",
    "webots_remove_breakpoint",
    "webots_set_field",
    "webots_add_node",
    "webots_remove_node",
    "webots_launch_world",
    "webots_load_world",
    "webots_quit",
}
SHARED = ("robot", "run_id", "last_s", "start_s", "end_s", "timeout_s", "cursor")


def serve(file: Path, *options: str) -> StdioServerParameters:
    arguments = ["-m", "webots_mcp", "serve", "--database", str(file), *options]
    return StdioServerParameters(command=sys.executable, args=arguments, env=dict(os.environ))


@pytest.mark.parametrize(("read_only", "names"), [(False, READING | ACTING), (True, READING)])
async def test_exactly_the_named_tools_are_there(
    connect: Connect, read_only: bool, names: set[str]
) -> None:
    async with connect(read_only=read_only) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == names


async def test_every_tool_says_what_it_is_and_whether_it_changes_anything(
    connect: Connect,
) -> None:
    async with connect() as client:
        for tool in (await client.list_tools()).tools:
            assert tool.title
            assert tool.description
            assert tool.annotations is not None
            assert tool.annotations.read_only_hint == (tool.name in READING)
            assert tool.annotations.open_world_hint is False


async def test_every_parameter_is_described_and_flat(connect: Connect) -> None:
    async with connect() as client:
        for tool in (await client.list_tools()).tools:
            for name, schema in tool.input_schema.get("properties", {}).items():
                assert schema.get("description"), f"{tool.name}({name})"
                flat = schema.get("type") != "object" or name in ("params", "values", "parameters")
                assert flat, f"{tool.name}({name})"


async def test_shared_parameters_mean_the_same_in_every_tool(connect: Connect) -> None:
    seen: dict[str, Any] = {}
    async with connect() as client:
        for tool in (await client.list_tools()).tools:
            for name, schema in tool.input_schema.get("properties", {}).items():
                if name in SHARED and tool.name != "webots_simulation_control":
                    words = seen.setdefault(name, schema["description"])
                    assert schema["description"] == words, tool.name
    assert set(seen) == set(SHARED)


async def test_arguments_out_of_bounds_are_refused_with_the_bound(connect: Connect) -> None:
    async with connect() as client:
        for tool, arguments in [
            ("webots_get_logs", {"lines": 0}),
            ("webots_monitor", {"duration_s": 500}),
            ("webots_simulation_control", {"command": "fly"}),
            ("webots_simulation_control", {"command": "step", "steps": 10**9}),
        ]:
            result = await client.call_tool(tool, arguments)
            assert result.is_error


@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_both_eras_are_served_in_memory(
    connect: Connect, recorded: Recorded, mode: str
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    async with connect(mode=mode) as client:
        assert (await ask(client, "webots_get_robot_state"))["state"] == {"x": 1}


@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_both_eras_are_served_over_stdio(recorded: Recorded, mode: Any) -> None:
    recorded.robot().state(1.0, {"x": 1})
    assert isinstance(recorded.database, Path)
    async with Client(serve(recorded.database), mode=mode) as client:
        assert (await ask(client, "webots_get_robot_state"))["state"] == {"x": 1}


async def test_over_stdio_a_server_without_a_database_starts_and_says_what_to_do(
    tmp_path: Path,
) -> None:
    file = tmp_path / "folder" / "webots.db"
    async with Client(serve(file, "--read-only")) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == READING
        answer = await ask(client, "webots_get_robot_state")
        assert client.instructions
        assert "webots_list_robots" in client.instructions
    assert answer["status"] == "never seen"
    assert str(file) in answer["hint"]
    assert not file.parent.exists()
