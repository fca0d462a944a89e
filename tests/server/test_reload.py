"""Controllers as real processes: a reload, and what a plain Robot cannot do."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from mcp import Client

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import data_dir, filed, has_states, start  # fixtures
from tests.server.conftest import ask, fail
from tests.waiting import until
from webots_mcp.server.mcp_server import create_server
from webots_mcp.standin import Simulation

__all__ = ["data_dir", "filed", "start"]
pytestmark = pytest.mark.anyio

LOOP = """
while robot.step(16) != -1:
    bridge.publish({"mode": "cruise"})
    bridge.get_command()
"""


@pytest.mark.slow
async def test_a_reload_is_confirmed_by_the_new_controllers_run(
    start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    simulation = start(LOOP, mode="realtime")
    simulation.wait_for(lambda: has_states(filed), 20)
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        before = await ask(client, "webots_get_world_info")
        answer = await ask(client, "webots_world_reload")
        assert answer["outcome"] == "done"
        assert answer["run_id"] == answer["result"]["run_id"] > before["run_id"]
        after = await ask(client, "webots_get_world_info")
        assert after["controller"]["pid"] != before["controller"]["pid"]
        assert after["run"]["began_by"] == "reload"
        earlier = await ask(client, "webots_get_world_info", run_id=before["run_id"])
        assert earlier["run"]["ended_by"] == "reload"


@pytest.mark.slow
async def test_a_person_who_pauses_in_webots_is_one_of_the_reasons_told(
    start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    simulation = start(LOOP, mode="realtime")
    simulation.wait_for(lambda: has_states(filed), 20)
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        simulation.pause()
        await _until_nothing_comes(filed)
        text = await fail(client, "webots_simulation_control", command="resume", timeout_wall_s=3)
        answer = json.loads(text)
        assert answer["outcome"] == "cancelled"
        assert "paused by hand in Webots" in answer["why"]
        assert "press play in Webots" in answer["hint"]
        assert answer["status"].startswith("stopped")


async def _until_nothing_comes(filed: Recording) -> None:
    """Until the controller's loop is surely inside the step that does not return."""
    newest = "SELECT max(wall_time_s) FROM state"
    await until(lambda: time.time() - filed.rows(newest)[0] > 0.5)
