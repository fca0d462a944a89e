"""Loops that are silent, in real controller processes: which are named, with their line, and which
only wait for Webots."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import PatientSimulation, Start, has_states
from tests.setup.doctor.conftest import found
from webots_mcp.contract import HANG_VARIABLE
from webots_mcp.database.connection import connect
from webots_mcp.database.thread_stacks import stacks_path
from webots_mcp.database.waiting_file import adopt, waiting_paths
from webots_mcp.standin import Mode, Simulation
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.store.recording import RecordingAccess as Store
from webots_mcp.store.robot_status import WAITING_IN_STEP, Status

pytestmark = pytest.mark.slow

Script = Callable[..., "subprocess.Popen[str]"]

HANGS = """
import queue, threading
from pathlib import Path
lock = threading.Lock()
lock.acquire()
def plan():
    {hang}
def run():
    plan()
bridge.attach(robot)
for _ in range(30):
    robot.step(16)
run()
while robot.step(16) != -1:
    pass
"""
IN_PLAN = "silent for {} s in rover.py:14, plan(), called from run() and rover.py:20"
LOGGED = "SELECT message FROM log WHERE logger = 'stacks'"


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:  # pyright: ignore[reportUnusedFunction]
    monkeypatch.setenv(HANG_VARIABLE, "0.5")


def status(recording: Recording, robot: str = "rover") -> Status:
    assert isinstance(recording.database, Path)
    with Store(recording.database, recording.database.parent).view(robot) as view:
        return view.status


def why(simulation: Simulation, recording: Recording, words: str, robot: str = "rover") -> str:
    """Why a robot stands still, as soon as these words say it."""

    def look() -> str:
        found = (status(recording, robot).why or "") if has_states(recording) else ""
        return found if words in found else ""

    return simulation.wait_for(look)


def messages(recording: Recording) -> list[str]:
    """The first line of each log row about a silent loop."""
    return [text.partition("\n")[0] for text in recording.rows(LOGGED)]


@pytest.mark.parametrize(
    ("hang", "inside"),
    [
        ("while True: pass", ""),
        ("sum(range(10**15))  # C code that keeps the interpreter's lock", ""),
        ("lock.acquire()", ""),
        ("queue.Queue().get()", "; there in threading.py:"),
    ],
    ids=["Python", "C", "lock", "library"],
)
def test_a_hang_is_named_with_its_line_while_it_lasts_and_once_when_its_process_is_killed(
    start: Start, filed: Recording, hang: str, inside: str
) -> None:
    simulation = start(HANGS.format(hang=hang))
    said = why(simulation, filed, "plan()")
    simulation.close()  # which kills it
    assert isinstance(filed.database, Path)
    (file,) = waiting_paths(filed.database, stacks_path)
    with closing(connect(filed.database, "writer")) as connection:
        adopt(connection, filed.database)
        adopt(connection, filed.database)

    place = IN_PLAN.partition("{} s ")[2]
    assert said.startswith("silent for ") and place in said and inside in said
    assert file.stat().st_mode & 0o777 == 0o600 if file.exists() else True
    assert [text.startswith(f"silent for more than 0.5 s {place}") for text in messages(filed)] == [
        True
    ]
    assert waiting_paths(filed.database, stacks_path) == []
    assert f"it was {messages(filed)[0]}" in (status(filed).why or "")


def test_one_that_comes_back_is_logged_once_and_not_said_any_more(
    start: Start, filed: Recording, tmp_path: Path
) -> None:
    simulation = start(
        HANGS.format(hang=f"while not Path({str(tmp_path / 'go')!r}).exists(): pass")
    )
    why(simulation, filed, "plan()")
    assert isinstance(filed.database, Path)
    assert "mend that line" in str(found(filed.database, "Simulation").fix)
    (tmp_path / "go").touch()
    simulation.wait_for(lambda: status(filed) == Status("running") and messages(filed))
    simulation.quit()
    simulation.wait_for(lambda: filed.rows("SELECT end_reason FROM session") == ["finished"])

    assert [text.count("plan()") for text in messages(filed)] == [1]
    assert waiting_paths(filed.database, stacks_path) == []


def test_c_code_that_the_question_wakes_from_its_sleep_is_named_nevertheless(
    start: Start, filed: Recording
) -> None:
    hang = "__import__('ctypes').PyDLL(None).sleep(600)"
    simulation = start(HANGS.format(hang=hang))
    said = why(simulation, filed, "plan()")
    simulation.wait_for(lambda: status(filed).is_moving and messages(filed))
    assert said.startswith("silent for ")
    assert [text.count("plan()") for text in messages(filed)] == [1]


def test_neither_a_simulation_that_is_paused_nor_a_loop_that_is_held_hangs(
    start: Start, filed: Recording
) -> None:
    simulation = start(HANGS.format(hang="pass"))
    simulation.wait_for(lambda: has_states(filed))
    filed.send("pause")
    simulation.wait_for(lambda: status(filed).text == "paused")
    beats = "SELECT last_seen_wall_time_s FROM session"
    (paused_s,) = filed.rows(beats)
    simulation.wait_for(lambda: filed.rows(beats)[0] > paused_s + 2)  # longer than the limit
    held = status(filed)
    filed.send("resume")
    simulation.wait_for(lambda: simulation.mode is not Mode.PAUSE)
    simulation.pause()  # as a person does in the window
    by_hand = why(simulation, filed, WAITING_IN_STEP)

    assert held.why is None
    assert by_hand == WAITING_IN_STEP
    assert messages(filed) == []


def test_the_controller_that_holds_up_the_world_is_named_to_the_others(
    tmp_path: Path, data_dir: Path, filed: Recording
) -> None:
    world = tmp_path / "two.wbt"
    other = 'Robot { name "other" translation 0.5 0.5 0.05 supervisor TRUE controller "other" }'
    world.write_text(f"{DEFAULT_WORLD.read_text()}\n{other}\n")
    begins = "from controller import Supervisor\nfrom webots_mcp import MCPBridge\n"
    programs = {
        "rover": "bridge = MCPBridge.attach(Supervisor())\nwhile bridge.robot.step(16) != -1: pass",
        "other": "r = Supervisor(); MCPBridge.attach(r)\nwhile r.getTime() < 1: r.step(16)\n"
        "while True: pass",
    }
    for name, text in programs.items():
        (tmp_path / f"{name}.py").write_text(begins + text)
    simulation = PatientSimulation(
        world,
        mode="fast",
        controllers={name: tmp_path / f"{name}.py" for name in programs},
        environment={"WEBOTS_MCP_DATA_DIR": str(data_dir)},
    )
    with closing(simulation.start()):
        said = why(simulation, filed, "for other: silent for ")
    assert "its loop waits in step(), as the whole world does, for other: silent for" in said
    assert said.endswith("s in other.py:5")


@pytest.mark.parametrize("attached", [True, False])
def test_whose_time_a_loop_takes_is_known_of_each_run(
    start: Start, filed: Recording, attached: bool
) -> None:
    round_ = "pass" if attached else "bridge.publish({}); bridge.get_command()"
    simulation = start(
        f"import time\nif {attached}: bridge.attach(robot)\n"
        f"while robot.step(16) != -1:\n    time.sleep(0.02)\n    {round_}\n"
    )
    sql = "SELECT own_wall_s, step_wait_wall_s, steps FROM run WHERE steps > 25"
    simulation.wait_for(lambda: has_states(filed) and filed.rows(sql))
    ((own_s, wait_s, steps),) = filed.rows(sql)
    taken_s = time.time() - filed.rows("SELECT started_wall_time_s FROM run")[0]
    assert own_s >= 0.02 * steps
    assert wait_s > 0 and own_s + wait_s < taken_s


def test_asking_read_only_wakes_no_c_code(start: Start, filed: Recording, tmp_path: Path) -> None:
    slept = tmp_path / "slept"
    sleep = "__import__('ctypes').PyDLL(None).sleep(8)"
    hang = f"left = {sleep}; Path({str(slept)!r}).write_text(str(left))"
    simulation = start(HANGS.format(hang=hang))
    simulation.wait_for(lambda: has_states(filed))
    assert isinstance(filed.database, Path)
    store = Store(filed.database, filed.database.parent, read_only=True)

    def is_over() -> bool:
        with store.view() as view:
            assert view.status.text
        return slept.exists()

    simulation.wait_for(is_over)
    assert slept.read_text() == "0"  # seconds that were left when it returned
