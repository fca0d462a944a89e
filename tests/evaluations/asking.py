"""Clients that are asked a scenario's question: one that follows its plan, and any command line."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import anyio
from mcp import Client
from mcp.types import CallToolResult

from tests.evaluations.scenario import Fact, Scenario
from tests.evaluations.subjects import subject
from webots_mcp.answers.shortening import tokens_in
from webots_mcp.server.mcp_server import create_server

CHECKOUT: Final = Path(__file__).parents[2]
_TIMEOUT_S: Final = 600.0


@dataclass(frozen=True)
class Outcome:
    """How a client did: what it called, which facts it lacked, how much it read, how long it took.

    Attributes:
        tokens: Of the tools' answers, by the rule of `tokens_in`; None where they were not seen.
        said: The text of a client that answers in words, or why it gave none.
    """

    scenario: Scenario
    called: tuple[str, ...]
    lacking: tuple[Fact, ...]
    wall_s: float
    tokens: int | None = None
    said: str = ""

    @property
    def is_right(self) -> bool:
        """Whether all facts are there, by no more calls than allowed."""
        return not self.lacking and 0 < len(self.called) <= self.scenario.calls


def ask_by_plan(scenario: Scenario) -> Outcome:
    """The scripted client: it makes the calls of the plan, and the facts are sought in the JSON."""
    with tempfile.TemporaryDirectory() as folder, subject(scenario.of, Path(folder)) as file:
        began_s = time.monotonic()
        answers = anyio.run(_answers, scenario, file)
    data = [data_of(each) for each in answers]
    return Outcome(
        scenario,
        tuple(tool for tool, _ in scenario.plan),
        tuple(fact for fact in scenario.facts if not fact.is_in(data)),
        time.monotonic() - began_s,
        sum(tokens_in(json.dumps(each, separators=(",", ":"))) for each in data),
    )


async def _answers(scenario: Scenario, file: Path) -> list[CallToolResult]:
    async with Client(create_server(file, file.parent)) as client:
        return [await client.call_tool(tool, arguments) for tool, arguments in scenario.plan]


def data_of(result: CallToolResult) -> dict[str, Any]:
    """An answer as data; of a picture its kind and the facts of its caption, of an error its text.

    Raises:
        AssertionError: It is neither.
    """
    if result.structured_content is not None:
        return result.structured_content
    texts = [each.text for each in result.content if each.type == "text"]
    if result.is_error:
        return {"error": "\n".join(texts)}
    (picture,) = [each.mime_type for each in result.content if each.type == "image"]
    return {"picture": picture, **json.loads(texts[0])}


def ask_by_command(scenario: Scenario, command: str) -> Outcome:
    """Give the question to a client of the command line, and judge the text that it prints.

    `{config}` in the command is a file that names the server, as .mcp.json; `{question}` is the
    question, which otherwise comes over stdin. The server counts the calls.
    """
    with tempfile.TemporaryDirectory() as folder, subject(scenario.of, Path(folder)) as file:
        calls, config = Path(folder, "calls.jsonl"), Path(folder, "mcp.json")
        line = ["-m", "tests.evaluations.counting", str(calls), "--database", str(file)]
        above = os.pathsep.join([str(CHECKOUT), os.environ.get("PYTHONPATH", "")])
        server = {"command": sys.executable, "args": line, "env": {"PYTHONPATH": above}}
        config.write_text(json.dumps({"mcpServers": {"webots": server}}), "utf-8")
        given = {"{config}": str(config), "{question}": scenario.question}
        words = shlex.split(command)
        for name, value in given.items():
            words = [word.replace(name, value) for word in words]
        began_s = time.monotonic()
        said = _printed(words, None if "{question}" in command else scenario.question)
        took_s = time.monotonic() - began_s
        text = calls.read_text("utf-8") if calls.exists() else ""
    called = tuple(json.loads(each)["tool"] for each in text.splitlines())
    lacking = tuple(fact for fact in scenario.facts if not fact.is_said(said))
    return Outcome(scenario, called, lacking, took_s, said=said)


def _printed(words: Sequence[str], question: str | None) -> str:
    try:
        ended = subprocess.run(
            words, input=question or "", text=True, encoding="utf-8", capture_output=True,
            timeout=_TIMEOUT_S, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"(no answer: {error})"
    failed = f"\n(exit code {ended.returncode}: {ended.stderr.strip()})" if ended.returncode else ""
    return ended.stdout + failed
