"""How much a model has to read: the answer of each MCP tool about the arena's rover."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import AsyncIterator, Iterable
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple

import anyio
from mcp import Client
from mcp.types import ImageContent, TextContent, Tool

from tests.benchmarks.core import Bench, Line, Target, benchmark
from tests.benchmarks.processes import environment
from webots_mcp.answers.shortening import tokens_in
from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.server.mcp_server import create_server
from webots_mcp.standin import Simulation
from webots_mcp.standin.in_process import DEFAULT_WORLD

_ROWS: Final = 2000
_START_TIMEOUT_S: Final = 120
_TOKENS: Final = 2000
_OF_WEBOTS: Final = ("webots_launch_world", "webots_load_world", "webots_quit")
_PLOT: Final = "webots_plot"
_ARGUMENTS: Final[dict[str, dict[str, Any]]] = {
    "webots_monitor": {"lookback_wall_s": 10},
    "webots_query_history": {"signals": ["*"]},
    "webots_query_sql": {"sql": "SELECT * FROM state"},
    "webots_send_command": {"action": "set_speed", "params": {"speed": 6.0}},
    "webots_simulation_control": {"command": "resume"},
    "webots_annotate_run": {"label": "benchmark"},
    "webots_run": {"for_s": 0.5, "then": "go_on"},
    "webots_run_trials": {"parameters": {"speed": [4.0, 6.0]}, "score": "duration", "for_s": 0.2},
    "webots_breakpoint": {"condition": "distance_m.left < 0", "action": "log"},
    "webots_remove_breakpoint": {"breakpoint_id": 1},
    "webots_set_parameters": {"values": {"speed": 6.0}},
    "webots_get_field": {"path": "ROVER"},
    "webots_set_field": {"path": "BALL.physics.mass", "value": 0.06},
    "webots_add_node": {"vrml": 'DEF PILL Solid { name "pill" }'},
    "webots_remove_node": {"path": "CRATE"},
    "webots_compare_runs": {"run_ids": [1, 2]},
    "webots_wait_for_command": {"command_id": 1},
}
_LAST: Final = ("webots_compare_runs", "webots_wait_for_command")
_ROWS_AND_BYTES: Final = "SELECT count(*), coalesce(sum(length(data)), 0) FROM state"
_IS_CREATED: Final = "SELECT 1 FROM sqlite_master WHERE name = 'state'"


class _Answer(NamedTuple):
    """What a tool said: its text, the bytes of its picture, the JSON in the database by then."""

    tool: str
    text: str
    picture_bytes: int
    recorded_bytes: int


@benchmark("answers", "what a model reads: each tool's answer about the arena's rover")
def measure_answers(bench: Bench) -> Iterable[Line]:
    rows = bench.count(_ROWS, least=50)
    variables = {**environment(), DATA_DIR_VARIABLE: str(bench.folder)}
    database = bench.folder / DATABASE_NAME
    with Simulation(DEFAULT_WORLD, mode="fast", environment=variables) as simulation:
        bench.say(f"recording {rows:,} rows")
        simulation.wait_for(lambda: _recorded(database)[0] >= rows, _START_TIMEOUT_S)
        simulation.resume()
        for answer in anyio.run(_ask_all, bench):
            yield _line(answer)


def _recorded(database: Path) -> tuple[int, int]:
    """State rows, and the bytes of their JSON."""
    if not database.exists():
        return 0, 0
    with closing(connect(database, "reader")) as connection:
        if not connection.execute(_IS_CREATED).fetchone():
            return 0, 0
        return connection.execute(_ROWS_AND_BYTES).fetchone()


async def _ask_all(bench: Bench) -> list[_Answer]:
    server = create_server(bench.folder / DATABASE_NAME, bench.folder)
    async with Client(server) as client:
        tools = sorted((await client.list_tools()).tools, key=_order)
        listed = [tool.name for tool in tools if tool.name not in _without()]
        parts = [name for name in _ARGUMENTS if name not in listed]  # of merged tools, by name
        return [answer async for answer in _answers(bench, client, [*listed, *parts])]


def _without() -> tuple[str, ...]:
    """The tools that need what is not there: Webots itself, perhaps what draws."""
    return _OF_WEBOTS if find_spec("resvg_py") else (*_OF_WEBOTS, _PLOT)


def _order(tool: Tool) -> tuple[bool, bool]:
    """Those that act after those that read; last, those that ask about what came of that."""
    reads = bool(tool.annotations and tool.annotations.read_only_hint)
    return tool.name in _LAST, not reads


async def _answers(bench: Bench, client: Client, tools: list[str]) -> AsyncIterator[_Answer]:
    for tool in tools:
        bench.say(tool)
        result = await client.call_tool(tool, _ARGUMENTS.get(tool, {}))
        assert not result.is_error, (tool, result.content)
        text = "".join(block.text for block in result.content if isinstance(block, TextContent))
        pictures = (block.data for block in result.content if isinstance(block, ImageContent))
        picture = sum(len(b64decode(data)) for data in pictures)
        yield _Answer(tool, text, picture, _recorded(bench.folder / DATABASE_NAME)[1])


def _line(answer: _Answer) -> Line:
    ours = f"{len(answer.text.encode()):,} bytes"
    if answer.picture_bytes:
        ours += f", picture of {answer.picture_bytes:,}"
    beside = f"all rows as JSON {answer.recorded_bytes:,} bytes"
    tokens = tokens_in(answer.text)
    return Line(answer.tool, ours, beside, tokens, "tokens", Target(_TOKENS))


BENCHMARKS = (measure_answers,)
