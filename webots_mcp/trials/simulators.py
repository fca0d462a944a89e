"""A simulator process for one trial: Webots or the stand-in, as fast as it can, unseen."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from webots_mcp.errors import CommandRefusedError
from webots_mcp.liveness import process_alive
from webots_mcp.trials import keeper
from webots_mcp.webots.installations import find_webots

CONSOLE: Final = "simulator.log"


def stand_in(world: str) -> list[str]:
    """The command of the stand-in."""
    return [sys.executable, "-m", "webots_mcp.standin", world, "--mode", "fast"]


def webots(world: str) -> list[str]:
    """The command of Webots, with a port that was free a moment ago.

    Raises:
        CommandRefusedError: There is no Webots.
    """
    program = _program()
    options = ("--batch", "--mode=fast", "--minimize", "--no-rendering", "--stdout", "--stderr")
    return [program, *options, f"--port={_free_port()}", world]


def _program() -> str:
    try:
        return str(find_webots().program)
    except CommandRefusedError as error:
        raise CommandRefusedError(f"{error}; or try on the stand-in with --stand-in") from error


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


class Simulator:
    """A simulator, which ends with this process at the latest; it prints to a file of its folder.

    Nothing runs before `start`, but its process is there: whoever notes its pid in between leaves
    no simulator behind that nobody knows.
    """

    def __init__(self, command: list[str], folder: Path, environment: Mapping[str, str]) -> None:
        with (folder / CONSOLE).open("wb") as console:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", keeper.__file__, *command],
                env={**os.environ, **environment},
                stdin=subprocess.PIPE,
                stdout=console,
                stderr=subprocess.STDOUT,
                start_new_session=os.name == "posix",  # Ctrl-C is for us alone
            )
        self.pid = self._process.pid
        self._folder = folder

    def start(self) -> None:
        """Let it run."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # somebody has ended it already
            self._process.stdin.write(b"!")
            self._process.stdin.flush()

    @property
    def is_over(self) -> bool:
        """Whether it has ended by itself."""
        return self._process.poll() is not None

    def end(self) -> None:
        """End it with its controllers, the hard way if need be."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(2 * keeper.GRACE_S)
        except subprocess.TimeoutExpired:
            _signal(self.pid, hard=True)
            self._process.wait()

    def last_line(self) -> str:
        """What it printed last; empty if nothing."""
        text = (self._folder / CONSOLE).read_bytes()[-2000:].decode("utf-8", "replace")
        return next((line for line in reversed(text.splitlines()) if line.strip()), "")


def end_left_over(pid: int, process: str | None, started_wall_time_s: float) -> None:
    """End a simulator that outlived who started it."""
    seen = (pid, process, started_wall_time_s)
    if not process_alive(*seen):
        return
    _signal(pid, hard=False)
    until_s = time.monotonic() + keeper.GRACE_S
    while process_alive(*seen):
        if time.monotonic() > until_s:
            _signal(pid, hard=True)
        time.sleep(0.02)


def _signal(pid: int, *, hard: bool) -> None:
    """To all of its session: Webots is a script that starts the program."""
    with contextlib.suppress(ProcessLookupError):
        if sys.platform == "win32":
            os.kill(pid, signal.SIGTERM)
        else:
            os.killpg(pid, signal.SIGKILL if hard else signal.SIGTERM)
