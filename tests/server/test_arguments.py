"""What a tool cannot mean is refused with what it can."""

from __future__ import annotations

import json
import re
import string
from pathlib import Path
from typing import Any, Final

import anyio
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from mcp.server.mcpserver import Context
from mcp.server.mcpserver.exceptions import ToolError

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, Driver, ask, fail, text_of
from webots_mcp import MemoryDatabase
from webots_mcp.questions import all_questions
from webots_mcp.server.tools import tool_of
from webots_mcp.store.recording import RecordingAccess

pytestmark = pytest.mark.anyio

HUGE = 2**63


@pytest.mark.parametrize(
    ("tool", "arguments", "told"),
    [
        (
            "compare_runs",
            {"runs": [1, 2]},
            "Unknown argument 'runs'. webots_compare_runs takes run_ids, ",
        ),
        ("get_trends", {"params": {"robot": "a"}, "run_id": 1}, "Unknown argument 'params'"),
        (
            "get_trends",
            {"params": {"strt_s": 1}},
            "Unknown argument 'strt_s'. webots_get_trends takes start_s, ",
        ),
        ("get_trends", {"params": "robot"}, "Unknown argument 'params'"),
        ("get_logs", {"response_format": "yaml"}, "response_format must be 'json' or 'markdown'"),
        ("get_logs", {"force": True}, "Unknown argument 'force'. webots_get_logs takes "),
        ("monitor", {"duration": 120}, "duration must be less than or equal to 90, not 120"),
        ("list_robots", {"x": 1}, "Unknown argument 'x'. webots_list_robots takes no arguments."),
        ("query_history", {}, "signals is missing"),
        ("query_history", {"signals": ["x"], "max_points": 501}, "max_points must be less than"),
        ("query_history", {"signals": []}, "signals must have at least 1 item, not []"),
        ("get_trends", {"last_s": 0}, "last_s must be greater than 0, not 0"),
        ("get_trends", {"start_s": 1e308}, "start_s must be a number of seconds, not 1e+308"),
        ("get_camera", {"at_s": "nan"}, "at_s must be a number of seconds, not 'nan'"),
        (
            "get_trends",
            {"run_id": HUGE},
            f"run_id must be an id from an earlier answer, not {HUGE}",
        ),
        ("plot", {"run_ids": [1, HUGE]}, "run_ids.1 must be the number of a run, or a range"),
        (
            "get_logs",
            {"level": "loud"},
            "level must be 'debug', 'info', 'warning', 'error' or 'critical', not",
        ),
        ("query_sql", {"sql": "x" * 10**6}, "sql must have at most"),
        ("get_trends", {"since_wall_time": [1]}, "since_wall_time must be a valid number, not [1]"),
        ("get_logs", {"lines": 1e308}, "lines must be a smaller number, not 1e+308"),
        ("get_logs", {"n" * 10**5: 1}, "Unknown argument 'nnn"),
        (
            "get_trends",
            {"signal": ["x"]},
            "Unknown argument 'signal'. webots_get_trends takes signals, ",
        ),
        (
            "find_events",
            {"strt_s": 1},
            "Unknown argument 'strt_s'. webots_find_events takes start_s, ",
        ),
        (
            "find_events",
            {"for_s": 2.0},
            "Unknown argument 'for_s'. webots_find_events takes start_s, ",
        ),
        (
            "query_history",
            {"signals": ["x"], "cursor": 3},
            "cursor continues only the rows of raw=true. Add raw=true",
        ),
        (
            "monitor",
            {"duration_wall_s": 2, "lookback_wall_s": 9},
            "duration_wall_s and lookback_wall_s exclude each other. Give ",
        ),
        (
            "monitor",
            {"duration_wall_s": 2, "duration": 9},
            "duration and duration_wall_s exclude each other. Give ",
        ),
        (
            "send_command",
            {"speed": 1},
            "Unknown argument 'speed'. Names of the controller go into `params`: "
            'webots_send_command(action=..., params={"speed":1})',
        ),
        (
            "set_parameters",
            {"kp": 1.5, "when": "reset"},
            "Unknown argument 'kp'. Names of the controller go into `values`: "
            'webots_set_parameters(when="reset", values={"kp":1.5})',
        ),
        ("run", {"duration": 5}, "Unknown argument 'duration'. webots_run takes for_s, "),
        ("run", {"condition": "x > 1"}, "Unknown argument 'condition'. webots_run takes until, "),
        (
            "run",
            {"kp": 2, "duration_s": 5},
            "Unknown argument 'duration_s'. webots_run takes for_s, ",
        ),
        (
            "send_command",
            {"command": "go"},
            "Unknown argument 'command'. webots_send_command takes action, ",
        ),
        (
            "run",
            {"seconds": 5, "until": "x > 1"},
            "Unknown argument 'seconds'. webots_run takes for_s, ",
        ),
        (
            "simulation_control",
            {"command": "pause", "steps": 2},
            "steps is possible only with command='step'",
        ),
        ("get_trends", {"robot": "r" * 201}, "robot must have at most 200 characters, not"),
    ],
)
async def test_the_answer_names_the_parameter_what_it_takes_and_what_came(
    connect: Connect, tool: str, arguments: dict[str, Any], told: str
) -> None:
    async with connect() as client:
        answer = await client.call_tool(f"webots_{tool}", arguments)
    assert answer.is_error
    assert text_of(answer).removeprefix(f"Error executing tool webots_{tool}: ").startswith(told)
    assert len(text_of(answer)) < 600


@pytest.mark.parametrize(
    ("tool", "arguments", "told"),
    [
        (
            "get_timeline",
            {"cursor": "x"},
            ": 'x' is not a cursor of this tool. Give the `cursor` of",
        ),
        (
            "get_trends",
            {"since_wall_time": "n" * 10**5},
            "nnn' is not a time. Give Unix seconds or ISO 8601",
        ),
        ("get_trends", {"signals": ["n" * 10**5]}, "No signal 'nnn"),
    ],
)
async def test_what_a_question_refuses_is_told_briefly_in_the_words_of_the_tool(
    connect: Connect, recorded: Recorded, tool: str, arguments: dict[str, Any], told: str
) -> None:
    recorded.robot().state(1.0, {"y": 1})
    async with connect() as client:
        answer = await fail(client, f"webots_{tool}", **arguments)
    assert told in answer
    assert len(answer) < 4_200


async def test_a_parameter_that_may_be_left_out_may_be_null_as_well(connect: Connect) -> None:
    async with connect() as client:
        for name, value in (("robot", None), ("cursor", None), ("limit", None)):
            answer = await client.call_tool("webots_list_commands", {name: value})
            assert not answer.is_error


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("get_world_info", {"params": {"response_format": "markdown"}}),
        ("get_robot_state", {"params": {"response_format": "json"}}),
        ("get_sensors", {"params": '{"response_format": "json"}'}),
        ("get_full_state", {"params": {}}),
        ("get_camera", {"params": {}}),
        ("get_logs", {"params": {"lines": 20, "filter_text": None}}),
        ("monitor", {"params": {"duration": 1}}),
        ("simulation_control", {"params": {"command": "step"}}),
        ("world_reset", {"params": {"force": False}}),
        ("reset_controller_state", {"params": {}}),
        ("take_screenshot", {"params": {}}),
        ("send_command", {"params": {"action": "set_speed", "params": {"speed": 2.0}}}),
        ("world_reset", {"response_format": "markdown"}),
    ],
)
async def test_the_calls_of_a_server_whose_tools_take_one_object_are_understood(
    connect: Connect, driver: Driver, tool: str, arguments: dict[str, Any]
) -> None:
    async with connect() as client:
        answer = await client.call_tool(f"webots_{tool}", arguments)
    assert not answer.is_error, text_of(answer)


async def test_a_reload_may_be_forced(connect: Connect) -> None:
    async with connect() as client:
        told = await fail(client, "webots_world_reload", force=True)
    assert "keyboard: " in told and "needs force=true" not in told


async def test_every_schema_says_that_there_are_no_other_parameters(connect: Connect) -> None:
    async with connect() as client:
        tools = (await client.list_tools()).tools
    assert tools
    assert all(tool.input_schema["additionalProperties"] is False for tool in tools)


async def test_one_name_is_taken_for_a_list_of_one(connect: Connect, recorded: Recorded) -> None:
    recorded.robot().state(1.0, {"pose": {"x": 1, "y": 2}})
    arguments: dict[str, Any] = {"raw": True, "run_id": 1}
    async with connect() as client:
        for names in ("pose.x", ["pose.x"], '["pose.x"]'):
            answer = await ask(client, "webots_query_history", signals=names, **arguments)
            assert answer["raw"]["signals"] == {"pose.x": [1]}
        assert "not [1, 1]" in await fail(client, "webots_compare_runs", run_ids=[1, 1])
        assert "run 1" in str((await ask(client, "webots_compare_runs", run_ids=1))["groups"])
        answer = await ask(client, "webots_find_events", kinds="run")
        assert answer["verdicts"]["found"] == {"run": 1}


async def test_a_misspelt_signal_is_answered_with_the_nearest_names(
    connect: Connect, recorded: Recorded
) -> None:
    names = ["aa", "battery_v", "sensors.front", "sensors.rear", "zz.pose_x"]
    recorded.robot().state(1.0, dict.fromkeys(names, 1))
    async with connect() as client:
        for wrong, near in (
            ("nope", "zz.pose_x"),
            ("FRONT", "sensors.front"),
            ("batery", names[1]),
        ):
            told = await fail(client, "webots_get_trends", signals=[wrong])
            assert f"No signal {wrong!r} is recorded. The nearest of 5 signals: {near}" in told


@pytest.mark.parametrize(
    ("tool", "arguments", "near"),
    [
        ("find_events", {"kinds": ["stucked"]}, "stuck"),
        ("get_logs", {"level": "warn"}, "warning"),
        ("simulation_control", {"command": "resumee"}, "resume"),
        ("simulation_control", {"command": "stop"}, "pause"),
        ("simulation_control", {"command": "start"}, "resume"),
        ("list_commands", {"status": "canceled"}, "cancelled"),
    ],
)
async def test_a_near_miss_of_a_choice_is_offered_what_was_perhaps_meant(
    connect: Connect, tool: str, arguments: dict[str, Any], near: str
) -> None:
    async with connect() as client:
        told = await fail(client, f"webots_{tool}", **arguments)
    assert f"; did you mean {near!r}? " in told
    assert re.search(r"\? \w+: [A-Z]", told), "what the argument means"


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("simulation_control", {"command": "resett"}),
        ("simulation_control", {"command": "reloaded"}),
        ("edit_scene", {"action": "removed", "path": "BALL"}),
        ("world", {"action": "quitt"}),
        ("breakpoint", {"change": "remov"}),
        ("send_command", {"action": "resett"}),
        ("send_command", {"action": "delete_node"}),
        ("send_command", {"action": "erase_mapp"}),
    ],
)
async def test_nothing_that_loses_something_is_offered_as_what_was_meant(
    connect: Connect, recorded: Recorded, tool: str, arguments: dict[str, Any]
) -> None:
    recorded.robot(actions='{"erase_map": "Forget the map."}')
    async with connect() as client:
        told = await fail(client, f"webots_{tool}", **arguments)
    assert "did you mean" not in told


@pytest.mark.parametrize(
    ("tool", "arguments", "call"),
    [
        ("set_parameters", {"speed": 4}, 'webots_set_parameters(values={"speed":4})'),
        (
            "set_parameters",
            {"robot": "rover", "speed": 4, "gait": "trot"},
            'webots_set_parameters(robot="rover", values={"speed":4,"gait":"trot"})',
        ),
        (
            "send_command",
            {"action": "go_to", "x": 1.5},
            'webots_send_command(action="go_to", params={"x":1.5})',
        ),
        ("run", {"kp": 2}, 'webots_run(parameters={"kp":2})'),
        ("run", {"values": {"kp": 2}}, 'webots_run(parameters={"kp":2})'),
        (
            "send_command",
            {"text": "a" * 1_000, "timeout_wall_s": 3.0},
            "webots_send_command(action=..., timeout_wall_s=3.0, params={...})",
        ),
    ],
)
async def test_names_of_the_controller_are_shown_in_the_argument_that_takes_them(
    connect: Connect, tool: str, arguments: dict[str, Any], call: str
) -> None:
    async with connect() as client:
        told = await fail(client, f"webots_{tool}", **arguments)
    assert told.endswith(f": {call}")


_NAMES: Final = st.text(string.ascii_letters + "_", min_size=1, max_size=12)
_PLAIN: Final = st.one_of(st.booleans(), st.integers(-9, 9), st.text(max_size=400))
_VALUES: Final = st.dictionaries(_NAMES, _PLAIN, min_size=1, max_size=5)
_OWN: Final = st.fixed_dictionaries({}, optional={"robot": st.text(max_size=200)})


@pytest.mark.slow
@pytest.mark.parametrize("name", [each.name for each in all_questions() if each.of_controller])
@given(_VALUES | st.fixed_dictionaries({"arguments": _VALUES}), _OWN)
def test_a_suggested_call_has_all_that_its_tool_requires_and_nothing_else(
    name: str, unknown: dict[str, Any], own: dict[str, Any]
) -> None:
    (question,) = (each for each in all_questions() if each.name == name)
    recording = RecordingAccess(MemoryDatabase(), Path("unused"))
    tool = tool_of(question, recording)
    arguments = own | {key: value for key, value in unknown.items() if key not in own}
    allowed = tool.parameters["properties"]
    assume(arguments.keys() - allowed.keys())
    with pytest.raises(ToolError) as refused:
        anyio.run(tool.run, arguments, Context[Any]())
    said = str(refused.value)
    if f": {name}(" not in said:
        assert " takes " in said and said.split(" takes ")[1].split(", ")[0].rstrip(".") in allowed
        return
    call = call_of(said.partition(f": {name}(")[2].removesuffix(")"))
    assert call.keys() <= allowed.keys()
    assert call.keys() >= {*tool.parameters.get("required", ()), *own}
    shown = {key: value for key, value in call.items() if value is not ...}
    if shown.keys() >= {*tool.parameters.get("required", ())}:
        tool.fn_metadata.arg_model.model_validate(shown)


def call_of(text: str) -> dict[str, Any]:
    """The arguments of a suggested call; `...` where one stands for its value."""
    found: dict[str, Any] = {}
    while text:
        name, _, text = text.partition("=")
        dots = next((each for each in ("{...}", "...") if text.startswith(each)), None)
        value, end = (..., len(dots)) if dots else json.JSONDecoder().raw_decode(text)
        found[name], text = value, text[end:].removeprefix(", ")
    return found


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("WEBOTS_GET_LOGS", "Did you mean webots_get_logs"),
        ("webots_get_stat", "webots_get_robot_state"),
        ("webots_get_robot_stat", "Did you mean webots_get_robot_state"),
        ("webots_find_event", "Did you mean webots_find_events"),
        ("webots_get_timelines", "Did you mean webots_get_timeline"),  # one that is not listed
        ("webots_world_reste", "tools/list names all tools."),  # nothing that loses something
        ("x" * 100_000, "tools/list names all tools."),
    ],
)
async def test_a_misspelt_tool_is_refused_with_the_nearest_one(
    connect: Connect, name: str, told: str
) -> None:
    async with connect() as client:
        answer = await client.call_tool(name, {})
    assert answer.is_error
    assert text_of(answer).startswith(f"There is no tool '{name[:20]}")
    assert told in text_of(answer)
    assert len(text_of(answer)) < 300
