"""What a start waits for: nothing is imported that only a later call needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded, insert
from webots_mcp.cli.commands import COMMANDS, EVERYDAY
from webots_mcp.cli.question_commands import command_of
from webots_mcp.questions.declaration import Question

_ROBOT = """
class Robot:
    devices = {}
    time_s = 0.0
    def step(self, duration_ms):
        self.time_s += duration_ms / 1000
        return 0
    def getTime(self): return self.time_s
    def getName(self): return "rover"
    def getBasicTimeStep(self): return 8.0
    def getWorldPath(self): return ""
    def getSupervisor(self): return False
robot = Robot()
"""
# What carries out single tools, and the packages that it needs.
_OF_SINGLE_TOOLS = {
    "numpy", "PIL", "resvg_py", "jinja2", "sqlalchemy", "sqlmodel", "pcodec", "websockets",
    "webots_mcp.bridge.mcp_bridge", "webots_mcp.judging.checks", "webots_mcp.judging.comparison",
    "webots_mcp.judging.divergence", "webots_mcp.judging.run_measures",
    "webots_mcp.judging.run_score", "webots_mcp.judging.run_series", "webots_mcp.judging.trends",
    "webots_mcp.lint.bodies", "webots_mcp.lint.scene", "webots_mcp.plotting.painting",
    "webots_mcp.plotting.signal_plot", "webots_mcp.plotting.trajectory",
    "webots_mcp.plugins.clip.clip", "webots_mcp.plugins.report.make_report",
    "webots_mcp.rerun", "webots_mcp.setup.doctor", "webots_mcp.standin", "webots_mcp.worlds",
}  # fmt: skip


def loaded_by(program: str, *arguments: str) -> set[str]:
    """The modules that a program of its own has imported at its end."""
    whole = f"{program}\nimport sys\nprint(*sys.modules, file=sys.stderr)"
    line = [sys.executable, "-c", whole, *arguments]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    return set(done.stderr.splitlines()[-1].split())


def run_command(*arguments: str) -> set[str]:
    return loaded_by(
        "import contextlib\nfrom webots_mcp.cli import main\n"
        f"with contextlib.suppress(SystemExit): main({[*arguments]!r})"
    )


def ours(modules: set[str]) -> set[str]:
    return {name for name in modules if name.partition(".")[0] == "webots_mcp"}


def test_importing_the_bridge_waits_for_nothing_that_only_a_session_needs() -> None:
    loaded = loaded_by("from webots_mcp import MCPBridge")
    assert "webots_mcp.bridge.mcp_bridge" in loaded
    assert not loaded & {
        "orjson", "dataclasses", "inspect", "logging", "uuid", "platform", "subprocess", "asyncio",
        "webots_mcp.bridge.session", "webots_mcp.bridge.recorder", "webots_mcp.bridge.encoding",
        "webots_mcp.signals.register", "webots_mcp.database.connection",
    }  # fmt: skip


def test_no_step_of_the_loop_waits_for_an_import(tmp_path: Path) -> None:
    program = f"""
import sys
from webots_mcp import MCPBridge
{_ROBOT}
bridge = MCPBridge(robot, {str(tmp_path)!r}, throttle_interval=1)
made = set(sys.modules)
for count in range(50):
    robot.step(8)
    bridge.publish({{"count": count, "pose": [0.5, count / 10, 1.0], "mode": "drive"}})
    bridge.log("a line")
    bridge.get_command()
print(sorted(set(sys.modules) - made))
bridge.close()
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_the_version_is_printed_before_anything_else_is_imported() -> None:
    loaded = run_command("--version")
    assert ours(loaded) == {
        "webots_mcp", "webots_mcp.cli", "webots_mcp.contract", "webots_mcp.errors"
    }  # fmt: skip
    assert not loaded & {"cyclopts", "pydantic", "rich", "inspect", "json", "sqlite3"}


def test_the_everyday_commands_are_listed_without_what_carries_them_out() -> None:
    loaded = run_command("--help")
    assert "cyclopts" in loaded
    assert not loaded & {"pydantic", "anyio", "sqlite3"}
    assert not {name for name in ours(loaded) if name.startswith("webots_mcp.questions")}


def test_they_are_listed_with_the_sentences_of_their_own_help() -> None:
    for name, sentence in EVERYDAY.items():
        declared = COMMANDS[name].declared()
        function = command_of(declared) if isinstance(declared, Question) else declared
        assert (function.__doc__ or "").strip().splitlines()[0] == sentence, name


@pytest.mark.slow
def test_status_waits_for_no_tool_but_its_own(tmp_path: Path) -> None:
    recording = Recorded(tmp_path / "webots.db")
    robot = recording.robot()
    robot.state(1.5, {"x": 1})
    known = {"name": "x", "path": "$.x", "kind": "num", "first_seen_wall_time_s": robot.now}
    insert(recording.connection, "signal", known | {"robot_id": robot.id})
    recording.close()
    loaded = run_command("status", "--data-dir", str(tmp_path))
    assert "webots_mcp.questions.list_robots" in loaded
    assert not loaded & (_OF_SINGLE_TOOLS | {"mcp"})
    assert not {"webots_mcp.steering", "webots_mcp.simulator", "webots_mcp.plotting"} & loaded


@pytest.mark.slow
def test_a_server_lists_its_tools_without_what_carries_them_out(tmp_path: Path) -> None:
    program = f"""
import anyio
from pathlib import Path
from webots_mcp.server.mcp_server import create_server
folder = Path({str(tmp_path)!r})
print(len(anyio.run(create_server(folder / "webots.db", folder, tools="all").list_tools)))
"""
    loaded = loaded_by(program)
    assert "webots_mcp.server.tool_list" in loaded
    assert not loaded & _OF_SINGLE_TOOLS
    assert not loaded & {"webots_mcp.questions.declaration", "webots_mcp.answers.answer_models"}
    assert "webots_mcp.judging" not in loaded
