"""Shippers that are killed at any moment, while a bridge records: the pool comes to hold it all."""

from __future__ import annotations

import functools
import multiprocessing
import random
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import pytest

from tests.plugins.pool.rows import BeforeWrite, pooled, recorded
from tests.postgres import Server
from tests.recordings.bridge import STEP_MS, Rover
from webots_mcp.database.connection import connect
from webots_mcp.plugins.pool.pool_contents import open_pool
from webots_mcp.plugins.pool.shipping import ShippingJob, ShippingReport, follow, ship
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.recording import RecordingAccess

pytestmark = pytest.mark.slow

KILLS = {"postgresql": 20, "parquet": 8}


def order_of(folder: Path, url: str) -> ShippingJob:
    recording = RecordingAccess(folder / "webots.db", folder, read_only=True)
    return ShippingJob(
        recording, functools.partial(open_pool, url, ships=True), full=True, pictures=True
    )


def ship_on_and_on(folder: Path, url: str, writing: Connection) -> None:
    def tell() -> None:
        writing.send("about to write")

    opened: Callable[[], Any] = lambda: BeforeWrite(open_pool(url, ships=True), tell)  # noqa: E731
    order = replace(order_of(folder, url), open_pool=opened)
    follow(order, ShippingReport(), lambda _: None, 0.01)


def ship_again(folder: Path, url: str) -> ShippingReport:
    report = ShippingReport()
    ship(order_of(folder, url), report)
    return report


@pytest.fixture(scope="module")
def processes() -> Iterator[ForkServerContext]:
    """Processes that have everything imported when they start."""
    context = multiprocessing.get_context("forkserver")
    engines = [
        "webots_mcp.plugins.pool.postgres_pool",
        "webots_mcp.plugins.pool.parquet_pool",
    ]
    context.set_forkserver_preload([__name__, "webots_mcp.store.models", *engines])
    yield context


@pytest.fixture(params=["postgresql", "parquet"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A pool of each kind, with its tables."""
    if request.param == "parquet":
        return str(tmp_path / "pool")
    server: Server = request.getfixturevalue("postgres")
    return server.url(server.new_database())


def test_of_shippers_that_are_killed_while_a_bridge_records_no_row_is_lost_or_twice(
    tmp_path: Path, url: str, processes: ForkServerContext
) -> None:
    folder = tmp_path / "robot"
    rover, chance = Rover(folder / "webots.db"), random.Random(11)
    steps = 0

    def drive(most: int) -> None:
        nonlocal steps
        steps += chance.randint(2, most)
        rover.drive(steps * STEP_MS / 1000, {}, (0.0, 0.0))

    with closing(connect(rover.database, "writer")) as connection:
        ship_again(folder, url)
        for _ in range(KILLS["postgresql" if "://" in url else "parquet"]):
            drive(10)
            writing, theirs = processes.Pipe()
            shipper = processes.Process(target=ship_on_and_on, args=(folder, url, theirs))
            shipper.start()
            writing.recv()
            drive(40)
            make_chunks(connection)
            if chance.random() < 0.5:
                writing.recv()  # what was recorded since
            drive(4)
            shipper.kill()
            shipper.join()
        rover.bridge.close()
        while not make_chunks(connection).done:
            pass
        last = ship_again(folder, url)
        (uuid,) = connection.execute("SELECT uuid FROM recording").fetchone()
        rows = recorded(connection)
    assert pooled(url, uuid) == rows
    assert len(rows["state"]) > 80
    assert last.rows["state"] < len(rows["state"]) / 2  # those that were killed did something
    assert ship_again(folder, url).rows.total() == 0
