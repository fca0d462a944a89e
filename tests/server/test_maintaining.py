"""While a server runs, it keeps the database in order."""

from __future__ import annotations

import anyio
import pytest

from tests.server.conftest import Connect
from tests.store.recorded import Recorded

pytestmark = pytest.mark.anyio


async def test_a_server_that_may_write_maintains_the_database(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    for i in range(10):
        robot.state(i * 1.0, {"x": float(i)})
    async with connect():
        with anyio.fail_after(10):
            while not recorded.connection.execute("SELECT 1 FROM rollup").fetchone():
                await anyio.sleep(0.02)
        holder = recorded.connection.execute("SELECT holder FROM lease").fetchone()[0]
        assert holder.startswith("server ")
    assert recorded.connection.execute("SELECT count(*) FROM lease").fetchone() == (0,)
