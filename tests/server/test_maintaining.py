"""While a server runs, it keeps the database in order."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcp import Client

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, ask
from tests.waiting import until
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.purge import prune
from webots_mcp.store.retention_limits import Limit, Retention

pytestmark = pytest.mark.anyio


async def test_a_server_that_may_write_maintains_the_database(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    for i in range(1024):
        robot.state(i * 1.0, {"x": float(i)})
    async with connect():
        await until(lambda: recorded.connection.execute("SELECT 1 FROM chunk").fetchone())
        holder = recorded.connection.execute("SELECT holder FROM lease").fetchone()[0]
        assert holder.startswith("server ")
    assert recorded.connection.execute("SELECT count(*) FROM lease").fetchone() == (0,)


async def test_the_server_keeps_as_much_as_it_was_told(file: Path, recorded: Recorded) -> None:
    robot = recorded.robot()
    for i in range(1028):
        robot.state(i * 1.0, {"x": float(i)})
    limits = {"state": Limit(rows=4)}
    async with Client(create_server(file, file.parent, limits=limits)):
        counted = "SELECT count(*) FROM state"
        await until(lambda: recorded.connection.execute(counted).fetchone()[0] <= 4)
    assert recorded.connection.execute("SELECT min(sim_time_s) FROM state").fetchone() == (1024.0,)


async def test_a_run_whose_states_are_all_gone_is_not_said_to_have_had_none(
    connect: Connect, file: Path, recorded: Recorded
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1.0})
    prune(recorded.connection, file.parent, Retention(state=Limit(rows=0)), rest=False)
    async with connect() as client:
        hint = (await ask(client, "webots_get_robot_state"))["hint"]
        (run,) = (await ask(client, "webots_query_history", signals=["x"]))["runs"]
    assert "retention has deleted 1" in hint
    assert "webots_query_history" in hint
    assert run["numbers"]["x"]["value"] == [1.0]
