"""Whatever a rule forbids is not done, by whichever route it is asked for.

What was done is read from the recording: commands that were queued, breakpoints that were stored,
worlds that were started. It is judged here by plain sets, not by the code that is tested.
"""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple, cast

import pytest
from anyio.from_thread import start_blocking_portal
from hypothesis import given, settings
from hypothesis import strategies as st
from mcp import Client

from tests.exploring import attempts
from tests.server.test_parameters import TunableDriver
from webots_mcp.cli import main
from webots_mcp.plugins.page.page_orders import steer, tune
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.recording import RecordingAccess

pytestmark = pytest.mark.slow

# What ends the robot of the test is never allowed, and always asked for.
ENDING = ("quit", "reload", "load_world")
READING = ("get_scene", "get_field")
ACTIONS = (
    "pause", "resume", "fast", "step", "run", "reset", "set_parameters", "set_field", "add_node",
    "remove_node", "keep", "screenshot", "set_speed", *READING,
)  # fmt: skip
TOOLS = (
    "webots_set_parameters", "webots_send_command", "webots_run", "webots_run_trials",
    "webots_breakpoint", "webots_edit_scene", "webots_set_field", "webots_simulation_control",
    "webots_take_screenshot", "webots_get_scene",
)  # fmt: skip
FIELDS = ("WorldInfo.title", "rover.customData", "#1.title")
NODES = ("root", "WorldInfo")
MERGED = {
    "webots_set_field": "webots_edit_scene",
    "webots_add_node": "webots_edit_scene",
    "webots_remove_node": "webots_edit_scene",
    "webots_remove_breakpoint": "webots_breakpoint",
    "webots_get_field": "webots_get_scene",
}


class Rules(NamedTuple):
    """What is allowed; None for a file that is invalid."""

    actions: frozenset[str]
    forbidden_tools: frozenset[str]
    kp: tuple[float, float]
    gaits: tuple[str, ...]
    fields: frozenset[str]
    nodes: frozenset[str]
    spelled_out: bool

    @property
    def text(self) -> str:
        forbidden = [f"!{each}" for each in (*ACTIONS, *ENDING) if each not in self.actions]
        actions = sorted(self.actions) if self.spelled_out else ["*", *forbidden]
        gait = json.dumps(self.gaits) if self.gaits else "false"
        tools = json.dumps(["*", *(f"!{each}" for each in self.forbidden_tools)])
        return (
            f"[allow]\ntools = {tools}\nactions = {json.dumps(actions)}\n"
            f"fields = {json.dumps(sorted(self.fields))}\n"
            f"nodes = {json.dumps(sorted(self.nodes))}\nworlds = []\nlaunch = false\n"
            f"[allow.parameters]\nkp = {list(self.kp)}\ngait = {gait}\n"
        )


def all_but(values: tuple[str, ...], most: int) -> st.SearchStrategy[frozenset[str]]:
    """All of them but a few, so that much is allowed."""
    few = st.frozensets(st.sampled_from(values), max_size=most)
    return few.map(lambda each: frozenset(values) - each)


RULES = st.builds(
    Rules, all_but(ACTIONS, 5), st.frozensets(st.sampled_from(TOOLS), max_size=2),
    st.tuples(st.sampled_from([0.0, 2.0]), st.sampled_from([2.0, 4.0])),
    st.sampled_from([(), ("walk",), ("trot", "walk")]), all_but(FIELDS, 2), all_but(NODES, 1),
    st.booleans(),
)  # fmt: skip
VALUES = st.fixed_dictionaries(
    {},
    optional={
        "kp": st.sampled_from([1.0, 2.0, 3.0, 9.5]),
        "gait": st.sampled_from(["trot", "walk"]),
        "laps": st.just(4),
    },
).filter(bool)
PATHS = st.sampled_from((*FIELDS, "WorldInfo.info", "rover.name"))
AT = st.sampled_from((*NODES, "rover"))
NODE = "Solid { }"
BRIEF = {"for_s": 0.032, "then": "go_on"}
EXAMPLES = attempts(15, exploring=1000)
WORLD = Path(__file__).parents[2] / "bridge" / "worlds" / "crowd.wbt"


def drawn(value: Any) -> st.SearchStrategy[Any]:
    """A strategy as it is; anything else is always drawn."""
    return cast("Any", value) if isinstance(value, st.SearchStrategy) else st.just(value)


def tool(name: str, **arguments: Any) -> st.SearchStrategy[tuple[str, str, dict[str, Any]]]:
    made = {key: drawn(value) for key, value in arguments.items()}
    return st.tuples(st.just("mcp"), st.just(name), st.fixed_dictionaries(made))


def sent(action: str, **params: Any) -> st.SearchStrategy[tuple[str, str, dict[str, Any]]]:
    made = {key: drawn(value) for key, value in params.items()}
    return tool("webots_send_command", action=action, params=st.fixed_dictionaries(made))


def line(*words: Any) -> st.SearchStrategy[tuple[str, str, list[str]]]:
    made = st.tuples(*map(drawn, words)).map(list)
    return st.tuples(st.just("cli"), st.just(words[0]), made)


ORDERS = st.sampled_from(["pause", "resume", "fast", "step", "reset", "reload"])
CALLS = st.one_of(
    tool("webots_set_parameters", values=VALUES),
    tool("webots_run", parameters=VALUES | st.none(), reset=st.booleans(), **BRIEF),
    tool("webots_run", **BRIEF), line("run", "--for", "0.032"),
    tool("webots_run_trials", parameters=st.lists(VALUES, min_size=1, max_size=2),
         score="max(steps)", for_s=0.032),
    tool("webots_breakpoint", condition="steps > 1e9",
         action=st.sampled_from(["pause", "keep", "log"])),
    tool("webots_set_field", path=PATHS, value="x"),
    tool("webots_edit_scene", action="set", path=PATHS, value="x"),
    tool("webots_edit_scene", action="add", vrml=NODE, path=AT),
    tool("webots_remove_node", path=AT),
    tool("webots_simulation_control", command=ORDERS),
    tool("webots_world_reload"), tool("webots_quit"), tool("webots_take_screenshot"),
    tool("webots_launch_world", world=str(WORLD)), tool("webots_load_world", world=str(WORLD)),
    tool("webots_launch_world", action="load", world=str(WORLD)),
    tool("webots_get_scene"), tool("webots_get_scene", what="field", path=PATHS),
    sent("set_parameters", values=VALUES, when=st.sampled_from(["now", "reset"])),
    sent("run", parameters=VALUES, reset=st.booleans(), **BRIEF),
    sent("set_field", path=PATHS, value="x"), sent("add_node", vrml=NODE, path=AT),
    sent("remove_node", path=AT), sent("load_world", world=str(WORLD)), sent("quit"),
    sent("reload"), sent("keep", reason="x"), sent("set_speed", speed=2.0), sent("pause"),
    line("send", st.sampled_from(["quit", "reload", "pause", "keep", "set_parameters"])),
    line("send", "set_speed", "speed=3"), line("keep", "x"), line("pause"), line("step"),
    line("parameters", st.sampled_from(["kp=1", "kp=3", "kp=9.5", "gait=walk"])),
    line("run", "--for", "0.032", "--set", st.sampled_from(["kp=1", "kp=9.5"]), "--reset"),
    line("field", PATHS, '"x"'), line("launch", str(WORLD)),
    line("breakpoint", "steps > 1e9", "--action", st.sampled_from(["pause", "keep", "log"])),
    st.tuples(st.just("page"), st.just("steer"), ORDERS),
    st.tuples(st.just("page"), st.just("tune"), VALUES.map(lambda each: next(iter(each.items())))),
)  # fmt: skip
ALLOWED = Rules(frozenset(ACTIONS), frozenset(), (0.0, 4.0), ("trot", "walk"), frozenset(FIELDS),
                frozenset(NODES), spelled_out=False)  # fmt: skip
EACH_DONE: list[tuple[str, str, Any]] = [
    ("mcp", "webots_run", BRIEF),
    ("mcp", "webots_set_field", {"path": "WorldInfo.title", "value": "x"}),
    ("cli", "send", ["send", "set_speed", "speed=3"]),
    ("page", "tune", ["kp", 3.0]),
    ("page", "steer", "pause"),
]
OF_COMMANDS = {
    "send": "webots_send_command", "keep": "webots_send_command", "run": "webots_run",
    "pause": "webots_simulation_control", "step": "webots_simulation_control",
    "parameters": "webots_set_parameters", "field": "webots_set_field",
    "breakpoint": "webots_breakpoint", "steer": "webots_simulation_control",
    "tune": "webots_set_parameters",
}  # fmt: skip


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """In a project, whose file says what is allowed."""
    for name in ("worlds", "controllers", "mcp_data"):
        (tmp_path / name).mkdir()
    return tmp_path / "mcp_data" / "webots.db"


def is_allowed(rules: Rules | None, action: str, params: dict[str, Any]) -> bool:
    if rules is None:
        return action in READING
    if action == "arm_breakpoints":
        return True
    values = params.get("values" if action == "set_parameters" else "parameters") or {}
    return (
        action in rules.actions
        and not (action == "run" and params.get("reset") and "reset" not in rules.actions)
        and not (action == "set_field" and params["path"] not in rules.fields)
        and not (action in ("add_node", "remove_node") and params["path"] not in rules.nodes)
        and rules.kp[0] <= values.get("kp", rules.kp[0]) <= rules.kp[1]
        and ("gait" not in values or values["gait"] in rules.gaits)
        and "laps" not in values
    )


def test_nothing_that_a_rule_forbids_is_done_by_any_route(
    robot: TunableDriver, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = RecordingAccess(file, file.parent, asker="page")
    toml = file.parents[1] / "webots-mcp.toml"
    passed, refused = set[str](), set[str]()

    def done(query: str, after: int) -> list[tuple[Any, ...]]:
        with closing(sqlite3.connect(file)) as connection:
            return connection.execute(query, (after,)).fetchall()

    with (
        start_blocking_portal() as portal,
        portal.wrap_async_context_manager(Client(create_server(file, file.parent))) as client,
    ):

        def ask(route: str, name: str, given_by: Any) -> None:
            if route == "mcp":
                portal.call(client.call_tool, name, given_by)
            elif route == "cli":
                where = [] if name == "launch" else ["--database", str(file)]
                main([*given_by, *where])
            elif name == "steer":
                steer(recording, "rover", given_by)
            else:
                tune(recording, "rover", *given_by)

        def attempt(rules: Rules | None, calls: list[tuple[str, str, Any]]) -> None:
            toml.write_text(rules.text if rules else "[allow]\nactions = 'all'\n")
            for route, name, given_by in calls:
                (before,) = done("SELECT coalesce(max(id), ?) FROM command", 0)[0]
                (stored,) = done("SELECT coalesce(max(id), ?) FROM breakpoint", 0)[0]
                ask(route, name, given_by)
                leaf = OF_COMMANDS.get(name, name)
                names = {leaf, MERGED.get(leaf, leaf)}
                sent_here = done(
                    "SELECT action, params, request_id, requested_by FROM command WHERE id > ?",
                    before,
                )
                points = done("SELECT action FROM breakpoint WHERE id > ?", stored)
                shown = (rules and rules.text, route, name, given_by, sent_here, points)
                if rules and names & rules.forbidden_tools:
                    assert not sent_here and not points, shown
                for action, params, request_id, by in sent_here:
                    if by == "trials" and request_id is None:  # what trials have changed, set back
                        continue
                    assert is_allowed(rules, action, json.loads(params)), shown
                    assert request_id is not None or action in READING, shown
                    passed.add(action)
                for (action,) in points:
                    assert rules and (action == "log" or action in rules.actions), shown
                if not sent_here:
                    refused.add(leaf)
            assert robot.is_alive(), "something that ends it was allowed"

        @settings(max_examples=EXAMPLES, deadline=None)
        @given(RULES, st.integers(0, 7), st.lists(CALLS, min_size=4, max_size=10))
        def try_all(rules: Rules, kind: int, calls: list[tuple[str, str, Any]]) -> None:
            attempt(rules if kind else None, calls)

        attempt(ALLOWED, EACH_DONE)
        assert passed >= {"set_parameters", "run", "set_field", "pause", "set_speed"}
        try_all()
    assert len(refused) > 5
    rows = done("SELECT tool, transport, rule FROM request WHERE id > ?", 0)
    assert {transport for _, transport, _ in rows} == {"stdio", "cli", "page"}
    assert any(rule and "webots-mcp.toml, line" in rule for *_, rule in rows)
    capsys.readouterr()
