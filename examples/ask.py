"""Has the conversation of an example with its robots on the stand-in, and prints it as Markdown.

    python examples/ask.py examples/e_puck > examples/e_puck/README.md

What is said stands in the example's `conversation.toml`; what the tools answer comes from its
world, through an MCP client and a server as an assistant's own would.
"""

import json
import os
import re
import sqlite3
import sys
import tempfile
from contextlib import closing
from importlib import import_module
from pathlib import Path
from typing import Any

import anyio
from mcp import Client, StdioServerParameters

from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME
from webots_mcp.standin import Simulation

SHOWN_CHARACTERS = 600
LONGEST_START_S = 480.0  # of wall time until what is talked of has happened
READY = "SELECT 1 FROM state WHERE sim_time_s > 1"

Answer = dict[str, Any]
Turn = dict[str, Any]
"""`person` says something (not where the assistant goes on by itself), `tool` is called with
`arguments`, the parts `shown` of its answer are on the page, and the assistant `says` something,
with the answer's values in the place of their names.
"""


def main(example: Path) -> None:
    text = (example / "conversation.toml").read_text("utf-8")
    conversation = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli").loads(text)
    with tempfile.TemporaryDirectory() as folder:
        environment = {DATA_DIR_VARIABLE: folder}
        world, mode = example / conversation["world"], conversation.get("mode", "realtime")
        with Simulation(world, mode=mode, environment=environment) as simulation:
            database, ready = Path(folder) / DATABASE_NAME, conversation.get("ready", READY)
            simulation.wait_for(
                lambda: database.exists() and answers(database, ready), LONGEST_START_S
            )
            simulation.resume()  # in real time: it need not hurry while they talk
            parts = anyio.run(converse, Path(folder), conversation["turn"])
    print("\n".join((conversation["beginning"], *parts)), end="")


def answers(database: Path, sql: str) -> bool:
    """Whether the recording has what the conversation begins with."""
    with closing(sqlite3.connect(database)) as connection:
        has_tables = connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'log'").fetchone()
        return bool(has_tables and connection.execute(sql).fetchone())


async def converse(folder: Path, turns: list[Turn]) -> list[str]:
    """What is said, called and answered, as Markdown."""
    parts, known = list[str](), dict[str, Any]()
    server = StdioServerParameters(
        command=sys.executable,
        args=["-m", "webots_mcp", "serve", "--data-dir", str(folder)],
        env=dict(os.environ),
    )
    async with Client(server) as client:
        for turn in turns:
            arguments = filled(turn.get("arguments", {}), known)
            result = await client.call_tool(turn["tool"], arguments)
            if result.is_error or result.structured_content is None:
                raise RuntimeError(f"{turn['tool']}: {result.content}")
            answer = result.structured_content
            remember(answer, known)
            parts.append(as_text(turn, arguments, answer))
    return parts


def filled(arguments: dict[str, Any], known: dict[str, Any]) -> dict[str, Any]:
    """With the ids of earlier answers in the place of their names."""
    text = json.dumps(arguments)
    return json.loads(re.sub(r'"\{(\w+)\}"', lambda name: str(known[name[1]]), text))


def remember(answer: Answer, known: dict[str, Any]) -> None:
    known["command_id"] = answer.get("command_id")
    if "run_id" in answer:
        known.setdefault("asked_run_id", answer["run_id"])
    if ran := answer.get("ran"):
        known["run_id"] = ran["run_id"]
        known.setdefault("first_run_id", ran["run_id"])


def as_text(turn: Turn, arguments: Answer, answer: Answer) -> str:
    shown = {name: answer[name] for name in turn["shown"] if answer.get(name) is not None}
    lines = [f"  {json.dumps(name)}: {cut(json.dumps(shown[name]))}" for name in shown]
    body = "{\n" + ",\n".join(lines) + "\n}"
    call = f"{turn['tool']}({json.dumps(arguments) if arguments else ''})"
    question = f"**You:** {turn['person']}\n\n" if "person" in turn else ""
    says = turn["says"].format(**answer)
    return f"{question}```\n{call}\n```\n\n```\n{body}\n```\n\n**Assistant:** {says}\n"


def cut(text: str) -> str:
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[:SHOWN_CHARACTERS]} ..."


if __name__ == "__main__":
    main(Path(sys.argv[1]))
