"""The prompts, which clients show as commands: every tool and parameter they name is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from mcp import Client, MCPError
from mcp.types import TextContent

from tests.server.story import client_on, write_story

pytestmark = pytest.mark.anyio

ARGUMENTS: dict[str, dict[str, str]] = {
    "diagnose_robot": {"robot": "rover", "problem": "it stands still"},
    "compare_last_edit": {"robot": "rover"},
    "explain_stretch": {"start_s": "50", "end_s": "62.5", "run_id": "1", "robot": "rover"},
}
LEAST: dict[str, dict[str, str]] = {
    "diagnose_robot": {},
    "compare_last_edit": {},
    "explain_stretch": {"start_s": "1", "end_s": "2"},
}


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_story(tmp_path_factory.mktemp("prompts") / "webots.db")


async def read(client: Client, name: str, arguments: dict[str, str]) -> str:
    (message,) = (await client.get_prompt(name, arguments)).messages
    assert message.role == "user" and isinstance(message.content, TextContent)
    return message.content.text


def calls_in(text: str) -> list[ast.Call]:
    """The calls of tools that a text names, as `webots_x(a=1)`."""
    found = re.findall(r"webots_\w+\([^)]*\)", text)
    parsed = [ast.parse(each, mode="eval").body for each in found]
    return [call for call in parsed if isinstance(call, ast.Call)]


@pytest.mark.parametrize("arguments", [ARGUMENTS, LEAST], ids=["all", "least"])
async def test_a_prompt_names_only_tools_and_parameters_that_a_reading_server_has(
    story: Path, arguments: dict[str, dict[str, str]]
) -> None:
    async with client_on(story) as client:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools}
        for name, given in arguments.items():
            calls = calls_in(await read(client, name, given))
            assert len(calls) >= 3
            for call in calls:
                assert isinstance(call.func, ast.Name)
                parameters = tools[call.func.id].input_schema["properties"]
                assert {keyword.arg for keyword in call.keywords} <= set(parameters)


@pytest.mark.slow
async def test_the_calls_of_a_prompt_can_be_made_as_they_stand(story: Path) -> None:
    async with client_on(story) as client:
        for name, given in ARGUMENTS.items():
            for call in calls_in(await read(client, name, given)):
                assert isinstance(call.func, ast.Name)
                if "..." in ast.unparse(call):
                    continue  # what to put there comes from an answer before
                asked = {str(each.arg): ast.literal_eval(each.value) for each in call.keywords}
                if call.func.id == "webots_compare_runs":
                    continue  # the story's controller was never edited
                result = await client.call_tool(call.func.id, asked)
                assert not result.is_error, (ast.unparse(call), result.content)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"start_s": "soon", "end_s": "2"}, "start_s must be a valid number, not 'soon'"),
        ({"start_s": "1", "end_s": "2", "speed": "3"}, "there is no argument 'speed'"),
        ({"start_s": "1"}, "end_s"),
        ({"start_s": "1", "end_s": "2", "run_id": "1.5"}, "run_id must be a valid integer"),
    ],
)
async def test_an_argument_that_a_prompt_cannot_use_is_refused_by_its_name(
    story: Path, given: dict[str, str], said: str
) -> None:
    async with client_on(story) as client:
        with pytest.raises(MCPError, match=said):
            await client.get_prompt("explain_stretch", given)
        assert "run_id" not in await read(
            client, "explain_stretch", {"start_s": "1", "end_s": "2", "run_id": ""}
        )


async def test_a_stretch_may_be_given_from_its_end(story: Path) -> None:
    async with client_on(story) as client:
        said = await read(client, "explain_stretch", {"start_s": "9", "end_s": "3"})
        assert "from 3 to 9 s" in said and "start_s=3, end_s=9" in said
