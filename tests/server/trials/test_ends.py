"""A server or a controller that ends in the middle of a trial set."""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import anyio
import pytest
from anyio import to_thread
from mcp import Client, MCPError, StdioServerParameters

from tests.bridge.conftest import Recording
from tests.bridge.processes.stopping import stop_between_writes
from tests.server.conftest import Connect, ask, ask_until, fail
from tests.server.story import rows_of
from tests.server.trials.conftest import SPEEDS, TunableDriver, trials, value_of
from tests.waiting import until
from webots_mcp.database.connection import connect as database
from webots_mcp.server.mcp_server import create_server
from webots_mcp.standin import Simulation

pytestmark = [pytest.mark.anyio, pytest.mark.slow]
SERVER = """
import os, pathlib, sys
from webots_mcp.cli import main

pathlib.Path(sys.argv[1]).write_text(str(os.getpid()))
main(["serve", "--database", sys.argv[2]])
"""
TRIED = "SELECT count(*) FROM command WHERE json_extract(params, '$.until') IS NOT NULL"


async def _ask_in_vain(client: Client, arguments: dict[str, Any]) -> None:
    with anyio.fail_after(60), pytest.raises(MCPError, match="closed"):
        await client.call_tool("webots_run_trials", arguments)


async def _until(filed: Recording, sql: str, found: object) -> None:
    await until(lambda: filed.rows(sql), lambda rows: rows == [found])


async def test_a_set_whose_server_was_killed_is_gone_on_with_by_another(
    simulation: Simulation, filed: Recording, data_dir: Path, release: Path, tmp_path: Path
) -> None:
    database, pid = str(data_dir / "webots.db"), tmp_path / "pid"
    server = StdioServerParameters(
        command=sys.executable, args=["-c", SERVER, str(pid), database], env=dict(os.environ)
    )
    asked = {"parameters": SPEEDS, "score": "last(released)", "until": "released > 0"}
    async with Client(server) as client, anyio.create_task_group() as tasks:
        tasks.start_soon(_ask_in_vain, client, asked)
        await _until(filed, "SELECT count(*) FROM command WHERE status = 'claimed'", 1)
        os.kill(int(pid.read_text()), signal.SIGKILL)
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        left = await ask(client, "webots_get_trials")
        assert left["state"] == "left by a server that ended"
        said = await fail(client, "webots_run_trials", parameters=SPEEDS, score="duration", for_s=1)
        assert "Trial set 1 of this robot is not over (its server ended)" in said
        release.touch()
        answer = await ask(client, "webots_run_trials", trial_set=1, timeout_wall_s=90)
        assert (answer["state"], answer["over"]) == ("done", 5)
        assert "failed" not in answer
        assert await value_of(client, "speed") == 1.0
    assert filed.rows(TRIED) == [5], "what the killed server had sent was not sent again"


def let_leases_run_out(file: Path) -> None:
    """As time does, where nobody renews them."""
    with closing(database(file, "writer")) as connection:
        connection.execute("UPDATE lease SET until_wall_time_s = 1.0 WHERE name <> 'maintainer'")


async def test_a_set_whose_server_was_stopped_is_taken_over_and_never_run_by_both(
    simulation: Simulation, filed: Recording, data_dir: Path, release: Path, tmp_path: Path
) -> None:
    file, pid = data_dir / "webots.db", tmp_path / "pid"
    server = StdioServerParameters(
        command=sys.executable, args=["-c", SERVER, str(pid), str(file)], env=dict(os.environ)
    )
    asked = {"parameters": SPEEDS, "score": "last(released)", "until": "released > 0"}
    told: list[dict[str, Any]] = []

    async def ask_the_stopped_one(client: Client) -> None:
        told.append(await ask(client, "webots_run_trials", **asked, timeout_wall_s=90))

    async with Client(server) as client, anyio.create_task_group() as tasks:
        tasks.start_soon(ask_the_stopped_one, client)
        await _until(filed, "SELECT count(*) FROM command WHERE status = 'claimed'", 1)
        async with Client(create_server(file, data_dir)) as other:
            stop_between_writes(int(pid.read_text()), file)
            assert (await ask(other, "webots_get_trials"))["state"] == "under way"
            let_leases_run_out(file)
            assert (await ask(other, "webots_get_trials"))["state"] == "left by a server that ended"
            await ask(other, "webots_run_trials", trial_set=1, timeout_wall_s=0.1)
            os.kill(int(pid.read_text()), signal.SIGCONT)
            release.touch()
            answer = await ask(other, "webots_run_trials", trial_set=1, timeout_wall_s=90)
            assert (answer["state"], answer["over"]) == ("done", 5)
            assert await value_of(other, "speed") == 1.0
    assert (told[0]["state"], told[0]["over"]) == ("done", 5)
    assert filed.rows(TRIED) == [5]
    assert filed.rows("SELECT count(*) FROM command WHERE action = 'cancel_run'") == [0]


@pytest.mark.parametrize("renewed", [True, False])
async def test_a_set_at_work_on_another_host_is_its_own_as_long_as_it_renews_the_lease(
    connect: Connect, tunable: TunableDriver, file: Path, renewed: bool
) -> None:
    async with connect() as client:
        await trials(client, parameters={"kp": [1.0, 2.0]})
        with closing(database(file, "writer")) as connection:
            connection.execute("UPDATE trial_set SET host = 'elsewhere', pid = 1, process = 'x'")
            connection.execute("UPDATE trial SET status = 'waiting', run_id = NULL, score = NULL")
            until_s = time.time() + (20 if renewed else -1)
            values = ("trial set 1", "elsewhere 1", until_s)
            connection.execute("INSERT INTO lease VALUES (?, ?, ?)", values)
        answer = await ask(
            client, "webots_run_trials", trial_set=1, timeout_wall_s=1 if renewed else 60
        )
        assert answer["state"] == ("under way" if renewed else "done")


async def test_a_server_that_ends_leaves_the_parameters_as_they_were(
    simulation: Simulation, filed: Recording, data_dir: Path, release: Path
) -> None:
    asked = {"parameters": {"speed": [3.0]}, "score": "last(released)", "until": "released > 0"}
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        await ask(client, "webots_run_trials", timeout_wall_s=0.1, **asked)
        await _until(filed, "SELECT count(*) FROM command WHERE status = 'claimed'", 1)
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        assert await value_of(client, "speed") == 1.0
        assert (await ask(client, "webots_get_trials"))["state"] == "left by a server that ended"
        release.touch()
        answer = await ask(client, "webots_run_trials", trial_set=1, timeout_wall_s=60)
        assert (answer["state"], answer["over"]) == ("done", 1)


async def test_a_killed_controller_fails_its_trial_and_the_set_says_why_it_stops(
    simulation: Simulation, filed: Recording, data_dir: Path, release: Path
) -> None:
    asked = {"parameters": SPEEDS, "score": "last(released)", "until": "released > 0"}
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        await ask(client, "webots_run_trials", timeout_wall_s=0.1, **asked)
        await _until(filed, "SELECT count(*) FROM command WHERE status = 'claimed'", 1)
        await _until(filed, "SELECT max(id) FROM run", 2)
        simulation.controller("rover").kill()
        answer = await ask(client, "webots_run_trials", trial_set=1, timeout_wall_s=60)
        assert "no live controller" in answer["state"]
        assert (answer["over"], answer["failed"]) == (1, 1)
        (row,) = rows_of(answer["ranked"])
        assert row["runs"] == [2]
        assert "its controller ended before it finished" in row["why"]
        await to_thread.run_sync(simulation.reload)
        release.touch()
        await ask_until(
            client, "webots_get_robot_state", lambda told: "stopped" not in told["status"]
        )
        answer = await ask(client, "webots_run_trials", trial_set=1, timeout_wall_s=60)
        assert (answer["state"], answer["over"], answer["failed"]) == ("done", 5, 1)
