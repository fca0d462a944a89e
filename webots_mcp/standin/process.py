"""One controller process: starting it, passing on what it prints, ending it."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Final

_TERMINATION_S: Final = 1.0
"""How long a process may take to end after it was asked to."""


class ControllerProcess:
    """A running controller; what it prints is passed on line by line."""

    def __init__(
        self,
        command: list[str],
        folder: Path,
        environment: Mapping[str, str],
        on_line: Callable[[str], None],
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
            start_new_session=os.name == "posix",  # Ctrl-C is for the simulator alone
        )
        self.pid = self._process.pid
        self._on_line = on_line
        self._on_exit = on_exit
        self._readers = [self._reader(self._process.stdout), self._reader(self._process.stderr)]
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    @property
    def exit_code(self) -> int | None:
        """The exit status; negative: the signal that ended it; None while it runs."""
        return self._process.returncode

    def kill(self) -> None:
        """End the process at once, as a crash would."""
        self._process.kill()

    def end(self) -> None:
        """Terminate the process, the hard way if need be, and wait until it is gone."""
        if self.exit_code is None:
            self._process.terminate()
        try:
            self._process.wait(_TERMINATION_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._watcher.join()

    def _reader(self, stream: IO[str] | None) -> threading.Thread:
        assert stream is not None
        thread = threading.Thread(target=self._read, args=(stream,), daemon=True)
        thread.start()
        return thread

    def _read(self, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                self._on_line(line.rstrip("\r\n"))

    def _watch(self) -> None:
        self._process.wait()
        for reader in self._readers:  # a grandchild may hold the pipes open: do not wait for it
            reader.join(0.5)
        self._on_exit(self)
