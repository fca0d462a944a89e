"""An observer makes exactly N steps of the world, or its answer explains why it did not."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import PatientSimulation
from tests.simulator.observer.conftest import STEP_MS, Watching
from webots_mcp.database.connection import connect
from webots_mcp.database.pause_states import SET_FREE
from webots_mcp.database.stored_breakpoints import set_breakpoint
from webots_mcp.setup.observer_edits import with_observer
from webots_mcp.signals.conditions import parse_condition
from webots_mcp.standin import InProcessSupervisor

# -- in this process, where a step that is asked for in a pause raises an error ----


@pytest.fixture
def recording(watching: Watching) -> Recording:
    """Of an observer in real time, with a world that another robot has moved."""
    watching.go_on(5)
    watching.simulation.resume()
    watching.go_on()  # it learns the mode
    return Recording(watching.database)


@pytest.fixture
def rover(watching: Watching) -> InProcessSupervisor:
    return InProcessSupervisor("rover", world=watching.simulation)


@contextmanager
def resumed_once(recording: Recording, command_id: int) -> Generator[None]:
    """Send `resume` when a command is answered: until then the observer stays in its pause."""

    def resume() -> None:
        while recording.fate(command_id)[0] in ("pending", "claimed") and not over.wait(0.01):
            pass
        recording.send("resume", time_to_live_s=600)

    over, sender = threading.Event(), threading.Thread(target=resume)
    sender.start()
    try:
        yield
    finally:
        over.set()
        sender.join()


def begin_steps(
    watching: Watching, recording: Recording, rover: InProcessSupervisor, steps: int
) -> int:
    """Send `step`, and let the world make the first step, which the observer does not wait for."""
    command_id = recording.send("step", steps=steps, time_to_live_s=600)
    while recording.fate(command_id)[0] == "pending":
        watching.go_on()
    assert rover.step(STEP_MS) == 0
    watching.go_on()
    return command_id


def test_steps_end_where_a_person_pauses_the_world_and_the_answer_counts_them(
    watching: Watching, recording: Recording, rover: InProcessSupervisor
) -> None:
    began_s = watching.simulation.time_s
    command_id = begin_steps(watching, recording, rover, 100_000)
    watching.simulation.pause()
    paused_s = watching.simulation.time_s
    with resumed_once(recording, command_id):
        watching.go_on()
    status, result, _ = recording.fate(command_id)
    assert (status, result["why"]) == ("done", "it was paused in Webots before the last step")
    assert (result["mode"], result["steps"] > 1) == ("pause", True)
    assert result["sim_time_s"] == paused_s
    assert result["advanced_s"] == pytest.approx(result["steps"] * 0.016)
    assert result["advanced_s"] == pytest.approx(paused_s - began_s)
    assert watching.simulation.robot("mcp_observer").is_synchronous is False


def test_a_breakpoint_ends_the_steps_at_the_state_that_it_holds_in(
    watching: Watching, recording: Recording, rover: InProcessSupervisor
) -> None:
    at_s = recording.rows("SELECT max(sim_time_s) FROM state")[0]
    with closing(connect(watching.database, "writer")) as connection:
        condition = parse_condition("world.ROVER.x_m > -100")
        set_breakpoint(connection, 1, condition.text, "pause", 1, "test")
    recording.send("arm_breakpoints", time_to_live_s=600)
    command_id = recording.send("step", steps=100_000, time_to_live_s=600)
    with resumed_once(recording, command_id):
        while recording.fate(command_id)[0] == "pending":
            watching.go_on()
        assert rover.step(STEP_MS) == 0
        while recording.fate(command_id)[0] == "claimed":
            watching.go_on()
    status, result, _ = recording.fate(command_id)
    assert (status, result["why"]) == ("done", "a breakpoint paused it before the last step")
    ((hit_s, data),) = watching.rows("SELECT sim_time_s, data FROM event WHERE kind = 'breakpoint'")
    assert json.loads(data)["action"] == "pause"
    assert at_s < hit_s == result["sim_time_s"]


# -- with real processes ----


class Observed:
    """A world of one robot, watched by `webots-mcp observe`."""

    def __init__(self, folder: Path) -> None:
        (folder / "controllers" / "idle").mkdir(parents=True)
        idle = "from controller import Robot\nrobot = Robot()\nwhile robot.step(16) != -1: pass\n"
        (folder / "controllers" / "idle" / "idle.py").write_text(idle)
        world = folder / "worlds" / "w.wbt"
        world.parent.mkdir()
        world.write_bytes(with_observer(WORLD.encode(), extern=True))
        self.data_dir = folder / "data"
        self.recording = Recording(self.data_dir / "webots.db")
        self.simulation = PatientSimulation(world, mode="realtime")
        self._processes: list[subprocess.Popen[bytes]] = []

    def observe(self) -> subprocess.Popen[bytes]:
        line = [sys.executable, "-m", "webots_mcp", "observe", "--data-dir", str(self.data_dir)]
        environment = self.simulation.environment_of("mcp_observer")
        process = subprocess.Popen(line, env=environment)
        self._processes.append(process)
        self.until(lambda: self.simulation.robot("mcp_observer") and self._worlds())
        return process

    def _worlds(self) -> bool:
        count = len(self._processes)
        tables = "SELECT count(*) FROM sqlite_master WHERE name = 'event'"
        worlds = "SELECT count(*) FROM event WHERE kind = 'world'"
        is_there = (self.data_dir / "webots.db").exists() and self.recording.rows(tables) == [1]
        return is_there and self.recording.rows(worlds)[0] >= count

    def step_on(self) -> int:
        """Begin many steps, for which the world waits."""
        command_id = self.recording.send("step", steps=100_000, time_to_live_s=600)
        self.until(lambda: self.is_waiting)
        return command_id

    @property
    def is_waiting(self) -> bool:
        return self.simulation.robot("mcp_observer").is_synchronous

    def until(self, holds: Callable[[], object]) -> None:
        self.simulation.wait_for(lambda: bool(holds()))

    def close(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait()


WORLD = """#VRML_SIM R2025a utf8
WorldInfo { basicTimeStep 16 }
Robot { name "rover" controller "idle" }
"""


@pytest.fixture
def observed(tmp_path: Path) -> Iterator[Observed]:
    observed = Observed(tmp_path)
    with observed.simulation:
        yield observed
        observed.close()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows ends processes without a signal")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_observer_that_a_signal_ends_lets_the_world_go_on(
    observed: Observed, number: signal.Signals
) -> None:
    process = observed.observe()
    command_id = observed.step_on()
    process.send_signal(number)
    assert process.wait(60) == -number
    assert not observed.is_waiting
    status, _, error = observed.recording.fate(command_id)
    assert status == "failed"
    assert error is not None and error.startswith("the controller ended after ")
    began_s = observed.simulation.time_s
    observed.until(lambda: observed.simulation.time_s > began_s + 0.1)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows ends processes without a signal")
def test_a_signal_ends_an_observer_that_is_blocked_in_a_step(observed: Observed) -> None:
    process = observed.observe()
    observed.step_on()
    process.send_signal(signal.SIGSTOP)
    observed.simulation.pause()
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGCONT)
    assert process.wait(60) in (-signal.SIGTERM, 128 + signal.SIGTERM)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows ends processes without a signal")
def test_the_observer_after_one_that_was_killed_lets_the_world_go_on(observed: Observed) -> None:
    first = observed.observe()
    observed.step_on()
    first.kill()
    first.wait()
    assert observed.is_waiting
    observed.observe()
    observed.until(lambda: not observed.is_waiting)
    logged = "SELECT count(*) FROM log WHERE level = 'warning' AND message = ?"
    observed.until(lambda: observed.recording.rows(logged, SET_FREE) == [1])
    command_id = observed.recording.send("step", steps=3, time_to_live_s=600)
    observed.until(lambda: observed.recording.fate(command_id)[0] == "done")
    _, result, _ = observed.recording.fate(command_id)
    assert result["steps"] == 3 and "warning" not in result
