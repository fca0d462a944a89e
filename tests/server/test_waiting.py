"""No call waits for ever: what is under way has an id, and another call goes on waiting for it."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable
from pathlib import Path

import anyio
import pytest
from mcp import Client

from tests.recordings.rows import Recorded, RecordedRobot
from tests.server.conftest import Connect, Driver, ask, ask_until, fail
from tests.server.story import rows_of
from webots_mcp.database.connection import connect as open_database

pytestmark = pytest.mark.anyio


def claim(connection: sqlite3.Connection, robot: RecordedRobot) -> bool:
    """What a controller does first; False while there is nothing to claim."""
    sql = "UPDATE command SET status = 'claimed', session_id = ? WHERE status = 'pending'"
    return connection.execute(sql, (robot.session_id,)).rowcount == 1


def claim_soon(file: Path, robot: RecordedRobot) -> threading.Thread:
    def run() -> None:
        connection = open_database(file, "writer")
        while not claim(connection, robot):
            pass
        connection.close()

    thread = threading.Thread(target=run)
    thread.start()
    return thread


async def under_way(client: Client, file: Path, robot: RecordedRobot) -> int:
    """The id of a command that is still at it when its call is answered."""
    thread = claim_soon(file, robot)
    answer = await ask(client, "webots_send_command", action="go", timeout_wall_s=0.5)
    thread.join()
    assert answer["outcome"] == "claimed"
    assert "webots_wait_for_command(command_id=" in answer["hint"]
    assert str(answer["command_id"]) in answer["hint"]
    return answer["command_id"]


@pytest.mark.slow
async def test_a_second_call_goes_on_waiting_for_what_is_under_way(
    connect: Connect, recorded: Recorded, file: Path
) -> None:
    robot = recorded.robot()
    async with connect() as client:
        command_id = await under_way(client, file, robot)
        again = await ask(
            client, "webots_wait_for_command", command_id=command_id, timeout_wall_s=0.2
        )
        assert (again["outcome"], again["command_id"]) == ("claimed", command_id)
        recorded.connection.execute("UPDATE command SET status = 'done', result = '{\"way_m\": 2}'")
        done = await ask(client, "webots_wait_for_command", command_id=command_id)
        assert (done["outcome"], done["result"]) == ("done", {"way_m": 2})
        assert "no command 77" in await fail(client, "webots_wait_for_command", command_id=77)


async def test_what_only_waited_takes_nothing_back(connect: Connect, recorded: Recorded) -> None:
    robot = recorded.robot()
    recorded.connection.execute(
        "INSERT INTO command (robot_id, action, params, status, created_wall_time_s, "
        "expires_wall_time_s) VALUES (?, 'go', '{}', 'pending', 0, 9e9)",
        (robot.id,),
    )
    async with connect() as client:
        answer = await ask(client, "webots_wait_for_command", command_id=1, timeout_wall_s=0.2)
        assert answer["outcome"] == "pending"
    assert recorded.connection.execute("SELECT status FROM command").fetchone() == ("pending",)


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("webots_simulation_control", {"command": "step"}),
        ("webots_send_command", {"action": "go"}),
        ("webots_world_reset", {}),
        ("webots_wait_for_command", {"command_id": 1}),
    ],
)
async def test_no_call_waits_longer_than_clients_do(
    connect: Connect, recorded: Recorded, tool: str, arguments: dict[str, object]
) -> None:
    recorded.robot()
    async with connect() as client:
        assert "90" in await fail(client, tool, **arguments, timeout_wall_s=101)


async def test_no_tool_may_be_asked_to_wait_for_longer(connect: Connect) -> None:
    async with connect() as client:
        tools = (await client.list_tools()).tools
    waits = {
        f"{tool.name} {name}": options.get("maximum")
        for tool in tools
        for name, options in tool.input_schema["properties"].items()
        if name in ("timeout_wall_s", "duration_wall_s")
    }
    assert len(waits) > 10
    assert {name: longest for name, longest in waits.items() if longest != 90} == {}


async def test_a_command_whose_asker_went_away_says_that_it_goes_on(
    connect: Connect, recorded: Recorded, file: Path
) -> None:
    robot = recorded.robot()
    async with connect() as client:
        async with anyio.create_task_group() as tasks:
            asked = {"action": "go", "timeout_wall_s": 60}
            tasks.start_soon(client.call_tool, "webots_send_command", asked)
            await anyio.to_thread.run_sync(claim_soon(file, robot).join)
            tasks.cancel_scope.cancel()
        told = await ask_until(
            client, "webots_list_commands", lambda told: rows_of(told["commands"])[0].get("error")
        )
        (row,) = rows_of(told["commands"])
        assert (row["outcome"], row["error"]) == (
            "claimed",
            "the client disconnected; the command continues",
        )


async def test_resume_and_reset_say_at_which_pace_it_goes_on_and_why(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        await ask(client, "webots_simulation_control", command="fast")
        await ask(client, "webots_simulation_control", command="pause")
        resumed = await ask(client, "webots_simulation_control", command="resume")
        assert resumed["result"]["mode"] == "real_time"
        assert "ran fast before" in resumed["result"]["why"]
        await ask(client, "webots_simulation_control", command="pause")
        reset = await ask(client, "webots_world_reset")
        assert reset["result"]["mode"] == "real_time"
        assert "ended the pause; the simulation runs" in reset["result"]["why"]
        assert reset["status"] == "running"
    assert driver.is_alive()


async def test_a_killed_controllers_run_goes_on_nowhere(
    connect: Connect, recorded: Recorded, gone: Callable[[], int]
) -> None:
    robot = recorded.robot(pid=gone())
    for n in range(200):
        robot.state(n * 0.1, {"pose": [1.0, 2.0, 0.0], "mode": "drive", "speed": 0.5})
    async with connect(read_only=True) as client:
        runs = (await ask(client, "webots_list_runs"))["runs"]
        assert "crashed" in runs["rows"][0]
        assert "going on" not in runs["rows"][0]
        info = await ask(client, "webots_get_world_info")
        assert info["run"]["ended_by"] == "crashed"
        events = (await ask(client, "webots_find_events", kinds=["stuck", "change"]))["events"]
        assert "ongoing" not in events["columns"]


@pytest.fixture
def gone() -> Callable[[], int]:
    from tests.store.test_status import dead_pid

    return dead_pid
