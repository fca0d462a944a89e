"""Commands: how long one takes there and back, and whether any runs twice."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterable
from contextlib import ExitStack, closing
from pathlib import Path

import anyio
from mcp import Client

from tests.benchmarks.measuring import Samples
from tests.benchmarks.processes import Program
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.rover import STEP_S
from tests.benchmarks.servers import our_server
from tests.benchmarks.table import Line, Target, duration
from webots_mcp.connection import connect, create_schema
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.queue import CommandQueue, fetch_command

_ROUND_TRIPS = 300
_LOOK_INTERVAL_S = 0.001
_COMMANDS = 10_000
_CLAIMERS = 8


@benchmark("command", "a command there and back, minus the loop's own step of 8 ms")
def measure_round_trip(bench: Bench) -> Iterable[Line]:
    times = bench.count(_ROUND_TRIPS, least=5)
    database = bench.folder / DATABASE_NAME
    with Program("answering_robot", bench.folder) as robot:
        robot.hear()
        bench.say("by the database")
        yield from _lines("by the database", _by_database(database, times))
        bench.say("by an MCP client over stdio")
        yield from _lines("by an MCP client", anyio.run(_by_client, database, times))


def _lines(what: str, trips: list[float]) -> Iterable[Line]:
    taken = Samples([trips])
    step = f"the loop's step {duration(STEP_S)}"
    p50_ms, p99_ms = (1e3 * (value - STEP_S) for value in (taken.p50, taken.p99))
    yield Line(f"p50, {what}", duration(taken.p50), step, p50_ms, "ms", Target(20))
    yield Line(f"p99, {what}", duration(taken.p99), step, p99_ms, "ms")


def _by_database(database: Path, times: int) -> list[float]:
    with closing(connect(database, "writer")) as connection:
        robot_id = connection.execute("SELECT max(id) FROM robot").fetchone()[0]
        return [_round_trip(connection, robot_id) for _ in range(times)]


def _round_trip(connection: sqlite3.Connection, robot_id: int) -> float:
    started = time.perf_counter()
    command = CommandQueue(connection).enqueue(robot_id, "echo", {"x": 1})
    while not fetch_command(connection, command.id).is_final:
        time.sleep(_LOOK_INTERVAL_S)
    return time.perf_counter() - started


async def _by_client(database: Path, times: int) -> list[float]:
    async with Client(our_server(database)) as client:
        return [await _call(client) for _ in range(times + 1)][1:]


async def _call(client: Client) -> float:
    started = time.perf_counter()
    arguments = {"action": "echo", "params": {"x": 1}}
    result = await client.call_tool("webots_send_command", arguments)
    assert not result.is_error, result.content
    return time.perf_counter() - started


@benchmark("claims", "commands claimed twice")
def measure_claims(bench: Bench) -> Iterable[Line]:
    commands = bench.count(_COMMANDS, least=50)
    database = bench.folder / DATABASE_NAME
    _queue_up(database, commands)
    bench.say(f"{_CLAIMERS} claimers")
    with ExitStack() as stack:
        claimers = [stack.enter_context(Program("claimer", database)) for _ in range(_CLAIMERS)]
        for claimer in claimers:
            claimer.hear()
        for claimer in claimers:
            claimer.send("go")
        ids = [command for claimer in claimers for command in claimer.hear()]
    twice, never = len(ids) - len(set(ids)), commands - len(set(ids))
    what = f"{commands:,} commands, {_CLAIMERS} processes at once"
    yield Line(what, f"{len(ids):,} claims", f"{never} left over", twice, "twice", Target(0))


def _queue_up(database: Path, commands: int) -> None:
    insert = (
        "INSERT INTO command (robot_id, action, params, status, created_wall_time_s, "
        "expires_wall_time_s) VALUES (1, 'move', '{}', 'pending', 0, 9e9)"
    )
    with closing(connect(database, "writer", create=True)) as connection:
        create_schema(connection)
        connection.execute("INSERT INTO robot VALUES (1, 'rover', 'Robot', '{}', 0, 0)")
        connection.execute("BEGIN")
        connection.executemany(insert, [()] * commands)
        connection.execute("COMMIT")
