"""A pool of many recordings, and the recordings themselves."""

from __future__ import annotations

import math
import random
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from tests.plugins.pool.parquet import bucket
from tests.recordings.rows import Recorded
from webots_mcp.contract import DATABASE_NAME, new_uuid
from webots_mcp.plugins.pool.pool_contents import open_pool
from webots_mcp.plugins.pool.shipping import ShippingJob, ShippingReport, ship
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.recording import RecordingAccess

RECORDINGS: Final = 10
ROBOTS: Final = 4
STARTED_S: Final = 1_700_000_000.0  # 2023-11-14, 22:13 in UTC: later recordings begin the next day
_APART_S: Final = 900.0


class Many(NamedTuple):
    """A pool, and the recordings that were shipped to it."""

    pool: Path
    databases: tuple[Path, ...]


def record(folder: Path, number: int) -> Path:
    """20 to 35 s of a robot that meets walls, and says so."""
    folder.mkdir(parents=True)
    database = folder / DATABASE_NAME
    recorded, noise = Recorded(database), random.Random(number)
    with closing(recorded.connection) as connection:
        connection.execute("PRAGMA synchronous=OFF")  # it need not outlast the machine
        connection.execute("BEGIN IMMEDIATE")
        robot = recorded.robot(f"rover_{number % ROBOTS}", now=STARTED_S + _APART_S * number)
        connection.execute("UPDATE run SET uuid = ?, label = 'lab'", (new_uuid(),))
        for step in range(200 + 3 * number):
            time_s = round(step * 0.1, 3)
            front_m = round(1 + math.sin(time_s * (1 + number / 50)) + noise.random() / 10, 4)
            mode = "avoid" if front_m < 0.3 else "cruise"
            state = {"mode": mode, "front_m": front_m, "speed_m_s": noise.gauss(0.2, 0.01)}
            robot.state(time_s, state, at=robot.now + time_s)
        robot.log(1.0, "a wall", "warning")
        robot.now += 60
        robot.end_run("finished")
        connection.execute("COMMIT")
        while not make_chunks(connection).done:
            pass
    return database


@pytest.fixture(scope="session")
def many(tmp_path_factory: pytest.TempPathFactory) -> Many:
    """Recordings with all their states in one pool; do not change it."""
    folder = tmp_path_factory.mktemp("many")
    databases = [record(folder / str(number), number) for number in range(RECORDINGS)]
    url = bucket.empty()  # a disk would have to be waited for a thousand times
    for database in databases:
        recording = RecordingAccess(database, database.parent, read_only=True)
        ship(
            ShippingJob(recording, partial(open_pool, url, ships=True), full=True), ShippingReport()
        )
    bucket.copy_to(folder / "pool")
    return Many(folder / "pool", tuple(databases))
