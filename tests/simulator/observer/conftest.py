"""An observer in a crowd, in this process, with a database in memory."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from webots_mcp import MemoryDatabase
from webots_mcp.database.connection import connect
from webots_mcp.simulator.observer import Observer
from webots_mcp.standin import InProcessSimulation, InProcessSupervisor

STEP_MS = 16
CROWD = Path(__file__).parents[2] / "bridge" / "worlds" / "crowd.wbt"
OBSERVER = """
Robot { name "mcp_observer" supervisor TRUE synchronization FALSE controller "mcp_observer" }
"""


class Watching:
    """An observer, what it has recorded, and the other robots' hands."""

    def __init__(self, world: Path, database: MemoryDatabase) -> None:
        self.simulation = InProcessSimulation(world)
        self.robot = InProcessSupervisor("mcp_observer", world=self.simulation)
        self.database = database
        self.observer = Observer(self.robot, STEP_MS, database=database)

    def go_on(self, rounds: int = 1) -> None:
        for _ in range(rounds):
            assert self.observer.go_on()

    def rows(self, sql: str) -> list[Any]:
        with closing(connect(self.database, "reader")) as connection:
            return connection.execute(sql).fetchall()

    def newest(self) -> dict[str, dict[str, dict[str, float]]]:
        return json.loads(self.rows("SELECT data FROM state ORDER BY id DESC LIMIT 1")[0][0])

    def worlds(self) -> list[dict[str, Any]]:
        rows = self.rows("SELECT data FROM event WHERE kind = 'world' ORDER BY id")
        return [json.loads(text) for (text,) in rows]


@pytest.fixture
def world(tmp_path: Path) -> Path:
    file = tmp_path / "crowd.wbt"
    file.write_text(CROWD.read_text("utf-8") + OBSERVER, "utf-8")
    return file


@pytest.fixture
def database() -> Iterator[MemoryDatabase]:
    database = MemoryDatabase()
    yield database
    database.close()


@pytest.fixture
def watching(world: Path, database: MemoryDatabase) -> Iterator[Watching]:
    watching = Watching(world, database)
    yield watching
    watching.observer.bridge.close()
