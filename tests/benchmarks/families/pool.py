"""Pools: how fast PostgreSQL takes rows beside a bare COPY, and what a recording takes there."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import psutil

from tests.benchmarks.measuring import Samples, alternate, ratio
from tests.benchmarks.recordings import record
from tests.benchmarks.registry import Bench, NotMeasurableError, benchmark
from tests.benchmarks.states import make_states
from tests.benchmarks.table import Line, Target
from tests.pool.lab import short_runs
from tests.postgres import NoServerError, Server, running_server
from webots_mcp.connection import connect as connect_recording
from webots_mcp.contract import DATABASE_NAME, new_uuid
from webots_mcp.plugins.pool.fetching import fetch
from webots_mcp.plugins.pool.pool_contents import Choice, meant, open_pool, open_target, pooled_runs
from webots_mcp.plugins.pool.pool_interface import Batch, Table, batches, table
from webots_mcp.plugins.pool.postgres_pool import PostgresShipment
from webots_mcp.plugins.pool.postgres_schema import Connection, connect, prepare
from webots_mcp.plugins.pool.shipping import Order, Report, ship
from webots_mcp.schema import create_schema
from webots_mcp.store.recording import Recording

_ROWS: Final = 20_000
_BLOCKS: Final = 5
_WALL_S: Final = 1.7e9
_RESOLUTION_S: Final = 0.01  # of a process's times
_LEAST: Final = Target(0.5, least=True)
_VALUES: Final = ("state", "row_group", "chunk", "value")


class _Taken(NamedTuple):
    """Seconds by the clock, and of processor time on both sides."""

    wall_s: float
    shipper_s: float
    server_s: float


@benchmark(
    "pool",
    "rows into PostgreSQL (fsync off, on this machine), beside a bare COPY of the same rows",
)
def measure_pool(bench: Bench) -> Iterable[Line]:
    try:
        with running_server() as server:
            yield from _measure(bench, server)
    except NoServerError as reason:
        raise NotMeasurableError(str(reason)) from reason


@benchmark(
    "pool_room", "a recording of 39 signals in pools: room, and processor time of ship and fetch"
)
def measure_room(bench: Bench) -> Iterable[Line]:
    rows = bench.rows or bench.count(100_000, least=2000)
    bench.say(f"building {rows:,} rows")
    database = bench.place("there") / DATABASE_NAME
    record(database, rows)
    with closing(connect_recording(database, "writer")) as db:
        db.execute("UPDATE run SET uuid = ?, end_reason = 'finished'", (new_uuid(),))
        db.execute("UPDATE session SET uuid = ?, ended_wall_time_s = 2e9", (new_uuid(),))
        held = dict(db.execute("SELECT name, sum(pgsize) FROM dbstat GROUP BY name").fetchall())
    states = sum(size for name, size in held.items() if "state" in name)
    chunks = sum(size for name, size in held.items() if "chunk" in name or "row_group" in name)
    yield _room("SQLite, states", states, rows, states)
    yield _room("SQLite, chunks", chunks, rows, states)
    with ExitStack() as stack:
        urls = {"Parquet": lambda: str(bench.place(f"files{len(list(bench.folder.iterdir()))}"))}
        try:
            server = stack.enter_context(running_server())
            urls["PostgreSQL"] = lambda: server.url(server.new_database())
        except NoServerError as reason:
            bench.say(str(reason))
        for (name, make), full in product(urls.items(), (False, True)):
            what = f"{name}, {'states and chunks' if full else 'chunks'}"
            bench.say(what)
            url = make()
            recording = Recording(database, database.parent, read_only=True)
            order = Order(recording, partial(open_target, url), full=full)
            shipped_s = _processor_s(lambda order=order: ship(order, Report()))
            here = bench.place(what)
            with closing(connect_recording(here / DATABASE_NAME, "writer", create=True)) as db:
                create_schema(db)
                with open_pool(url) as pool:
                    sizes = sum(each.size_bytes or 0 for each in pool.sizes()
                                if each.table in _VALUES)  # fmt: skip
                    wanted = meant(pool, Choice(since="0"))
                    fetched_s = _processor_s(partial(fetch, pool, db, here, wanted))
            yield _room(what, sizes, rows, states)
            yield Line(f"{what}: ship", "", "", 1e6 * shipped_s / rows, "us/row")
            yield Line(f"{what}: fetch", "", "", 1e6 * fetched_s / rows, "us/row")


@benchmark("pool_listing", "the runs of a pool of Parquet files with many recordings, listed")
def measure_listing(bench: Bench) -> Iterable[Line]:
    recordings = bench.count(1000, 20)
    with short_runs(bench.folder / "robot") as recorded:
        recording = Recording(recorded.folder / DATABASE_NAME, recorded.folder, read_only=True)
        url = str(bench.place("listed"))
        ship(Order(recording, partial(open_target, url)), Report())
    (shipped,) = Path(url).glob("recording=*")
    for _ in range(recordings - 1):
        other = shipped.with_name(f"recording={new_uuid()}")
        shutil.copytree(shipped, other, copy_function=os.link)
    with open_pool(url) as pool:
        listed_s = _processor_s(lambda: pooled_runs(pool))
    yield Line(
        "list the runs of 1,000 recordings", f"{recordings}", "", 1000 * listed_s / recordings, "s",
        Target(1.0),
    )  # fmt: skip


def _room(what: str, size: int, rows: int, states: int) -> Line:
    return Line(what, f"{size / rows:.0f} bytes/row", f"of JSON {states / rows:.0f}", size / states)


def _processor_s(work: Callable[[], object]) -> float:
    started_s = time.process_time()
    work()
    return time.process_time() - started_s


def _measure(bench: Bench, server: Server) -> Iterable[Line]:
    pool = server.new_database()
    url = server.url(pool)
    prepare(url, "the pool")
    server.execute(pool, "SELECT make_partition('state', 2023, 11)")
    rows = bench.count(_ROWS, 50)
    for name, made in (("state", _states(rows)), ("chunk", _chunks(rows))):
        bench.say(name)
        with connect(url, "the pool") as connection:
            yield from _lines(name, rows, _compare(connection, list(batches(table(name), made))))


def _states(rows: int) -> Iterable[tuple[Any, ...]]:
    texts = [json.dumps(each, separators=(",", ":")) for each in make_states()]
    for number in range(rows):
        yield _row(table("state"), {
            "id": number + 1, "run_id": 1, "sim_time_s": number * 0.016,
            "wall_time_s": _WALL_S + number * 0.016, "data": texts[number % len(texts)],
        })  # fmt: skip


def _chunks(rows: int) -> Iterable[tuple[Any, ...]]:
    figures = dict.fromkeys(("first", "last", "min", "max", "sum", "largest_step"), 1.25)
    counts = {"row_count": 1024, "value_count": 1024, "change_count": 9}
    numbers = bytes(range(256)) * 5
    for number in range(rows):
        key = {"id": number + 1, "run_id": 1, "signal_id": number % 39, "group_id": number // 39}
        held = {"codec": "pcodec/float64", "numbers": numbers}
        yield _row(table("chunk"), counts | key | figures | held)


def _row(of: Table, values: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(values.get(column) for column in of.columns)


def _compare(connection: Connection, shipped: list[Batch]) -> dict[str, list[_Taken]]:
    def ours() -> _Taken:
        shipment = PostgresShipment(connection, "the pool", new_uuid())
        return _timed(connection, lambda: _ship(shipment, shipped))

    def bare() -> _Taken:
        name, columns = shipped[0].table.name, ", ".join(f'"{c}"' for c in shipped[0].table.columns)
        text = _as_text(connection, shipped)
        copy = f"COPY {name} (recording_uuid, {columns}) FROM STDIN".encode()
        return _timed(connection, lambda: _copy(connection, copy, text))

    return alternate({"ours": ours, "bare": bare}, _BLOCKS)


def _ship(shipment: PostgresShipment, shipped: list[Batch]) -> None:
    for number, each in enumerate(shipped):
        shipment.write([each], {each.table.name: number})


def _copy(connection: Connection, statement: bytes, text: list[bytes]) -> None:
    with connection.cursor() as cursor, cursor.copy(statement) as copy:
        for part in text:
            copy.write(part)


def _as_text(connection: Connection, shipped: list[Batch]) -> list[bytes]:
    """The rows of a new recording as COPY has them, made before anything is timed."""
    uuid = new_uuid()
    return [
        "".join("\t".join(map(_field, (uuid, *row))) + "\n" for row in each.rows).encode()
        for each in shipped
    ]


def _field(value: Any) -> str:
    if isinstance(value, bytes):
        return rf"\\x{value.hex()}"
    return r"\N" if value is None else str(value).replace("\\", r"\\")


def _timed(connection: Connection, work: Callable[[], None]) -> _Taken:
    backend = psutil.Process(connection.info.backend_pid)
    before, shipper_s, started_s = backend.cpu_times(), time.process_time(), time.perf_counter()
    work()
    wall_s = time.perf_counter() - started_s
    shipper_s, after = time.process_time() - shipper_s, backend.cpu_times()
    server_s = after.user + after.system - before.user - before.system
    return _Taken(wall_s, shipper_s, server_s)


def _lines(name: str, rows: int, taken: dict[str, list[_Taken]]) -> Iterable[Line]:
    for said, of, target in (("clock", _clock, None), ("processors", _processors, _LEAST)):
        ours, bare = (Samples.of(map(of, taken[who])) for who in ("ours", "bare"))
        per_s = [f"{rows / each.p50:,.0f} rows/s" for each in (ours, bare)]
        what = f"{name}, by the {said}"
        yield Line(what, per_s[0], f"bare {per_s[1]}", ratio(bare, ours), target=target)
    for side in ("shipper_s", "server_s"):
        spent_s = sum(getattr(each, side) for each in taken["ours"])
        per_s = round(rows * len(taken["ours"]) / max(spent_s, _RESOLUTION_S))
        what = f"{name}, per second of a core of the {side.removesuffix('_s')}"
        yield Line(what, "", "", per_s, "rows/s")


def _clock(taken: _Taken) -> float:
    return taken.wall_s


def _processors(taken: _Taken) -> float:
    return max(taken.shipper_s + taken.server_s, _RESOLUTION_S)
