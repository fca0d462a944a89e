"""Asks a client a scenario's question, and judges its answer and what it did."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import anyio
from mcp import Client
from mcp.types import CallToolResult

from tests.evaluations.judging import (
    NotedCall,
    read_answer,
    wrong_effects,
    wrong_fields,
    wrong_turns,
)
from tests.evaluations.scenario import Scenario
from tests.evaluations.subjects import Subject, subject
from webots_mcp.answers.shortening import tokens_in
from webots_mcp.server.mcp_server import create_server

CHECKOUT: Final = Path(__file__).parents[2]
_TIMEOUT_S: Final = 600.0

Call = Callable[[str, dict[str, Any]], Awaitable[dict[str, Any]]]
"""Calls a tool and returns its answer as data."""
AskedClient = Callable[[str, dict[str, Any], Call], Awaitable[Any]]
"""A client in this process: from the question and the JSON schema to its answer."""


@dataclass(frozen=True)
class Outcome:
    """How a client did on one question.

    Attributes:
        wrong: What is wrong with the answer and with what was done; empty if it is right.
        said: What the client printed, or why it gave no answer.
    """

    scenario: Scenario
    calls: tuple[NotedCall, ...]
    wrong: tuple[str, ...]
    wall_s: float
    said: str = ""

    @property
    def is_right(self) -> bool:
        """Return whether the answer is right and all that was to be done was done."""
        return not self.wrong

    @property
    def tokens(self) -> int:
        """Return how many tokens the answers of the tools have, by the rule of `tokens_in`."""
        return sum(call.tokens for call in self.calls)

    @property
    def wrong_turns(self) -> int:
        """Return how many calls failed or repeated another one."""
        return wrong_turns(self.calls)


def ask(scenario: Scenario, client: AskedClient) -> Outcome:
    """Ask a client of this process, whose calls go to a server of this process."""
    (outcome,) = ask_readers(scenario, [client])
    return outcome


def ask_readers(scenario: Scenario, clients: Iterable[AskedClient]) -> list[Outcome]:
    """Ask clients of this process one after the other about one subject, which they only read."""
    outcomes = list[Outcome]()
    with subject(scenario.of) as asked:
        for client in clients:
            began_s = time.monotonic()
            said, calls = anyio.run(_answer, scenario, client, asked.file)
            took_s = time.monotonic() - began_s
            outcomes.append(_judged(scenario, asked, calls, said, took_s))
    return outcomes


async def _answer(
    scenario: Scenario, client: AskedClient, file: Path
) -> tuple[Any, list[NotedCall]]:
    calls = list[NotedCall]()
    async with Client(create_server(file, file.parent)) as session:

        async def call(tool: str, arguments: dict[str, Any]) -> dict[str, Any]:
            result = await session.call_tool(tool, arguments)
            calls.append(noted(tool, arguments, result))
            return data_of(result)

        return await client(scenario.text(), scenario.schema(), call), calls


def noted(tool: str, arguments: dict[str, Any], result: CallToolResult) -> NotedCall:
    """Return the record of a call; of a picture the caption counts."""
    text = json.dumps(data_of(result), separators=(",", ":"))
    return NotedCall(tool, arguments, bool(result.is_error), tokens_in(text))


def data_of(result: CallToolResult) -> dict[str, Any]:
    """Return an answer as data: of a picture the facts of its caption, of an error its text."""
    if result.structured_content is not None:
        return result.structured_content
    texts = [each.text for each in result.content if each.type == "text"]
    if result.is_error:
        return {"error": "\n".join(texts)}
    try:
        return {"picture": True, **json.loads(texts[0])}
    except (IndexError, ValueError):
        return {"text": "\n".join(texts)}


def ask_by_command(scenario: Scenario, command: str) -> Outcome:
    """Ask a client of the command line, whose calls go to `webots-mcp serve`.

    In the command, `{question}` stands for the question, which otherwise comes over stdin;
    `{config}` for a file that names the server, as .mcp.json; `{server}` for the server's command
    line; `{schema}` for a file with the JSON schema of the answer, `{schema_json}` for its text.
    The command runs in an empty folder, where no file has the answers.
    """
    with subject(scenario.of) as asked, tempfile.TemporaryDirectory() as folder:
        calls = Path(folder, "calls.jsonl")
        words = _command_words(scenario, command, asked.file, calls)
        began_s = time.monotonic()
        question = None if "{question}" in command else scenario.text()
        with tempfile.TemporaryDirectory() as empty:
            said = _printed(words, question, empty)
        took_s = time.monotonic() - began_s
        lines = calls.read_text("utf-8").splitlines() if calls.exists() else []
        made = [NotedCall(**json.loads(line)) for line in lines]
        return _judged(scenario, asked, made, said, took_s)


def _command_words(scenario: Scenario, command: str, file: Path, calls: Path) -> list[str]:
    """Return the command with its placeholders filled in, and write the files they name."""
    line = ["-m", "tests.evaluations.counting", str(calls), "--database", str(file)]
    above = os.pathsep.join(filter(None, [str(CHECKOUT), os.environ.get("PYTHONPATH")]))
    server = {"command": sys.executable, "args": line, "env": {"PYTHONPATH": above}}
    config, schema = calls.with_name("mcp.json"), calls.with_name("schema.json")
    config.write_text(json.dumps({"mcpServers": {"webots": server}}), "utf-8")
    schema.write_text(json.dumps(scenario.schema()), "utf-8")
    given = {
        "{config}": str(config),
        "{schema}": str(schema),
        "{schema_json}": json.dumps(scenario.schema()),
        "{server}": shlex.join(["env", f"PYTHONPATH={above}", sys.executable, *line]),
        "{question}": scenario.text(),
    }
    words = shlex.split(command)
    for name, value in given.items():
        words = [word.replace(name, value) for word in words]
    return words


def _printed(words: Sequence[str], question: str | None, folder: str) -> str:
    try:
        ended = subprocess.run(
            words, input=question or "", text=True, encoding="utf-8", capture_output=True,
            timeout=_TIMEOUT_S, check=False, cwd=folder,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"(no answer: {error})"
    failed = f"\n(exit code {ended.returncode}: {ended.stderr.strip()})" if ended.returncode else ""
    return ended.stdout + failed


def _judged(
    scenario: Scenario, asked: Subject, calls: Sequence[NotedCall], said: Any, wall_s: float
) -> Outcome:
    wrong = [*wrong_fields(scenario, read_answer(said)), *wrong_effects(scenario, asked)]
    if all(call.failed for call in calls):
        wrong.append("no call was answered")
    if len(calls) > scenario.calls:
        wrong.append(f"made {len(calls)} calls of {scenario.calls}")
    text = said if isinstance(said, str) else json.dumps(said)
    return Outcome(scenario, tuple(calls), tuple(wrong), wall_s, text)
