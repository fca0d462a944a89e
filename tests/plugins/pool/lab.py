"""A pool, and a recording beside it to fetch into."""

from __future__ import annotations

import sqlite3
from collections.abc import Generator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.runs import Recorded
from webots_mcp.contract import DATABASE_NAME, new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.plugins.pool.fetching import FetchResult, fetch
from webots_mcp.plugins.pool.pool_contents import RunFilter, open_pool, resolve_filter
from webots_mcp.plugins.pool.shipping import ShippingJob, ShippingReport, ship
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.trial_sets import TrialResult, create_trial_set, finish_trial, trials_of

POSTGRES = pytest.param("postgres", marks=pytest.mark.slow)
IN_EACH_POOL = pytest.mark.parametrize("lab", ["parquet", POSTGRES], indirect=True)


class Lab:
    """A pool, and a folder of a recording to fetch into."""

    def __init__(self, folder: Path, url: str) -> None:
        self.url, self.here = url, folder / "here"
        self.here.mkdir()
        with closing(connect(self.here / DATABASE_NAME, "writer", create=True)) as connection:
            create_schema(connection)

    def ship(self, database: Path, **options: Any) -> None:
        recording = RecordingAccess(database, database.parent, read_only=True)
        ship(
            ShippingJob(recording, partial(open_pool, self.url, ships=True), **options),
            ShippingReport(),
        )

    def fetch(self, **choice: Any) -> FetchResult:
        with self.opened() as connection, open_pool(self.url) as pool:
            return fetch(pool, connection, self.here, resolve_filter(pool, RunFilter(**choice)))

    def opened(self) -> closing[sqlite3.Connection]:
        return closing(connect(self.here / DATABASE_NAME, "writer"))

    def everything(self) -> list[Any]:
        with self.opened() as connection:
            query = "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
            names = [name for (name,) in connection.execute(query).fetchall()]
            return [connection.execute(f"SELECT * FROM {name}").fetchall() for name in names]


@contextmanager
def short_runs(folder: Path) -> Generator[Recorded]:
    """Three short runs of two robots, with pictures, labels and a trial set of two."""
    folder.mkdir()
    with closing(connect(folder / DATABASE_NAME, "writer", create=True)) as connection:
        create_schema(connection)
        recorded = Recorded(connection, folder)
        for rows, robot in ((10, "rover"), (6, "rover"), (4, "drone")):
            recorded.add_run(rows, robot_id=None if robot == "rover" else recorded.robot(robot))
        for table in ("session", "run"):
            for key in (1, 2, 3):
                connection.execute(f"UPDATE {table} SET uuid = ? WHERE id = ?", (new_uuid(), key))
        connection.execute("UPDATE run SET label = 'wall ' || id")
        connection.execute("UPDATE parameter_value SET command_id = run_id")
        set_id = create_trial_set(connection, "{}", [{"kp": 1.0}, {"kp": 2.0}, {"kp": 3.0}])
        for trial, run_id in zip(trials_of(connection, set_id), (1, 2), strict=False):
            finish_trial(connection, trial, TrialResult(run_id, 1.5 * run_id, None))
        yield recorded
