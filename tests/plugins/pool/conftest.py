"""A recording that is shipped, and where to."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pytest

from tests.plugins.pool.lab import Lab, short_runs
from tests.plugins.pool.rows import pooled, recorded, uuid_of
from tests.postgres import NoServerError, Server, running_server
from tests.recordings.runs import Recorded
from webots_mcp.contract import DATABASE_NAME, new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.plugins.pool.pool_contents import open_pool
from webots_mcp.plugins.pool.shipping import ShippingJob, ShippingReport, ship
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.recording import RecordingAccess


class Shipped:
    """A recording in a folder, and a pool beside it."""

    def __init__(self, folder: Path, connection: sqlite3.Connection, pool: Path) -> None:
        self.folder, self.pool, self.connection = folder, pool, connection
        recording = RecordingAccess(folder / DATABASE_NAME, folder, read_only=True)
        self.order = ShippingJob(recording, partial(open_pool, str(pool), ships=True))

    @cached_property
    def recorded(self) -> Recorded:
        """Records more, of a robot that is made with it."""
        return Recorded(self.connection, self.folder)

    @property
    def uuid(self) -> str:
        return uuid_of(self.connection)

    def add_run(self, rows: int = 60, end: str | None = "reset") -> int:
        """A run with a UUID, in chunks."""
        run_id = self.recorded.add_run(rows, end)
        self.connection.execute("UPDATE run SET uuid = ? WHERE id = ?", (new_uuid(), run_id))
        self.make_chunks()
        return run_id

    def keep(self, run_id: int, start_s: float, end_s: float) -> None:
        """A stretch at full rate."""
        self.connection.execute(
            "INSERT INTO kept_stretch (run_id, uuid, start_sim_time_s, end_sim_time_s, "
            "wall_time_s, reason) VALUES (?, ?, ?, ?, 0, 'a bump')",
            (run_id, new_uuid(), start_s, end_s),
        )

    def make_chunks(self) -> None:
        while not make_chunks(self.connection).done:
            pass

    def ship(self, **options: Any) -> ShippingReport:
        report = ShippingReport()
        ship(replace(self.order, **options), report)
        return report

    def pooled(self) -> dict[str, Any]:
        return pooled(self.pool, self.uuid)

    def rows(self) -> dict[str, Any]:
        return recorded(self.connection)


@pytest.fixture
def shipped(tmp_path: Path) -> Iterator[Shipped]:
    folder = tmp_path / "robot"
    with closing(connect(folder / DATABASE_NAME, "writer", create=True)) as connection:
        create_schema(connection)
        yield Shipped(folder, connection, tmp_path / "pool")


@pytest.fixture(scope="session")
def postgres() -> Iterator[Server]:
    """A server that all tests share; each makes a database of its own."""
    with ExitStack() as stack:
        try:
            server = stack.enter_context(running_server())
        except NoServerError as reason:
            pytest.skip(str(reason))
        yield server


@pytest.fixture
def lab(tmp_path: Path, request: pytest.FixtureRequest) -> Lab:
    """With a pool of files, or of the kind that the test asks for."""
    if getattr(request, "param", "parquet") == "parquet":
        return Lab(tmp_path, str(tmp_path / "pool"))
    server: Server = request.getfixturevalue("postgres")
    return Lab(tmp_path, server.url(server.new_database()))


@pytest.fixture
def runs(tmp_path: Path) -> Iterator[Recorded]:
    with short_runs(tmp_path / "there") as recorded:
        yield recorded
