"""A wrong call is refused with what the next, right call needs; that call then works."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
from mcp import Client

from tests.recordings.rows import Recorded, RecordedRobot
from tests.server.conftest import Connect, text_of
from tests.server.test_parameters import TunableDriver, tunable  # a fixture
from tests.waiting import until

__all__ = ["tunable"]
pytestmark = pytest.mark.anyio


class Case(NamedTuple):
    """A wrong call, what its error has to name, and the arguments of the call that follows.

    Attributes:
        tool: The tool that is called wrongly, without `webots_`.
        needs: What the reader of the error needs in order to make the right call.
        then: The tool of the right call, if it is another one.
    """

    tool: str
    wrong: dict[str, Any]
    needs: tuple[str, ...]
    right: dict[str, Any]
    then: str = ""


def condition(wrong: str, need: str, right: str) -> Case:
    """A condition that is not of the language, and one that is."""
    return Case("find_events", {"where": wrong}, (need,), {"where": right})


_TWO: Final = {"run_ids": [1, 2]}
PAST: Final = [
    Case("query_history", {"signals": ["pose.x"]}, ("pose.0",), {"signals": ["pose.0"]}),
    Case("query_history", {"signals": ["batery_v"]}, ("battery_v",), {"signals": ["battery_v"]}),
    Case("query_history", {"signals": []}, ("at least 1",), {"signals": ["front_m"]}),
    Case("query_history", {"signals": ["front_m"], "cursor": 3}, ("raw=true",),
         {"signals": ["front_m"], "cursor": 3, "raw": True}),
    Case("query_history", {"signals": "*", "max_points": 9_999}, ("max_points", "500"),
         {"signals": "*", "max_points": 500}),
    Case("get_trends", {"run_id": 99}, ("2, 1",), {"run_id": 2}),
    Case("get_trends", {"start_s": 5, "end_s": 2}, ("start_s=5", "end_s=2", "Swap"),
         {"start_s": 2, "end_s": 5}),
    Case("get_trends", {"start_s": 5, "end_s": 5}, ("greater end_s",), {"start_s": 5, "end_s": 6}),
    Case("get_trends", {"last_s": 5, "start_s": 2}, ("two ways", "or last_s"), {"last_s": 5}),
    Case("get_trends", {"end_s": -5}, ("0 s to 9.9 s",), {"end_s": 9.9}),
    Case("get_trends", {"start_s": "1:30"}, ("start_s", "simulated seconds"), {"start_s": 3.0}),
    Case("get_trends", {"since_wall_time": "yesterday"}, ("ISO 8601", "2026-05-04T13:30:00+02:00"),
         {"since_wall_time": "2026-05-04T13:30:00+02:00"}),
    Case("get_robot_state", {"robot": "rovr"}, ("Did you mean 'rover'",), {"robot": "rover"}),
    Case("get_world_info", {"run_id": 44}, ("2, 1",), {"run_id": 1}),
    Case("find_events", {"kinds": ["stuk"]}, ("did you mean 'stuck'",), {"kinds": ["stuck"]}),
    Case("find_events", {"kinds": ["tilt"]}, ("fall: tipped over",), {"kinds": ["fall"]}),
    Case("find_events", {"kinds": ["stuck"], "where": "front_m < 0.5"},
         ('kinds=["stuck", "condition"]',),
         {"kinds": ["stuck", "condition"], "where": "front_m < 0.5"}),
    Case("find_events", {"cursor": "3"}, ("leave cursor out",), {}),
    Case("get_timeline", {"cursor": '{"stuck": null}'}, ("leave cursor out",), {}),
    Case("find_events", {"position": ["pose.0"]}, ("2 items", "x and y"),
         {"position": ["pose.0", "pose.1"]}),
    condition("front_m << 0.5", "< <= > >= ==", "front_m < 0.5"),
    condition("front_m = 0.5", "write ==", "front_m == 0.5"),
    condition("front_m < 0.5 && pose.0 > 0", "write `and`", "front_m < 0.5 and pose.0 > 0"),
    condition("mode == turn", "mode == 'turn'", "mode == 'turn'"),
    condition("frnt_m < 0.5", "front_m", "front_m < 0.5"),
    condition("front_m < 50cm", "without 'cm'", "front_m < 0.5"),
    condition("mode > 3", "== or != and a text in quotes", "mode == 'turn'"),
    condition("abs(front_m < 1", "parenthesis", "abs(front_m) < 1"),
    condition("front_m < 0.5 for", "x < 1 for 0.5", "front_m < 0.5 for 0.5"),
    condition("front_m < 0.5 for 2 s", "seconds without a unit", "front_m < 0.5 for 2"),
    condition("sqrt(front_m) < 0.5", "abs()", "abs(front_m) < 0.5"),
    condition("front_m > 0.1 and", "ends too early", "front_m > 0.1 and pose.0 > 0"),
    condition("front_m ** 2 < 0.5", "x * x", "front_m * front_m < 0.5"),
    condition("mode in ['turn', 'cruise']", "mode == 'a' or mode == 'b'",
              "mode == 'turn' or mode == 'cruise'"),
    condition("front_m < 1 if mode == 'turn'", "and", "front_m < 1 and mode == 'turn'"),
    condition("", "front_m < 0.1 for 0.5", "front_m < 0.1 for 0.5"),
    Case("find_events", {"where": "mean(front_m) < 1"}, ("webots_get_trends",),
         {"signals": ["front_m"]}, "get_trends"),
    Case("compare_runs", {"run_ids": [1, 1]}, ("different runs", "webots_list_runs"), {},
         "list_runs"),
    Case("compare_runs", {"run_ids": [1], "first_difference": True},
         ("two runs", "webots_list_runs"), _TWO | {"first_difference": True}),
    Case("compare_runs", _TWO | {"trial_set": 1}, ("exclude", "run_ids"), _TWO),
    Case("plot", {"kind": "scatter"}, ("'trajectory'",), {"kind": "trajectory"}),
    Case("plot", {"kind": "trajectory", "signals": ["pose.0"]}, ("['pose.0', 'pose.1']",),
         {"kind": "trajectory", "signals": ["pose.0", "pose.1"]}),
    Case("plot", {"kind": "trajectory", "signals": ["mode", "pose.1"]}, ("pose.0",),
         {"kind": "trajectory", "signals": ["pose.0", "pose.1"]}),
    Case("plot", {"width_px": 10}, ("400",), {"width_px": 400}),
    Case("get_full_state", {"path": "pose.x"}, ("pose.0 to pose.2",), {"path": "pose.0"}),
    Case("get_full_state", {"path": "sensors"}, ("battery_v",), {"path": "battery_v"}),
    Case("get_full_state", {"path": "front_m.mean"}, ("path='front_m'",), {"path": "front_m"}),
    Case("get_full_state", {"path": "front_m", "offset": 9}, ("Leave offset out",),
         {"path": "front_m"}),
    Case("query_sql", {"sql": "DELETE FROM run"}, ("Use SELECT",), {"sql": "SELECT * FROM run"}),
    Case("query_sql", {"sql": "SELECT * FROM runs"}, (": run,",), {"sql": "SELECT * FROM run"}),
    Case("query_sql", {"sql": "SELECT id, time FROM state"}, ("sim_time_s", "wall_time_s"),
         {"sql": "SELECT id, sim_time_s FROM state"}),
    Case("query_sql", {"sql": "SELECT 1; SELECT 2"}, ("Only one statement",), {"sql": "SELECT 1"}),
    Case("list_runs", {"limit": 9_999}, ("limit", "500"), {"limit": 500}),
    Case("get_logs", {"source": "robot"}, ("'controller'",), {"source": "controller"}),
    Case("check_run", {"expect": ["fornt_m > 0"]}, ("front_m",), {"expect": ["front_m > 0"]}),
    Case("annotate_run", {}, ("label='baseline'",), {"label": "baseline"}),
    Case("describe_signals", {"quantity": "distance"},
         ("signals is missing", "webots_list_signals"),
         {"signals": ["front_m"], "quantity": "distance"}),
    Case("describe_signals", {"signals": ["front_m"], "low": 5, "high": 1}, ("Swap",),
         {"signals": ["front_m"], "low": 1, "high": 5}),
    Case("describe_signals", {"signals": ["front_m"], "role": "sensor"}, ("'measured'",),
         {"signals": ["front_m"], "role": "measured"}),
    Case("get_trials", {"trial_set": 7}, ("none was started yet",), {}),
    Case("run_trials", {"cancel": True}, ("trial_set", "webots_get_trials()"), {}, "get_trials"),
    Case("wait_for_command", {"command_id": 55}, ("webots_list_commands",), {}, "list_commands"),
    Case("list_commands", {"status": "running"}, ("'claimed'",), {"status": "claimed"}),
    Case("get_camera", {"fresh": True, "at_s": 5}, ("leave fresh out",), {"at_s": 5}),
]  # fmt: skip

_SPEED: Final = {"action": "set_speed", "params": {"speed": 2}}
LIVE: Final = [
    Case("send_command", _SPEED | {"action": "set_sped"}, ("Did you mean 'set_speed'",), _SPEED),
    Case("send_command", _SPEED | {"params": "speed=2"}, ("params", "{'x': 1.5}"), _SPEED),
    Case("send_command", {"action": "step", "params": {"n": 2}}, ("'steps'",),
         {"action": "step", "params": {"steps": 2}}),
    Case("set_parameters", {"values": {"kp": 50}}, ("from 0 up to 10",), {"values": {"kp": 5}}),
    Case("set_parameters", {"values": {"kpp": 5}}, (": kp,",), {"values": {"kp": 5}}),
    Case("set_parameters", {"values": {"gait": "fly"}}, ("'trot', 'walk'",),
         {"values": {"gait": "walk"}}),
    Case("set_parameters", {"values": {"laps": 2.5}}, ("whole number",), {"values": {"laps": 2}}),
    Case("set_parameters", {"values": "kp=3"}, ('{"kp": 3.0',), {"values": {"kp": 3.0}}),
    Case("get_parameters", {"names": ["kpp"]}, (": kp,",), {"names": ["kp"]}),
    Case("run", {}, ("for_s=10",), {"for_s": 0.1}),
    Case("run", {"for_s": -1}, ("for_s", "greater than 0"), {"for_s": 0.1}),
    Case("run", {"until": "mode == cruise"}, ("mode == 'cruise'",),
         {"until": "mode == 'cruise'", "for_s": 5, "reset": True}),
    Case("run", {"until": "steps > 0"}, ("for_s alone", "reset=true"), {"for_s": 0.1}),
    Case("set_field", {"path": "ROVER.translation", "value": "left"}, ("[0, 0.5, 0.1]",),
         {"path": "ROVER.translation", "value": [0, 0.5, 0.1]}),
    Case("set_field", {"path": "ROVER.translaton", "value": [0, 0, 0]}, ("translation",),
         {"path": "ROVER.translation", "value": [0, 0, 0]}),
    Case("remove_breakpoint", {"breakpoint_id": 99}, ("no breakpoints",), {}, "list_breakpoints"),
]  # fmt: skip


def fill(recorded: Recorded) -> RecordedRobot:
    """Two runs of a rover, 10 s each."""
    rover = recorded.robot()
    for run in range(2):
        if run:
            rover.end_run("reset")
            rover.begin_run("reset")
        for row in range(100):
            mode = "cruise" if row // 20 % 2 else "turn"
            numbers = {"battery_v": 12.0 - row * 0.001, "front_m": 1.0 - row * 0.008}
            rover.state(row * 0.1, {"pose": [row * 0.01, 0.0, 0.1], "mode": mode, **numbers})
    return rover


async def recover(client: Client, case: Case) -> None:
    """Make the wrong call, read its error, and make the right one."""
    refused = await client.call_tool(f"webots_{case.tool}", case.wrong)
    assert refused.is_error, text_of(refused)
    missing = [need for need in case.needs if need not in text_of(refused)]
    assert not missing, text_of(refused)
    right = await client.call_tool(f"webots_{case.then or case.tool}", case.right)
    assert not right.is_error, text_of(right)


@pytest.mark.parametrize("case", PAST, ids=str)
async def test_an_error_about_a_recording_has_what_the_right_call_needs(
    connect: Connect, recorded: Recorded, case: Case
) -> None:
    fill(recorded)
    async with connect() as client:
        await recover(client, case)


@pytest.mark.slow
async def test_an_error_about_a_live_robot_has_what_the_right_call_needs(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        await until(lambda: has_published(client), bool)
        for case in LIVE:
            await recover(client, case)
    assert tunable.kp.value == 3.0


async def has_published(client: Client) -> bool:
    answer = await client.call_tool("webots_list_signals", {})
    return "steps" in text_of(answer)


async def test_a_run_of_another_robot_is_answered_with_its_robot(
    connect: Connect, recorded: Recorded
) -> None:
    fill(recorded)
    recorded.robot("crane").state(1.0, {"x": 1})
    case = Case("get_trends", {"robot": "crane", "run_id": 1}, ("robot='rover'", ": 3"),
                {"robot": "rover", "run_id": 1})  # fmt: skip
    several = Case("get_robot_state", {}, ("robot='rover'",), {"robot": "rover"})
    async with connect() as client:
        await recover(client, case)
        await recover(client, several)


async def test_a_read_only_server_names_what_it_can_answer(
    connect: Connect, recorded: Recorded
) -> None:
    fill(recorded)
    async with connect(read_only=True) as client:
        await recover(
            client, Case("get_scene", {}, ("webots_get_world_info",), {}, "get_world_info")
        )
        await recover(client, Case("get_camera", {"fresh": True}, ("fresh out",), {}))


async def test_a_robot_that_is_not_live_is_answered_with_how_to_start_it(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot(now=1_000.0).state(1.0, {"x": 1})
    called = ("webots_launch_world", "then call again")
    async with connect() as client:
        for tool, arguments in (("send_command", {"action": "go"}), ("run", {"for_s": 1})):
            await recover(client, Case(tool, arguments, called, {}, "get_robot_state"))


async def test_a_forbidden_value_is_answered_with_the_rule_and_its_bounds(
    connect: Connect, tunable: TunableDriver, file: Path
) -> None:
    rule = "[allow]\nparameters.kp = [0, 5]\n"
    (file.parent / "webots-mcp.toml").write_text(rule)
    async with connect() as client:
        await until(lambda: has_published(client), bool)
        needs = ("value 8 of parameter 'kp'", "line 2: parameters.kp = [0, 5]")
        case = Case("set_parameters", {"values": {"kp": 8}}, needs, {"values": {"kp": 5}})
        await recover(client, case)
    assert tunable.kp.value == 5
