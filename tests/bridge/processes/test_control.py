"""Holds, simulators and extern controllers, with real processes on the stand-in."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import CONTROLLER, Start, has_states
from webots_mcp.database.connection import connect
from webots_mcp.errors import CommandRefusedError
from webots_mcp.standin import Mode, Simulation
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.steering.target_robot import find_target
from webots_mcp.store.recording import view_robot

pytestmark = pytest.mark.slow

LOOP = """
while robot.step(16) != -1:
    bridge.publish({"time": robot.getTime()})
    bridge.get_command()
print("left the loop", flush=True)
"""


def wait(simulation: Simulation, filed: Recording, command: int) -> Any:
    """The result of a command, which has to be done."""
    ended = ("done", "failed", "lost", "expired")
    simulation.wait_for(lambda: filed.fate(command)[0] in ended, timeout_s=20)
    status, result, error = filed.fate(command)
    assert (status, error) == ("done", None)
    return result


def test_a_handler_that_drives_with_steps_of_its_own_works_during_a_hold(
    start: Start, filed: Recording
) -> None:
    simulation = start(
        """
def drive(command):
    for _ in range(command["steps"]):
        assert robot.step(32) == 0
    return robot.getTime()

bridge.register_command("drive", drive)
"""
        + LOOP,
        mode="realtime",
    )
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    wait(simulation, filed, filed.send("pause"))
    from_s = simulation.time_s
    assert wait(simulation, filed, filed.send("drive", steps=3)) == pytest.approx(from_s + 0.096)
    assert simulation.time_s == pytest.approx(from_s + 0.096)
    assert simulation.mode is Mode.PAUSE
    wait(simulation, filed, filed.send("step", steps=2))
    assert simulation.time_s == pytest.approx(from_s + 0.128)
    wait(simulation, filed, filed.send("resume"))
    simulation.wait_for(lambda: simulation.time_s > from_s + 0.5)


@pytest.mark.parametrize("press", ["reset", "reload"])
def test_a_world_that_a_person_begins_anew_during_a_hold_can_be_resumed(
    start: Start, filed: Recording, press: str
) -> None:
    simulation = start(LOOP, mode="realtime")
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    wait(simulation, filed, filed.send("pause"))
    getattr(simulation, press)()
    if press == "reload":
        simulation.step()  # which starts the controllers of a world that was loaded in pause
    simulation.wait_for(lambda: filed.rows("SELECT count(*) FROM session") == [2], timeout_s=30)
    simulation.wait_for(
        lambda: filed.rows("SELECT pause_state FROM session") == ["paused", "paused"]
    )
    assert wait(simulation, filed, filed.send("resume"))["mode"] == "real_time"
    simulation.wait_for(lambda: simulation.time_s > 0.3)
    assert sum("left the loop" in line for line in simulation.console) == 1


def test_a_breakpoint_in_fast_mode_pauses_at_the_very_step(start: Start, filed: Recording) -> None:
    simulation = start(
        """
bridge.breakpoint("time > 2 for 0.1")
"""
        + LOOP,
        mode="fast",
    )
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    simulation.wait_for(
        lambda: filed.rows("SELECT pause_state FROM session") == ["paused"], timeout_s=30
    )
    (hit_s,) = filed.rows("SELECT sim_time_s FROM event WHERE kind = 'breakpoint'")
    # 2.016 is the first step beyond 2 s; 7 steps later it has lasted for 0.1 s.
    assert hit_s == pytest.approx(2.128)
    assert simulation.time_s == pytest.approx(hit_s)
    assert filed.rows("SELECT max(sim_time_s) FROM state") == [pytest.approx(hit_s)]
    assert simulation.mode is Mode.PAUSE
    assert wait(simulation, filed, filed.send("fast"))["mode"] == "fast"
    simulation.wait_for(lambda: simulation.time_s > hit_s + 1)


@pytest.fixture
def extern_world(tmp_path: Path) -> Path:
    text = DEFAULT_WORLD.read_text(encoding="utf-8").replace(
        'controller "rover"', 'controller "<extern>"'
    )
    assert "<extern>" in text
    file = tmp_path / "project" / "worlds" / "extern.wbt"
    file.parent.mkdir(parents=True)
    file.write_text(text, encoding="utf-8")
    return file


Connect = Callable[[Simulation], subprocess.Popen[str]]


@pytest.fixture
def connect_extern(tmp_path: Path, data_dir: Path) -> Iterator[Connect]:
    """Start an extern controller of a simulation's rover, as a person in a shell would."""
    started: list[subprocess.Popen[str]] = []
    file = tmp_path / "rover.py"
    file.write_text(CONTROLLER + LOOP)

    def begin(simulation: Simulation) -> subprocess.Popen[str]:
        environment = simulation.environment_of("rover") | {"WEBOTS_MCP_DATA_DIR": str(data_dir)}
        process = subprocess.Popen(
            [sys.executable, str(file)], env=environment, stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.communicate()


def status(filed: Recording, robot: str) -> str:
    connection = connect(filed.database, "reader")
    text = view_robot(connection, robot).status.text
    connection.close()
    return text


def test_pausing_one_of_two_simulators_of_one_shell_leaves_the_other_alone(
    extern_world: Path, connect_extern: Connect, filed: Recording
) -> None:
    recorded = "SELECT count(DISTINCT run_id) FROM state"
    with Simulation(extern_world) as first, Simulation(extern_world) as second:
        connect_extern(first)
        first.wait_for(lambda: has_states(filed), timeout_s=30)
        connect_extern(second)
        second.wait_for(lambda: filed.rows(recorded) == [2], timeout_s=30)
        assert filed.rows("SELECT count(DISTINCT instance), sum(extern) FROM session") == [(2, 2)]
        wait(second, filed, filed.send("pause"))  # of the newest robot
        assert second.mode is Mode.PAUSE
        assert status(filed, "rover#2") == "paused"
        assert status(filed, "rover") == "running"


@pytest.fixture
def simulation_of_two(extern_world: Path, tmp_path: Path, data_dir: Path) -> Iterator[Simulation]:
    """The extern rover's world with a referee, whose controller Webots starts."""
    referee = tmp_path / "referee.py"
    referee.write_text(CONTROLLER + LOOP)
    text = extern_world.read_text(encoding="utf-8")
    robot = 'Robot { name "referee" controller "referee" supervisor TRUE }'
    extern_world.write_text(text + robot, encoding="utf-8")
    controllers, environment = {"referee": referee}, {"WEBOTS_MCP_DATA_DIR": str(data_dir)}
    with Simulation(extern_world, controllers=controllers, environment=environment) as simulation:
        yield simulation


def test_an_extern_and_an_intern_controller_of_one_simulator_are_companions(
    simulation_of_two: Simulation, connect_extern: Connect, filed: Recording
) -> None:
    simulation = simulation_of_two
    connect_extern(simulation)
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    simulation.wait_for(
        lambda: filed.rows("SELECT count(*), count(DISTINCT instance) FROM session") == [(2, 1)]
    )
    assert filed.rows("SELECT extern FROM session ORDER BY extern") == [0, 1]
    wait(simulation, filed, filed.send("pause"))
    assert {status(filed, name) for name in ("rover", "referee")} == {"paused"}


def test_the_reload_of_an_extern_controller_is_answered_when_its_process_has_ended(
    extern_world: Path, connect_extern: Connect, filed: Recording
) -> None:
    with Simulation(extern_world) as simulation:
        process = connect_extern(simulation)
        simulation.wait_for(lambda: has_states(filed), timeout_s=30)
        result = wait(simulation, filed, filed.send("reload"))
        assert "start it by hand" in result["controller"]
        assert process.wait(10) == 0
        connection = connect(filed.database, "reader")
        assert "start it by hand" in (view_robot(connection, "rover").status.why or "")
        with pytest.raises(CommandRefusedError, match="start it by hand"):
            find_target(connection, "rover", "pause")
        connection.close()


def test_a_killed_extern_controllers_hold_is_taken_over_by_the_next_one(
    extern_world: Path, connect_extern: Connect, filed: Recording
) -> None:
    with Simulation(extern_world) as simulation:
        process = connect_extern(simulation)
        simulation.wait_for(lambda: has_states(filed), timeout_s=30)
        wait(simulation, filed, filed.send("pause"))
        process.kill()
        process.wait()
        assert status(filed, "rover").startswith("stopped")
        connect_extern(simulation)
        simulation.wait_for(lambda: filed.rows("SELECT count(*) FROM session") == [2], timeout_s=30)
        simulation.wait_for(lambda: status(filed, "rover") == "paused")
        at_s = simulation.time_s
        wait(simulation, filed, filed.send("resume"))
        simulation.wait_for(lambda: simulation.time_s > at_s + 0.3)
