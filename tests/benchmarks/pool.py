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

from tests.benchmarks.core import (
    Bench,
    Line,
    NotMeasurableError,
    Samples,
    Target,
    alternate,
    benchmark,
    processor_s,
    ratio,
)
from tests.benchmarks.history import record
from tests.benchmarks.ways import make_states
from tests.plugins.pool.lab import short_runs
from tests.postgres import NoServerError, Server, running_server
from webots_mcp.contract import DATABASE_NAME, new_uuid
from webots_mcp.database.connection import connect as connect_recording
from webots_mcp.database.schema import create_schema
from webots_mcp.plugins.pool.fetching import fetch
from webots_mcp.plugins.pool.pool_contents import (
    RunFilter,
    open_pool,
    pooled_runs,
    resolve_filter,
)
from webots_mcp.plugins.pool.pool_interface import Batch, batches, table
from webots_mcp.plugins.pool.postgres_connection import Connection, connect
from webots_mcp.plugins.pool.postgres_pool import PostgresShipment
from webots_mcp.plugins.pool.postgres_schema import prepare
from webots_mcp.plugins.pool.shipping import ShippingJob, ShippingReport, ship
from webots_mcp.store.recording import RecordingAccess

_RESOLUTION_S: Final = 0.01  # of a process's times
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


@benchmark("pool_listing", "the runs of a pool of Parquet files with many recordings, listed")
def measure_listing(bench: Bench) -> Iterable[Line]:
    recordings = bench.count(1000, 20)
    with short_runs(bench.folder / "robot") as recorded:
        recording = RecordingAccess(
            recorded.folder / DATABASE_NAME, recorded.folder, read_only=True
        )
        url = str(bench.place("listed"))
        ship(ShippingJob(recording, partial(open_pool, url, ships=True)), ShippingReport())
    (shipped,) = Path(url).glob("recording=*")
    for _ in range(recordings - 1):
        other = shipped.with_name(f"recording={new_uuid()}")
        shutil.copytree(shipped, other, copy_function=os.link)
    with open_pool(url) as pool:
        listed_s = processor_s(lambda: pooled_runs(pool))
    yield Line(
        "list the runs of 1,000 recordings", f"{recordings}", "", 1000 * listed_s / recordings, "s",
        Target(1.0),
    )  # fmt: skip


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
        server: Server | None = None
        try:
            server = stack.enter_context(running_server())
            urls["PostgreSQL"] = lambda: server.url(server.new_database())
        except NoServerError as reason:
            bench.say(str(reason))
        for (name, make), full in product(urls.items(), (False, True)):
            what = f"{name}, {'states and chunks' if full else 'chunks'}"
            bench.say(what)
            url = make()
            recording = RecordingAccess(database, database.parent, read_only=True)
            order = ShippingJob(recording, partial(open_pool, url, ships=True), full=full)
            shipped_s = processor_s(lambda order=order: ship(order, ShippingReport()))
            here = bench.place(what)
            with closing(connect_recording(here / DATABASE_NAME, "writer", create=True)) as db:
                create_schema(db)
                with open_pool(url) as pool:
                    wanted = resolve_filter(pool, RunFilter(since="0"))
                    fetched_s = processor_s(partial(fetch, pool, db, here, wanted))
            yield _room(what, _size_of(url, server), rows, states)
            yield Line(f"{what}: ship", "", "", 1e6 * shipped_s / rows, "us/row")
            yield Line(f"{what}: fetch", "", "", 1e6 * fetched_s / rows, "us/row")


def _size_of(url: str, server: Server | None) -> int:
    """Of the tables that hold what was published, in bytes, with their indexes."""
    if "://" not in url:
        files = (each for name in _VALUES for each in Path(url).rglob(f"table={name}/**/*.parquet"))
        return sum(each.stat().st_size for each in files)
    assert server is not None
    sizes = ", ".join(f"pg_total_relation_size('{name}')" for name in _VALUES if name != "value")
    database = url.partition("@/")[2].partition("?")[0]
    return sum(server.execute(database, f"SELECT {sizes}")[0])


def _room(what: str, size: int, rows: int, states: int) -> Line:
    return Line(what, f"{size / rows:.0f} bytes/row", f"of JSON {states / rows:.0f}", size / states)


def _measure(bench: Bench, server: Server) -> Iterable[Line]:
    pool = server.new_database()
    url = server.url(pool)
    prepare(url, "the pool")
    rows = bench.count(20_000, 50)
    with connect(url, "the pool") as connection:
        shipped = list(batches(table("state"), _states(rows)))
        taken = alternate(
            {
                "ours": partial(_timed, connection, partial(_ship, connection, shipped)),
                "bare": lambda: _timed(connection, _copying(connection, shipped)),
            },
            5,
        )
    for name, spent in (("clock", _wall_s), ("processors", _both_s)):
        ours, bare = (Samples.of(map(spent, taken[who])) for who in ("ours", "bare"))
        per_s = [f"{rows / each.p50:,.0f} rows/s" for each in (ours, bare)]
        target = Target(0.5, least=True) if name == "processors" else None
        beside = f"a bare COPY {per_s[1]}"
        yield Line(f"by the {name}", per_s[0], beside, ratio(bare, ours), target=target)
    for side in ("shipper_s", "server_s"):
        spent_s = sum(getattr(each, side) for each in taken["ours"])
        per_s = round(rows * len(taken["ours"]) / max(spent_s, _RESOLUTION_S))
        yield Line(f"per second of a core of the {side[:-2]}", "", "", per_s, "rows")


def _wall_s(taken: _Taken) -> float:
    return taken.wall_s


def _both_s(taken: _Taken) -> float:
    return max(taken.shipper_s + taken.server_s, _RESOLUTION_S)


def _states(rows: int) -> Iterable[tuple[Any, ...]]:
    texts = [json.dumps(each, separators=(",", ":")) for each in make_states()]
    columns = table("state").columns
    for number in range(rows):
        values: dict[str, Any] = {
            "id": number + 1, "run_id": 1, "sim_time_s": number * 0.016,
            "wall_time_s": 1.7e9 + number * 0.016, "data": texts[number % len(texts)],
        }  # fmt: skip
        yield tuple(values.get(column) for column in columns)


def _ship(connection: Connection, shipped: list[Batch]) -> None:
    shipment = PostgresShipment(connection, "the pool", new_uuid())
    for number, each in enumerate(shipped):
        shipment.write([each], {each.table.name: number})


def _copying(connection: Connection, shipped: list[Batch]) -> Callable[[], None]:
    """A COPY of the rows of a new recording, whose text is made before anything is timed."""
    uuid, columns = new_uuid(), ", ".join(f'"{c}"' for c in shipped[0].table.columns)
    text = [
        "".join("\t".join(map(_field, (uuid, *row))) + "\n" for row in each.rows).encode()
        for each in shipped
    ]
    statement = f"COPY {shipped[0].table.name} (recording_uuid, {columns}) FROM STDIN".encode()

    def copy() -> None:
        with connection.cursor() as cursor, cursor.copy(statement) as sink:
            for part in text:
                sink.write(part)

    return copy


def _field(value: Any) -> str:
    return r"\N" if value is None else str(value).replace("\\", r"\\")


def _timed(connection: Connection, work: Callable[[], None]) -> _Taken:
    backend = psutil.Process(connection.info.backend_pid)
    before, started_s = backend.cpu_times(), time.perf_counter()
    shipper_s = processor_s(work)
    wall_s, after = time.perf_counter() - started_s, backend.cpu_times()
    server_s = after.user + after.system - before.user - before.system
    return _Taken(wall_s, shipper_s, server_s)


BENCHMARKS = (measure_pool, measure_listing, measure_room)
