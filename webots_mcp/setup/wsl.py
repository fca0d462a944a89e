"""The border between Windows and WSL, which no recording can be shared across.

The server has to run on the side on which controllers record. From WSL programs of Windows can be
started, and speak over pipes: so a client in WSL starts Windows' server. All that is asked of
either system is asked here, by `wslpath`, `powershell.exe` and /proc/version.
"""

from __future__ import annotations

import base64
import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import PROJECT_DATA_FOLDER
from webots_mcp.errors import CommandRefusedError
from webots_mcp.simulator.installations import installations

WAY_OUT: Final = (
    "keep the recording on a local disk of the side where Webots runs (--data-dir), and let the "
    "server run there too. For a project on a drive of Windows 'webots-mcp init' in WSL registers "
    "the server of Windows; or start 'webots-mcp serve --http 8000' on that side, and name it on "
    "the other by 'webots-mcp init --http URL'"
)
_PROC_VERSION: Final = Path("/proc/version")
_DRIVE: Final = re.compile(r"[A-Za-z]:\\")


class Windows(NamedTuple):
    """What there is on Windows.

    Attributes:
        webots: The folder of Webots, as Windows writes it; None where none was found.
        server: The command of webots-mcp, as WSL starts it; empty where it is not installed.
        version: Of that webots-mcp.
    """

    webots: str | None
    server: list[str]
    version: str


def is_wsl(proc_version: Path = _PROC_VERSION) -> bool:
    """Return whether this is Linux within Windows, by its name or by its kernel."""
    if os.environ.get("WSL_DISTRO_NAME"):
        return True
    try:
        return "microsoft" in proc_version.read_text("utf-8", "replace").lower()
    except OSError:
        return False


def ask_windows() -> Windows:
    """Return what there is on Windows, as PowerShell says.

    Raises:
        CommandRefusedError: It cannot be asked from here.
    """
    script = Path(__file__).with_name("ask_windows.ps1").read_text("utf-8")
    encoded = base64.b64encode(script.encode("utf-16-le")).decode()
    said = _answer("powershell.exe", "-NoProfile", "-NonInteractive", "-EncodedCommand", encoded)
    try:
        found: dict[str, Any] = json.loads(said)
        command: list[str] = found["server"] or []
        server = [in_wsl(command[0]), *command[1:]] if command else []
        return Windows(found["webots"], server, found["version"])
    except (ValueError, TypeError, KeyError) as error:
        raise CommandRefusedError(f"powershell.exe answered {said[:200]!r}") from error


def on_windows(folder: Path) -> str | None:
    """Return a folder as Windows writes it, with its drive; None for one of WSL itself.

    Raises:
        CommandRefusedError: It cannot be asked.
    """
    path = _answer("wslpath", "-w", str(folder))
    return path if _DRIVE.match(path) else None


def in_wsl(path: str) -> str:
    """Return a path of Windows as WSL writes it; any other as it is.

    Raises:
        CommandRefusedError: It cannot be asked.
    """
    return _answer("wslpath", "-u", path) if _DRIVE.match(path) else path


def windows_server(project: Path) -> tuple[list[str] | None, str | None]:
    """Return the command of Windows' server for a project on a drive of Windows, and a note.

    Neither where this is not WSL, or the project and Webots are on its own side.

    Raises:
        CommandRefusedError: It would have to be Windows' server, and that is not to be had.
    """
    if not is_wsl():
        return None, None
    there = on_windows(project)
    if there is None:
        if installations():
            return None, None
        note = "no Webots was found in WSL; one on Windows cannot record into this project"
        return None, f"{note}: {WAY_OUT}"
    windows = ask_windows()
    if not windows.server:
        raise CommandRefusedError(
            f"{project} is on a drive of Windows, where a recording is not to be shared with WSL, "
            "and no webots-mcp was found on Windows: install it there, for the Python of the "
            "controllers, and run this again; or name a server that runs there by --http URL"
        )
    data_dir = rf"{there.rstrip(chr(92))}\{PROJECT_DATA_FOLDER}"
    webots = f"Webots is at {windows.webots}" if windows.webots else "no Webots was found there"
    note = f"clients in WSL start the server of Windows ({windows.version}), where {webots}"
    return [*windows.server, "serve", "--data-dir", data_dir], note


def _answer(*command: str) -> str:
    try:
        ended = subprocess.run(
            # PowerShell takes seconds to start the first time.
            command,
            capture_output=True,
            timeout=30,
            check=True,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise CommandRefusedError(
            f"this is WSL, and {command[0]} cannot be asked what there is on Windows ({error}); "
            "it is there where WSL lets programs of Windows be started (interop in /etc/wsl.conf)"
        ) from error
    return ended.stdout.decode("utf-8-sig", "replace").strip()
