"""Commands there and back, commands that several would claim, and a crowd of robots."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Generator, Iterable
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from statistics import fmean

import anyio
from mcp import Client

from tests.benchmarks.core import (
    Bench,
    Line,
    Samples,
    Target,
    added,
    alternate,
    benchmark,
    duration,
)
from tests.benchmarks.processes import Program, driving
from tests.benchmarks.servers import our_server, running_server
from tests.benchmarks.ways import STEP_S
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.queue import CommandQueue, fetch_command
from webots_mcp.database.schema import create_schema

_LOOK_INTERVAL_S = 0.001
_CLAIMERS = 8
_ROBOTS = 8
_READ_INTERVAL_S = 0.1
_RANGE = "SELECT sim_time_s, data FROM state WHERE id > (SELECT max(id) FROM state) - 2000"


@benchmark("command", "a command there and back, minus the loop's own step of 8 ms")
def measure_round_trip(bench: Bench) -> Iterable[Line]:
    times = bench.count(300, least=5)
    database = bench.folder / DATABASE_NAME
    with Program("answering_robot", bench.folder) as robot:
        robot.receive()
        bench.say("by the database")
        yield from _lines("by the database", _by_database(database, times))
        bench.say("by an MCP client over stdio")
        yield from _lines("by an MCP client", anyio.run(_by_client, database, times))


def _lines(what: str, trips: list[float]) -> Iterable[Line]:
    taken = Samples([trips])
    yield added(f"p50, {what}", taken.p50, "the loop's step", STEP_S, "ms", 10)
    yield added(f"p99, {what}", taken.above(0.99), "the loop's step", STEP_S, "ms")


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
    commands = bench.count(10_000, least=50)
    database = bench.folder / DATABASE_NAME
    _queue_up(database, commands)
    bench.say(f"{_CLAIMERS} claimers")
    with ExitStack() as stack:
        claimers = [stack.enter_context(Program("claimer", database)) for _ in range(_CLAIMERS)]
        for claimer in claimers:
            claimer.receive()
        for claimer in claimers:
            claimer.send("go")
        ids = [command for claimer in claimers for command in claimer.receive()]
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


@benchmark(
    "crowd", "publish() by robots at once in 8 ms loops, and a reader of 2,000 rows at 10 Hz"
)
def measure_crowd(bench: Bench) -> Iterable[Line]:
    count = bench.count(_ROBOTS, least=2)
    bench.say(f"starting {count} robots")
    steps, database = bench.count(300, least=20), bench.folder / DATABASE_NAME
    with ExitStack() as stack:
        robots = [
            stack.enter_context(Program("crowd_robot", bench.folder, n)) for n in range(count)
        ]
        for robot in robots:
            robot.receive()
        contenders = {
            "bridge": driving(robots, f"bridge {steps}", partial(_reading, database)),
            "served": driving(robots, f"bridge {steps}", partial(running_server, database)),
            "noise": driving(robots, f"noise {steps}"),
        }
        bench.say("8 ms steps")
        blocks = bench.count(5)
        taken = alternate(contenders, blocks, warm_up=blocks > 1)
    ours, served, noise = (
        Samples([[s for answer in block for s in answer["durations"]] for block in taken[name]])
        for name in contenders
    )
    put_off = fmean(answer["put_off"] for block in taken["bridge"] for answer in block)
    beside = f"json.dumps alone {duration(noise.worst)}"
    for what, taken_by in (
        (f"worst, {count} robots", ours),
        (f"worst, {count} robots and a server that looks back", served),
    ):
        yield Line(what, duration(taken_by.worst), beside, taken_by.worst * 1e3, "ms", Target(5))
    beside = "another writer held the lock, and nothing waited for it"
    yield Line("put off to the next call", f"{put_off:.1%}", beside, 100 * put_off, "%")


@contextmanager
def _reading(database: Path) -> Generator[None]:
    """Read ten times a second as long as the `with` block lasts."""
    over = threading.Event()

    def run() -> None:
        while not over.wait(_READ_INTERVAL_S):
            with closing(connect(database, "reader")) as connection:
                connection.execute(_RANGE).fetchall()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


BENCHMARKS = (measure_round_trip, measure_claims, measure_crowd)
