"""Starting Webots, opening another world in it, and ending it, by tools."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil
import pytest
from mcp import Client

from tests.recordings.rows import Recorded
from tests.server.conftest import ask, ask_until, fail
from tests.simulator.conftest import (
    CONTROLLER,
    StartWebots,
    free_port,
    wait_for_line,
    write_project,
)
from tests.waiting import until
from webots_mcp.server.mcp_server import create_server
from webots_mcp.setup.client_entries import policy_file
from webots_mcp.setup.file_change import apply
from webots_mcp.setup.observer_edits import controller_change, with_observer

pytestmark = pytest.mark.anyio
PLAIN = CONTROLLER.replace("Supervisor", "Robot")
Begin = Callable[..., Client]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    return tmp_path / "project"


@pytest.fixture
def begin(project: Path, webots: Path, monkeypatch: pytest.MonkeyPatch) -> Begin:
    """A client of a server for a project of two worlds, whose robot has this controller."""
    monkeypatch.setenv("DISPLAY", ":99")

    def client(controller: str = CONTROLLER) -> Client:
        world = write_project(project, controller)
        shutil.copy(world, world.with_name("field.wbt"))
        data = project / "mcp_data"
        return Client(create_server(data / "webots.db", data))

    return client


def _are_gone(family: list[psutil.Process]) -> bool:
    return not any(each.is_running() and each.status() != psutil.STATUS_ZOMBIE for each in family)


def _family(answer: dict[str, Any]) -> list[psutil.Process]:
    process = psutil.Process(answer["result"]["pid"])
    return [process, *process.children(recursive=True)]


def _two_robots_of_the_past(data: Path) -> None:
    data.mkdir()
    recorded = Recorded(data / "webots.db")
    for name in ("hunter", "runner"):
        robot = recorded.robot(name)
        robot.beat(ended_wall_time_s=robot.now, end_reason="finished")
    recorded.close()


@pytest.mark.slow
async def test_a_world_is_started_changed_and_ended(begin: Begin, project: Path) -> None:
    async with begin() as client:
        answer = await ask(client, "webots_launch_world", world="worlds/arena.wbt", mode="fast")
        assert (answer["outcome"], answer["route"]) == ("done", "process")
        assert answer["evidence"] == f"rover records: run {answer['run_id']}"
        assert answer["result"]["world"] == str(project / "worlds" / "arena.wbt")
        family = _family(answer)
        text = await fail(client, "webots_launch_world", world="field.wbt")
        assert "still running with arena.wbt. webots_load_world opens another world in it" in text

        loaded = await ask(client, "webots_load_world", world="field.wbt", timeout_wall_s=60)
        assert (loaded["outcome"], loaded["route"]) == ("done", "bridge")
        assert loaded["run_id"] > answer["run_id"]
        assert loaded["evidence"] == (
            f"its controller has ended; run {loaded['run_id']} of rover began in field.wbt"
        )
        world = await ask(client, "webots_get_world_info")
        assert world["world"].endswith("field.wbt")

        ended = await ask(client, "webots_quit")
        assert (ended["outcome"], ended["route"]) == ("done", "process")
        assert ended["evidence"] == "its processes have ended, exit code 0"
        await until(lambda: _are_gone(family))
        assert "rover" in await fail(client, "webots_quit")


@pytest.mark.slow
async def test_webots_ends_with_the_server_that_started_it(begin: Begin) -> None:
    async with begin() as client:
        family = _family(await ask(client, "webots_launch_world", world="arena.wbt", headless=True))
    await until(lambda: _are_gone(family))


@pytest.mark.slow
async def test_what_init_allows_is_enough_to_start_a_world_and_to_end_it(
    begin: Begin, project: Path
) -> None:
    async with begin() as client:
        apply(policy_file(project))
        await ask(client, "webots_launch_world", world="arena.wbt", headless=True)
        refusal = await fail(client, "webots_load_world", world="field.wbt")
        assert "'load_world' is not allowed" in refusal
        assert (await ask(client, "webots_quit"))["route"] == "process"


@pytest.mark.slow
async def test_where_nobody_records_the_answer_comes_in_time_and_says_why(begin: Begin) -> None:
    async with begin("from controller import Robot\nRobot().step(16)\n") as client:
        answer = await ask(client, "webots_launch_world", world="arena.wbt", timeout_wall_s=4)
        assert answer["outcome"] == "claimed"
        assert "without a bridge: rover (attach one: webots-mcp init --patch" in answer["hint"]
        assert "run_id" not in answer
        ended = await ask(client, "webots_quit")
        assert ended["route"] == "process"


@pytest.mark.slow
async def test_a_start_in_pause_says_how_to_go_on_also_beside_robots_of_the_past(
    begin: Begin, project: Path
) -> None:
    async with begin() as client:
        _two_robots_of_the_past(project / "mcp_data")
        start = {"world": "arena.wbt", "mode": "pause", "timeout_wall_s": 2}
        alone = await ask(client, "webots_launch_world", **start)
        assert "quit it and start it in another mode or with stream" in alone["hint"]
        await ask(client, "webots_quit")
        answer = await ask(client, "webots_launch_world", **start, stream=True)
        assert answer["hint"].endswith('. webots_simulation_control("resume") plays it')
        played = await ask(client, "webots_simulation_control", command="resume", timeout_wall_s=30)
        assert (played["outcome"], played["route"]) == ("done", "websocket")


@pytest.mark.slow
async def test_a_robot_of_the_webots_that_was_started_here_names_what_is_to_end(
    begin: Begin,
) -> None:
    async with begin(PLAIN) as client:
        family = _family(await ask(client, "webots_launch_world", world="arena.wbt"))
        ended = await ask(client, "webots_quit", robot="rover")
        assert (ended["outcome"], ended["route"]) == ("done", "process")
        await until(lambda: _are_gone(family))


@pytest.mark.slow
async def test_webots_that_ends_at_its_start_is_an_error_with_what_it_said(
    begin: Begin, project: Path
) -> None:
    async with begin() as client:
        (project / "worlds" / "arena.wbt").write_text("no world", "utf-8")
        text = await fail(client, "webots_launch_world", world="arena.wbt")
        assert "Webots ended with exit code 1; its console has: " in text
        rows = (await ask(client, "webots_get_logs"))["lines"]["rows"]
        assert sum("a world begins with" in row[2] for row in rows) == 1
        assert (await ask(client, "webots_launch_world", world="field.wbt"))["outcome"] == "done"


@pytest.mark.parametrize(
    ("world", "said"),
    [
        ("../outside.wbt", "lies outside of the project"),
        ("arna.wbt", "/worlds there is arena.wbt, field.wbt"),
        ("controllers/rover/rover.py", "its name does not end with .wbt"),
        ("a\0b.wbt", "'a\\x00b.wbt' is not the name of a world: "),
        ("x" * 900, "is not the name of a world: File name too long"),
    ],
)
@pytest.mark.parametrize("tool", ["webots_launch_world", "webots_load_world"])
async def test_only_worlds_of_the_project_are_opened(
    begin: Begin, tmp_path: Path, tool: str, world: str, said: str
) -> None:
    async with begin() as client:
        shutil.copy(tmp_path / "project" / "worlds" / "arena.wbt", tmp_path / "outside.wbt")
        assert said in await fail(client, tool, world=world)


@pytest.mark.slow
async def test_a_robot_that_is_no_supervisor_has_another_world_by_webots_itself(
    begin: Begin,
) -> None:
    async with begin(PLAIN) as client:
        first = await ask(client, "webots_launch_world", world="arena.wbt", stream=True)
        loaded = await ask(client, "webots_load_world", world="field.wbt", timeout_wall_s=60)
        assert loaded["route"] == "websocket"
        assert loaded["evidence"].startswith("Webots replied 'delete world'; run ")
        assert loaded["evidence"].endswith(" of rover began in field.wbt")
        assert loaded["run_id"] > first["run_id"]


async def test_a_world_of_the_same_name_in_another_project_is_not_opened_instead(
    begin: Begin, start_webots: StartWebots, project: Path, tmp_path: Path
) -> None:
    async with begin(PLAIN) as client:
        _two_robots_of_the_past(project / "mcp_data")
        foreign = write_project(tmp_path / "foreign", "print('ready', flush=True)")
        with closing(sqlite3.connect(project / "mcp_data" / "webots.db")) as connection:
            connection.execute("UPDATE run SET world = ?", (str(foreign),))
            connection.commit()
        port = free_port()
        wait_for_line(start_webots("--stdout", "--stream", f"--port={port}", foreign), "ready")
        text = await fail(client, "webots_load_world", world="arena.wbt")
    assert f"only worlds in the folder of the current one, {foreign.parent}" in text


@pytest.mark.slow
async def test_an_observer_opens_another_world_for_a_robot_that_is_no_supervisor(
    begin: Begin, project: Path
) -> None:
    async with begin(PLAIN) as client:
        for world in (project / "worlds").iterdir():
            world.write_bytes(with_observer(world.read_bytes()))
        apply(controller_change(project))
        await ask(client, "webots_launch_world", world="arena.wbt")
        await ask_until(client, "webots_list_robots", lambda told: len(told["robots"]["rows"]) == 2)
        loaded = await ask(
            client, "webots_load_world", world="field.wbt", robot="rover", timeout_wall_s=60
        )
        assert (loaded["route"], loaded["outcome"]) == ("observer", "done")
        assert "its controller has ended; run " in loaded["evidence"]


@pytest.mark.slow
@pytest.mark.parametrize("controller", [CONTROLLER, PLAIN])
async def test_a_webots_that_somebody_else_started_is_ended_by_a_supervisor_alone(
    begin: Begin, start_webots: StartWebots, project: Path, controller: str
) -> None:
    async with begin(controller) as client:
        port = free_port()
        world = project / "worlds" / "arena.wbt"
        process = start_webots("--stdout", "--mode=fast", f"--port={port}", world)
        wait_for_line(process, "ready")
        await ask_until(client, "webots_get_robot_state", lambda told: told["status"] == "running")
        if controller == PLAIN:
            text = await fail(client, "webots_quit")
            assert "no Webots that was started by this server runs" in text
            assert "bridge: quit needs a Supervisor" in text and "(Ctrl+Q)" in text
            assert process.poll() is None
            return
        answer = await ask(client, "webots_quit", timeout_wall_s=60)
        assert (answer["outcome"], answer["route"]) == ("done", "bridge")
        assert answer["evidence"] == f"no Webots listens at port {port} any more"
    assert process.wait(30) == 0
