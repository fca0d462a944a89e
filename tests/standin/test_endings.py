"""Controllers as real processes: how they end, and how they start again."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.standin.conftest import WriteController
from tests.standin.running import LOOP, fast, has_line
from webots_mcp.standin import StandInError


def test_the_world_goes_on_without_a_controller_that_crashed(
    world: Path, write_controller: WriteController
) -> None:
    write_controller("drive(5, 5)\nrobot.step(160)\nraise RuntimeError('broken')")
    with fast(world) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 1.0)
        simulation.wait_for(lambda: simulation.controller("rover").exit_code == 1)
        simulation.wait_for(lambda: has_line(simulation, "[rover] RuntimeError: broken"))
        simulation.wait_for(lambda: has_line(simulation, "exited with status: 1"))
        simulation.reset()
        simulation.wait_for(lambda: simulation.controller("rover").starts == 2)


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_killed_controller_is_gone_and_the_world_goes_on(
    world: Path, write_controller: WriteController
) -> None:
    write_controller(LOOP)
    with fast(world) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 0.1)
        controller = simulation.controller("rover")
        controller.kill()
        simulation.wait_for(lambda: controller.exit_code == -9)
        gone_s = simulation.time_s
        simulation.wait_for(lambda: simulation.time_s > gone_s + 1.0)
        assert controller.connection is None


def test_a_supervisors_reload_ends_the_controller_and_starts_it_again(
    world: Path, write_controller: WriteController
) -> None:
    write_controller(
        """
        print("time", robot.getTime())
        robot.step(160)
        robot.worldReload()
        print("step", robot.step(16), flush=True)
        robot.getFromDef("WALL_EAST")  # ends the process: no `finally`, no atexit
        print("never")
        """
    )
    with fast(world) as simulation:
        simulation.wait_for(lambda: simulation.controller("rover").starts >= 3, timeout_s=20)
        console = simulation.console
    assert "[rover] step -1" in console
    assert "[rover] never" not in console
    assert "INFO: 'rover' controller exited successfully." in console
    assert console.count("[rover] time 0.0") >= 2


def test_a_reset_by_hand_starts_controllers_again(
    world: Path, write_controller: WriteController
) -> None:
    write_controller("drive(5, 5)", LOOP)
    with fast(world) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 1.0)
        simulation.pause()
        simulation.reset()
        assert simulation.time_s == 0.0
        assert simulation.robot("rover").position == (-1.2, 0.0, 0.04)
        simulation.fast()
        simulation.wait_for(lambda: simulation.time_s > 1.0)
        assert simulation.controller("rover").starts == 2
        assert has_line(simulation, "[rover] ended")


def test_a_reload_reads_the_world_file_again(
    world: Path, write_controller: WriteController
) -> None:
    write_controller(LOOP)
    with fast(world) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 0)
        text = world.read_text(encoding="utf-8")
        world.write_text(text.replace("-1.2 0 0.04", "1.2 0 0.04"), encoding="utf-8")
        simulation.reload()
        assert simulation.robot("rover").position == (1.2, 0.0, 0.04)
        world.write_text("broken", encoding="utf-8")
        simulation.reload()
        assert has_line(simulation, "the world stays as it was")
        simulation.wait_for(lambda: simulation.time_s > 0.1)


@pytest.mark.slow
def test_a_controller_that_does_not_end_is_terminated(
    world: Path, write_controller: WriteController
) -> None:
    write_controller(
        """
        while robot.step(16) != -1:
            pass
        print("deaf", flush=True)
        import time
        time.sleep(60)
        """
    )
    with fast(world) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 0)
    assert has_line(simulation, "Forced termination")
    assert simulation.controller("rover").exit_code not in (None, 0)


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_signal_ends_a_controller_without_any_cleanup(
    world: Path, write_controller: WriteController
) -> None:
    write_controller(
        """
        import atexit, signal
        atexit.register(print, "cleanup", flush=True)
        """,
        LOOP,
    )
    with fast(world) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 0)
        controller = simulation.controller("rover")
        assert controller.pid is not None
        os.kill(controller.pid, 15)
        simulation.wait_for(lambda: controller.exit_code == -15)
    assert not has_line(simulation, "cleanup")


def test_quitting_gives_the_simulation_its_exit_status(
    world: Path, write_controller: WriteController
) -> None:
    write_controller("robot.step(16)\nrobot.simulationQuit(7)", LOOP)
    with fast(world) as simulation:
        simulation.wait_for(lambda: not simulation.is_running)
    assert simulation.exit_status == 7
    assert has_line(simulation, "[rover] ended")
    with pytest.raises(StandInError, match="has ended"):
        simulation.pause()


def test_what_is_read_while_the_world_ends_keeps_its_last_value(
    world: Path, write_controller: WriteController
) -> None:
    write_controller(
        """
        where = robot.getFromDef("WALL_EAST").getField("translation")
        camera = robot.getDevice("camera")
        camera.enable(16)
        while robot.step(16) != -1:
            for _ in range(200):
                x, y, z = where.getSFVec3f()
        print("ended with a picture of", len(camera.getImage()), "bytes")
        """
    )
    with fast(world) as simulation:
        simulation.wait_for(lambda: simulation.time_s > 0.1)
    assert has_line(simulation, "[rover] ended with a picture of")
    assert simulation.failure is None
