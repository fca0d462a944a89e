"""`webots-mcp launch` on a program named `webots` that behaves as Webots' sources tell."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from tests.simulator.conftest import CONTROLLER, free_port, started, webots, write_project
from tests.waiting import wait_for
from webots_mcp.cli import main

__all__ = ["webots"]
pytestmark = pytest.mark.skipif(os.name != "posix", reason="the program `webots` is a script")

Launch = Callable[..., "subprocess.Popen[str]"]
PLAIN = "from controller import Robot\nrobot = Robot()\nwhile robot.step(16) != -1: pass\n"
FAILING = (
    "from webots_mcp import MCPBridge\nprint('hello', flush=True)\nraise ValueError('no arm')\n"
)
QUITTING = CONTROLLER.replace("robot.getTime()})", "1})\n    robot.simulationQuit(5)", 1)


@pytest.fixture
def launch(webots: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Launch]:
    """Run the command, in the way of a person at a desktop."""
    monkeypatch.setenv("DISPLAY", ":99")
    with started(sys.executable, "-m", "webots_mcp", "launch", end=signal.SIGKILL) as launch:
        yield launch


@pytest.fixture
def project(tmp_path: Path) -> Callable[[str], Path]:
    """A project whose robot has this controller; the world of it."""
    return lambda controller=CONTROLLER: write_project(tmp_path / "project", controller)


def _told(process: subprocess.Popen[str], text: str) -> str:
    """The first line of its stderr with a text in it."""
    assert process.stderr is not None
    said = list[str]()
    for line in process.stderr:
        said.append(line)
        if text in line:
            return line
    raise AssertionError(f"{text!r} never came: {said}")


def _refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What the command says that refuses these arguments before anything starts."""
    capsys.readouterr()
    try:
        code = main(["launch", *map(str, arguments)])
    except SystemExit as refused:  # by the parser of the command line
        code = refused.code
    out, told = capsys.readouterr()
    assert (code, out) == (2, "")
    assert "Traceback" not in told
    return told


def _assert_told(launch: Launch, world: Path, *options: str, text: str) -> None:
    """Why nobody records has a text in it; what shows late on a slow machine needs patience."""
    told = ""
    for patience_s in (1, 4, 16, 60):
        process = launch(world, "--patience", str(patience_s), *options)
        told = _told(process, f"no controller has recorded within {patience_s} s: ")
        process.terminate()
        process.communicate(timeout=60)
        if text in told:
            return
    raise AssertionError(told)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_it_says_who_records_and_leaves_nothing_running_however_it_ends(
    launch: Launch, project: Callable[..., Path], number: signal.Signals, tmp_path: Path
) -> None:
    port = free_port()
    process = launch(project(), "--mode", "fast", "--headless", "--port", port)
    said = _told(process, "records")
    assert said == f"webots-mcp: rover records: run 1, Webots listens at port {port}\n"
    assert (tmp_path / "project" / "mcp_data" / "webots.db").exists()
    family = psutil.Process(process.pid).children(recursive=True)
    assert any("rover.py" in " ".join(each.cmdline()) for each in family)

    assert process.stdout is not None
    assert "ready\n" in process.stdout  # which the controller prints when it records already

    process.send_signal(number)
    out, rest = process.communicate(timeout=60)

    wait_for(lambda: not any(each.is_running() for each in family))
    if number != signal.SIGKILL:
        assert process.returncode == 128 + number
        assert "webots-mcp: ending Webots\n" in rest
        assert "Traceback" not in out + rest


@pytest.mark.slow
def test_webots_ends_by_itself_with_its_own_exit_code(
    launch: Launch, project: Callable[..., Path]
) -> None:
    process = launch(project(QUITTING), "--mode", "fast")
    out, said = process.communicate(timeout=60)
    assert process.returncode == 5, said
    assert "webots-mcp: rover records: run 1" in said
    assert "ready\n" in out
    assert "ending Webots" not in said


@pytest.mark.slow
def test_a_port_that_is_taken_is_told_by_the_one_that_webots_took(
    launch: Launch, project: Callable[..., Path]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        process = launch(project(), "--port", port)
        said = _told(process, "records")
    taken = int(said.split()[-1])
    assert port < taken <= port + 10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("controller", "said"),
    [
        (PLAIN, "without a bridge: rover (attach one: webots-mcp init --patch "),
        (FAILING, "ValueError: no arm | WARNING: 'rover' controller exited with status: 1."),
    ],
)
def test_it_says_why_nobody_records(
    launch: Launch, project: Callable[..., Path], controller: str, said: str
) -> None:
    _assert_told(launch, project(controller), text=said)


@pytest.mark.slow
def test_an_extern_controller_that_is_missing_is_named(
    launch: Launch, project: Callable[..., Path]
) -> None:
    world = project()
    text = world.read_text("utf-8").replace('controller "rover"', 'controller "<extern>"')
    world.write_text(text, "utf-8")
    said = "a robot has the controller <extern>: start it with webots-controller"
    _assert_told(launch, world, text=said)


@pytest.mark.slow
def test_webots_that_ends_at_its_start_is_told_with_what_it_said(
    launch: Launch, project: Callable[..., Path]
) -> None:
    world = project()
    world.write_text("no world at all", "utf-8")
    process = launch(world)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "webots-mcp: Webots ended with exit code 1; its console has: " in said
    asking = [sys.executable, "-m", "webots_mcp", "logs", "--data-dir"]
    asking += [str(world.parent.parent / "mcp_data")]
    told = subprocess.run(asking, capture_output=True, text=True, check=False).stdout
    assert told.count("a world begins with") == 1


@pytest.mark.slow
def test_without_a_free_port_webots_says_so_and_ends(
    launch: Launch, project: Callable[..., Path]
) -> None:
    with contextlib.ExitStack() as taken:
        first = free_port()
        for port in range(first, first + 11):
            with contextlib.suppress(OSError):  # somebody else has it
                taken.enter_context(socket.create_server(("127.0.0.1", port)))
        process = launch(project(), "--port", first)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 1
    assert f"Could not initialize TCP server on port {first}" in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["arna.wbt"], "arna.wbt; in {}/worlds there is arena.wbt"),
        (["worlds/arna.wbt"], "arna.wbt; in {}/worlds there is arena.wbt"),
        (["controllers/rover/rover.py"], "is no world: its name does not end with .wbt"),
        (["../lonely.wbt"], "lies in no Webots project: that is a folder that holds worlds/"),
        (
            ["worlds/arena.wbt", "--port", "70000"],
            'Invalid value "70000" for --port. Must be <= 65535.',
        ),
    ],
)
def test_a_world_that_cannot_be_meant_is_refused(
    webots: Path,
    project: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    folder = project().parent.parent
    (folder.parent / "lonely.wbt").write_text("#VRML_SIM R2025a utf8\n")
    monkeypatch.chdir(folder)
    assert said.format(folder) in _refusal(capsys, *arguments)


def test_a_folder_where_nothing_can_be_recorded_is_told_before_webots_runs(
    webots: Path, project: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    world = project()
    (world.parent.parent / "mcp_data").write_text("a file")
    assert "mcp_data" in _refusal(capsys, world)


@pytest.mark.slow
def test_who_reads_no_longer_ends_it(launch: Launch, project: Callable[..., Path]) -> None:
    process = launch(project(CONTROLLER + '    print("x" * 9999)\n'), "--mode", "fast")
    _told(process, "records")
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(60) == 0


@pytest.mark.slow
def test_what_webots_says_is_recorded_also_where_no_controller_ever_recorded(
    launch: Launch,
    project: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    process = launch(project(FAILING), "--mode", "fast", "--patience", "0")
    _told(process, "no controller has recorded")
    asking = ["logs", "--source", "console"]
    asking += ["--data-dir", str(tmp_path / "project" / "mcp_data")]

    def told() -> str:
        main(asking)  # which may find no recording yet
        return capsys.readouterr().out

    wait_for(lambda: "console: ValueError: no arm" in told())


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_stand_in_runs_a_world_where_no_webots_is(
    launch: Launch, project: Callable[..., Path], number: signal.Signals, tmp_path: Path
) -> None:
    process = launch(project(), "--stand-in", "--mode", "fast")
    assert re.search(r": \w+ records: run 1$", _told(process, "records"))
    family = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(number)
    out, rest = process.communicate(timeout=60)
    wait_for(lambda: not any(each.is_running() for each in family))
    assert process.returncode == 0
    assert "Traceback" not in out + rest
    assert (tmp_path / "project" / "mcp_data" / "webots.db").exists()


def test_the_stand_in_says_why_no_controller_records(
    launch: Launch, project: Callable[..., Path]
) -> None:
    process = launch(project(PLAIN), "--stand-in", "--patience", "0")
    assert "(attach one: webots-mcp init --patch " in _told(process, "no controller has recorded")


@pytest.mark.slow
def test_the_stand_in_runs_a_file_for_an_extern_robot(
    launch: Launch, project: Callable[..., Path], tmp_path: Path
) -> None:
    world, file = project(), tmp_path / "mine.py"
    text = world.read_text(encoding="utf-8")
    assert 'controller "rover"' in text
    world.write_text(text.replace('controller "rover"', 'controller "<extern>"'), encoding="utf-8")
    file.write_text("from controller import Supervisor\nSupervisor().simulationQuit(3)\n")
    process = launch(world, "--stand-in", "--mode", "fast", "--robot", f"rover={file}")
    process.communicate(timeout=60)
    assert process.returncode == 3


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--robot", "rover=x.py"], "--robot applies only to --stand-in"),
        (["--stand-in", "--robot", "rover"], "--robot 'rover' is not of the form NAME=FILE"),
    ],
)
def test_a_file_for_a_robot_is_refused_where_it_cannot_be_run(
    webots: Path,
    project: Callable[..., Path],
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    why: str,
) -> None:
    assert why in _refusal(capsys, project(), *options)


def test_what_only_webots_has_is_refused_for_the_stand_in(
    webots: Path, project: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    told = _refusal(capsys, project(), "--stand-in", "--stream")
    assert "--stream and --port apply only to Webots" in told
