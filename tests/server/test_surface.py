"""What a client sees before it asks anything, in both eras, in memory and over stdio."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import pytest
from mcp import Client, StdioServerParameters

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, ask, fail
from tests.tool_list import counts_of

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
    "webots_query_history",
    "webots_get_trends",
    "webots_find_events",
    "webots_list_runs",
    "webots_check_run",
    "webots_compare_runs",
    "webots_plot",
    "webots_query_sql",
    "webots_get_scene",
}
ACTING = {
    "webots_annotate_run",
    "webots_describe_signals",
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
    "webots_edit_scene",
    "webots_launch_world",
}
SHARED = ("robot", "run_id", "last_s", "start_s", "end_s", "timeout_wall_s", "cursor")


def serve(file: Path, *options: str) -> StdioServerParameters:
    arguments = ["-m", "webots_mcp", "serve", "--database", str(file), *options]
    return StdioServerParameters(command=sys.executable, args=arguments, env=dict(os.environ))


def same(answer: Any) -> Any:
    """An answer without what the clock moves on."""
    return {name: value for name, value in answer.items() if name not in ("age_s", "why", "status")}


@pytest.mark.parametrize(("read_only", "names"), [(False, READING | ACTING), (True, READING)])
async def test_exactly_the_named_tools_are_there(
    connect: Connect, read_only: bool, names: set[str]
) -> None:
    async with connect(read_only=read_only) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == names


@pytest.mark.parametrize(
    ("core", "tools", "size", "tokens"), [(False, 34, 33_000, 7_600), (True, 18, 18_400, 4_200)]
)
async def test_the_list_is_short(
    connect: Connect, core: bool, tools: int, size: int, tokens: int
) -> None:
    async with connect(core=core) as client:
        listed = await client.list_tools()
    counted = counts_of(listed.tools)
    assert counted.tools <= tools
    assert counted.bytes <= size
    assert counted.tokens <= tokens
    assert listed.ttl_ms


async def test_a_tool_that_is_not_listed_answers_when_it_is_called(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    async with connect(core=True, read_only=True) as client:
        assert (await ask(client, "webots_get_sensors"))["hint"]
        with pytest.raises(AssertionError, match="There is no tool"):
            await ask(client, "webots_world_resets")


async def test_a_tool_that_steers_says_that_the_server_only_reads(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    async with connect(read_only=True) as client:
        for name in ("webots_world_reset", "webots_set_field"):
            assert "this server is --read-only" in await fail(client, name)


@pytest.mark.parametrize(
    ("old", "merged", "arguments"),
    [
        ("webots_get_timeline", ("webots_find_events", "timeline"), {"limit": 3}),
        ("webots_list_signals", ("webots_get_trends", "signals"), {"pattern": "x"}),
        ("webots_get_trials", ("webots_list_runs", "trials"), {}),
        ("webots_get_parameters", ("webots_list_commands", "parameters"), {}),
        ("webots_list_breakpoints", ("webots_list_commands", "breakpoints"), {}),
        ("webots_wait_for_command", ("webots_list_commands", "outcome"), {"command_id": 1}),
        ("webots_get_field", ("webots_get_scene", "field"), {"path": "X"}),
    ],
)
async def test_a_merged_tool_answers_as_the_one_that_it_took_in(
    connect: Connect,
    recorded: Recorded,
    old: str,
    merged: tuple[str, str],
    arguments: dict[str, Any],
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    tool, what = merged
    async with connect(read_only=True) as client:
        first = await client.call_tool(old, arguments)
        second = await client.call_tool(tool, arguments | {"what": what})
    assert first.is_error == second.is_error
    if not first.is_error:
        assert same(first.structured_content) == same(second.structured_content)


async def test_an_argument_of_another_part_of_a_merged_tool_is_refused_with_those_there_are(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    async with connect() as client:
        told = await fail(client, "webots_find_events", what="timeline", where="x > 1")
        assert "where has no meaning with what='timeline': there is kinds, log_level" in told
        assert "value" in await fail(client, "webots_edit_scene", action="set", path="X.y")
        assert "action" in await fail(client, "webots_edit_scene", path="X.y")


async def test_the_schemas_of_answers_are_listed_where_they_are_asked_for(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    async with connect(output_schemas=True) as client:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools}
        assert tools["webots_find_events"].output_schema
        for what in ("events", "timeline"):
            assert "verdicts" in await ask(client, "webots_find_events", what=what)


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


@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_both_eras_are_served_in_memory(
    connect: Connect, recorded: Recorded, mode: str
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    async with connect(mode=mode) as client:
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


async def test_what_a_tool_does_is_said_as_it_is(connect: Connect) -> None:
    async with connect() as client:
        notes = {tool.name: tool.annotations for tool in (await client.list_tools()).tools}
    told = {name: note for name, note in notes.items() if note and not note.read_only_hint}
    assert {name for name, note in told.items() if not note.destructive_hint} == {
        "webots_annotate_run",
        "webots_breakpoint",
        "webots_describe_signals",
        "webots_set_parameters",
        "webots_take_screenshot",
    }
    assert {name for name, note in told.items() if note.idempotent_hint} == {
        "webots_annotate_run",
        "webots_set_parameters",
    }


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
