"""The last resort: pressing Webots' own keys, where no controller can be asked.

Keys from Webots' source (WbActionManager.cpp, R2023b to R2025a): Reset Simulation is Ctrl+Shift+T,
with Command in place of Ctrl on macOS.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Final

from webots_mcp.errors import CommandRefusedError

_TIMEOUT_S: Final = 10.0
_RESET_SCRIPT: Final = (
    'tell application "Webots" to activate',
    "delay 0.3",
    'tell application "System Events" to keystroke "t" using {command down, shift down}',
)


def press_reset(platform: str = sys.platform) -> None:
    """Press Reset Simulation in Webots' window.

    Raises:
        CommandRefusedError: This is not macOS, or the keys could not be sent.
    """
    if platform != "darwin":
        raise CommandRefusedError(
            f"force=true presses keys in Webots' window, which works on macOS only (this is "
            f"{platform}): leave force out to ask the controller, or press Ctrl+Shift+T in Webots"
        )
    command = ["osascript", *(part for line in _RESET_SCRIPT for part in ("-e", line))]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CommandRefusedError(f"osascript could not be run: {error}") from error
    except subprocess.CalledProcessError as error:
        raise CommandRefusedError(
            f"macOS refused the keys ({str(error.stderr).strip()[:300]}): allow the program that "
            "runs this server under System Settings, Privacy & Security, Accessibility"
        ) from error
