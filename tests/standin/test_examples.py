"""The examples run as they are, record themselves and obey."""

from __future__ import annotations

import json
import runpy
import sqlite3
import sys
import time
from collections.abc import Callable
from contextlib import closing
from math import pi
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from webots_mcp.standin import InProcessRobot, Simulation

EXAMPLES = Path(__file__).parents[2] / "examples"


class Records:
    """The database of the examples' bridges."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "webots.db"

    def rows(self, sql: str, *values: object) -> list[Any]:
        with closing(sqlite3.connect(self._path)) as connection:
            return connection.execute(sql, values).fetchall()

    def count(self, table: str) -> int:
        return self.rows(f"SELECT count(*) FROM {table}")[0][0]

    def state(self, robot: str) -> dict[str, Any]:
        """The robot's latest state."""
        rows = self.rows(
            "SELECT data FROM state JOIN run ON run.id = run_id JOIN robot ON robot.id = robot_id "
            "WHERE robot.name = ? ORDER BY state.id DESC LIMIT 1",
            robot,
        )
        return json.loads(rows[0][0])

    def send(self, robot: str, action: str, **params: object) -> Callable[[], Any]:
        """Sends a command; what it returns gives the result once there is one."""
        now = time.time()
        with closing(sqlite3.connect(self._path)) as connection, connection:
            command = connection.execute(
                "INSERT INTO command (robot_id, action, params, status, created_wall_time_s, "
                "expires_wall_time_s) SELECT id, ?, ?, 'pending', ?, ? FROM robot WHERE name = ?",
                (action, json.dumps(params), now, now + 10.0, robot),
            ).lastrowid

        def result() -> Any:
            status, answer, error = self.rows(
                "SELECT status, result, error FROM command WHERE id = ?", command
            )[0]
            return (status, json.loads(answer) if answer else error) if answer or error else None

        return result


@pytest.fixture
def records(tmp_path: Path) -> Records:
    return Records(tmp_path)


def example(world: str, folder: Path) -> Simulation:
    environment = {"WEBOTS_MCP_DATA_DIR": str(folder), "WEBOTS_MCP_STRICT": "1"}
    return Simulation(EXAMPLES / "worlds" / world, mode="fast", environment=environment)


@pytest.mark.slow
def test_the_rover_wanders_and_records_itself(records: Records, tmp_path: Path) -> None:
    with example("arena.wbt", tmp_path) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 12.0, timeout_s=30)
        simulation.pause()
        assert simulation.robot("rover").collisions == 0
        state = records.state("rover")
        assert records.count("state") > 100
        assert records.count("image") >= 2
        assert records.count("log") >= 2
    assert state["mode"] in ("cruise", "turn")
    assert {*state} == {"pose", "mode", "wheel_radps", "distance_m", "lidar", "stuck"}
    assert state["pose"]["x"] == pytest.approx(simulation.robot("rover").position[0], abs=0.1)
    assert simulation.controller("rover").exit_code == 0


def test_the_rover_obeys_and_starts_anew_after_a_reset(records: Records, tmp_path: Path) -> None:
    with example("arena.wbt", tmp_path) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 0.5)
        result = records.send("rover", "set_speed", speed=99)
        assert simulation.wait_for(result) == ("done", {"speed_radps": 10.0})
        result = records.send("rover", "turn_to", heading=pi / 2)
        assert simulation.wait_for(result)[0] == "done"
        reset = records.send("rover", "reset")
        simulation.wait_for(reset)
        simulation.wait_for(lambda: records.count("run") == 2)
        simulation.wait_for(lambda: records.state("rover")["wheel_radps"]["left"] > 1.0)


def test_the_referee_watches_and_places_the_rover(records: Records, tmp_path: Path) -> None:
    with example("arena_referee.wbt", tmp_path) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 3.0)
        assert records.count("robot") == 2
        travelled = records.state("referee")["distance_m"]
        assert travelled == pytest.approx(0.2 * simulation.time_s, rel=0.5)
        result = records.send("referee", "place_rover", x=1.5, y=-1.5, heading=pi / 2)
        assert simulation.wait_for(result)[1] == {"x": 1.5, "y": -1.5, "heading_rad": pi / 2}
        simulation.wait_for(lambda: records.state("referee")["rover"]["region"] == "south-east")
        result = records.send("referee", "place_rover", x=5, y=0)
        status, error = simulation.wait_for(result)
        assert (status, "is not inside the arena" in error) == ("failed", True)


def test_the_mcp_configuration_is_the_documented_command() -> None:
    text = (EXAMPLES / ".mcp.json").read_text(encoding="utf-8")
    assert json.loads(text) == {
        "mcpServers": {"webots": {"command": "webots-mcp", "args": ["serve"]}}
    }


def test_the_plugin_for_ros_2_records_what_was_asked_and_asks_for_velocities(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Twist:
        def __init__(self) -> None:
            self.linear, self.angular = SimpleNamespace(x=0.0), SimpleNamespace(z=0.0)

    class Topic:
        """One topic that delivers at once what is published."""

        def __init__(self, *_: object, **__: object) -> None: ...

        def create_publisher(self, *_: object) -> Topic:
            return self

        def create_subscription(self, kind: object, topic: str, callback: Any, depth: int) -> None:
            self.publish = callback

    rclpy = SimpleNamespace(init=Topic, create_node=Topic, spin_once=Topic)
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.setitem(sys.modules, "geometry_msgs", ModuleType("geometry_msgs"))
    monkeypatch.setitem(sys.modules, "geometry_msgs.msg", SimpleNamespace(Twist=Twist))
    monkeypatch.setenv("WEBOTS_MCP_DATA_DIR", str(tmp_path))
    plugin = runpy.run_path(str(EXAMPLES / "ros2" / "rover_driver.py"))["RoverDriver"]()
    robot = InProcessRobot()
    plugin.init(SimpleNamespace(robot=robot), {})
    done = Records(tmp_path).send(robot.getName(), "set_velocity", ahead=0.2)
    while done() is None:
        assert robot.step(16) != -1
        plugin.step()
    for _ in range(10):
        robot.step(16)
        plugin.step()
    plugin.bridge.close()

    assert done() == ("done", {"ahead_mps": 0.2, "turn_radps": 0.0})
    assert Records(tmp_path).state(robot.getName())["asked"]["ahead_mps"] == 0.2
