"""Try, wait, look, compare: a conversation with an assistant, on the stand-in, as Markdown.

    python examples/conversation/conversation.py > examples/conversation/README.md

What is said stands here; what the tools answer comes from a robot in the arena, through an MCP
client and a server as an assistant's own would.
"""

import json
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import anyio
from mcp import Client, StdioServerParameters

from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME
from webots_mcp.standin import Simulation

WORLD = Path(__file__).parents[1] / "worlds" / "arena.wbt"
SHOWN_CHARACTERS = 600
BEGINNING = """# Try, wait, look, compare

How fast should the rover cruise? A conversation in which an assistant finds out, with what it calls
and what the tools answer (shortened to what matters here). `conversation.py` has it with
a robot in the stand-in, and writes this page; a test has it again and compares.
"""

Answer = dict[str, Any]


class Turn(NamedTuple):
    """What a person says, what the assistant calls for it, and what it makes of the answer.

    Attributes:
        person: Empty where the assistant goes on by itself.
        shown: The parts of the answer that this page shows.
        says: With the answer's values in the place of their names.
    """

    person: str
    tool: str
    arguments: dict[str, Any]
    shown: tuple[str, ...]
    says: str


STOPPED = "It stopped: {stopped}, after {ran[advanced_s]} simulated seconds, in run {ran[run_id]}."

TURNS: tuple[Turn, ...] = (
    Turn(
        "What can I tune?",
        "webots_get_parameters",
        {},
        ("parameters",),
        "Its cruising speed, and how near it gets before it turns; the bounds stand beside them.",
    ),
    Turn(
        "Note each time it comes nearer than 20 cm to anything.",
        "webots_breakpoint",
        {"condition": "lidar.nearest_m < 0.2", "action": "log"},
        ("breakpoint_id", "condition", "action", "armed"),
        "The bridge asks that at every step from now on (armed: {armed}).",
    ),
    Turn(
        "Try speed 3: from the start, 10 s, as fast as you can.",
        "webots_run",
        {"reset": True, "parameters": {"speed": 3.0}, "for_s": 10},
        ("stopped", "ran", "mode", "movement"),
        STOPPED,
    ),
    Turn(
        "Now 8, but stop as soon as it is stuck.",
        "webots_run",
        {"reset": True, "parameters": {"speed": 8.0}, "for_s": 10, "until": "stuck"},
        ("stopped", "ran", "mode", "movement"),
        STOPPED,
    ),
    Turn(
        "Let me watch a second of that in real time.",
        "webots_run",
        {"for_s": 1, "pace": "real_time", "timeout_s": 0.3},
        ("stopped", "why_stopped", "command_id", "hint"),
        "The call is over before that second is: {why_stopped}. I go on waiting for it.",
    ),
    Turn(
        "",
        "webots_wait_for_command",
        {"command_id": "{command_id}", "timeout_s": 30},
        ("stopped", "ran", "mode"),
        STOPPED,
    ),
    Turn(
        "How near did it come?",
        "webots_list_breakpoints",
        {},
        ("breakpoints",),
        "The breakpoint tells how often it was hit, and when last.",
    ),
    Turn(
        "And when, in the second run?",
        "webots_find_events",
        {"where": "lidar.nearest_m < 0.2", "kinds": ["condition"], "run_id": "{run_id}"},
        ("run_id", "events", "verdicts"),
        "That is asked of the recording, and needs no robot. Found: {verdicts[found]}.",
    ),
    Turn(
        "Which speed was better?",
        "webots_compare_runs",
        {"run_ids": ["{first_run_id}", "{run_id}"]},
        ("compared_s", "groups", "measures"),
        "One run of each says nothing about the noise: repeat both before you believe it.",
    ),
    Turn(
        "Do so, in 5 s each, and take 5 in, too.",
        "webots_run_trials",
        {
            "parameters": {"speed": [3.0, 5.0, 8.0]},
            "score": "max(pose.x) - first(pose.x) - count(stuck)",
            "for_s": 5,
            "repeats": 2,
        },
        ("trial_set", "state", "trials", "over", "failed", "ranked", "noise", "best_is_better"),
        "The verdict: {verdict}. What can be scored: [docs/trials.md](../../docs/trials.md).",
    ),
)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        environment = {DATA_DIR_VARIABLE: folder}
        with Simulation(WORLD, environment=environment) as simulation:
            simulation.wait_for(lambda: (Path(folder) / DATABASE_NAME).exists(), 30.0)
            simulation.wait_for(lambda: simulation.time_s > 1.0, 30.0)
            print(anyio.run(converse, Path(folder)), end="")


async def converse(folder: Path) -> str:
    """The conversation as Markdown."""
    parts, known = [BEGINNING], dict[str, Any]()
    server = StdioServerParameters(
        command=sys.executable,
        args=["-m", "webots_mcp", "serve", "--data-dir", str(folder)],
        env=dict(os.environ),
    )
    async with Client(server) as client:
        for turn in TURNS:
            arguments = filled(turn.arguments, known)
            result = await client.call_tool(turn.tool, arguments)
            if result.is_error or result.structured_content is None:
                raise RuntimeError(f"{turn.tool}: {result.content}")
            answer = result.structured_content
            remember(answer, known)
            parts.append(as_text(turn, arguments, answer))
    return "\n".join(parts)


def filled(arguments: dict[str, Any], known: dict[str, Any]) -> dict[str, Any]:
    """With the ids of earlier answers in the place of their names."""
    text = json.dumps(arguments)
    return json.loads(re.sub(r'"\{(\w+)\}"', lambda name: str(known[name[1]]), text))


def remember(answer: Answer, known: dict[str, Any]) -> None:
    known["command_id"] = answer.get("command_id")
    if ran := answer.get("ran"):
        known["run_id"] = ran["run_id"]
        known.setdefault("first_run_id", ran["run_id"])


def as_text(turn: Turn, arguments: Answer, answer: Answer) -> str:
    shown = {name: answer[name] for name in turn.shown if answer.get(name) is not None}
    lines = [f"  {json.dumps(name)}: {cut(json.dumps(shown[name]))}" for name in shown]
    body = "{\n" + ",\n".join(lines) + "\n}"
    call = f"{turn.tool}({json.dumps(arguments) if arguments else ''})"
    question = f"**You:** {turn.person}\n\n" if turn.person else ""
    says = turn.says.format(**answer)
    return f"{question}```\n{call}\n```\n\n```\n{body}\n```\n\n**Assistant:** {says}\n"


def cut(text: str) -> str:
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[:SHOWN_CHARACTERS]} ..."


if __name__ == "__main__":
    main()
