"""A program, Webots or the stand-in, that ends with this process at the latest."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import IO, Final, NamedTuple

from webots_mcp.liveness import process_alive
from webots_mcp.webots import keeper

_HARD: Final = signal.SIGTERM if sys.platform == "win32" else signal.SIGKILL
# Ctrl-C in a console is for us alone: elsewhere a session of its own sees to that.
_GROUP_OF_ITS_OWN: Final = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)


class CommandLine(NamedTuple):
    """What to run, and the program that gives it a display where there is none."""

    words: list[str]
    display: list[str]


class KeptProgram:
    """A program that ends with this process, however that ends.

    Nothing runs before `start`, but its process is there: whoever notes its pid in between leaves
    no program behind that nobody knows.

    Attributes:
        pid: Of the process around it, whose group it is in where it needs no display.
    """

    def __init__(
        self,
        command: CommandLine,
        environment: Mapping[str, str],
        stdout: int | IO[bytes],
        stderr: int | IO[bytes],
    ) -> None:
        kept = [sys.executable, "-I", "-S", keeper.__file__, *command.words]
        self._process = subprocess.Popen(
            [*command.display, *kept],
            env={**os.environ, **environment},
            stdin=subprocess.PIPE,
            stdout=stdout,
            stderr=stderr,
            start_new_session=os.name == "posix",
            creationflags=_GROUP_OF_ITS_OWN,
        )
        self.pid = self._process.pid

    def start(self) -> None:
        """Let it run."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # somebody has ended it already
            self._process.stdin.write(b"!")
            self._process.stdin.flush()

    @property
    def is_over(self) -> bool:
        """Whether it has ended by itself."""
        return self.exit_code is not None

    @property
    def exit_code(self) -> int | None:
        """None while it runs; 128 and more: that signal ended it."""
        return self._process.poll()

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


def end_left_over(pid: int, process: str | None, started_wall_time_s: float) -> None:
    """End a program that outlived who started it."""
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
