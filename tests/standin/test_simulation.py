"""Controllers as real processes: how they start, what they see, when they wait."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.standin.conftest import WriteController
from tests.standin.running import LOOP, fast, has_line
from webots_mcp.standin import Mode, Simulation, StandInError, WorldError
from webots_mcp.standin.in_process import DEFAULT_WORLD


def test_a_controller_drives_its_robot_and_prints_to_the_console(
    world: Path, write_controller: WriteController
) -> None:
    write_controller("drive(5, 5)\nprint('off we go', flush=True)", LOOP)
    lines: list[str] = []
    with Simulation(world, mode="fast", console=lines.append) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 1.0)
        assert simulation.robot("rover").position[0] > -1.1
        simulation.wait_for(lambda: "[rover] off we go" in simulation.console)
    assert "[rover] ended" in lines
    assert lines[-1] == "INFO: 'rover' controller exited successfully."
    assert simulation.controller("rover").exit_code == 0


def test_a_controller_runs_where_and_as_webots_would_run_it(
    world: Path, write_controller: WriteController
) -> None:
    text = world.read_text(encoding="utf-8")
    world.write_text(
        text.replace('controller "rover"', 'controller "rover" controllerArgs ["a b" "c"]'),
        encoding="utf-8",
    )
    file = write_controller(
        """
        import os, sys
        print("argv", sys.argv)
        print("cwd", os.getcwd())
        print("name", os.environ["WEBOTS_ROBOT_NAME"], os.environ["PYTHONIOENCODING"])
        folder = os.environ["WEBOTS_INSTANCE_PATH"]
        print("instance", os.path.isdir(folder), folder.rstrip("/").rpartition("/")[2].isdigit())
        print("own", os.environ["MY_SETTING"])
        print("module", Supervisor.__module__, robot.getDevice("gps").__class__.__module__)
        print("paths", robot.getWorldPath(), robot.getProjectPath())
        """,
        LOOP,
    )
    with Simulation(world, mode="fast", environment={"MY_SETTING": "yes"}) as simulation:
        simulation.wait_for(lambda: has_line(simulation, "paths "))
        console = [line.removeprefix("[rover] ") for line in simulation.console]
    assert "argv ['rover.py', 'a b', 'c']" in console
    assert f"cwd {file.parent}" in console
    assert "name rover UTF-8" in console
    assert "instance True True" in console
    assert "own yes" in console
    assert "module controller.robot controller.devices" in console
    assert f"paths {world} {world.parent.parent}" in console


def test_a_person_pauses_steps_and_resumes(world: Path, write_controller: WriteController) -> None:
    write_controller(LOOP)
    with fast(world) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 0.1)
        simulation.pause()
        stopped_s = simulation.time_s
        simulation.step()
        simulation.wait_for(lambda: simulation.time_s > stopped_s)
        assert simulation.mode is Mode.PAUSE
        assert simulation.time_s == pytest.approx(stopped_s + 0.016)
        simulation.resume()
        simulation.wait_for(lambda: simulation.time_s > stopped_s + 0.1)
        assert simulation.mode is Mode.REAL_TIME


def test_in_a_pause_step_blocks_but_step_zero_and_requests_do_not(
    world: Path, write_controller: WriteController
) -> None:
    write_controller(
        """
        robot.step(16)
        robot.simulationSetMode(robot.SIMULATION_MODE_PAUSE)
        print("zero", robot.step(0), robot.getFromDef("ROVER").getDef())
        print("began", flush=True)
        print("returned", robot.step(16), robot.simulationGetMode())
        """,
        LOOP,
    )
    with fast(world) as simulation:
        simulation.wait_for(lambda: has_line(simulation, "began"))
        assert has_line(simulation, "zero 0 ROVER")
        assert simulation.time_s == pytest.approx(0.016)
        assert not has_line(simulation, "returned")
        simulation.fast()
        simulation.wait_for(lambda: has_line(simulation, "returned 0 2"))


def test_synchronous_robots_wait_for_each_other(
    world: Path, write_controller: WriteController
) -> None:
    second = 'Robot { name "second" controller "second" supervisor TRUE }'
    world.write_text(world.read_text(encoding="utf-8") + second, encoding="utf-8")
    write_controller(LOOP)
    write_controller(
        """
        from pathlib import Path
        for _ in range(5):
            robot.step(32)
        print("holding", flush=True)
        while not Path("go").exists():
            robot.step(0)
        """,
        LOOP,
        name="second",
    )
    with fast(world) as simulation:
        simulation.wait_for(lambda: has_line(simulation, "holding"))
        simulation.wait_for(lambda: simulation.robot("rover").remaining_ms == 16.0)
        assert simulation.time_s == pytest.approx(0.16)
        (world.parent.parent / "controllers" / "second" / "go").touch()
        simulation.wait_for(lambda: simulation.time_s > 0.5)


def test_a_world_loaded_in_pause_starts_its_controllers_with_the_first_step(
    world: Path, write_controller: WriteController
) -> None:
    write_controller("print('started', flush=True)", LOOP)
    with Simulation(world, mode="pause") as simulation:
        simulation.pause()
        assert simulation.controller("rover").pid is None
        simulation.step()
        simulation.wait_for(lambda: simulation.time_s == pytest.approx(0.016))
        simulation.wait_for(lambda: has_line(simulation, "started"))


def test_a_robot_without_synchronization_is_told_how_late_it_is(
    world: Path, write_controller: WriteController
) -> None:
    world.write_text(
        world.read_text(encoding="utf-8").replace(
            "supervisor TRUE", "supervisor TRUE synchronization FALSE"
        ),
        encoding="utf-8",
    )
    write_controller(
        """
        robot.step(16)
        began = robot.getTime()
        while robot.getTime() < began + 1.0:
            robot.step(0)
        print("late", robot.step(16) > 500, robot.getSynchronization(), flush=True)
        """,
        LOOP,
    )
    with fast(world) as simulation:
        simulation.wait_for(lambda: has_line(simulation, "late True False"))


def test_a_program_of_ones_own_can_be_an_extern_controller(
    world: Path, write_controller: WriteController
) -> None:
    file = write_controller("robot.step(160)\nprint(robot.getTime())")
    text = world.read_text(encoding="utf-8")
    world.write_text(text.replace('"rover"\n  super', '"<extern>"\n  super'), encoding="utf-8")
    with fast(world) as simulation:
        simulation.wait_for(lambda: has_line(simulation, "WARNING: rover: the controller is <ext"))
        assert has_line(simulation, "the world waits for it. Let the stand-in do so with --robot")
        environment = simulation.environment_of("rover")
        assert simulation.time_s == 0.0
        assert environment["WEBOTS_CONTROLLER_URL"].startswith("tcp://127.0.0.1:")
        assert "WEBOTS_INSTANCE_PATH" not in environment
        done = subprocess.run(
            [sys.executable, str(file)], env=environment, capture_output=True, text=True, check=True
        )
        assert done.stdout == "0.16\n"
        refused = subprocess.run(
            [sys.executable, str(file)],
            env=environment
            | {"WEBOTS_CONTROLLER_URL": environment["WEBOTS_CONTROLLER_URL"] + "-not"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert "no robot 'rover-not'" in refused.stderr


def test_a_controller_that_no_simulation_started_says_what_to_do(
    world: Path, write_controller: WriteController
) -> None:
    file = write_controller("")
    with Simulation(world, controllers={"rover": file}) as simulation:
        environment = simulation.environment_of("rover")
    del environment["WEBOTS_INSTANCE_PATH"]
    alone = subprocess.run(
        [sys.executable, str(file)], env=environment, capture_output=True, text=True, check=False
    )
    assert "InProcessRobot" in alone.stderr


def test_what_cannot_be_run_is_refused_at_once(world: Path, tmp_path: Path) -> None:
    with pytest.raises(StandInError, match="mode has to be one of"):
        Simulation(world, mode="quick")
    with pytest.raises(WorldError, match="cannot read"):
        Simulation(tmp_path / "missing.wbt")
    double = tmp_path / "double.wbt"
    rover = 'Robot { name "rover" }'
    double.write_text(DEFAULT_WORLD.read_text(encoding="utf-8") + rover, encoding="utf-8")
    with pytest.raises(WorldError, match="two robots have the name 'rover'"):
        Simulation(double)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("rover", "the controller .*rover.py is missing"),
        ("../evil", "is no name of a folder in controllers/"),
        ("/tmp/evil", "is no name of a folder in controllers/"),
    ],
)
def test_a_controller_that_is_not_in_its_folder_is_not_started(
    world: Path, name: str, why: str
) -> None:
    (world.parent.parent / "controllers").mkdir()
    (world.parent.parent / "evil.py").write_text("print('here I am', flush=True)")
    text = world.read_text(encoding="utf-8")
    world.write_text(text.replace('controller "rover"', f'controller "{name}"'), encoding="utf-8")
    with fast(world) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 0.1)
        assert re.search(f"WARNING: rover: .*{why}", "\n".join(simulation.console))
        assert simulation.controller("rover").pid is None


@pytest.mark.slow
def test_real_time_is_no_faster_than_the_clock(
    world: Path, write_controller: WriteController
) -> None:
    write_controller(LOOP)
    with Simulation(world) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 0)
        began_s, simulated_s = time.monotonic(), simulation.time_s
        simulation.wait_for(lambda: simulation.time_s > simulated_s + 0.4)
        assert time.monotonic() - began_s > 0.25  # what was lost is caught up with, 0.1 s of it


def test_a_controller_that_is_linked_into_the_project_is_started(
    world: Path, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere" / "rover"
    elsewhere.mkdir(parents=True)
    (elsewhere / "rover.py").write_text("print('here I am', flush=True)", encoding="utf-8")
    link = world.parent.parent / "controllers" / "rover"
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(elsewhere)
    with fast(world) as simulation:
        simulation.wait_for(lambda: has_line(simulation, "here I am"))


def test_waiting_in_vain_shows_the_console(world: Path, write_controller: WriteController) -> None:
    write_controller("print('here I am', flush=True)", LOOP)
    with fast(world) as simulation:
        simulation.wait_for(lambda: has_line(simulation, "here I am"))
        with pytest.raises(TimeoutError, match="here I am"):
            simulation.wait_for(lambda: False, timeout_s=0.1)


def test_real_time_begins_anew_after_a_fast_stretch(
    world: Path, write_controller: WriteController
) -> None:
    write_controller(
        """
        robot.simulationSetMode(robot.SIMULATION_MODE_FAST)
        while robot.getTime() < 40.0:
            robot.step(16)
        robot.simulationSetMode(robot.SIMULATION_MODE_REAL_TIME)
        for _ in range(5):
            robot.step(16)
        print("five steps in real time", flush=True)
        """,
        LOOP,
    )
    with Simulation(world, mode="realtime") as simulation:
        simulation.wait_for(lambda: simulation.time_s > 39.0, timeout_s=60)
        simulation.wait_for(lambda: has_line(simulation, "five steps in real time"))
