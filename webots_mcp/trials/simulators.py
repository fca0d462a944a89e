"""A simulator process for one trial: Webots or the stand-in, as fast as it can, unseen."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from webots_mcp.errors import CommandRefusedError
from webots_mcp.webots.starting import CommandLine, KeptProgram, Start, any_port

CONSOLE: Final = "simulator.log"


def stand_in(world: str) -> CommandLine:
    """The command of the stand-in."""
    return CommandLine([sys.executable, "-m", "webots_mcp.standin", world, "--mode", "fast"], [])


def webots(world: str) -> CommandLine:
    """The command of Webots, with a port that was free a moment ago.

    Raises:
        CommandRefusedError: There is no Webots.
    """
    start = Start(Path(world), "fast", headless=True, streams=False, port=any_port())
    try:
        return start.command_line()
    except CommandRefusedError as error:
        raise CommandRefusedError(f"{error}; or try on the stand-in with --stand-in") from error


class Simulator(KeptProgram):
    """A simulator that prints to a file of its folder."""

    def __init__(self, command: CommandLine, folder: Path, environment: Mapping[str, str]) -> None:
        with (folder / CONSOLE).open("wb") as console:
            super().__init__(command, environment, console, subprocess.STDOUT)
        self._folder = folder

    def last_line(self) -> str:
        """What it printed last; empty if nothing."""
        text = (self._folder / CONSOLE).read_bytes()[-2000:].decode("utf-8", "replace")
        return next((line for line in reversed(text.splitlines()) if line.strip()), "")
