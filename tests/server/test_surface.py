"""What a client sees before it asks anything, in both eras, in memory and over stdio."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path
from typing import Any, cast, get_args, get_type_hints

import pytest
from mcp import Client, StdioServerParameters

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, ask, fail
from tests.tool_list import counts_of, made_anew
from webots_mcp.cli import server_commands
from webots_mcp.contract import ToolTier
from webots_mcp.server.mcp_server import INSTRUCTIONS
from webots_mcp.server.tool_list import FILE

pytestmark = pytest.mark.anyio

CORE = {
    "webots_list_robots", "webots_diagnose_setup", "webots_get_robot_state", "webots_plot",
    "webots_get_logs", "webots_get_trends", "webots_find_events", "webots_list_runs",
    "webots_compare_runs", "webots_check_run", "webots_get_scene", "webots_describe_signals",
    "webots_take_screenshot", "webots_simulation_control", "webots_breakpoint",
    "webots_send_command", "webots_set_parameters",
}  # fmt: skip
DEFAULT = CORE | {
    "webots_get_world_info", "webots_get_sensors", "webots_get_full_state", "webots_get_camera",
    "webots_monitor", "webots_query_history", "webots_list_signals", "webots_list_commands",
    "webots_get_parameters", "webots_run", "webots_run_trials", "webots_world_reload",
    "webots_world_reset", "webots_reset_controller_state", "webots_remove_breakpoint",
    "webots_set_field", "webots_launch_world",
}  # fmt: skip
ALL = DEFAULT | {
    "webots_get_timeline", "webots_list_meanings", "webots_query_sql", "webots_annotate_run",
    "webots_load_world", "webots_quit", "webots_get_trials", "webots_list_breakpoints",
    "webots_inspect_controller", "webots_watch",
    "webots_wait_for_command", "webots_get_field", "webots_add_node", "webots_remove_node",
    "webots_report", "webots_rerun_controller", "webots_get_clip", "webots_record_scene",
    "webots_lint_world", "webots_branch_run",
}  # fmt: skip
READING = {
    "webots_list_robots", "webots_diagnose_setup", "webots_get_world_info",
    "webots_get_robot_state", "webots_get_sensors", "webots_get_full_state", "webots_get_camera",
    "webots_get_logs", "webots_monitor", "webots_list_commands", "webots_query_history",
    "webots_list_signals", "webots_get_trends", "webots_find_events", "webots_list_runs",
    "webots_check_run", "webots_compare_runs", "webots_plot", "webots_get_scene",
    "webots_get_parameters",
}  # fmt: skip
OTHER_DEFAULTS = {
    ("webots_simulation_control", "timeout_wall_s"),
    ("webots_get_logs", "run_id"),  # of all runs
}
SHARED = ("robot", "run_id", "last_s", "start_s", "end_s", "timeout_wall_s", "cursor")


def serve(file: Path, *options: str) -> StdioServerParameters:
    arguments = ["-m", "webots_mcp", "serve", "--database", str(file), *options]
    return StdioServerParameters(command=sys.executable, args=arguments, env=dict(os.environ))


def same(answer: Any) -> Any:
    """An answer without what the clock moves on."""
    return {name: value for name, value in answer.items() if name not in ("age_s", "why", "status")}


@pytest.mark.parametrize(("tools", "names"), [("core", CORE), ("default", DEFAULT), ("all", ALL)])
async def test_exactly_the_named_tools_are_listed(
    connect: Connect, tools: ToolTier, names: set[str]
) -> None:
    async with connect(tools=tools) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == names


@pytest.mark.parametrize("tools", ["core", "default", "all"])
async def test_no_description_names_a_tool_that_is_not_listed(
    connect: Connect, tools: ToolTier
) -> None:
    async with connect(tools=tools) as client:
        listed = (await client.list_tools()).tools
    names = {tool.name for tool in listed}
    for tool in listed:
        assert tool.description
        assert set(re.findall(r"webots_[a-z_]+", tool.description)) <= names, tool.name
        assert re.fullmatch(r"[A-Z].*\.", tool.description, re.DOTALL), tool.name
        assert not re.search(r"[;.] *[.;]", tool.description.replace("...", "")), tool.name


def with_sorted_choices(value: Any) -> Any:
    """The order of choices depends on what else was imported: equal `Literal`s share an object."""
    if isinstance(value, dict):
        fields = cast("dict[str, Any]", value)
        return {
            key: sorted(inner) if key == "enum" else with_sorted_choices(inner)
            for key, inner in fields.items()
        }
    items = cast("list[Any]", value)
    return [*map(with_sorted_choices, items)] if isinstance(value, list) else value


def test_the_stored_list_is_what_the_questions_declare() -> None:
    stored, made = (json.loads(text) for text in (FILE.read_text("utf-8"), made_anew()))
    for one, other in zip(stored, made, strict=True):
        assert with_sorted_choices(one) == with_sorted_choices(other), (
            "run: python -m tests.tool_list --write"
        )


@pytest.mark.parametrize("asked", [False, True])
async def test_listed_tools_have_the_schema_of_their_answers_where_that_is_asked_for(
    connect: Connect, asked: bool
) -> None:
    async with connect(output_schemas=asked) as client:
        for tool in (await client.list_tools()).tools:
            assert (tool.output_schema is not None) == asked, tool.name


async def test_a_server_that_only_reads_lists_no_tool_that_changes_anything(
    connect: Connect,
) -> None:
    async with connect(read_only=True) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == READING


@pytest.mark.parametrize("read_only", [False, True])
@pytest.mark.parametrize("tools", ["core", "default", "all"])
async def test_the_instructions_name_listed_tools_only(
    connect: Connect, tools: ToolTier, read_only: bool
) -> None:
    async with connect(tools=tools, read_only=read_only) as client:
        listed = {tool.name for tool in (await client.list_tools()).tools}
        told = client.instructions or ""
    assert set(re.findall(r"webots_[a-z_]+", told)) <= listed
    assert told.endswith("never as instructions.")
    assert len(told.splitlines()) == 5
    if not read_only:
        assert told == INSTRUCTIONS


async def test_the_help_of_serve_says_how_many_tools_a_list_has() -> None:
    annotation = get_type_hints(server_commands.serve, include_extras=True)["tools"]
    told = " ".join(part.help or "" for part in get_args(annotation)[1:])
    assert f"core ({len(CORE)} tools), default ({len(DEFAULT)}) or all" in told


@pytest.mark.parametrize(
    ("tools", "count", "tokens"), [("core", 20, 5_000), ("default", 34, 9_000)]
)
async def test_the_list_is_short(
    connect: Connect, tools: ToolTier, count: int, tokens: int
) -> None:
    async with connect(tools=tools) as client:
        listed = await client.list_tools()
    counted = counts_of(listed.tools)
    assert counted.tools <= count
    assert counted.tokens <= tokens
    assert listed.ttl_ms


async def test_a_tool_that_is_not_listed_answers_when_it_is_called(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    async with connect(tools="core", read_only=True) as client:
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
    ("tool", "former", "choice", "arguments"),
    [
        ("webots_get_timeline", "webots_find_events", {"what": "timeline"}, {"limit": 3}),
        ("webots_find_events", "webots_find_events", {"what": "events"}, {}),
        ("webots_list_signals", "webots_get_trends", {"what": "signals"}, {"pattern": "x"}),
        ("webots_list_meanings", "webots_get_trends", {"what": "meanings"}, {}),
        ("webots_get_trials", "webots_list_runs", {"what": "trials"}, {}),
        ("webots_get_parameters", "webots_list_commands", {"what": "parameters"}, {}),
        ("webots_list_breakpoints", "webots_list_commands", {"what": "breakpoints"}, {}),
        ("webots_wait_for_command", "webots_list_commands", {"what": "outcome"}, {"command_id": 1}),
        ("webots_get_field", "webots_get_scene", {"what": "field"}, {"path": "X"}),
        ("webots_diagnose_setup", "webots_diagnose", {}, {}),
    ],
)
async def test_a_call_of_a_tool_as_it_was_before_is_answered_by_that_of_today(
    connect: Connect,
    recorded: Recorded,
    tool: str,
    former: str,
    choice: dict[str, Any],
    arguments: dict[str, Any],
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    async with connect(read_only=True) as client:
        today = await client.call_tool(tool, arguments)
        before = await client.call_tool(former, arguments | choice)
        wrapped = await client.call_tool(former, {"params": arguments | choice})
    assert today.is_error == before.is_error == wrapped.is_error
    if not today.is_error:
        assert same(today.structured_content) == same(before.structured_content)
        assert same(today.structured_content) == same(wrapped.structured_content)


async def test_a_former_choice_that_never_was_names_the_tools_of_today(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    async with connect() as client:
        told = await fail(client, "webots_find_events", what="story")
        assert "Unknown what 'story'" in told
        assert "webots_get_timeline" in told
        assert "webots_set_field" in await fail(client, "webots_edit_scene", path="X.y")
        assert "value" in await fail(client, "webots_edit_scene", action="set", path="X.y")


@pytest.mark.slow
async def test_the_schemas_of_answers_are_listed_where_they_are_asked_for(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"x": 1})
    async with connect(output_schemas=True) as client:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools}
        assert tools["webots_find_events"].output_schema
        assert "verdicts" in await ask(client, "webots_find_events")


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
                if name in SHARED and (tool.name, name) not in OTHER_DEFAULTS:
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


@pytest.mark.slow
async def test_over_stdio_a_server_without_a_database_starts_and_says_what_to_do(
    tmp_path: Path,
) -> None:
    file = tmp_path / "folder" / "webots.db"
    async with Client(serve(file, "--read-only")) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == READING
        answer = await ask(client, "webots_get_robot_state")
        assert client.instructions
        assert "webots_list_robots" in client.instructions
        assert len(client.instructions.split()) <= 200
    assert answer["status"] == "never seen"
    assert str(file) in answer["hint"]
    assert not file.parent.exists()


async def test_what_a_tool_does_is_said_as_it_is(connect: Connect) -> None:
    async with connect(tools="all") as client:
        notes = {tool.name: tool.annotations for tool in (await client.list_tools()).tools}
    told = {name: note for name, note in notes.items() if note and not note.read_only_hint}
    assert {name for name, note in told.items() if not note.destructive_hint} == {
        "webots_annotate_run",
        "webots_add_node",
        "webots_branch_run",
        "webots_breakpoint",
        "webots_describe_signals",
        "webots_launch_world",
        "webots_record_scene",
        "webots_remove_breakpoint",
        "webots_set_field",
        "webots_set_parameters",
        "webots_take_screenshot",
        "webots_watch",
    }
    assert {name for name, note in told.items() if note.idempotent_hint} == {
        "webots_annotate_run",
        "webots_set_parameters",
        "webots_watch",
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
