"""Shippers that are killed at any moment, while a bridge records: the pool comes to hold it all."""

from __future__ import annotations

import functools
import multiprocessing
import random
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path

import pytest

from tests.pool.sqlite_target import SQLiteTarget, pooled, recorded
from tests.recordings.bridge import STEP_MS, Rover
from webots_mcp.connection import connect
from webots_mcp.pool.shipping import Order, Report, follow, ship
from webots_mcp.store.recording import Recording
from webots_mcp.store.rollup.rolling import roll

KILLS = 50


def order_of(folder: Path, pool: Path) -> Order:
    recording = Recording(folder / "webots.db", folder, read_only=True)
    return Order(recording, functools.partial(SQLiteTarget, pool), full=True, pictures=True)


def ship_on_and_on(folder: Path, pool: Path, writing: Connection) -> None:
    tell = functools.partial(writing.send, "about to write")
    order = replace(order_of(folder, pool), open_target=lambda: SQLiteTarget(pool, tell))
    follow(order, Report(), lambda _: None, 0.0)


@pytest.fixture(scope="module")
def processes() -> Iterator[ForkServerContext]:
    """Processes that have everything imported when they start."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, "webots_mcp.store.models"])
    yield context


def test_of_fifty_shippers_that_are_killed_while_a_bridge_records_no_row_is_lost_or_twice(
    tmp_path: Path, processes: ForkServerContext
) -> None:
    folder, pool = tmp_path / "robot", tmp_path / "pool.db"
    rover, chance = Rover(folder / "webots.db"), random.Random(11)
    steps = 0

    def drive(most: int) -> None:
        nonlocal steps
        steps += chance.randint(2, most)
        rover.drive(steps * STEP_MS / 1000, {}, (0.0, 0.0))

    with closing(connect(rover.database, "writer")) as connection:
        for _ in range(KILLS):
            drive(10)
            writing, theirs = processes.Pipe()
            shipper = processes.Process(target=ship_on_and_on, args=(folder, pool, theirs))
            shipper.start()
            writing.recv()
            drive(40)
            roll(connection)
            if chance.random() < 0.5:
                writing.recv()  # what was recorded since
            drive(4)
            shipper.kill()
            shipper.join()
        rover.bridge.close()
        while not roll(connection).done:
            pass
        last = ship_again(folder, pool)
        (uuid,) = connection.execute("SELECT uuid FROM recording").fetchone()
        rows = recorded(connection)
        assert pooled(pool, uuid) == rows
        assert len(rows["state"]) > 400
        assert last.rows["state"] < len(rows["state"]) / 2  # those that were killed did something
    assert ship_again(folder, pool).rows.total() == 0


def ship_again(folder: Path, pool: Path) -> Report:
    report = Report()
    ship(order_of(folder, pool), report)
    return report
