"""Writes down where the loop is when it gives no sign of life.

`faulthandler` has one timer for the whole process. It is set again by the maintainer's thread once
a second where the loop has given a sign of life since, so that it costs the loop nothing, and runs
out where the loop, or C code that keeps the interpreter's lock, is silent for longer than the
limit. A timer that other code of the process has set is left alone: from then on this one is off.
"""

from __future__ import annotations

import functools
import json
import os
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.contract import HANG_VARIABLE, PRIVATE_FILE, MemoryDatabase
from webots_mcp.stacks import FORMAT, VERSION, read_stacks, stacks_path
from webots_mcp.waiting_file import lock

if TYPE_CHECKING:
    from webots_mcp.bridge.session import Session

_SHORTEST_S: Final = 0.05  # of the timer
_SETTLED_S: Final = 0.2  # by then all threads have been written
_MOST_LOGGED: Final = 20  # in a session: a loop that is slow by design would fill the log
_OURS: Final = str(Path(__file__).parents[1]) + os.sep
_STDLIB: Final = str(Path(os.__file__).parent) + os.sep
_ALL_BLOCKED: Final = 0x3FFF_FFFF  # signals 1 to 30, some of which cannot be blocked
_NEVER: Final = 1 << 8 | 1 << 18  # SIGKILL and SIGSTOP
_BY_OTHERS: Final = (
    f"hangs of the loop are not looked for: this process uses faulthandler's only timer for "
    f"something else (set {HANG_VARIABLE}=0 to leave it to that)"
)


class Watchdog:
    """Of the loop of one session; it is off for a database in memory, and with a limit of 0.

    Args:
        session: The session.
        limit_s: So long may the loop be silent, in seconds of wall time.
    """

    def __init__(self, session: Session, limit_s: float) -> None:
        self._session = session
        self._limit_s = limit_s
        self._meter = meter = session.simulation.meter
        self._file: int | None = None
        self._path: Path | None = None
        self._head = b""
        self._thread = threading.get_ident()
        self._began_s = self._armed_s = 0.0
        self._taken_s = 0.0  # time of the stacks that were judged last
        self._logged = 0
        self._lock = threading.Lock()
        if limit_s and not isinstance(session.recorder.database, MemoryDatabase):
            meter.limit_s = limit_s * 0.9
            self._path = stacks_path(session.recorder.database, session.recorder.uuid)

    def begin(self) -> None:
        """Set the timer for the first time, in the loop's thread."""
        self._thread = threading.get_ident()
        self._began_s = self._meter.at_s = time.perf_counter()
        if self._path is None:
            return
        if _timer.is_anothers():
            self._step_aside()
        else:
            self._arm()

    def look(self) -> None:
        """In the maintainer's thread: log what was written, and set the timer again."""
        with self._lock:
            self._look()

    def _look(self) -> None:
        if self._path is None:
            return
        if _timer.of_others:
            self._step_aside()
            return
        alive_s = self._meter.at_s
        if self._file is not None:
            written = os.fstat(self._file)
            if written.st_size > len(self._head):
                if time.time() - written.st_mtime < _SETTLED_S:
                    return
                self._take(written.st_mtime)
        if alive_s != self._armed_s:
            self._arm()

    def close(self) -> None:
        """Log what was written last, and remove the file."""
        is_locked = self._lock.acquire(timeout=1.0)  # an interrupt may have left it locked
        try:
            self._close()
        finally:
            if is_locked:
                self._lock.release()

    def _close(self) -> None:
        if _timer.owner is self:
            _timer.cancel()
        if self._file is not None and self._path is not None:
            with suppress(OSError):
                self._take(os.fstat(self._file).st_mtime)
            os.close(self._file)
            self._file = None
            with suppress(OSError):
                self._path.unlink()
        self._path = None

    def abandon(self) -> None:
        """In a forked child, which has no timer: the file is the parent's."""
        self._path = None

    def _arm(self) -> None:
        """Let the timer run out when the loop has been silent for the limit."""
        if _timer.is_forking:
            return
        self._armed_s = alive_s = self._meter.at_s
        left_s = max(self._limit_s - (time.perf_counter() - alive_s), _SHORTEST_S)
        try:
            self._write_head()
            assert self._file is not None
            _timer.arm(self, left_s, self._file)
        except (OSError, RuntimeError, ValueError) as error:  # also: there is no thread any more
            self._session.errors.warn("stacks", f"where the loop hangs is not recorded: {error}")
            self._path = None

    def _write_head(self) -> None:
        """Begin the file anew: whose stacks follow."""
        about = {
            VERSION: FORMAT,
            "session": self._session.recorder.uuid,
            "run": self._session.clock.run.uuid,
            "thread": self._thread,
            "limit_s": self._limit_s,
            "step_files": self._session.simulation.step_files,
            "libraries": [_OURS, _STDLIB],
        }
        head = json.dumps(about).encode() + b"\n"
        if self._file is None:
            assert self._path is not None
            # In place of its former content each time, as the timer's thread writes to its end.
            flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)
            self._file = os.open(self._path, flags, PRIVATE_FILE)
            lock(self._file)
        elif head == self._head and os.fstat(self._file).st_size == len(head):
            return
        os.ftruncate(self._file, 0)
        os.write(self._file, head)
        self._head = head

    def _take(self, written_s: float) -> None:
        """Log where the loop was, unless it waited for Webots or was not silent at all."""
        if self._file is None or written_s == self._taken_s or self._logged >= _MOST_LOGGED:
            return
        self._taken_s = written_s
        with open(self._file, "rb", closefd=False) as file:
            stacks = read_stacks(file)
        if stacks is None or not stacks.is_hang or not self._was_silent(written_s):
            return
        self._logged += 1
        clock = self._session.clock
        values = {"sim_time": clock.sim_time_s, "wall_time": written_s, "message": stacks.message}
        self._session.recorder.record("stacks", clock.run, values)

    def _was_silent(self, wall_time_s: float) -> bool:
        """Whether the loop had begun, and gave no sign of life up to then for the limit.

        The maintainer's thread may come late, and the timer run out although the loop runs.
        """
        at_s = time.perf_counter() - (time.time() - wall_time_s)
        alive_s = self._meter.at_s
        since_s, until_s = self._meter.silence
        if alive_s <= at_s:
            since_s, until_s = alive_s, at_s
        return since_s > self._began_s and since_s + self._meter.limit_s <= at_s <= until_s

    def _step_aside(self) -> None:
        self._close()
        self._session.journal.log("info", "bridge", _BY_OTHERS)


# -- the timer of this process ---------------------------------------------------------------------


class _Timer:
    """The one timer of `faulthandler`, and whose it is.

    Attributes:
        owner: Which watchdog has set it.
        of_others: Code that is not the bridge's has set it, at some time.
        is_forking: The process is being forked; a child could not cancel the parent's timer.
    """

    def __init__(self) -> None:
        self.owner: Watchdog | None = None
        self.of_others = False
        self.is_forking = False
        self._was_imported = "faulthandler" in sys.modules
        import faulthandler

        self._faulthandler = faulthandler
        self._set = faulthandler.dump_traceback_later
        self._is_checked = False

        @functools.wraps(self._set)
        def set_by_others(*args: Any, **kwargs: Any) -> None:
            self.of_others, self.owner = True, None
            self._set(*args, **kwargs)

        faulthandler.dump_traceback_later = set_by_others

    def is_anothers(self) -> bool:
        """Whether code that is not the bridge's has set it, also before this module was there.

        There is no call that answers this. On Linux its thread is known by the signals that it
        blocks: all. Elsewhere a `faulthandler` that was imported and not enabled was for the timer,
        and that of pytest counts as set.
        """
        if not self._is_checked:
            self._is_checked = True
            if self._was_imported and not self.of_others:
                self.of_others = (
                    _blocks_all_signals()
                    if sys.platform.startswith("linux")
                    else not self._faulthandler.is_enabled() or "_pytest" in sys.modules
                )
        return self.of_others

    def arm(self, owner: Watchdog, timeout_s: float, file: int) -> None:
        """Set it, in place of one of another watchdog."""
        self._set(timeout_s, file=file)
        self.owner = owner

    def cancel(self) -> None:
        """Cancel it, where a watchdog has set it."""
        if self.owner is not None:
            self.owner = None
            self._faulthandler.cancel_dump_traceback_later()

    def before_fork(self) -> None:
        """A child has no thread of the timer, and would wait for it for ever when it exits."""
        self.is_forking = True
        self.cancel()

    def after_fork(self) -> None:
        """The maintainer's thread sets it again."""
        self.is_forking = False


def _blocks_all_signals() -> bool:
    with suppress(OSError, ValueError):
        for task in Path("/proc/self/task").iterdir():
            for line in (task / "status").read_text().splitlines():
                if line.startswith("SigBlk:"):
                    blocked = int(line.split()[1], 16)
                    if (blocked | _NEVER) & _ALL_BLOCKED == _ALL_BLOCKED:
                        return True
    return False


_timer: Final = _Timer()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_timer.before_fork,
        after_in_parent=_timer.after_fork,
        after_in_child=_timer.after_fork,
    )
