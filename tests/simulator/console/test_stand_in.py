"""What a stand-in and its controllers print is recorded by `webots-mcp launch --stand-in`."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from re import findall

import pytest

from tests.simulator.conftest import started
from tests.waiting import wait_for
from webots_mcp.simulator.console import StandInConsole
from webots_mcp.store.logs import MOST_WAITING
from webots_mcp.store.recording import RecordingAccess

pytestmark = pytest.mark.slow

WORLD = """#VRML_SIM R2023b utf8
WorldInfo { basicTimeStep 16 }
Viewpoint { }
Robot { name "broken" controller "broken" }
Robot { translation 1 0 0 name "quiet" controller "quiet" }
"""
RECORDER = 'Robot { translation 2 0 0 name "recorder" controller "recorder" }\n'
BROKEN = "import no_such_module\n"
QUIET = """
from controller import Robot
robot = Robot()
print("the same words")
while robot.step(16) != -1:
    pass
"""
RECORDING = """
import sys
print("before the bridge")
from controller import Robot
from webots_mcp import MCPBridge
robot = Robot()
bridge = MCPBridge.attach(robot)
print("the same words")
print("a warning", file=sys.stderr)
while robot.step(16) != -1:
    if abs(robot.getTime() - 0.8) < 0.001:
        print("all is printed")
print("last words")
"""

Launch = Callable[[Path], "subprocess.Popen[str]"]


@pytest.fixture
def launch() -> Iterator[Launch]:
    command = (sys.executable, "-m", "webots_mcp", "launch")
    with started(*command, end=signal.SIGTERM) as start:
        yield lambda world: start(world, "--stand-in", "--mode", "realtime")


def project(folder: Path, world: str) -> Path:
    controllers = {"broken": BROKEN, "quiet": QUIET, "recorder": RECORDING}
    for name, code in controllers.items():
        file = folder / "controllers" / name / f"{name}.py"
        file.parent.mkdir(parents=True)
        file.write_text(code, encoding="utf-8")
    (folder / "worlds").mkdir()
    path = folder / "worlds" / "w.wbt"
    path.write_text(world, encoding="utf-8")
    return path


def ended(process: subprocess.Popen[str], text: str) -> None:
    """Wait until the text is printed, and end the simulation as a person does."""
    assert process.stdout is not None
    assert any(text in line for line in process.stdout)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)


def rows(world: Path, query: str) -> list[tuple[object, ...]]:
    database = world.parent.parent / "mcp_data" / "webots.db"
    with closing(sqlite3.connect(database)) as connection:
        return connection.execute(query).fetchall()


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_lines_have_their_robot_and_none_is_there_twice(launch: Launch, tmp_path: Path) -> None:
    world = project(tmp_path / "project", WORLD + RECORDER)
    ended(launch(world), "all is printed")
    found = rows(
        world,
        "SELECT source, level, message FROM log WHERE source <> 'webots' "
        "AND message NOT LIKE '%File%' ORDER BY message",
    )
    assert found == [
        ("console", "warning", "[broken]     import no_such_module"),
        ("console", "warning", "[broken] ModuleNotFoundError: No module named 'no_such_module'"),
        ("console", "warning", "[broken] Traceback (most recent call last):"),
        ("console", "info", "[quiet] the same words"),
        ("controller", "warning", "a warning"),
        ("controller", "info", "all is printed"),
        ("controller", "info", "before the bridge"),
        ("controller", "info", "last words"),
        ("controller", "info", "the same words"),
    ]
    own = rows(world, "SELECT level, message FROM log WHERE source = 'webots'")
    assert ("warning", "WARNING: 'broken' controller exited with status: 1.") in own


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_logs_show_why_a_controller_failed_where_no_robot_records(
    launch: Launch, tmp_path: Path
) -> None:
    world = project(tmp_path / "project", WORLD)
    (tmp_path / "project" / "controllers" / "quiet" / "quiet.py").write_text(
        "from controller import Robot\nrobot = Robot()\nrobot.step(160)\nprint('done')\n"
        "while robot.step(16) != -1: pass\n"
    )
    process = launch(world)
    asking = [sys.executable, "-m", "webots_mcp", "logs", "--source", "console"]
    asking += ["--data-dir", str(tmp_path / "project" / "mcp_data")]

    def shown() -> str:
        return subprocess.run(asking, capture_output=True, text=True, check=False).stdout

    wait_for(lambda: "[broken] ModuleNotFoundError: No module named" in shown())
    ended(process, "[quiet] done")
    assert "[broken] ModuleNotFoundError: No module named" in shown()


def test_of_a_flood_all_lines_are_recorded_or_counted(tmp_path: Path) -> None:
    database = tmp_path / "webots.db"
    with StandInConsole(RecordingAccess(database, tmp_path)) as console:
        console.begin(1234)
        for number in range(3_000):
            console.put("stdout", f"[rover] line {number}")
    with closing(sqlite3.connect(database)) as connection:
        lines = [text for (text,) in connection.execute("SELECT message FROM console_line")]
    (newest,) = lines[-1:]
    assert "more than 500 in a second" in newest
    counted = sum(int(count) for text in lines for count in findall(r"recorded: (\d+) lines", text))
    assert counted >= 1_000
    assert len(lines) == MOST_WAITING
