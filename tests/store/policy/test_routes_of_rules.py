"""A rule about a tool or an action holds by whichever route it is asked for."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from anyio import to_thread
from mcp import Client

from tests.server.conftest import fail
from tests.store.policy.test_requests import allow, client_of, run
from webots_mcp.contract import BUILT_IN_ACTIONS
from webots_mcp.plugins.page.page_orders import steer, tune
from webots_mcp.plugins.page.page_server import ORDERS
from webots_mcp.questions import all_questions
from webots_mcp.store.policy import LAUNCH, RERUN, TOOLS_OF_ACTIONS
from webots_mcp.store.recording import RecordingAccess

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("robot")]

# What changes something and sends no action of its own: what it does is checked by its own name, or
# by the actions that it brings about.
WITHOUT_ACTION = {
    "webots_annotate_run", "webots_breakpoint", "webots_remove_breakpoint", "webots_report",
    "webots_run_trials", "webots_send_command", "webots_describe_signals",
}  # fmt: skip
HARMLESS = {"cancel_run", "arm_breakpoints"}
PARAMS: dict[str, dict[str, Any]] = {
    "run": {"for_s": 1},
    "set_parameters": {"values": {"kp": 1}},
    "get_field": {"path": "WorldInfo.title"},
    "set_field": {"path": "WorldInfo.title", "value": "x"},
    "add_node": {"vrml": "Solid { }"},
    "remove_node": {"path": "WorldInfo"},
    "record_scene": {"do": "start"},
}


class Route(NamedTuple):
    """A way to have an action done.

    Attributes:
        ask: Of a client and a database; answers what was said, and raises nothing.
    """

    name: str
    ask: Callable[[Client, Path], Any]


def tool(name: str, **arguments: Any) -> Route:
    async def ask(client: Client, _: Path) -> str:
        return await fail(client, name, **arguments)

    return Route(f"{name}({', '.join(f'{n}={v!r}' for n, v in arguments.items())})", ask)


def command(*words: str) -> Route:
    async def ask(_: Client, file: Path) -> None:
        assert await run(*words, "--database", str(file)) == 2

    return Route(f"webots-mcp {' '.join(words)}", ask)


def page(do: Callable[[RecordingAccess], dict[str, Any]]) -> Route:
    async def ask(_: Client, file: Path) -> None:
        said = await to_thread.run_sync(do, RecordingAccess(file, file.parent))
        assert not said["is_done"]

    return Route("the page", ask)


def routes_to(action: str, world: Path) -> list[Route]:
    """All of them that there are to an action."""
    params = PARAMS.get(action, {})
    former = {
        "set_field": ("webots_edit_scene", {"action": "set"}),
        "add_node": ("webots_edit_scene", {"action": "add"}),
        "remove_node": ("webots_edit_scene", {"action": "remove"}),
        "get_field": ("webots_get_scene", {"what": "field"}),
    }
    found = {
        "reset": [
            tool("webots_world_reset"),
            tool("webots_run", for_s=1, reset=True),
            command("run", "--for", "1", "--reset"),
        ],
        "reload": [tool("webots_world_reload"), tool("webots_world_reload", force=True)],
        "reset_state": [tool("webots_reset_controller_state")],
        "run": [tool("webots_run", for_s=1), command("run", "--for", "1")],
        "pause": [
            tool("webots_breakpoint", condition="steps > 1e9"),
            tool("webots_run", for_s=1),
            tool("webots_simulation_control", command="step"),
            tool("webots_send_command", action="run", params={"for_s": 1}),
            command("pause"),
        ],
        "resume": [tool("webots_run", for_s=1, then="go_on"), command("resume")],
        "fast": [tool("webots_run", for_s=1, pace="fast", then="as_before")],
        "step": [command("step")],
        "keep": [tool("webots_breakpoint", condition="steps > 1e9", action="keep")],
        "quit": [tool("webots_quit")],
        "load_world": [tool("webots_load_world", world=str(world))],
        RERUN: [tool("webots_rerun_controller"), command("rerun")],
        LAUNCH: [tool("webots_launch_world", world=str(world))],
        "set_parameters": [
            tool("webots_set_parameters", values={"kp": 1}),
            tool("webots_run", for_s=1, then="as_before", parameters={"kp": 1}),
            tool("webots_run_trials", for_s=1, score="steps", parameters={"kp": [1]}),
            command("parameters", "kp=1"),
            page(lambda recording: tune(recording, "rover", "kp", 1)),
        ],
        "take_frame": [tool("webots_get_camera", fresh=True)],
        "screenshot": [tool("webots_take_screenshot")],
        "record_scene": [
            tool("webots_record_scene", action="start"),
            tool("webots_record_scene", action="start", kind="animation"),
            command("record-scene", "start"),
        ],
        "get_scene": [tool("webots_get_scene"), command("scene")],
    }.get(action, [])
    if action in ("pause", "resume", "fast", "step", "reset", "reload"):
        found.append(tool("webots_simulation_control", command=action))
    if action in ORDERS:
        found.append(page(lambda recording: steer(recording, "rover", action)))  # type: ignore[arg-type]
    if action in former:
        name, choice = former[action]
        found += [tool(f"webots_{action}", **params), tool(name, **choice, **params)]
    if action != LAUNCH:
        typed = [f"{name}={json.dumps(value)}" for name, value in params.items()]
        found += [tool("webots_send_command", action=action, params=params)]
        found += [command("send", action, *typed)]
    return found


def test_the_table_has_every_action_and_every_tool_that_does_one() -> None:
    assert set(TOOLS_OF_ACTIONS) == {*BUILT_IN_ACTIONS, LAUNCH, RERUN}
    doing = {each.name for each in all_questions() if not each.effect.reads}
    listed = {name for names in TOOLS_OF_ACTIONS.values() for name in names}
    assert doing - listed == WITHOUT_ACTION


def rules_against(action: str) -> list[str]:
    """Each way to forbid it: by the action, by each tool of it, and by leaving them out."""
    tools = TOOLS_OF_ACTIONS[action]
    by_tool = [f'tools = ["*", "!{name}"]' for name in tools]
    by_action = "launch = false" if action == LAUNCH else f'actions = ["*", "!{action}"]'
    return [*by_tool, by_action]


@pytest.mark.slow
@pytest.mark.parametrize("action", sorted(set(TOOLS_OF_ACTIONS) - HARMLESS))
async def test_what_a_rule_forbids_is_done_by_no_route(
    project: Path, file: Path, action: str
) -> None:
    world = project / "worlds" / "other.wbt"
    world.write_text("#VRML_SIM R2025a utf8\n")
    done: list[str] = []
    routes = routes_to(action, world)
    assert routes
    async with client_of(file) as client:
        for rule in rules_against(action):
            allow(project, f"[allow]\n{rule}\n")
            for route in routes:
                said = await route.ask(client, file)
                if said is not None and "is not allowed by" not in said:
                    done.append(f"{rule}: {route.name}: {said}")
                if queued := commands_in(file):
                    done.append(f"{rule}: {route.name} queued {queued}")
    assert done == []


async def test_a_list_of_allowed_tools_gives_no_other_action_to_the_tool_that_sends_any(
    project: Path, file: Path
) -> None:
    allow(project, '[allow]\ntools = ["webots_send_command", "webots_run"]\n')
    async with client_of(file) as client:
        told = await fail(client, "webots_send_command", action="reload")
        assert "'reload', which webots_world_reload does, is not allowed by" in told
        allow(project, '[allow]\ntools = ["webots_run"]\n')
        result = await client.call_tool("webots_run", {"for_s": 0.1, "reset": True})
    assert "is not allowed" not in str(result.content)


def commands_in(file: Path) -> list[Any]:
    with closing(sqlite3.connect(file)) as connection:
        return connection.execute(
            "SELECT action FROM command WHERE action != 'arm_breakpoints'"
        ).fetchall()
