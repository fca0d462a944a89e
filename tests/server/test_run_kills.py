"""webots_run when a process is killed in its middle: the server that asked, or the controller."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import anyio
import pytest
from anyio import to_thread
from mcp import Client, MCPError, StdioServerParameters
from mcp.types import CallToolResult

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import Start, data_dir, filed, has_states, start  # fixtures
from tests.server.conftest import ask, text_of
from tests.waiting import until
from webots_mcp.server.mcp_server import create_server
from webots_mcp.standin import Mode, Simulation

__all__ = ["data_dir", "filed", "start"]
pytestmark = [pytest.mark.anyio, pytest.mark.slow]

# `released` is 1 from the step on at which the test has made a file.
LOOP = """
from pathlib import Path

while robot.step(16) != -1:
    bridge.publish({{"released": int(Path({release!r}).exists())}})
    bridge.get_command()
"""
SERVER = """
import os, pathlib, sys
from webots_mcp.cli import main

pathlib.Path(sys.argv[1]).write_text(str(os.getpid()))
main(["serve", "--database", sys.argv[2]])
"""
CONDITION = "released > 0 for 0.48"


@pytest.fixture
def release(tmp_path: Path) -> Path:
    return tmp_path / "release"


@pytest.fixture
def simulation(start: Start, filed: Recording, release: Path) -> Simulation:
    arena = start(LOOP.format(release=str(release)), mode="realtime")
    arena.wait_for(lambda: has_states(filed), 30)
    return arena


def run_command(filed: Recording) -> int:
    """The id of the `run` command, the only one."""
    (number,) = filed.rows("SELECT id FROM command WHERE action = 'run'")
    return number


async def until_claimed(filed: Recording) -> None:
    """Wait until the controller has the command."""
    await until(lambda: filed.rows("SELECT status FROM command") == ["claimed"])


async def test_a_killed_server_leaves_a_run_that_ends_as_asked_and_another_server_tells_of(
    simulation: Simulation, filed: Recording, data_dir: Path, release: Path, tmp_path: Path
) -> None:
    database, pid = str(data_dir / "webots.db"), tmp_path / "pid"
    arguments = ["-c", SERVER, str(pid), database]
    server = StdioServerParameters(command=sys.executable, args=arguments, env=dict(os.environ))
    async with Client(server) as client, anyio.create_task_group() as tasks:
        tasks.start_soon(_ask_in_vain, client)
        await until_claimed(filed)
        os.kill(int(pid.read_text()), signal.SIGKILL)
    number = run_command(filed)
    assert filed.fate(number)[0] == "claimed"
    release.touch()
    await to_thread.run_sync(simulation.wait_for, lambda: filed.fate(number)[0] == "done", 30)

    rows = filed.rows("SELECT sim_time_s, data ->> 'released' FROM state ORDER BY id")
    since_s = next(time_s for time_s, released in rows if released)
    asked_s = next(time_s for time_s, _ in rows if time_s - since_s >= 0.48 - 1e-6)
    assert simulation.mode is Mode.PAUSE
    assert simulation.time_s == pytest.approx(asked_s)
    assert rows[-1][0] == pytest.approx(asked_s)
    async with Client(create_server(data_dir / "webots.db", data_dir)) as other:
        answer = await ask(other, "webots_wait_for_command", command_id=number)
        assert (answer["outcome"], answer["stopped"]) == ("done", "condition held")
        assert answer["status"] == "paused"
        assert answer["ran"]["end_s"] == pytest.approx(asked_s, abs=1e-3)
        assert answer["state"] == {"released": 1}


async def _ask_in_vain(client: Client) -> None:
    with anyio.fail_after(30), pytest.raises(MCPError, match="closed"):
        await client.call_tool("webots_run", {"until": CONDITION})


async def test_a_killed_controller_makes_the_run_lost_and_the_answer_says_what_to_do(
    simulation: Simulation, filed: Recording, data_dir: Path
) -> None:
    answers: list[CallToolResult] = []

    async def run(client: Client) -> None:
        answers.append(await client.call_tool("webots_run", {"until": CONDITION}))

    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run, client)
            await until_claimed(filed)
            simulation.controller("rover").kill()
        (result,) = answers
        assert result.is_error
        answer: dict[str, Any] = json.loads(text_of(result))
        assert (answer["command_id"], answer["outcome"]) == (run_command(filed), "lost")
        assert answer["stopped"] == "run ended"
        assert answer["error"] == "its controller ended before it finished; it may have run in part"
        assert answer["status"].startswith("stopped")
        assert answer["state"] == {"released": 0}
        assert "start its controller" in answer["hint"]
        assert "reload the world" in answer["hint"]
