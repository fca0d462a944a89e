"""How Webots is started: its options, a free port, and a display where there is none."""

from __future__ import annotations

import os
import shutil
import socket
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from webots_mcp.errors import CommandRefusedError
from webots_mcp.webots.installations import find_webots
from webots_mcp.webots.instances import DEFAULT_PORT
from webots_mcp.webots.kept_program import CommandLine

Mode = Literal["pause", "realtime", "fast"]

_HEADLESS: Final = ("--no-rendering", "--minimize")
_LAST_PORT: Final = (1 << 16) - 1


@dataclass(frozen=True)
class Start:
    """How a Webots is to be started.

    Attributes:
        world: The world file.
        mode: The mode that it begins with; None for that of its preferences.
        headless: Without its window and its 3D view; cameras and lidars still see.
        streams: Whether it obeys orders from outside, and serves the project's files at its port.
        port: Where it is to listen; it takes one of the ten after it where that is taken.
    """

    world: Path
    mode: Mode | None
    headless: bool
    streams: bool
    port: int

    @property
    def options(self) -> list[str]:
        """As Webots takes them: no dialog, and the console where this one is."""
        return [
            "--batch",
            "--stdout",
            "--stderr",
            f"--port={self.port}",
            *([f"--mode={self.mode}"] if self.mode else []),
            *(_HEADLESS if self.headless else ()),
            *(["--stream"] if self.streams else []),
        ]

    def command_line(self) -> CommandLine:
        """Of the Webots that is found here.

        Raises:
            CommandRefusedError: There is none, or nothing to show its window on.
        """
        program = find_webots().program
        return CommandLine([str(program), *self.options, str(self.world)], _virtual_display())


def free_port(first: int = DEFAULT_PORT) -> int:
    """The first port from there on that nobody listens at.

    Raises:
        CommandRefusedError: All are taken.
    """
    for port in range(first, _LAST_PORT + 1):
        if _is_free(port):
            return port
    raise CommandRefusedError(f"no port from {first} on is free")


def any_port() -> int:
    """A port that was free a moment ago, most likely another one at each call."""
    with socket.create_server(("", 0)) as server:
        return int(server.getsockname()[1])


def _is_free(port: int) -> bool:
    """Webots listens at all addresses of the machine."""
    try:
        with socket.create_server(("", port)):
            return True
    except OSError:
        return False


def _virtual_display() -> list[str]:
    """What gives Webots a display where it has none to show its window on; Linux' is X11 alone."""
    if sys.platform != "linux" or os.environ.get("DISPLAY"):
        return []
    program = shutil.which("xvfb-run")
    if program is None:
        raise CommandRefusedError(
            "Webots needs a display, and there is none (DISPLAY is not set): install xvfb-run, "
            "which gives it a virtual one (apt install xvfb)"
        )
    return [program, "--auto-servernum"]
