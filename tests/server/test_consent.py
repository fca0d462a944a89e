"""Rules that ask the person: who is asked, what goes on then, and what is refused all the same."""

from __future__ import annotations

import os
import sqlite3
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, closing
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pytest
from anyio import to_thread
from mcp import Client, MCPError, StdioServerParameters
from mcp.types import (
    INTERNAL_ERROR,
    ElicitRequestFormParams,
    ElicitRequestParams,
    ElicitResult,
    ErrorData,
    InputRequiredResult,
    InputResponse,
)

from tests.server.conftest import ask, fail
from tests.server.test_http import Http
from tests.server.test_http import home as home
from tests.server.test_parameters import TunableDriver
from tests.server.test_parameters import tunable as tunable
from webots_mcp.cli import main
from webots_mcp.database.connection import connect
from webots_mcp.errors import ConsentRequiredError, NotAllowedError
from webots_mcp.server import consent
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.policy import LAUNCH, Policy, read_policy
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import (
    BY_COMMAND_LINE,
    Consent,
    OpenRequest,
    newest_requests,
    permit,
)

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("tunable")]
Way = Literal["memory", "memory-legacy", "stdio", "stdio-legacy", "http", "http-legacy"]
WAYS: tuple[Way, ...] = (
    "memory", "memory-legacy", "stdio", "stdio-legacy", "http", "http-legacy",
)  # fmt: skip
ERAS: tuple[Way, ...] = ("memory", "memory-legacy")


class Person:
    """Who answers the forms that a client shows."""

    def __init__(self, *actions: Literal["accept", "decline", "cancel"]) -> None:
        self.asked: list[str] = []
        self._actions = list(actions)

    async def answer(self, _: Any, params: ElicitRequestParams) -> ElicitResult | ErrorData:
        assert isinstance(params, ElicitRequestFormParams)
        self.asked.append(params.message)
        if not self._actions:
            return ErrorData(code=INTERNAL_ERROR, message="nobody is there")
        return ElicitResult(action=self._actions.pop(0), content={})


@asynccontextmanager
async def client_of(file: Path, person: Person, way: Way) -> AsyncGenerator[Client]:
    options: dict[str, Any] = {"elicitation_callback": person.answer}
    mode: Any = "legacy" if "legacy" in way else "auto"
    if way.startswith("memory"):
        async with Client(create_server(file, file.parent), mode=mode, **options) as client:
            yield client
    elif way.startswith("stdio"):
        serve = ["-m", "webots_mcp", "serve", "--database", str(file)]
        child = StdioServerParameters(command=sys.executable, args=serve, env=dict(os.environ))
        async with Client(child, mode=mode, **options) as client:
            yield client
    else:
        served = Http(file.parent)
        try:
            async with served.client(mode, **options) as client:
                yield client
        finally:
            served.stop()


def allow(file: Path, text: str) -> Policy:
    project = file.parent / "webots-mcp.toml"
    project.write_text(f"[allow]\n{text}\n", "utf-8")
    policy = read_policy(project)
    assert policy is not None
    return policy


def rows(file: Path) -> list[dict[str, Any]]:
    """The requests, oldest first."""
    with closing(connect(file, "reader")) as connection:
        return newest_requests(connection, 100)[::-1]


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
async def test_what_the_person_agrees_to_goes_on_and_both_are_recorded(
    file: Path, tunable: TunableDriver, way: Way
) -> None:
    allow(file, "actions = ['*', '?set_parameters']")
    person = Person("accept")
    async with client_of(file, person, way) as client:
        answer = await ask(client, "webots_set_parameters", values={"kp": 3})
    assert answer["outcome"] == "done"
    (message,) = person.asked
    assert "asks for webots_set_parameters with" in message and '"kp": 3' in message
    assert "line 2: actions = ['*', '?set_parameters']" in message
    asked, done = rows(file)
    assert asked["outcome"].startswith("the person agreed, by ") and asked["commands"] == []
    assert done["outcome"] == "the person agreed: done"
    assert (asked["rule"], done["rule"]) == (None, None)
    assert [each[1:] for each in done["commands"]] == [["set_parameters", "done"]]


@pytest.mark.parametrize("way", ERAS)
@pytest.mark.parametrize(
    ("actions", "said"),
    [
        (("decline",), "The person declined"),
        (("cancel",), "The person cancelled"),
    ],
)
async def test_what_the_person_declines_is_refused_and_nothing_is_done(
    file: Path, way: Way, actions: Any, said: str
) -> None:
    allow(file, "actions = ['*', '?set_parameters']")
    person = Person(*actions)
    async with client_of(file, person, way) as client:
        refusal = await fail(client, "webots_set_parameters", values={"kp": 3})
        assert said in refusal and "line 2: actions" in refusal
    (row,) = rows(file)
    assert row["outcome"] == f"refused: {said[0].lower()}{said[1:]}"
    assert "line 2: actions" in row["rule"] and row["commands"] == []


async def test_a_client_that_announces_forms_and_shows_none_is_refused(file: Path) -> None:
    allow(file, "actions = ['?*']")
    async with client_of(file, Person(), "memory-legacy") as client:
        refusal = await fail(client, "webots_set_parameters", values={"kp": 3})
        assert "The client could not ask the person (nobody is there)" in refusal
    async with client_of(file, Person(), "memory") as client:
        with pytest.raises(MCPError, match="nobody is there"):
            await client.call_tool("webots_set_parameters", {"values": {"kp": 3}})
    assert all(not row["commands"] for row in rows(file))


async def test_a_person_who_does_not_answer_is_not_waited_for_for_ever(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import anyio

    class Away(Person):
        async def answer(self, _: Any, params: ElicitRequestParams) -> ElicitResult:
            await anyio.sleep_forever()
            raise AssertionError("it sleeps")

    monkeypatch.setattr(consent, "ASK_TIMEOUT_S", 0.1)
    allow(file, "actions = ['?*']")
    async with client_of(file, Away(), "memory-legacy") as client:
        refusal = await fail(client, "webots_set_parameters", values={"kp": 3})
    assert "The person did not answer within 0.1 s" in refusal
    assert rows(file)[0]["outcome"].startswith("refused: the person did not answer")


@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_without_forms_what_asks_is_refused(file: Path, mode: Any) -> None:
    allow(file, "actions = ['*', '?set_parameters']")
    async with Client(create_server(file, file.parent), mode=mode) as client:
        refusal = await fail(client, "webots_set_parameters", values={"kp": 3})
    assert "not allowed without the consent of the person, by " in refusal
    assert "Do not look for another way" in refusal
    (row,) = rows(file)
    assert row["outcome"] == "refused" and "line 2" in row["rule"]
    words = ["send", "set_parameters", "--params", '{"values": {"kp": 3}}']
    assert await to_thread.run_sync(main, [*words, "--database", str(file)]) == 2
    assert rows(file)[-1]["outcome"] == "refused"


@pytest.mark.parametrize("way", ERAS)
@pytest.mark.parametrize(
    "text",
    [
        "actions = ['?*', '!set_parameters']",
        "actions = ['?set_parameters']\nparameters = {kp = [0, 2]}",
        "parameters = {kp = 'ask'}\ntools = ['*', '!webots_set_parameters']",
        "actions = ['?*']\nparameters = {laps = 'ask'}",
    ],
)
async def test_nobody_is_asked_about_what_is_forbidden_outright(
    file: Path, way: Way, text: str
) -> None:
    allow(file, text)
    person = Person("accept", "accept", "accept")
    async with client_of(file, person, way) as client:
        await fail(client, "webots_set_parameters", values={"kp": 3})
    assert person.asked == []
    assert all(row["outcome"] == "refused" and row["rule"] for row in rows(file))


@pytest.mark.parametrize("way", ERAS)
async def test_each_rule_is_asked_about_and_one_refusal_is_enough(file: Path, way: Way) -> None:
    rules = "tools = ['?webots_set_parameters']\nactions = ['?*']\nparameters = {kp = 'ask'}"
    allow(file, rules)
    person = Person("accept", "accept", "accept")
    async with client_of(file, person, way) as client:
        await ask(client, "webots_set_parameters", values={"kp": 3})
    assert [message.partition("line ")[2][0] for message in person.asked] == ["2", "3", "4"]
    person = Person("accept", "decline")
    async with client_of(file, person, way) as client:
        await fail(client, "webots_set_parameters", values={"kp": 4})
    assert len(person.asked) == 2
    assert sum(len(row["commands"]) for row in rows(file)) == 1


async def test_an_answer_holds_for_the_call_that_was_asked_about_alone(file: Path) -> None:
    allow(file, "actions = ['?*']")
    name = "webots_set_parameters"
    async with client_of(file, Person("accept"), "memory") as client:
        session = client.session
        first = await session.call_tool(name, {"values": {"kp": 3}}, allow_input_required=True)
        assert isinstance(first, InputRequiredResult) and first.input_requests
        answers: dict[str, InputResponse] = {
            key: ElicitResult(action="accept", content={}) for key in first.input_requests
        }
        for state in (first.request_state, '{"agreed": []}', None):
            retried = partial(session.call_tool, input_responses=answers, request_state=state)
            try:
                again = await retried(name, {"values": {"kp": 9}}, allow_input_required=True)
            except MCPError as error:
                assert "Invalid or expired" in str(error)
            else:
                assert state is None and isinstance(again, InputRequiredResult)
    assert all(not row["commands"] for row in rows(file))


async def test_a_rule_that_is_changed_meanwhile_holds(file: Path) -> None:
    class Changing(Person):
        async def answer(self, _: Any, params: ElicitRequestParams) -> ElicitResult | ErrorData:
            allow(file, "actions = []")
            return await super().answer(_, params)

    allow(file, "actions = ['?*']")
    async with client_of(file, Changing("accept"), "memory-legacy") as client:
        refusal = await fail(client, "webots_set_parameters", values={"kp": 3})
    assert "line 2: actions = []" in refusal
    assert rows(file)[-1]["outcome"] == "refused"


@pytest.mark.slow
async def test_trials_ask_once_and_go_on_behind_the_answer(file: Path) -> None:
    allow(file, "actions = ['*', '?run', '?reset']")
    person = Person("accept", "accept")
    async with client_of(file, person, "memory-legacy") as client:
        await ask(
            client,
            "webots_run_trials",
            parameters={"kp": [1.0, 2.0]},
            score="max(steps)",
            for_s=0.2,
            timeout_wall_s=90,
        )
    assert len(person.asked) == 1, "both stand in one line"
    with closing(sqlite3.connect(file)) as connection:
        trials = connection.execute("SELECT status, error FROM trial").fetchall()
        ((refusals,),) = connection.execute("SELECT count(rule) FROM request").fetchall()
    assert trials == [("done", None)] * 2
    assert refusals == 0


def test_nobody_is_asked_when_a_part_of_the_request_was_done(file: Path) -> None:
    allow(file, "actions = ['*', '?quit']")
    recording = RecordingAccess(file, file.parent)
    for earlier in ("pause", "step"):
        with Consent(()).given(), OpenRequest(recording, BY_COMMAND_LINE, ["x"], {}):
            permit(recording, earlier, {})
            with pytest.raises(NotAllowedError) as raised:
                permit(recording, "quit", {})
        assert not isinstance(raised.value, ConsentRequiredError)
    with (
        Consent(()).given(),
        OpenRequest(recording, BY_COMMAND_LINE, ["x"], {}),
        pytest.raises(ConsentRequiredError),
    ):
        permit(recording, "quit", {})
    *refused, asked = rows(file)
    assert {row["outcome"] for row in refused} == {"refused"}
    assert asked["outcome"].startswith("the person is asked, by ") and asked["rule"] is None


async def test_a_call_asks_about_a_few_rules_and_no_more(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(consent, "MOST_QUESTIONS", 1)
    allow(file, "tools = ['?webots_set_parameters']\nactions = ['?*']")
    person = Person("accept", "accept")
    async with client_of(file, person, "memory-legacy") as client:
        await fail(client, "webots_set_parameters", values={"kp": 3})
    assert len(person.asked) == 1
    assert rows(file)[-1]["outcome"] == "refused"


@pytest.mark.parametrize(
    ("text", "action", "params"),
    [
        ("launch = 'ask'", LAUNCH, {}),
        ("parameters = {kp = 'ask'}", "set_parameters", {"values": {"kp": 1}}),
        ("fields = ['?*', 'BALL.*']", "set_field", {"path": "#12.translation"}),
        ("nodes = ['?root']", "add_node", {"path": "root"}),
        ("actions = ['*', '?pause']", "step", {}),
        ("tools = ['*', '?webots_world_reset']", "reset", {}),
    ],
)
def test_every_kind_of_rule_can_ask(
    file: Path, text: str, action: str, params: dict[str, Any]
) -> None:
    policy = allow(file, text)
    with pytest.raises(ConsentRequiredError) as raised:
        policy.require(action, params)
    policy.with_consent([raised.value.rule]).require(action, params)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("launch = 'maybe'", 'launch must be true, false or "ask"'),
        ("fields = ['*.translation', '?BALL.*']", "put the patterns with ? before the others"),
        ("nodes = ['BALL', '?*']", "put the patterns with ? before the others"),
        ("parameters = {kp = 'maybe'}", 'true, false or "ask"'),
    ],
)
def test_a_rule_that_asks_wrongly_is_an_error(file: Path, text: str, said: str) -> None:
    with pytest.raises(NotAllowedError, match="line 2") as raised:
        allow(file, text)
    assert said in str(raised.value)
