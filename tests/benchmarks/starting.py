"""How long a controller and a client wait at the start, and what memory a bridge takes."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median

import anyio
from mcp import Client, StdioServerParameters

from tests.benchmarks.core import (
    Bench,
    Line,
    NotMeasurableError,
    Samples,
    Target,
    added,
    alternate,
    benchmark,
    compared,
    ratio,
)
from tests.benchmarks.processes import output_of, program_line
from tests.benchmarks.servers import one_tool_server, our_server
from tests.benchmarks.ways import ORJSON, make_states

_TIMED = """
import sys, time
{before}
started = time.perf_counter()
{what}
print(time.perf_counter() - started)
"""
_BARE = "import sqlite3, json"
_BRIDGE = "from webots_mcp import MCPBridge"
_WITHOUT_ORJSON = "sys.modules['orjson'] = None"
_FIRST_ROW = """
from webots_mcp import MCPBridge
bridge = MCPBridge(robot, {folder!r}, throttle_interval=1)
bridge.publish({{"x": 1}})
"""
# Without an import: what the robot imports, the bridge would get for nothing.
_ROBOT = """
class Robot:
    devices = {}
    def step(self, duration_ms): return 0
    def getTime(self): return 0.0
    def getName(self): return "rover"
    def getBasicTimeStep(self): return 8.0
    def getWorldPath(self): return ""
    def getSupervisor(self): return False
robot = Robot()
"""
_ROWS_PER_S = 4500
_MB = 1e6


@benchmark("import", "importing the bridge, in fresh processes")
def measure_import(bench: Bench) -> Iterable[Line]:
    folders = (str(bench.place(f"data {n}")) for n in range(1_000))
    robot = _WITHOUT_ORJSON + _ROBOT
    contenders: dict[str, Callable[[], float]] = {
        "bare": lambda: _time(_BARE),
        "bridge": lambda: _time(_BRIDGE, _WITHOUT_ORJSON),
        "row": lambda: _time(_FIRST_ROW.format(folder=next(folders)), robot),
    }
    bench.say("fresh processes")
    taken = alternate(contenders, bench.count(15, least=1))
    bare = median(taken["bare"])
    yield added(_BRIDGE, median(taken["bridge"]), _BARE, bare, "ms", 50)
    yield added("import, new database, first row", median(taken["row"]), _BARE, bare, "ms")


def _time(what: str, before: str = "") -> float:
    return float(output_of([sys.executable, "-c", _TIMED.format(what=what, before=before)]))


@benchmark("console", "commands in fresh processes, over the bare interpreter")
def measure_console(bench: Bench) -> Iterable[Line]:
    folder = bench.place("recording")
    _time(_FIRST_ROW.format(folder=str(folder)), _ROBOT)
    asked = {
        "--version": ["--version"],
        "status": ["status", "--data-dir", str(folder)],
        "--help": ["--help"],
    }
    contenders: dict[str, Callable[[], float]] = {
        "bare": lambda: _run_for([sys.executable, "-c", ""])
    }
    for name, arguments in asked.items():
        line = [sys.executable, "-m", "webots_mcp", *arguments]
        contenders[name] = lambda line=line: _run_for(line)
    bench.say("fresh processes")
    taken = alternate(contenders, bench.count(9, least=1))
    bare, limits_ms = median(taken["bare"]), {"--version": 50.0, "status": 150.0}
    for name in asked:
        what, took = f"webots-mcp {name}", median(taken[name])
        yield added(what, took, "python -c ''", bare, "ms", limits_ms.get(name))


def _run_for(line: list[str]) -> float:
    started = time.perf_counter()
    output_of(line)
    return time.perf_counter() - started


@benchmark("server", "server started by a client over stdio, until its list of tools is there")
def measure_server(bench: Bench) -> Iterable[Line]:
    contenders = {
        "ours": lambda: anyio.run(_list_tools, our_server(bench.folder / "webots.db")),
        "one tool": lambda: anyio.run(_list_tools, one_tool_server()),
    }
    bench.say("fresh processes")
    taken = alternate(contenders, bench.count(7), warm_up=False)
    ours, one = Samples.of(taken["ours"]), Samples.of(taken["one tool"])
    yield compared("ready", ours.p50, "MCPServer of one tool", one.p50, ratio(ours, one), 1.25)


async def _list_tools(server: StdioServerParameters) -> float:
    started = time.perf_counter()
    async with Client(server) as client:
        await client.list_tools()
        return time.perf_counter() - started


@benchmark("memory", "private memory over a bare process that imports sqlite3 and json")
def measure_memory(bench: Bench) -> Iterable[Line]:
    states = bench.folder / "states.json"
    states.write_text(json.dumps(make_states()))
    bare = _held("bare", states)["private"]
    if not bare:
        raise NotMeasurableError("only Linux tells what is private to a process")
    for kind in ("bridge", "orjson") if ORJSON else ("bridge",):
        bench.say(kind)
        rows = bench.count(112_500, least=500)  # an hour at 31.25 Hz
        held = _held(kind, states, bench.place(kind), rows, _ROWS_PER_S)
        ours, pace = held["private"], f"{rows:,} rows at {_ROWS_PER_S:,}/s"
        beside = f"bare {bare / _MB:.1f} MB"
        over = (ours - bare) / _MB
        yield Line(f"{kind}, {pace}", f"{ours / _MB:.1f} MB", beside, over, "MB", Target(7))
        yield Line("growth of it meanwhile", "", "", held["grown"] / _MB, "MB", Target(1))
        yield Line("longest write-ahead log", "", "", held["log"] / _MB, "MB", Target(32))


def _held(kind: str, states: Path, *order: object) -> dict[str, float]:
    return json.loads(output_of(program_line("memory", kind, states, *order)))


BENCHMARKS = (measure_import, measure_console, measure_server, measure_memory)
