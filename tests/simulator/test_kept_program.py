"""A program that we start ends with us, also within a display that was made for it."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.waiting import wait_for
from webots_mcp.errors import CommandRefusedError
from webots_mcp.simulator import program_keeper
from webots_mcp.simulator.starting import CommandLine, KeptProgram, Start, any_port, free_port

needs_xvfb = pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="xvfb-run is missing")

# Tells its display and waits; asked to end, it says so and ends with a code of its own.
PROGRAM = """
import os, pathlib, signal, sys, time
def end(number, frame):
    print("ends", flush=True)
    sys.exit(7)
signal.signal(signal.SIGTERM, end)
told = f"{os.getpid()} {os.environ.get('DISPLAY')}"
pathlib.Path("program.part").write_text(told)
pathlib.Path("program.part").rename("program.txt")
time.sleep(600)
"""
OWNER = """
import subprocess, sys, time
from webots_mcp.simulator.starting import CommandLine, KeptProgram
command = CommandLine([sys.executable, "program.py"], ["xvfb-run", "--auto-servernum"])
kept = KeptProgram(command, {}, subprocess.DEVNULL, subprocess.DEVNULL)
kept.start()
time.sleep(600)
"""


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.delenv("DISPLAY", raising=False)
    Path("program.py").write_text(PROGRAM)


def _told() -> tuple[int, str]:
    wait_for(Path("program.txt").exists)
    pid, display = Path("program.txt").read_text().split()
    return int(pid), display


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_it_is_asked_to_end_and_its_exit_code_is_told() -> None:
    command = CommandLine([sys.executable, "program.py"], [])
    with open("said.txt", "wb") as said:  # noqa: PTH123
        kept = KeptProgram(command, {}, said, subprocess.STDOUT)
    kept.start()
    _told()
    assert kept.exit_code is None
    kept.end()
    assert (kept.exit_code, Path("said.txt").read_text()) == (7, "ends\n")


@needs_xvfb
@pytest.mark.parametrize("end", ["owner killed", "ended"])
def test_within_a_display_of_its_own_nothing_is_left_over(end: str, tmp_path: Path) -> None:
    owner = subprocess.Popen([sys.executable, "-c", OWNER]) if end == "owner killed" else None
    kept = None
    if owner is None:
        command = CommandLine([sys.executable, "program.py"], ["xvfb-run", "--auto-servernum"])
        kept = KeptProgram(command, {}, subprocess.DEVNULL, subprocess.DEVNULL)
        kept.start()
    pid, display = _told()
    assert display.startswith(":")
    family = _family(pid)
    if owner is not None:
        owner.send_signal(signal.SIGKILL)
        owner.wait()
    elif kept is not None:
        kept.end()
        assert kept.exit_code == 7
    wait_for(lambda: not any(each.is_running() for each in family))
    wait_for(lambda: not list(tmp_path.glob("xvfb-run.*")))


def _family(pid: int) -> list[psutil.Process]:
    """All from `xvfb-run` on, whose child the keeper of the program is."""
    above = psutil.Process(pid).parents()[1]
    assert "xvfb-run" in " ".join(above.cmdline())
    return [above, *above.children(recursive=True)]


def test_the_options_are_webots_own(webots: Path) -> None:
    world = Path("arena.wbt")
    start = Start(world, None, headless=False, streams=False, port=1234)
    assert start.options == ["--batch", "--stdout", "--stderr", "--port=1234"]
    start = Start(world, "fast", headless=True, streams=True, port=4000)
    assert start.options[3:] == [
        "--port=4000", "--mode=fast", "--no-rendering", "--minimize", "--stream"
    ]  # fmt: skip


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_without_a_display_there_is_a_virtual_one_or_a_word_about_it(
    webots: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = Start(Path("arena.wbt"), None, headless=False, streams=False, port=1234)
    (webots.parent / "xvfb-run").write_text("#!/bin/sh\n")
    (webots.parent / "xvfb-run").chmod(0o755)
    monkeypatch.setenv("PATH", str(webots.parent))
    virtual = start.command_line()
    assert virtual.display == [str(webots.parent / "xvfb-run"), "--auto-servernum"]
    assert virtual.words == [str(webots), *start.options, "arena.wbt"]
    (webots.parent / "xvfb-run").unlink()
    with pytest.raises(CommandRefusedError, match=r"DISPLAY is not set.*apt install xvfb"):
        start.command_line()
    monkeypatch.setenv("DISPLAY", ":0")
    assert start.command_line().display == []


def test_a_port_that_is_taken_is_left_out() -> None:
    first = any_port()
    with socket.create_server(("", first)):
        assert free_port(first) > first


def test_windows_ends_a_program_with_all_that_it_started() -> None:
    assert program_keeper.windows_command(12, hard=False) == ["taskkill", "/T", "/PID", "12"]
    assert program_keeper.windows_command(12, hard=True) == ["taskkill", "/T", "/F", "/PID", "12"]
