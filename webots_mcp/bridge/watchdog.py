"""Records where the loop is if it gives no sign of life.

Once a second the maintainer's thread checks the loop. If the loop is silent for longer than the
limit, the thread writes the stacks of all threads, while it holds the interpreter's lock, so that
no other thread runs meanwhile. The timer of `faulthandler` is not used: it works without that lock,
and ended one process in 15 to 100 whose code was running then (measured, Python 3.10 to 3.13).

While C code holds the lock, no Python thread runs, and the file's time stops. Then a process that
reads the status sends a signal, on which `faulthandler` writes the stacks (`store.loop_evidence`).
"""

from __future__ import annotations

import faulthandler
import functools
import json
import os
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

from webots_mcp.bridge.controller_variables import ControllerVariables
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.simulation import Clock, Simulation
from webots_mcp.database.files import PRIVATE_FILE
from webots_mcp.database.location import Database
from webots_mcp.database.thread_stacks import (
    FORMAT,
    LIBRARIES,
    SIGNAL,
    VERSION,
    read_stacks,
    stacks_path,
)
from webots_mcp.database.waiting_file import lock

_MOST_LOGGED: Final = 20  # in a session: a loop that is slow by design would fill the log
_WEBOTS: Final = ("controller", "vehicle")  # its packages


class Watchdog:
    """Watches the loop of one session; off for a database in memory, and with a limit of 0.

    Args:
        database: The database; the file with the stacks is written next to it.
        limit_s: How long the loop may be silent, in seconds of wall time.
    """

    def __init__(
        self,
        simulation: Simulation,
        clock: Clock,
        recorder: Recorder,
        journal: Journal,
        variables: ControllerVariables,
        database: Database,
        limit_s: float,
    ) -> None:
        self._clock = clock
        self._recorder = recorder
        self._journal = journal
        self._variables = variables
        self._meter = simulation.meter
        self._limit_s = limit_s
        self._is_on = limit_s > 0 and isinstance(database, Path)
        self._path = stacks_path(Path(str(database)), recorder.uuid)
        self._lock = threading.Lock()
        self._about = {VERSION: FORMAT, "limit_s": limit_s}
        files = simulation.step_files
        folders = [folder for file in files if (folder := Path(file).parent).name in _WEBOTS]
        libraries = [*LIBRARIES, *(f"{folder}{os.sep}" for folder in folders)]
        self._about |= {"step_files": files, "libraries": libraries}
        self._file = -1
        self._head = b""
        self._began_s = self._silent_since_s = 0.0  # times of signs of life
        self._judged_s = 0.0  # wall time of the stacks that were judged last
        self._logged = 0

    def begin(self) -> None:
        """Begin to watch the loop."""
        self._began_s = self._meter.at_s = time.perf_counter()
        self.check()

    def check(self) -> None:
        """Write the stacks of a silent loop and log it once; called in the maintainer's thread."""
        with self._lock:
            if not self._is_on:
                return
            try:
                self._write_if_silent()
            except (OSError, RuntimeError) as error:
                self._end()
                text = f"hangs of the loop are not detected: {error}"
                self._journal.log("warning", "bridge", text)

    def close(self) -> None:
        """Log the stacks that were written last, and remove the file."""
        is_locked = self._lock.acquire(timeout=1.0)  # an interrupt may have left it locked
        self._end()
        if is_locked:
            self._lock.release()

    def abandon(self) -> None:
        """Stop in a forked child: the file belongs to the parent."""
        self._is_on = False

    def _end(self) -> None:
        if self._is_on and self._file >= 0:
            with suppress(OSError):
                self._judge()
                os.ftruncate(self._file, 0)  # of a file without a first line no signal is sent
                self._path.unlink()
            self._leave_file()
        self._is_on = False

    def _write_if_silent(self) -> None:
        if self._file < 0 or not os.fstat(self._file).st_nlink:
            self._open()
        if self._judge():  # a signal has written them, and may have woken the loop: keep them
            return
        alive_s = self._meter.at_s
        if time.perf_counter() - alive_s < self._limit_s:
            self._begin_anew()
        elif alive_s != self._silent_since_s:
            self._silent_since_s = alive_s
            self._begin_anew()
            faulthandler.dump_traceback(self._file, all_threads=True)
            self._judge()

    def _open(self) -> None:
        """Create the file, also after it was deleted."""
        if self._file >= 0:
            self._leave_file()
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)
        self._file = os.open(self._path, flags, PRIVATE_FILE)
        lock(self._file)
        if SIGNAL and signal.getsignal(SIGNAL) is signal.SIG_DFL:
            _null_device()  # opened now: at the end there may be no file descriptor left for it
            faulthandler.register(SIGNAL, self._file, all_threads=True)
            self._about["signal"] = SIGNAL

    def _leave_file(self) -> None:
        """Close the file; a signal that arrives later must neither end the process nor write."""
        self._check_signal()
        if "signal" in self._about:
            faulthandler.register(SIGNAL, _null_device(), all_threads=False)
        file, self._file = self._file, -1  # first: the number may be another file's at once
        os.close(file)

    def _check_signal(self) -> None:
        """Give the signal up if the controller has installed a handler of its own."""
        if "signal" in self._about and signal.getsignal(SIGNAL) is not signal.SIG_DFL:
            del self._about["signal"]

    def _begin_anew(self) -> None:
        """Write the first line, which names run and thread, or touch the file: Python runs."""
        self._check_signal()
        now = {"run": self._clock.run.uuid, "thread": self._meter.thread}
        head = json.dumps(self._about | now).encode() + b"\n"
        if head == self._head and os.fstat(self._file).st_size == len(head):
            os.utime(self._file)
            return
        os.ftruncate(self._file, 0)
        os.write(self._file, head)
        self._head = head

    def _judge(self) -> bool:
        """Log where the loop was, unless it waited for Webots; return whether stacks are new."""
        with open(self._file, "rb", closefd=False) as file:
            stacks = read_stacks(file)
        if stacks is None or stacks.wall_time_s == self._judged_s or not stacks.is_hang:
            return False
        self._judged_s = stacks.wall_time_s
        if self._meter.at_s > self._began_s and self._logged < _MOST_LOGGED:
            self._logged += 1
            clock = self._clock
            self._recorder.record("stacks", clock.run, stacks.log_values(clock.sim_time_s))
            self._variables.record_thread(stacks.place, self._meter.thread)
        return True


@functools.cache
def _null_device() -> int:
    return os.open(os.devnull, os.O_WRONLY)
