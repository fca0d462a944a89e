"""The tool that films the simulation, on a controller that runs."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from tests.server.conftest import Connect, Driver, ask, ask_until, fail
from webots_mcp.questions import record_scene
from webots_mcp.simulator.instances import Instance

pytestmark = pytest.mark.anyio
TOOL = "webots_record_scene"


@pytest.mark.slow
async def test_a_movie_is_started_and_stopped_and_its_file_named(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        await ask_until(client, "webots_get_robot_state", lambda told: told["sim_time_s"] >= 0.1)
        begun = await ask(client, TOOL, action="start", width_px=160, height_px=120)
        assert begun["outcome"] == "done"
        assert "webots_record_scene(action='stop')" in begun["hint"]
        again = await fail(client, TOOL, action="start")
        assert "one recording is possible at a time" in again
        assert "would discard the movie" in await fail(client, "webots_world_reload")
        await ask(client, "webots_run", for_s=0.2, then="go_on")
        ended = await ask(client, TOOL, action="stop")
    assert ended["outcome"] == "done"
    file = Path(ended["result"]["file"])
    assert file.parent.name == "scenes"
    assert ended["result"]["size_bytes"] == file.stat().st_size > 1000


async def test_an_animation_is_refused_where_webots_streams(
    connect: Connect, driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with connect() as client:
        await ask_until(client, "webots_get_robot_state", lambda told: told["sim_time_s"] >= 0.1)
        name = driver.bridge._session.identity.instance  # pyright: ignore[reportPrivateUsage]

        class Streaming(Instance):
            @property
            def name(self) -> str:
                return name

        found = Streaming(psutil.Process().pid, 1234, True, None, True, None)
        monkeypatch.setattr(record_scene, "instances", lambda: [found])
        why = await fail(client, TOOL, action="start", kind="animation")
        assert "cannot record an animation while it streams" in why
        begun = await ask(client, TOOL, action="start", kind="movie", width_px=64, height_px=64)
        assert begun["outcome"] == "done"


async def test_it_can_be_called_though_it_is_not_listed(connect: Connect, driver: Driver) -> None:
    async with connect() as client:
        assert TOOL not in {tool.name for tool in (await client.list_tools()).tools}
        await ask_until(client, "webots_get_robot_state", lambda told: told["sim_time_s"] >= 0.1)
        assert "nothing is being recorded" in await fail(client, TOOL, action="stop")
    async with connect(read_only=True) as client:
        assert "read" in (await fail(client, TOOL, action="start")).lower()


async def test_a_rule_for_its_action_holds(connect: Connect, driver: Driver, file: Path) -> None:
    rules = '[allow]\nactions = ["*", "!record_scene"]\n'
    (file.parent / "webots-mcp.toml").write_text(rules, "utf-8")
    async with connect() as client:
        await ask_until(client, "webots_get_robot_state", lambda told: told["sim_time_s"] >= 0.1)
        why = await fail(client, TOOL, action="start")
        assert "'record_scene' is not allowed" in why
        why = await fail(
            client, "webots_send_command", action="record_scene", params={"do": "start"}
        )
        assert "record_scene" in why
