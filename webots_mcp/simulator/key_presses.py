"""Give orders to a running Webots by key presses, as the last resort.

The keys are those of Webots' menu actions in R2023b to R2025a, with Command instead of Ctrl on
macOS. They are sent to the window of one Webots, or not at all.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Final, NamedTuple

from webots_mcp.errors import CommandRefusedError
from webots_mcp.simulator.orders import Order

_TITLE: Final = "Webots R20"  # "<world> (<project>) - Webots R2023b"


class Key(NamedTuple):
    """A key that is pressed together with Ctrl, or with Command on macOS."""

    name: str
    shift: bool = False

    @property
    def spoken(self) -> str:
        """The keys in words, such as `Ctrl+Shift+T`."""
        return f"Ctrl+{'Shift+' * self.shift}{self.name.upper()}"


KEYS: Final[dict[Order, Key]] = {
    "pause": Key("0"),
    "step": Key("1"),
    "resume": Key("2"),
    "fast": Key("3"),
    "reset": Key("t", shift=True),
    "reload": Key("r", shift=True),
}


def press(order: Order, pid: int | None, platform: str = sys.platform) -> None:
    """Press the keys of an order in Webots' window.

    Args:
        order: What Webots is to do.
        pid: The process of the wanted Webots; None where there can be only one.
        platform: As `sys.platform` names it.

    Raises:
        CommandRefusedError: If the window was not found, the keys could not be sent, or it is not
                known how to press keys on this platform.
    """
    key = KEYS[order]
    try:
        if platform == "linux":
            _press_in_x11(key, pid)
        elif platform == "darwin":
            _run(
                macos_command(key, pid),
                "allow the program that runs this under System Settings, Privacy & Security, "
                "Accessibility",
            )
        elif platform == "win32":
            _run(
                windows_command(key, pid),
                "it needs exactly one window of Webots, and Windows' leave to bring it to the "
                "front",
            )
        else:
            raise CommandRefusedError(f"no way to press keys on {platform!r} is known")
    except CommandRefusedError as error:
        raise CommandRefusedError(f"{error}; or press {key.spoken} in Webots yourself") from error


def macos_command(key: Key, pid: int | None) -> list[str]:
    """Return the command that presses a key on macOS, in the window of that process."""
    of_pid = (
        'tell application "System Events" to set frontmost of '
        f"(first process whose unix id is {pid}) to true"
    )
    held = "{command down, shift down}" if key.shift else "{command down}"
    script = (
        'tell application "Webots" to activate' if pid is None else of_pid,
        "delay 0.3",
        f'tell application "System Events" to keystroke "{key.name}" using {held}',
    )
    return ["osascript", *(part for line in script for part in ("-e", line))]


def windows_command(key: Key, pid: int | None) -> list[str]:
    """Return the command that presses a key on Windows; it exits with 3 without one window."""
    wanted = f"$_.MainWindowTitle -like '*{_TITLE}*'" + (f" -and $_.Id -eq {pid}" if pid else "")
    script = (
        f"$found = @(Get-Process | Where-Object {{ {wanted} }}); "
        "if ($found.Count -ne 1) { exit 3 }; "
        "$shell = New-Object -ComObject WScript.Shell; "
        "if (-not $shell.AppActivate($found[0].Id)) { exit 4 }; "
        "Start-Sleep -Milliseconds 300; "
        f"$shell.SendKeys('^{'+' * key.shift}{key.name}')"
    )
    return ["powershell", "-NoProfile", "-NonInteractive", "-Command", script]


def _press_in_x11(key: Key, pid: int | None) -> None:
    window = _x11_window(pid)
    keys = f"ctrl+{'shift+' * key.shift}{key.name}"
    to_front = _attempt(["xdotool", "windowactivate", "--sync", window])
    if to_front.returncode:  # there is no window manager
        _run(["xdotool", "windowfocus", "--sync", window], "its window cannot have the focus")
    _run(["xdotool", "key", "--clearmodifiers", keys], "the X server did not take the keys")


def _x11_window(pid: int | None) -> str:
    """Return the only window of Webots, of that process where windows have a process id.

    Raises:
        CommandRefusedError: There is none, or it is not clear which of several.
    """
    found = _attempt(["xdotool", "search", "--onlyvisible", "--name", f" - {_TITLE}"])
    windows = found.stdout.split()
    found = [each for each in windows if pid is None or _owner(each) in (pid, None)]
    if len(found) == 1:
        return found[0]
    if found:
        raise CommandRefusedError(f"{len(found)} windows could be that of the wanted Webots")
    where = f"on the display {os.environ.get('DISPLAY') or '(DISPLAY is not set)'}"
    if os.environ.get("WAYLAND_DISPLAY"):
        where += "; this is a Wayland session, which hides windows from xdotool"
    raise CommandRefusedError(f"no window of Webots was found {where}")


def _owner(window: str) -> int | None:
    printed = _attempt(["xdotool", "getwindowpid", window]).stdout.strip()
    return int(printed) if printed.isdecimal() else None


def _run(command: Sequence[str], advice: str) -> None:
    ended = _attempt(command)
    if ended.returncode:
        reason = ended.stderr.strip()[:300] or f"exit code {ended.returncode}"
        raise CommandRefusedError(f"{command[0]} did not press the keys ({reason}): {advice}")


def _attempt(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            command,
            check=False,
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            timeout=10.0,
        )
    except FileNotFoundError as error:
        install = " (apt install xdotool)" if command[0] == "xdotool" else ""
        raise CommandRefusedError(f"the program {command[0]} is not there{install}") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CommandRefusedError(f"{command[0]} could not be run: {error}") from error
