"""`webots-mcp init` on real projects: what is written, what is said, and that nothing is lost."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests import unprivileged
from webots_mcp.contract import bundled

pytestmark = pytest.mark.slow

CONTROLLER = "from controller import Robot\n\nrobot = Robot()\nwhile robot.step(32) != -1: pass\n"
WRITTEN = [
    ".mcp.json", ".cursor/mcp.json", ".vscode/mcp.json", "mcp_data/.gitignore", "webots-mcp.toml",
]  # fmt: skip


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """One with a space and an umlaut, whose Python is this one."""
    folder = tmp_path / "mein schönes Projekt"
    (folder / "worlds").mkdir(parents=True)
    (folder / "controllers" / "läufer").mkdir(parents=True)
    (folder / "controllers" / "läufer" / "läufer.py").write_text(CONTROLLER)
    (folder / "controllers" / "läufer" / "runtime.ini").write_text(
        f"[python]\nCOMMAND = {sys.executable}\n", "utf-8"
    )
    return folder


def run(
    *arguments: str, cwd: Path, line: list[str] | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*(line or [sys.executable]), "-m", "webots_mcp", "init", *arguments], cwd=cwd, text=True,
        encoding="utf-8", capture_output=True, stdin=subprocess.DEVNULL, check=False,
        env={**os.environ, "HOME": str(cwd), "PYTHONPATH": str(Path(__file__).parents[2]),
             "PYTHONIOENCODING": "utf-8"},
    )  # fmt: skip


def snapshot(folder: Path) -> dict[str, tuple[bytes, int]]:
    return {
        str(file.relative_to(folder)): (file.read_bytes(), file.stat().st_mtime_ns)
        for file in folder.rglob("*")
        if file.is_file()
    }


def test_a_new_project_is_ready_in_one_command_and_a_second_changes_nothing(project: Path) -> None:
    ended = run(cwd=project / "controllers" / "läufer")
    assert ended.returncode == 0, ended.stderr
    before = snapshot(project)
    assert set(WRITTEN) <= set(before)
    assert before["mcp_data/.gitignore"][0] == b"*\n"
    assert (project / "mcp_data").stat().st_mode & 0o777 == 0o700
    for line in (
        "controllers/läufer/läufer.py",
        "from webots_mcp import MCPBridge",
        "MCPBridge.attach(robot)",
        "läufer/runtime.ini",
        "which has webots-mcp",
    ):
        assert line in ended.stdout
    again = run(cwd=project)
    assert again.stdout.count("unchanged: ") == len(WRITTEN)
    assert snapshot(project) == before


def test_the_command_that_is_written_starts_a_server(project: Path) -> None:
    run(cwd=project)
    entry = json.loads((project / ".mcp.json").read_text("utf-8"))["mcpServers"]["webots"]
    ask = {"jsonrpc": "2.0", "id": 1, "method": "initialize",
           "params": {"protocolVersion": "2025-06-18", "capabilities": {},
                      "clientInfo": {"name": "test", "version": "1"}}}  # fmt: skip
    ended = subprocess.run(
        [entry["command"], *entry["args"]], input=json.dumps(ask) + "\n", text=True, timeout=60,
        capture_output=True, check=False, cwd="/", env={"PATH": "/nowhere"},
    )  # fmt: skip
    assert '"serverInfo"' in ended.stdout, ended.stderr


def test_a_dry_run_writes_nothing_and_says_what_it_would(project: Path) -> None:
    before = snapshot(project)
    ended = run("--dry-run", "--claude-desktop", cwd=project)
    assert ended.stdout.count("would be written: ") == len(WRITTEN) + 1
    assert snapshot(project) == before
    assert not (project / "mcp_data").exists()


def test_json_holds_it_all(project: Path) -> None:
    found: dict[str, Any] = json.loads(run("--json", cwd=project).stdout)
    assert found["project"] == str(project)
    assert {each["outcome"] for each in found["files"]} == {"written"}
    (controller,) = found["controllers"]
    assert controller["lines"] == ["from webots_mcp import MCPBridge", "MCPBridge.attach(robot)"]
    assert controller["python"]["executable"] == sys.executable


def test_each_controller_is_named_by_its_language_with_what_to_do(project: Path) -> None:
    controllers = project / "controllers"
    for name in ("walls/walls.c", "arm/arm.m", "läufer/roboter.py"):
        (controllers / name).parent.mkdir(exist_ok=True)
        (controllers / name).write_text(CONTROLLER, "utf-8")
    (controllers / "läufer" / "läufer.py").write_text("import roboter\n", "utf-8")
    said = run("--dry-run", cwd=project).stdout
    assert "is C (Webots starts it once it is built): include webots_mcp.h" in said
    assert "is MATLAB: write its values as JSON with wb_robot_set_custom_data('{...}')" in said
    assert "these lines in controllers/läufer/roboter.py, the second after line 3," in said
    found = json.loads(run("--dry-run", "--json", cwd=project).stdout)["controllers"]
    assert [each["language"] for each in found] == ["MATLAB", "Python", "C"]
    assert found[1]["after_line"] == 3


def test_a_damaged_file_is_refused_and_the_others_are_written(project: Path) -> None:
    (project / ".vscode").mkdir()
    (project / ".vscode" / "mcp.json").write_text('{"servers": {\n  "a" 1}}')
    ended = run(cwd=project)
    assert ended.returncode == 2
    assert "line 2, column 7" in ended.stdout
    assert "mcp.json could not be written. The reasons are above" in ended.stderr
    assert (project / ".vscode" / "mcp.json").read_text() == '{"servers": {\n  "a" 1}}'
    assert (project / ".mcp.json").exists()


@pytest.mark.skipif(not unprivileged.POSSIBLE, reason="permissions do not stop this user")
def test_a_read_only_file_stays_as_it_is(project: Path) -> None:
    (project / ".mcp.json").write_text("{}")
    (project / ".mcp.json").chmod(0o444)
    controller = project / "controllers" / "läufer" / "läufer.py"
    controller.chmod(0o444)
    nobody = unprivileged.line()
    ended = run(cwd=project, line=nobody)
    assert ended.returncode == 2
    assert ".mcp.json is read-only" in ended.stdout
    assert (project / ".mcp.json").read_text() == "{}"
    ended = run("--patch", str(controller), "--yes", cwd=project, line=nobody)
    assert ended.returncode == 2
    assert "is read-only" in ended.stderr
    assert controller.read_text() == CONTROLLER


def test_patch_shows_a_diff_and_undo_gives_the_same_bytes(project: Path) -> None:
    file = project / "controllers" / "läufer" / "läufer.py"
    ended = run("--patch", str(file), "--yes", cwd=project)
    assert ended.returncode == 0, ended.stderr
    assert "\n+from webots_mcp import MCPBridge\n" in ended.stdout
    assert "\n+MCPBridge.attach(robot)\n" in ended.stdout
    assert "MCPBridge.attach(robot)" in file.read_text()
    assert not (project / ".mcp.json").exists()
    again = run("--patch", str(file), "--yes", cwd=project)
    assert (again.returncode, "already patched" in again.stdout) == (0, True)
    file.with_suffix(".cpp").write_text("int main() {}\n")
    other = run("--patch", str(file.with_suffix(".cpp")), "--yes", cwd=project)
    assert (other.returncode, "is not a Python file" in other.stderr) == (2, True)
    undone = json.loads(run("--undo", str(file), "--yes", "--json", cwd=project).stdout)
    assert [(each["file"], each["outcome"]) for each in undone["files"]] == [(str(file), "written")]
    assert "\n-MCPBridge.attach(robot)\n" in undone["files"][0]["diff"]
    assert file.read_text() == CONTROLLER


@pytest.mark.parametrize(("answer", "patched"), [("y\n", True), ("\n", False)])
def test_at_a_terminal_it_asks(project: Path, answer: str, patched: bool) -> None:
    pty = pytest.importorskip("pty")
    file = project / "controllers" / "läufer" / "läufer.py"
    keyboard, terminal = pty.openpty()
    os.write(keyboard, answer.encode())
    subprocess.run(
        [sys.executable, "-m", "webots_mcp", "init", "--patch", str(file)],
        stdin=terminal, capture_output=True, check=False,
    )  # fmt: skip
    os.close(keyboard)
    os.close(terminal)
    assert ("MCPBridge" in file.read_text()) == patched


def test_a_patched_controller_records_in_the_stand_in(tmp_path: Path) -> None:
    shutil.copytree(bundled("examples") / "worlds", tmp_path / "worlds")
    folder = tmp_path / "controllers" / "rover"
    folder.mkdir(parents=True)
    (folder / "rover.py").write_text(
        "from controller import Supervisor\n\nrobot = Supervisor()\n"
        "for _ in range(20):\n    robot.step(16)\nrobot.simulationQuit(0)\nrobot.step(16)\n"
    )
    assert run("--patch", str(folder / "rover.py"), "--yes", cwd=tmp_path).returncode == 0
    ended = subprocess.run(
        [sys.executable, "-m", "webots_mcp.standin", "worlds/arena.wbt"], cwd=tmp_path,
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (tmp_path / "mcp_data" / "webots.db").exists(), ended.stderr
    shown = subprocess.run(
        [sys.executable, "-m", "webots_mcp", "signals"], cwd=tmp_path, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert "motors.left wheel motor" in shown.stdout, shown.stderr


def test_what_a_plain_robot_cannot_do_is_said_with_the_line_that_adds_an_observer(
    project: Path,
) -> None:
    """Until there is one: then nothing is lacking."""
    (project / "worlds" / "arena.wbt").touch()
    (project / "controllers" / "läufer" / "läufer.py").write_text(
        "from controller import Robot\nrobot = Robot()\n", "utf-8"
    )
    said = run("--dry-run", cwd=project).stdout
    assert "its robot is a plain Robot: pause, step, reset, screenshots and the scene" in said
    assert "webots-mcp init --observer worlds/arena.wbt adds a robot" in said
    (project / "controllers" / "mcp_observer").mkdir()
    assert "plain Robot" not in run("--dry-run", cwd=project).stdout


def test_it_ends_with_the_commands_that_follow_and_the_first_question(project: Path) -> None:
    (project / "worlds" / "arena.wbt").write_text("#VRML_SIM R2025a utf8\n", "utf-8")
    told = run(cwd=project).stdout
    steps = json.loads(run("--json", cwd=project).stdout)["next"]
    assert steps[0] == "webots-mcp init --patch 'controllers/läufer/läufer.py'"
    assert steps[1].startswith("webots-mcp launch worlds/arena.wbt")
    assert steps[2].endswith("What is the robot doing?")
    assert told.splitlines()[-3:] == [f"  {n}. {step}" for n, step in enumerate(steps, 1)]
    patched = run("--patch", "controllers/läufer/läufer.py", "--yes", cwd=project).stdout
    assert patched.splitlines()[-1] == f"Next: {steps[1]}"


@pytest.mark.skipif(shutil.which("git") is None, reason="Git is not installed")
def test_files_with_paths_of_this_machine_are_named_until_the_repository_ignores_them(
    project: Path,
) -> None:
    assert ".gitignore: they hold" not in run(cwd=project).stdout
    subprocess.run(["git", "init", "--quiet", str(project)], check=True)
    told = run(cwd=project).stdout
    assert "add .mcp.json, .cursor/mcp.json and .vscode/mcp.json to .gitignore: they hold" in told
    (project / ".gitignore").write_text(".mcp.json\n.cursor/\n", "utf-8")
    assert "add .vscode/mcp.json to .gitignore" in run(cwd=project).stdout
