"""The controllers of a world's robots: their programs, processes and connections."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final, Protocol

from controller.simulator_link import Inbox, Message, pack

from webots_mcp.standin.base_simulation import ControllerEndpoint
from webots_mcp.standin.controller_path import LIBRARY
from webots_mcp.standin.simulator import SimulatedRobot, Simulator
from webots_mcp.standin.standin_errors import StandInError

_EXTERN: Final = "<extern>"
_INTERN_VARIABLES: Final = ("WEBOTS_ROBOT_NAME", "WEBOTS_INSTANCE_PATH")
_EXTERN_VARIABLES: Final = ("WEBOTS_CONTROLLER_URL", "WEBOTS_STANDIN_TOKEN")


@dataclass(frozen=True)
class EndingTimes:
    """Wall time for the end of a controller, in seconds.

    Attributes:
        termination_s: How long a process may take to end after SIGTERM.
        last_lines_s: How long to wait for its last lines: a child of it may hold the pipes open.
    """

    termination_s: float = 1.0
    last_lines_s: float = 0.5


_ENDING: Final = EndingTimes()


class ControllerProcess:
    """A running controller. Its output is passed on line by line with the name of the stream."""

    def __init__(
        self,
        command: list[str],
        folder: Path,
        environment: Mapping[str, str],
        on_line: Callable[[str, str], None],
        on_exit: Callable[[ControllerProcess], None],
    ) -> None:
        self._process = subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
            start_new_session=os.name == "posix",  # Ctrl-C must reach the simulator only.
        )
        self.pid = self._process.pid
        self.was_ended = False
        """Whether it was ended by force."""
        self._on_line = on_line
        self._on_exit = on_exit
        self._readers = [
            threading.Thread(target=self._read, args=(name, stream), daemon=True)
            for name, stream in (("stdout", self._process.stdout), ("stderr", self._process.stderr))
        ]
        for reader in self._readers:
            reader.start()
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    @property
    def exit_code(self) -> int | None:
        """Return the exit status; for a signal its negative number; None while it runs."""
        return self._process.returncode

    def kill(self) -> None:
        """End the process at once, as a crash would."""
        self._process.kill()

    def end(self) -> None:
        """Terminate the process, kill it if it does not end, and wait for that."""
        if self.exit_code is None:
            self.was_ended = True
            self._process.terminate()
        try:
            self._process.wait(_ENDING.termination_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._watcher.join()

    def _read(self, name: str, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                self._on_line(line.rstrip("\r\n"), name)

    def _watch(self) -> None:
        self._process.wait()
        until_s = time.monotonic() + _ENDING.last_lines_s
        for reader in self._readers:
            reader.join(max(until_s - time.monotonic(), 0.0))
        self._on_exit(self)


class ControllerConnection:
    """The socket of one controller."""

    def __init__(self, stream: socket.socket) -> None:
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.stream = stream
        self._inbox = Inbox()

    def send(self, message: Message) -> None:
        """Send an answer. The end of a controller is noticed when its socket is read."""
        with suppress(OSError):
            self.stream.sendall(pack(message))

    def receive(self) -> list[Message] | None:
        """Return the messages that have arrived; None if the controller has disconnected."""
        try:
            data = self.stream.recv(1 << 16)
        except OSError:
            data = b""
        if not data:
            return None
        self._inbox.feed(data)
        return [*iter(self._inbox.take, None)]


class PrintLine(Protocol):
    """A function that receives the lines of the console."""

    def __call__(self, line: str, stream: str | None = None, /) -> None:
        """Take a line.

        Args:
            line: The text.
            stream: `stdout` or `stderr` for lines of controllers; None for lines of the simulator.
        """


@dataclass
class ControllerLaunch:
    """Settings and results of starting controllers, shared by all robots of a simulation."""

    python: str
    environment: Mapping[str, str]
    overrides: Mapping[str, Path]
    """Controller files by robot name, instead of those that the world names."""
    print_line: PrintLine
    on_exit: Callable[[], None]
    token: str
    """Secret that controllers present to connect."""
    port: int = 0
    """Port of the simulator on this machine; 0 before it has started."""
    folder: Path = Path()
    """Folder of the simulator, named after the port as Webots does."""
    failure: int | None = None
    """Exit status of the first controller that ended with an error, but not by force."""


class Controller(ControllerEndpoint):
    """The controller of a robot, across all processes that run it one after the other."""

    def __init__(self, robot: SimulatedRobot, launch: ControllerLaunch) -> None:
        self.robot = robot
        self.launch = launch
        self.file: Path | None = None
        """File of its program; None if it has none or a person starts it."""
        self.process: ControllerProcess | None = None
        self.starts = 0
        """Number of processes that were started for the robot."""
        self.connection: ControllerConnection | None = None
        self.has_left = False
        """Whether the current process has closed its connection."""

    @property
    def name(self) -> str:
        """Return the robot's name."""
        return self.robot.name

    @property
    def pid(self) -> int | None:
        """Return the process id; None if no process was started."""
        return self.process.pid if self.process else None

    @property
    def exit_code(self) -> int | None:
        """Return the exit status of the last process; for a signal negative; None while it runs."""
        return self.process.exit_code if self.process else None

    @property
    def is_running(self) -> bool:
        """Return whether its process has not exited."""
        return self.process is not None and self.process.exit_code is None

    @property
    def may_act(self) -> bool:
        """Return whether it runs or is connected, or a person may still start it."""
        return self.is_running or self.connection is not None or self._is_extern

    @property
    def was_started(self) -> bool:
        """Return whether nothing remains to be started."""
        return self.process is not None or self.file is None

    @property
    def holds_up(self) -> bool:
        """Return whether the world has to wait for this controller before the next physics step."""
        if not self.robot.is_synchronous or self.robot.remaining_ms is not None:
            return False
        if self.connection is not None:
            return True
        if self.file is None:
            return self._is_extern
        return self.is_running and not self.has_left

    @property
    def awaits_quit(self) -> bool:
        """Return whether it is connected and was not ordered to quit yet."""
        return self.connection is not None and not self.was_told

    @property
    def is_leaving(self) -> bool:
        """Return whether it was ordered to quit, or has disconnected, and still runs."""
        is_going = self.was_told or self.has_left
        return is_going and (self.is_running or self.connection is not None)

    @property
    def _is_extern(self) -> bool:
        """Return whether a person starts its program."""
        is_extern = self.robot.node.fields["controller"] == _EXTERN
        return is_extern and self.name not in self.launch.overrides

    def enter(self, robot: SimulatedRobot, simulator: Simulator) -> None:
        """Control a robot of a world that was loaded.

        The controller that a world names has to be a plain folder name. As in Webots, links in the
        project are followed. A file that the caller names may be anywhere.
        """
        self.robot, self.process, self.file = robot, None, None
        self.was_told = False
        name: str = robot.node.fields["controller"]
        if robot.name in self.launch.overrides:
            self.file = self.launch.overrides[robot.name].resolve()
        elif name in ("", "<none>", "void", "<generic>", _EXTERN):
            return
        elif name == ".." or Path(name).name != name:
            self._warn(
                f"the controller {name!r} is no name of a folder in "
                "controllers/ but a path: it is not started."
            )
        else:
            self.file = simulator.world.path.parent.parent / "controllers" / name / f"{name}.py"

    def start(self) -> None:
        """Start a process if the robot has a controller file."""
        self.has_left = self.was_told = False
        self.process = None
        if self.file is None:
            if self._is_extern and self.connection is None:
                self._warn_of_extern()
            return
        if not self.file.is_file():
            self._warn(f"the controller {self.file} is missing.")
            self.file = None
            return
        arguments: list[str] = self.robot.node.fields["controllerArgs"]
        command = [self.launch.python, "-u", self.file.name, *arguments]
        self.launch.print_line(f"INFO: {self.name}: Starting controller: {' '.join(command)}")
        self.robot.folder = self.file.parent
        self.starts += 1
        self.process = ControllerProcess(
            command,
            self.file.parent,
            self.environment(),
            lambda line, stream: self.launch.print_line(f"[{self.name}] {line}", stream),
            self._exited,
        )

    def environment(self) -> dict[str, str]:
        """Return the environment of a controller, as Webots sets it, or a person for an extern one.

        Raises:
            StandInError: The simulation has not started.
        """
        launch = self.launch
        if not launch.port:
            raise StandInError("start the simulation before you ask how to reach it")
        merged = {**os.environ, **launch.environment}
        path = [str(LIBRARY), merged.get("PYTHONPATH", "")]
        merged["PYTHONPATH"] = os.pathsep.join(part for part in path if part)
        for name in (*_INTERN_VARIABLES, *_EXTERN_VARIABLES):
            merged.pop(name, None)
        if self._is_extern:
            url = f"tcp://127.0.0.1:{launch.port}/{self.name}"
            return merged | dict(zip(_EXTERN_VARIABLES, (url, launch.token), strict=True))
        folder = f"{launch.folder}{os.sep}"  # With a separator at the end, as Webots writes it.
        own = dict(zip(_INTERN_VARIABLES, (self.name, folder), strict=True))
        return merged | own | {"PYTHONIOENCODING": "UTF-8"}

    def _warn(self, what: str) -> None:
        self.launch.print_line(f"WARNING: {self.name}: {what}")

    def _warn_of_extern(self) -> None:
        """Warn that a person has to start its controller, for which the world may wait for ever."""
        waits = "the world waits for it" if self.robot.is_synchronous else "it has none until then"
        self._warn(
            "the controller is <extern>, so somebody else has to start it; "
            f"{waits}. Let the stand-in do so with --robot '{self.name}=FILE.py' (in Python "
            f"Simulation(..., controllers={{{self.name!r}: FILE}})), or start a program of yours "
            f"with Simulation.environment_of({self.name!r})."
        )

    def reply(self, message: Message) -> None:
        """Send an answer, if it is connected."""
        if self.connection:
            self.connection.send(message)

    def tell_to_quit(self) -> None:
        """Tell it to quit, if it is connected."""
        if self.connection:
            super().tell_to_quit()

    def kill(self) -> None:
        """End the process at once, as a crash would."""
        if self.process:
            self.process.kill()

    def end(self) -> None:
        """End the process by force, if it still runs."""
        if self.process is None:
            return
        if self.is_running and self.was_told:
            self._warn(
                "Forced termination (because process didn't terminate itself after 1 second)."
            )
        self.process.end()

    def _exited(self, process: ControllerProcess) -> None:
        code = process.exit_code or 0
        if code > 0 or (code < 0 and not process.was_ended):
            self.launch.failure = self.launch.failure or (code if code > 0 else 128 - code)
        if code == 0:
            self.launch.print_line(f"INFO: '{self.name}' controller exited successfully.")
        else:
            self.launch.print_line(f"WARNING: '{self.name}' controller exited with status: {code}.")
        self.launch.on_exit()
