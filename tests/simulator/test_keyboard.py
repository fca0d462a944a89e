"""Keys that are pressed in Webots' window: on Linux for real, elsewhere by the exact commands."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest

from webots_mcp.errors import CommandRefusedError
from webots_mcp.simulator.key_presses import KEYS, macos_command, press, windows_command
from webots_mcp.simulator.orders import Order

NEEDED = ("Xvfb", "xdotool", "xev")
MISSING = [program for program in NEEDED if shutil.which(program) is None]
IN_X11 = pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")
TITLE = "/home/ada/worlds/arena.wbt (arena) - Webots R2023b"


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An X server of its own."""
    reading, writing = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", "640x480x24", "-nolisten", "tcp"],
        pass_fds=(writing,),
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    with os.fdopen(reading) as told:
        name = f":{told.readline().strip()}"
    monkeypatch.setenv("DISPLAY", name)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    yield name
    server.terminate()
    server.wait()


class Window:
    """A window that prints the keys that it gets."""

    def __init__(self, title: str) -> None:
        self._process = subprocess.Popen(
            ["xev", "-name", title, "-event", "keyboard"], stdout=subprocess.PIPE, text=True
        )
        try:
            subprocess.run(
                ["xdotool", "search", "--sync", "--onlyvisible", "--name", re.escape(title)],
                check=True,
                stdout=subprocess.DEVNULL,
                timeout=30,
            )
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._process.terminate()
        self._process.communicate()

    def keys_until(self, last: str) -> list[str]:
        """The names of the keys that went down, up to that one."""
        assert self._process.stdout is not None
        keys: list[str] = []
        pressed = False
        for line in self._process.stdout:
            pressed = line.startswith("KeyPress") or (pressed and not line.startswith("KeyRel"))
            if pressed and "keysym" in line:
                keys.append(line.partition("keysym")[2].split()[1].rstrip("),"))
                if keys[-1] == last:
                    return keys
        raise AssertionError(keys)


@IN_X11
@pytest.mark.usefixtures("display")
@pytest.mark.parametrize("order", get_args(Order))
def test_the_keys_arrive_in_the_window_of_webots_and_in_no_other(order: Order) -> None:
    other, webots = Window("notes about Webots"), Window(TITLE)
    key = KEYS[order]
    last = key.name.upper() if key.shift else key.name
    try:
        press(order, None, "linux")
        assert webots.keys_until(last) == ["Control_L", *["Shift_L"] * key.shift, last]
    finally:
        webots.close()
        other.close()


@IN_X11
@pytest.mark.usefixtures("display")
def test_which_of_two_windows_is_meant_has_to_be_sure() -> None:
    windows = [Window(TITLE), Window(TITLE.replace("arena", "maze"))]
    try:
        with pytest.raises(CommandRefusedError, match=r"2 windows.*Ctrl\+Shift\+T in Webots"):
            press("reset", None, "linux")
    finally:
        for window in windows:
            window.close()


@IN_X11
def test_without_a_window_nothing_is_pressed_and_the_display_is_named(display: str) -> None:
    with pytest.raises(CommandRefusedError, match=f"no window of Webots was found .* {display}"):
        press("pause", None, "linux")


def test_on_a_system_whose_keys_are_unknown_nothing_is_pressed() -> None:
    with pytest.raises(CommandRefusedError, match=r"keys on 'freebsd14'.*press Ctrl\+0 in Webots"):
        press("pause", None, "freebsd14")


@pytest.mark.skipif(sys.platform == "win32", reason="a PATH without programs")
def test_where_xdotool_is_missing_the_line_that_installs_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CommandRefusedError, match=r"apt install xdotool\); or press Ctrl\+0"):
        press("pause", None, "linux")


@pytest.mark.skipif(sys.platform == "win32", reason="needs a shell script")
@pytest.mark.parametrize(
    ("platform", "program", "advice"),
    [
        ("darwin", "osascript", r"no access.*Accessibility"),
        ("win32", "powershell", r"exactly one window"),
    ],
)
def test_on_macos_and_windows_the_systems_own_program_is_run_or_says_why_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, platform: str, program: str, advice: str
) -> None:
    file, said = tmp_path / program, tmp_path / "said"
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    for exit_code in (0, 3):
        file.write_text(f'#!/bin/sh\necho "$@" > {said}\necho no access >&2\nexit {exit_code}\n')
        file.chmod(0o755)
        if exit_code:
            with pytest.raises(CommandRefusedError, match=advice):
                press("reset", 42, platform)
        else:
            press("reset", 42, platform)
        assert "42" in said.read_text()


def test_the_exact_commands_of_macos() -> None:
    assert macos_command(KEYS["reset"], None) == [
        "osascript",
        "-e", 'tell application "Webots" to activate',
        "-e", "delay 0.3",
        "-e", 'tell application "System Events" to keystroke "t" using {command down, shift down}',
    ]  # fmt: skip
    assert macos_command(KEYS["pause"], 42)[1:3] == [
        "-e",
        'tell application "System Events" to set frontmost of (first process whose unix id is 42) '
        "to true",
    ]
    assert 'keystroke "0" using {command down}' in macos_command(KEYS["pause"], 42)[-1]


def test_the_exact_commands_of_windows() -> None:
    *powershell, script = windows_command(KEYS["reload"], 42)
    assert powershell == ["powershell", "-NoProfile", "-NonInteractive", "-Command"]
    assert "$_.MainWindowTitle -like '*Webots R20*' -and $_.Id -eq 42" in script
    assert "if ($found.Count -ne 1) { exit 3 }" in script
    assert script.endswith("$shell.SendKeys('^+r')")
    assert windows_command(KEYS["fast"], None)[-1].endswith("$shell.SendKeys('^3')")
