"""A simulator process for one trial: Webots or the stand-in, as fast as it can, unseen."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from webots_mcp.errors import CommandRefusedError
from webots_mcp.liveness import process_alive
from webots_mcp.trials import keeper
from webots_mcp.webots.installations import find_webots

CONSOLE: Final = "simulator.log"
_HARD: Final = signal.SIGTERM if sys.platform == "win32" else signal.SIGKILL


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
            _signal(self.pid, _HARD)
            self._process.wait()
        if os.name == "posix":  # a keeper that was killed leaves the rest of its process group
            _end(self.pid, lambda: _signal(self.pid, 0))

    def last_line(self) -> str:
        """What it printed last; empty if nothing."""
        text = (self._folder / CONSOLE).read_bytes()[-2000:].decode("utf-8", "replace")
        return next((line for line in reversed(text.splitlines()) if line.strip()), "")


def end_left_over(pid: int, process: str | None, started_wall_time_s: float) -> None:
    """End a simulator that outlived who started it."""
    seen = (pid, process, started_wall_time_s)
    if not process_alive(*seen):
        return
    _end(pid, lambda: process_alive(*seen))


def _end(pid: int, is_there: Callable[[], bool]) -> None:
    """End a process with its group, the hard way if need be."""
    if not _signal(pid, signal.SIGTERM):
        return
    until_s = time.monotonic() + keeper.GRACE_S
    while is_there():
        if time.monotonic() > until_s:
            _signal(pid, _HARD)
        time.sleep(0.02)


def _signal(pid: int, number: int) -> bool:
    """To all of its session, as Webots is a script that starts the program; False if none is."""
    try:
        if sys.platform == "win32":
            os.kill(pid, signal.SIGTERM)
        else:
            os.killpg(pid, number)
    except ProcessLookupError:
        return False
    return True
