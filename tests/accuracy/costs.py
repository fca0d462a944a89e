"""What kills cost, and how much a model has to read."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from statistics import median
from typing import Final

import anyio

from tests.accuracy.page import table
from tests.benchmarks.core import Bench, Line
from tests.benchmarks.kills import measure_interrupts, measure_kills
from tests.golden.asking import TOOLS, ask_tools
from tests.golden.recordings import RECORDINGS
from tests.golden.stored import drawn
from tests.tool_list import counts_of
from webots_mcp.answers.budget import ANSWER_TOKENS, LARGE_ANSWER_TOKENS
from webots_mcp.answers.shortening import tokens_in
from webots_mcp.contract import TOOL_TIERS
from webots_mcp.database.location import MemoryDatabase
from webots_mcp.server.mcp_server import create_server

_KILLS: Final = 200  # of each kind with a server


def kills(bench: Bench) -> Iterator[str]:
    """Controllers that are killed or interrupted while they record."""
    wide = replace(bench, kills=bench.count(_KILLS))
    killed = list(measure_kills.measure(wide))
    rows = killed[:-2]
    published = sum(_number(line.beside) for line in rows)
    lost, of = sum(round(line.measured) for line in rows), sum(_number(line.ours) for line in rows)
    yield (
        f"{lost:,} of {published:,} states whose `publish()` had returned were lost in {of:,} "
        "kills (SIGKILL) of controllers."
    )
    yield _KILLED
    yield table(("what", "how often", "", "found"), map(_cells, killed))
    yield _INTERRUPTED
    place = bench.place("interrupts")
    interrupted = measure_interrupts.measure(replace(bench, folder=place, effort=bench.effort / 2))
    yield table(("what", "how often", "out of", "found"), map(_cells, interrupted))


_KILLED: Final = """\
Controllers record into one database, with or without a server. They are killed at random
moments, up to 0.3 s after their start, while five commands wait for each. What they reported as
published is compared with the database. States that a lock kept out of the database wait in a
file next to it, and the next process ingests them. The machine was not switched off: without
`fsync` in the loop, a power cut may cost the newest states."""
_INTERRUPTED: Final = """\
Ctrl-C is sent at randomly chosen instructions of the code with which the bridge writes:"""


def _number(text: str) -> int:
    return int(re.sub(r"\D.*", "", text.replace(",", "")) or 0)


def _cells(line: Line) -> tuple[str, ...]:
    return line.what, line.ours, line.beside, f"{line.measured:.0f}"


def answers(bench: Bench) -> Iterator[str]:
    """The tools' answers about the recordings of the golden answers, and the list of the tools."""
    told = dict[str, list[int]]()
    for name in list(RECORDINGS)[: bench.count(len(RECORDINGS))]:
        bench.say(f"answers about {name}")
        recording = RECORDINGS[name]
        with drawn(recording) as folder:
            answered = anyio.run(ask_tools, recording, folder / "webots.db", TOOLS)
            for asked, answer in answered.items():
                tokens = tokens_in(json.dumps(answer, ensure_ascii=False, separators=(",", ":")))
                told.setdefault(TOOLS[asked][0], []).append(tokens)
    every = [tokens for each in told.values() for tokens in each]
    memory = MemoryDatabase()
    server = {tier: create_server(memory, memory.data_dir, tools=tier) for tier in TOOL_TIERS}
    core, whole, _ = (counts_of(anyio.run(server[tier].list_tools)) for tier in TOOL_TIERS)
    memory.close()
    yield (
        f"Half of {len(every)} answers have at most {median(every):,.0f} tokens, the list of the "
        f"{whole.tools} tools has {whole.tokens:,}. The longest answer has {max(every):,}."
    )
    yield _READ.format(
        budget=f"{ANSWER_TOKENS:,}",
        large=f"{LARGE_ANSWER_TOKENS:,}",
        tools=core.tools,
        tokens=f"{core.tokens:,}",
    )
    rows = [
        (f"`{tool}`", str(len(each)), f"{median(each):,.0f}", f"{max(each):,}")
        for tool, each in told.items()
    ]
    yield table(("question", "answers", "tokens, median", "most"), rows)


_READ: Final = """\
Each question is asked of three recordings (`python -m tests.golden`), in its usual form and in
others. An answer has at most {budget} tokens by design, or up to {large} with `limit` or
`max_points`. With `serve --tools core`, the list has {tools} tools and {tokens} tokens. Tokens
are counted by a rule of this package (`tokens_in`), not by the tokenizer of a model."""
