"""What the tools answer where there is no database that they can read."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.older_recording import make_older
from tests.recordings.rows import Recorded
from tests.server.conftest import DATA_TOOLS, Connect, ask, fail, text_of
from webots_mcp.contract import SCHEMA_VERSION

pytestmark = pytest.mark.anyio


async def test_without_a_database_every_reading_tool_says_how_to_get_one(
    connect: Connect, file: Path
) -> None:
    async with connect() as client:
        for tool in DATA_TOOLS:
            answer = await ask(client, tool)
            assert answer["status"] == "never seen"
            for word in (str(file), "MCPBridge", "webots-mcp demo", "--data-dir"):
                assert word in answer["hint"], tool
        assert "MCPBridge" in text_of(await client.call_tool("webots_get_camera", {}))
        assert "MCPBridge" in text_of(await client.call_tool("webots_monitor", {}))
    assert not file.exists()


async def test_an_empty_file_and_an_empty_database_are_nothing_recorded_either(
    connect: Connect, file: Path
) -> None:
    file.touch()
    async with connect() as client:
        assert "is empty" in (await ask(client, "webots_list_robots"))["hint"]
        Recorded(file).close()
        assert "MCPBridge" in (await ask(client, "webots_list_robots"))["hint"]


async def test_a_database_that_appears_later_is_found(connect: Connect, file: Path) -> None:
    async with connect() as client:
        assert (await ask(client, "webots_get_robot_state"))["status"] == "never seen"
        recorded = Recorded(file)
        recorded.robot().state(1.0, {"x": 1})
        assert (await ask(client, "webots_get_robot_state"))["state"] == {"x": 1}
        recorded.close()


def make_notes(file: Path) -> None:
    file.write_text("certainly no database, " * 100)


def make_foreign(file: Path) -> None:
    with closing(sqlite3.connect(file)) as other, other:
        other.execute("CREATE TABLE contact (name TEXT)")


def make_newer(file: Path) -> None:
    Recorded(file).close()
    with closing(sqlite3.connect(file)) as other:
        other.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (make_notes, "is not a database"),
        (make_foreign, "belongs to another application"),
        (make_newer, "pip install --upgrade"),
        (make_older, "move it aside"),
    ],
    ids=["no database", "of another application", "newer", "older"],
)
async def test_a_database_that_is_none_of_ours_is_a_clear_error(
    connect: Connect, file: Path, make: Callable[[Path], object], said: str
) -> None:
    make(file)
    async with connect() as client:
        assert said in await fail(client, "webots_list_robots")


async def test_a_damaged_database_is_a_clear_error(
    connect: Connect, recorded: Recorded, file: Path
) -> None:
    recorded.robot()
    recorded.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
    recorded.close()
    data = file.read_bytes()
    file.write_bytes(data[:4096] + b"\xff" * (len(data) - 4096))
    async with connect() as client:
        assert "damaged" in await fail(client, "webots_list_robots")
