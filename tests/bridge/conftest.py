"""A robot of the stand-in in this process, a database in memory, and a bridge between them."""

from __future__ import annotations

import json
import math
import sqlite3
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.waiting import wait_for
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge import encoding, recorder
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.location import Database
from webots_mcp.database.waiting_file import waiting_path
from webots_mcp.standin import InProcessSupervisor

STEP_MS = 16


class Recording:
    """What a test asks a database, and the commands that it sends to the robot."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def rows(self, sql: str, *values: object) -> list[Any]:
        """All rows; rows of one column as plain values."""
        with closing(connect(self.database, "reader")) as connection:
            found = connection.execute(sql, values).fetchall()
        return [row[0] if len(row) == 1 else row for row in found]

    def states(self) -> list[dict[str, Any]]:
        return [json.loads(text) for text in self.rows("SELECT data FROM state ORDER BY id")]

    def send(self, action: str, /, time_to_live_s: float = 10, **params: object) -> int:
        with closing(connect(self.database, "writer")) as connection:
            return send(connection, action, params, time_to_live_s)

    def fate(self, command_id: int) -> tuple[str, Any, str | None]:
        """Status, result and error of a command."""
        sql = "SELECT status, result, error FROM command WHERE id = ?"
        status, result, error = self.rows(sql, command_id)[0]
        return status, json.loads(result) if result else None, error


def send(
    connection: sqlite3.Connection, action: str, params: object, time_to_live_s: float = 10
) -> int:
    now = time.time()
    text = params if isinstance(params, str) else json.dumps(params)
    cursor = connection.execute(
        "INSERT INTO command (robot_id, action, params, status, created_wall_time_s, "
        "expires_wall_time_s) VALUES ((SELECT max(id) FROM robot), ?, ?, 'pending', ?, ?)",
        (action, text, now, now + time_to_live_s),
    )
    assert cursor.lastrowid is not None
    return cursor.lastrowid


@contextmanager
def write_lock(file: Path) -> Generator[sqlite3.Connection]:
    """Another writer in the middle of its transaction."""
    with closing(connect(file, "writer")) as other:
        other.execute("BEGIN IMMEDIATE")
        yield other
        other.commit()


@pytest.fixture(params=["orjson", "standard library"])
def encoder(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both encoders give the same text, on a busy machine too."""
    monkeypatch.setattr("webots_mcp.bridge.json_cleaning.OBJECTS_BUDGET_S", math.inf)
    if request.param != "orjson":
        monkeypatch.setattr(encoding, "orjson", None)


@pytest.fixture
def database() -> Iterator[MemoryDatabase]:
    memory = MemoryDatabase()
    yield memory
    memory.close()


@pytest.fixture
def recording(database: MemoryDatabase) -> Recording:
    return Recording(database)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "mcp_data" / DATABASE_NAME


@pytest.fixture
def filed(file: Path) -> Recording:
    return Recording(file)


@pytest.fixture
def retry_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """No waiting between tries, so that the tests need no sleep."""
    monkeypatch.setattr(recorder, "_PATIENCE", recorder.RecorderPatience(retry_s=0.0))


@pytest.fixture
def robot() -> InProcessSupervisor:
    return InProcessSupervisor("rover")


@pytest.fixture
def bridge(
    robot: InProcessSupervisor, database: MemoryDatabase, monkeypatch: pytest.MonkeyPatch
) -> Iterator[MCPBridge]:
    """A bridge that records every call; strict, so that a test sees what went wrong."""
    monkeypatch.setenv("WEBOTS_MCP_STRICT", "1")
    with MCPBridge(robot, throttle_interval=1, database=database) as bridge:
        yield bridge


@pytest.fixture
def drive(robot: InProcessSupervisor, bridge: MCPBridge) -> Callable[[int], None]:
    """The user's loop: so many rounds of step, publish, get_command."""

    def rounds(count: int) -> None:
        for _ in range(count):
            assert robot.step(STEP_MS) != -1
            bridge.publish({"mode": "cruise"})
            eager(bridge)

    return rounds


def numbers(recording: Recording) -> list[int]:
    """The `n` of all states, in order."""
    return [state["n"] for state in recording.states()]


def waiting_file(bridge: MCPBridge) -> Path:
    """Where the rows of the bridge wait while its database takes none."""
    assert isinstance(bridge.database, Path)
    return waiting_path(bridge.database, bridge._session.recorder.uuid)  # pyright: ignore[reportPrivateUsage]


def keep_in_memory(bridge: MCPBridge) -> None:
    """From now on no row can wait in the file either, as on a full disk."""
    waiting_file(bridge).mkdir()


def catch_up(bridge: MCPBridge) -> None:
    """Write all that waits, whatever the maintainer is doing at this moment."""
    wait_for(bridge._session.recorder.flush)  # pyright: ignore[reportPrivateUsage]
    assert bridge.stats().rows_waiting == 0


def heartbeat_now(bridge: MCPBridge) -> None:
    """The next call looks after the file, as it would half a second later."""
    bridge._session.heartbeat._next_s = 0.0  # pyright: ignore[reportPrivateUsage]
    bridge.get_command()


def eager(bridge: MCPBridge) -> dict[str, Any] | None:
    """get_command() without its rule to look into the queue at most every 5 ms."""
    bridge._session.control._next_poll_s = 0.0  # pyright: ignore[reportPrivateUsage]
    return bridge.get_command()
