"""How long a controller and a client wait at the start."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

import anyio
from mcp import Client, StdioServerParameters

from tests.benchmarks.measuring import Samples, alternate, ratio
from tests.benchmarks.processes import run_python
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.servers import one_tool_server, our_server
from tests.benchmarks.table import Line, Target, duration
from tests.benchmarks.ways import ORJSON

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


@benchmark("import", "importing the bridge, in fresh processes")
def measure_import(bench: Bench) -> Iterable[Line]:
    folders = (str(bench.place(f"data {n}")) for n in range(1_000))
    first_row = {"before": _WITHOUT_ORJSON + _ROBOT}
    contenders: dict[str, Callable[[], float]] = {
        "bare": lambda: _time(_BARE),
        "bridge": lambda: _time(_BRIDGE, _WITHOUT_ORJSON),
        "row": lambda: _time(_FIRST_ROW.format(folder=next(folders)), **first_row),
    }
    if ORJSON is not None:
        contenders["orjson"] = lambda: _time(_BRIDGE)
    bench.say("fresh processes")
    taken = {
        name: Samples.of(times)
        for name, times in alternate(contenders, bench.count(15, least=1)).items()
    }
    yield _line("from webots_mcp import MCPBridge", taken, "bridge", Target(50))
    if "orjson" in taken:
        yield _line("the same, with orjson installed", taken, "orjson")
    yield _line("import, new database, first row", taken, "row")


def _line(what: str, taken: dict[str, Samples], name: str, target: Target | None = None) -> Line:
    ours, bare = taken[name], taken["bare"]
    over_ms = 1e3 * (ours.p50 - bare.p50)
    beside = f"{_BARE} {duration(bare.p50)}"
    return Line(what, duration(ours.p50), beside, over_ms, "ms more", target)


def _time(what: str, before: str = "") -> float:
    return float(run_python(_TIMED.format(what=what, before=before)))


@benchmark("server", "server started by a client over stdio, until its list of tools is there")
def measure_server(bench: Bench) -> Iterable[Line]:
    contenders = {
        "ours": lambda: anyio.run(_list_tools, our_server(bench.folder / "webots.db")),
        "one tool": lambda: anyio.run(_list_tools, one_tool_server()),
    }
    bench.say("fresh processes")
    taken = alternate(contenders, bench.count(7), warm_up=False)
    ours, one = Samples.of(taken["ours"]), Samples.of(taken["one tool"])
    beside = f"MCPServer of one tool {duration(one.p50)}"
    yield Line("ready", duration(ours.p50), beside, ratio(ours, one), target=Target(1.3))


async def _list_tools(server: StdioServerParameters) -> float:
    started = time.perf_counter()
    async with Client(server) as client:
        await client.list_tools()
        return time.perf_counter() - started
