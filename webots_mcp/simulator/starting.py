"""Start Webots or another simulator, which ends at the latest with this process.

`Start` says how Webots is started, `KeptProgram` runs any program through `program_keeper`, and
`LaunchedWebots` is a Webots of ours with its console.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final, Literal, NamedTuple

from webots_mcp.database.processes import process_alive
from webots_mcp.errors import CommandRefusedError
from webots_mcp.simulator import program_keeper
from webots_mcp.simulator.installations import find_webots
from webots_mcp.simulator.instances import DEFAULT_PORT, Instance, instances
from webots_mcp.simulator.orders import WebotsAddress, WebotsLine

if TYPE_CHECKING:
    import psutil

Mode = Literal["pause", "realtime", "fast"]
Show = Callable[[WebotsLine], None]
_HARD: Final = signal.SIGTERM if sys.platform == "win32" else signal.SIGKILL
# Ctrl-C in a Windows console must reach this process only; elsewhere a new session ensures that.
_GROUP_OF_ITS_OWN: Final = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)


class CommandLine(NamedTuple):
    """What to run, and the program that gives it a display where there is none."""

    words: list[str]
    display: list[str]


@dataclass(frozen=True)
class Start:
    """How a Webots is to be started.

    Attributes:
        world: The world file.
        mode: The initial mode; None for that of its preferences.
        headless: Whether to start without its window and its 3D view; cameras and lidars still see.
        streams: Whether it obeys orders from outside, and serves the project's files at its port.
        port: The port at which it listens; if it is taken, one of the ten following ones.
    """

    world: Path
    mode: Mode | None
    headless: bool
    streams: bool
    port: int

    @property
    def options(self) -> list[str]:
        """The options of Webots' command line: no dialogs, and its console on stdout and stderr."""
        return [
            "--batch",
            "--stdout",
            "--stderr",
            f"--port={self.port}",
            *([f"--mode={self.mode}"] if self.mode else []),
            *(("--no-rendering", "--minimize") if self.headless else ()),
            *(["--stream"] if self.streams else []),
        ]

    def command_line(self) -> CommandLine:
        """Return the command that starts the Webots of this machine.

        Raises:
            CommandRefusedError: If there is none, or no display for its window.
        """
        program = find_webots().program
        return CommandLine([str(program), *self.options, str(self.world)], _virtual_display())


def free_port(first: int = DEFAULT_PORT) -> int:
    """Return the first free port from there on.

    Raises:
        CommandRefusedError: All are taken.
    """
    for port in range(first, 1 << 16):
        if _is_free(port):
            return port
    raise CommandRefusedError(f"No port from {first} on is free. End another Webots first.")


def any_port() -> int:
    """Return a port that was free a moment ago, most likely another one at each call."""
    with socket.create_server(("", 0)) as server:
        return int(server.getsockname()[1])


def _is_free(port: int) -> bool:
    """Return whether a port is free at all addresses of the machine, where Webots listens."""
    try:
        with socket.create_server(("", port)):
            return True
    except OSError:
        return False


def _virtual_display() -> list[str]:
    """Return the command that gives Webots a display if it has none; on Linux that is X11."""
    if sys.platform != "linux" or os.environ.get("DISPLAY"):
        return []
    program = shutil.which("xvfb-run")
    if program is None:
        raise CommandRefusedError(
            "Webots needs a display, and there is none (DISPLAY is not set): install xvfb-run, "
            "which gives it a virtual one (apt install xvfb)"
        )
    return [program, "--auto-servernum"]


class KeptProgram:
    """A program that ends with this process, however that ends.

    Nothing runs before `start`, but the process exists already: a caller can store its pid first,
    and leaves no unknown program behind.

    Attributes:
        pid: The process around the program. The program is in its group if it needs no display.
    """

    def __init__(
        self,
        command: CommandLine,
        environment: Mapping[str, str],
        stdout: int | IO[bytes],
        stderr: int | IO[bytes],
    ) -> None:
        kept = [sys.executable, "-I", "-S", program_keeper.__file__, *command.words]
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
        with contextlib.suppress(BrokenPipeError):  # it was ended already
            self._process.stdin.write(b"!")
            self._process.stdin.flush()

    @property
    def is_over(self) -> bool:
        """Whether it has ended by itself."""
        return self.exit_code is not None

    @property
    def exit_code(self) -> int | None:
        """Its exit code; None while it runs, and 128 plus the signal if one ended it."""
        return self._process.poll()

    def end(self) -> None:
        """End it with its controllers, by force if necessary."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(2 * program_keeper.GRACE_S)
        except subprocess.TimeoutExpired:
            _signal(self.pid, _HARD)
            self._process.wait()
        if os.name == "posix":  # a keeper that was killed leaves the rest of its process group
            _end(self.pid, lambda: _signal(self.pid, 0))


class LaunchedWebots(KeptProgram):
    """A Webots that ends with this process at the latest; `start` lets it run.

    Args:
        start: How it is started.
        environment: Variables in addition to those of this process.
        show: Called with each line of its console, in a thread of its own.

    Raises:
        CommandRefusedError: There is no Webots, or no display.
    """

    def __init__(self, start: Start, environment: Mapping[str, str], show: Show) -> None:
        unseen = (
            {"WEBOTS_DISABLE_SAVE_SCREEN_PERSPECTIVE_ON_CLOSE": "1"} if start.headless else {}
        )  # the window's layout stays as it is
        command = start.command_line()
        super().__init__(command, {**unseen, **environment}, subprocess.PIPE, subprocess.PIPE)
        self._show = show
        self._lines = deque[WebotsLine](maxlen=200)
        self._instance: Instance | None = None
        self._search_again_s = 0.0
        self._readers = [
            threading.Thread(target=self._read, args=(name, pipe), daemon=True)
            for name, pipe in (("stdout", self._process.stdout), ("stderr", self._process.stderr))
        ]
        for reader in self._readers:
            reader.start()

    @property
    def lines(self) -> list[WebotsLine]:
        """The newest lines of its console."""
        return list(self._lines)

    @property
    def instance(self) -> Instance | None:
        """The instance as the system shows it; None before it listens, or where it is not shown."""
        if self._instance is None and time.monotonic() > self._search_again_s:
            self._search_again_s = time.monotonic() + 0.5
            pids = self.pids
            found = (each for each in instances() if each.is_listening and each.pid in pids)
            self._instance = next(found, None)
        return self._instance

    @property
    def address(self) -> WebotsAddress | None:
        """Its address; None before it listens, or where the system does not show it."""
        return self.instance.address if self.instance else None

    def address_now(self) -> WebotsAddress | None:
        """Return the same, searched for at once."""
        self._search_again_s = 0.0
        return self.address

    @property
    def pids(self) -> set[int]:
        """All processes of it: programs and controllers."""
        import psutil

        with contextlib.suppress(psutil.Error):
            family: list[psutil.Process] = psutil.Process(self.pid).children(recursive=True)
            return {self.pid, *(each.pid for each in family)}
        return set()

    def end(self) -> None:
        """End it with its controllers; its last lines are shown."""
        super().end()
        self.wait_for_output()

    def wait_for_output(self) -> None:
        """Wait until all lines of a Webots that is over were shown."""
        for reader in self._readers:
            reader.join(1.0)  # a child that outlives it may hold its output open

    def _read(self, name: str, pipe: IO[bytes]) -> None:
        with pipe:
            for data in pipe:
                line = WebotsLine(name, data.decode("utf-8", "replace").rstrip("\r\n"))
                self._lines.append(line)
                with contextlib.suppress(OSError, ValueError):  # the reader has closed it
                    self._show(line)


# -- ending programs that an earlier process left ----------------------------------------------


def end_left_over(pid: int, process: str | None, started_wall_time_s: float) -> None:
    """End a program that outlived the process which started it."""
    seen = (pid, process, started_wall_time_s)
    if not process_alive(*seen):
        return
    _end(pid, lambda: process_alive(*seen))


def _end(pid: int, is_there: Callable[[], bool]) -> None:
    """End a process with its group, by force if necessary."""
    if not _signal(pid, signal.SIGTERM):
        return
    until_s = time.monotonic() + program_keeper.GRACE_S
    while is_there():
        if time.monotonic() > until_s:
            _signal(pid, _HARD)
        time.sleep(0.02)


def _signal(pid: int, number: int) -> bool:
    """Signal a process and its group, since Webots is a script; False if there is no such one."""
    try:
        if sys.platform == "win32":
            os.kill(pid, signal.SIGTERM)
        else:
            os.killpg(pid, number)
    except ProcessLookupError:
        return False
    return True
