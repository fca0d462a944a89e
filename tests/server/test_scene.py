"""Looking at the scene over MCP, and changing it, by whichever Supervisor there is."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest

from tests.bridge.conftest import Recording
from tests.recordings.rows import Recorded
from tests.server.conftest import STEP_MS, Connect, Driver, ask, fail
from tests.simulator.observer.conftest import OBSERVER
from tests.waiting import until
from webots_mcp import MCPBridge
from webots_mcp.simulator.observer import observe
from webots_mcp.standin import InProcessRobot, InProcessSimulation, InProcessSupervisor

pytestmark = pytest.mark.anyio

WORLD = Path(__file__).parents[1] / "bridge" / "worlds" / "crowd.wbt"


class Loop(threading.Thread):
    """The loop of a robot that shares a simulation with others."""

    def __init__(self, robot: InProcessRobot, file: Path) -> None:
        super().__init__(daemon=True)
        self.robot = robot
        self.bridge = MCPBridge(robot, throttle_interval=1, database=file)
        self._pace = threading.Event()

    def run(self) -> None:
        while self.robot.step(STEP_MS) != -1:
            self.bridge.publish({"time": self.robot.getTime()})
            self.bridge.get_command()
            self._pace.wait(0.008)


class Crowd:
    """Robots of one world, each with its loop."""

    def __init__(self, file: Path) -> None:
        self.simulation = InProcessSimulation(WORLD)
        self._file = file
        self.loops: list[Loop] = []

    def add(self, kind: type[InProcessRobot], name: str) -> None:
        loop = Loop(kind(name, world=self.simulation), self._file)
        loop.start()
        self.loops.append(loop)

    def close(self) -> None:
        self.simulation.quit()
        for loop in self.loops:
            loop.join(timeout=60)
            assert not loop.is_alive()
            loop.bridge.close()


@pytest.fixture
def crowd(file: Path) -> Iterator[Crowd]:
    robots = Crowd(file)
    yield robots
    robots.close()


async def test_a_robot_is_moved_and_its_event_says_by_whom(
    connect: Connect, driver: Driver, file: Path
) -> None:
    async with connect() as client:
        path, value = "ROVER.translation", [0.0, 1.0, 0.04]
        answer = (await ask(client, "webots_set_field", path=path, value=value))["result"]
        assert (answer["from"], answer["to"]) == ([-1.2, 0.0, 0.04], value)
        assert driver.robot.simulation.robot("rover").position == pytest.approx((0.0, 1.0, 0.04))
        told = (await ask(client, "webots_get_field", path="ROVER.translation"))["result"]
        assert told["value"] == pytest.approx(value)
        events = await ask(client, "webots_find_events", kinds=["bridge_event"])
        assert "set_field" in json.dumps(events)
        assert "ROVER.translation" in json.dumps(events)
        await ask(client, "webots_world_reset")
        told = (await ask(client, "webots_get_field", path="ROVER.translation"))["result"]
        assert told["value"] == pytest.approx([-1.2, 0.0, 0.04], abs=0.05)
    ((data,),) = [Recording(file).rows("SELECT data FROM event WHERE kind = 'set_field'")]
    assert json.loads(data)["requested_by"] is not None


@pytest.mark.usefixtures("driver")
async def test_a_value_may_come_as_the_text_of_one(connect: Connect) -> None:
    """Some clients write lists so; a text that is itself JSON stays one."""
    async with connect() as client:
        for path, value, held in (
            ("BALL.translation", "[0, 1, 0.05]", [0.0, 1.0, 0.05]),
            ("ROVER.customData", '{"lap": 3}', '{"lap": 3}'),
            ("ROVER.customData", "7", "7"),
            ("BALL.locked", True, True),
        ):
            answer = await ask(client, "webots_set_field", path=path, value=value)
            assert answer["result"]["to"] == held


@pytest.mark.usefixtures("driver")
async def test_nodes_are_added_and_removed(connect: Connect) -> None:
    async with connect() as client:
        vrml = 'DEF PILL Solid { translation 1 1 0.1 name "pill" }'
        added = await ask(client, "webots_add_node", vrml=vrml)
        assert added["result"]["path"] == "PILL"
        found = await ask(client, "webots_get_field", path="PILL.translation")
        assert found["result"]["value"] == [1.0, 1.0, 0.1]
        await ask(client, "webots_remove_node", path="PILL")
        assert "no node has the DEF name, name or type 'PILL'" in await fail(
            client, "webots_get_field", path="PILL"
        )
        assert "cannot be removed" in await fail(client, "webots_remove_node", path="ROVER")
        assert "added nothing" in await fail(client, "webots_add_node", vrml="Hologram { }")


async def test_a_robot_that_is_no_supervisor_is_looked_at_by_one_that_is(
    connect: Connect, crowd: Crowd
) -> None:
    crowd.add(InProcessRobot, "rover")
    async with connect() as client:
        said = await fail(client, "webots_get_scene", robot="rover")
        assert "No live controller can read the scene of the simulation of robot 'rover'" in said
        assert "'supervisor' of a Robot node to TRUE" in said
        assert "webots-mcp init --observer" in said
        crowd.add(InProcessSupervisor, "referee")
        for robot in ("rover", None):
            path = "rover.translation"
            answer = await ask(client, "webots_get_field", path=path, robot=robot)
            assert answer["robot"] == "referee"
            assert answer["result"]["value"] == [1.0, 2.0, 0.0]


async def test_where_one_robot_holds_the_simulation_it_is_the_one_that_is_asked(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        await ask(client, "webots_simulation_control", command="pause")
        answer = await ask(client, "webots_set_field", path="BALL.physics.mass", value=2)
        assert answer["result"]["to"] == 2.0
        answer = await ask(client, "webots_get_field", path="BALL.physics.mass")
        assert answer["result"]["value"] == 2.0
        await ask(client, "webots_simulation_control", command="resume")
    assert driver.is_alive()


async def test_supervisors_of_several_simulations_are_told_apart_by_a_name(
    connect: Connect, recorded: Recorded
) -> None:
    for name in ("one", "two"):
        recorded.robot(name, instance=f"webots of {name}")
    async with connect() as client:
        said = await fail(client, "webots_get_scene")
        assert "Supervisors of several simulations are live: 'one', 'two'" in said


@pytest.mark.usefixtures("driver")
async def test_a_server_that_only_reads_asks_no_controller(connect: Connect) -> None:
    async with connect(read_only=True) as client:
        for tool, arguments in (("get_scene", dict[str, Any]()), ("get_field", {"path": "BALL"})):
            said = await fail(client, f"webots_{tool}", **arguments)
            assert "a --read-only server sends none" in said


async def test_an_observer_sees_and_changes_a_world_whose_robots_know_nothing_of_it(
    connect: Connect, file: Path
) -> None:
    """Also while a person has paused it: the observer's loop turns all the same."""
    world = file.parent / "crowd.wbt"
    world.write_text(WORLD.read_text("utf-8") + OBSERVER, "utf-8")
    simulation = InProcessSimulation(world)
    simulation.resume()
    robot = InProcessSupervisor("mcp_observer", world=simulation)
    observing = threading.Thread(target=observe, args=(robot, 100), kwargs={"database": file})
    rover = InProcessRobot("rover", world=simulation)
    observing.start()
    try:
        async with connect() as client:

            async def look() -> dict[str, Any]:
                rover.step(STEP_MS)
                return await ask(client, "webots_list_robots")

            await until(look, lambda told: "robot" in told)
            simulation.pause()
            robots = await ask(client, "webots_get_scene", types=["Robot"])
            assert {"rover", "rider"} < {row[3] for row in robots["result"]["rows"]}
            path, value = "rover.translation", [3.0, 0.0, 0.0]
            answer = await ask(client, "webots_set_field", path=path, value=value)
            assert (answer["robot"], answer["result"]["to"]) == ("mcp_observer", value)
            told = await ask(client, "webots_get_field", path=path)
            assert told["result"]["value"] == value
    finally:
        simulation.quit()
        await anyio.to_thread.run_sync(observing.join, 10)
    assert not observing.is_alive()


async def test_after_the_end_of_the_simulation_it_is_said_that_no_controller_is_live(
    connect: Connect, recorded: Recorded
) -> None:
    for name in ("rover", "arm"):
        robot = recorded.robot(name, supervisor=1)
        robot.state(1.0, {"x": 1})
        robot.end_run("finished")
        robot.beat(ended_wall_time_s=robot.now, end_reason="finished")
    asked = {"action": "set", "path": "BALL.translation", "value": [0, 0, 1]}
    async with connect() as client:
        for robot_name in (None, "rover"):
            told = await fail(client, "webots_edit_scene", robot=robot_name, **asked)
            assert "No controller of " in told and " is live (robot '" in told
            assert "its controller finished" in told and "Start the simulation" in told
