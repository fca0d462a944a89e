"""Writes down where the loop is when it gives no sign of life.

`faulthandler` has one timer for the whole process. The maintainer's thread sets it again once a
second if the loop has given a sign of life since, so that it costs the loop nothing. It runs out
where the loop is silent for longer than the limit, also in C code that keeps the interpreter's
lock. A timer that other code of the process has set is left alone: from then on this one is off.
"""

from __future__ import annotations

import functools
import json
import os
import re
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.contract import HANG_VARIABLE, PRIVATE_FILE, Database
from webots_mcp.maintenance import INTERVAL_S
from webots_mcp.stacks import FORMAT, VERSION, read_stacks, stacks_path
from webots_mcp.waiting_file import lock

if TYPE_CHECKING:
    from webots_mcp.bridge.session import Session

_SHORTEST_S: Final = 0.05  # of the timer
_SETTLED_S: Final = 0.2  # by then all threads have been written
_MOST_LOGGED: Final = 20  # in a session: a loop that is slow by design would fill the log
_OURS: Final = f"{Path(__file__).parents[1]}{os.sep}"
_STDLIB: Final = f"{Path(os.__file__).parent}{os.sep}"
_ALL: Final = 0x3FFF_FFFF & ~(1 << 8 | 1 << 18)  # but SIGKILL and SIGSTOP
_BY_OTHERS: Final = (
    "this process uses faulthandler's only timer for something else "
    f"({HANG_VARIABLE}=0 leaves it to that without this line)"
)


class Watchdog:
    """Of the loop of one session; it is off for a database in memory, and with a limit of 0.

    Args:
        session: The session.
        limit_s: So long may the loop be silent, in seconds of wall time.
    """

    def __init__(self, session: Session, database: Database, limit_s: float) -> None:
        self._session = session
        self._meter = session.simulation.meter
        self._limit_s = limit_s
        self._is_on = limit_s > 0 and isinstance(database, Path)
        self._path = stacks_path(Path(str(database)), session.recorder.uuid)
        self._lock = threading.Lock()
        about = {VERSION: FORMAT, "thread": threading.get_ident(), "limit_s": limit_s}
        about |= {"step_files": session.simulation.step_files, "libraries": [_OURS, _STDLIB]}
        self._about = about
        self._file = -1
        self._head = b""
        self._began_s = self._set_s = 0.0  # signs of life
        self._judged_s = 0.0  # when the stacks were written that were judged last
        self._logged = 0

    def begin(self) -> None:
        """Set the timer for the first time; what the loop's thread does from now on counts."""
        self._began_s = self._meter.at_s = time.perf_counter()
        self._meter.limit_s = 0.9 * self._limit_s
        self.look()

    def look(self) -> None:
        """In the maintainer's thread: log what was written, and set the timer again."""
        with self._lock:
            if not self._is_on or _timer.is_forking:
                return
            try:
                self._look()
            except (OSError, RuntimeError) as error:
                self._end()
                text = f"hangs of the loop are not looked for: {error}"
                self._session.journal.log("info", "bridge", text)

    def close(self) -> None:
        """Log what was written last, and remove the file."""
        is_locked = self._lock.acquire(timeout=1.0)  # an interrupt may have left it locked
        self._end()
        if is_locked:
            self._lock.release()

    def abandon(self) -> None:
        """In a forked child, which has no timer: the file is the parent's."""
        self._is_on = False

    def _end(self) -> None:
        if self._is_on and self._file >= 0:
            _timer.cancel()
            with suppress(OSError):
                self._judge(os.fstat(self._file).st_mtime)
                os.close(self._file)
                self._path.unlink()
        self._is_on = False

    def _look(self) -> None:
        if _timer.is_others:
            raise RuntimeError(_BY_OTHERS)
        if self._file < 0 or not os.fstat(self._file).st_nlink:  # it may have been deleted
            # To the end of what it has by then, as the timer's thread writes there too.
            flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)
            self._file = os.open(self._path, flags, PRIVATE_FILE)
            lock(self._file)
        file = os.fstat(self._file)
        if file.st_size > len(self._head):
            if time.time() - file.st_mtime < _SETTLED_S:
                return
            self._judge(file.st_mtime)
        alive_s = self._meter.at_s
        if alive_s == self._set_s:
            return
        head = json.dumps(self._about | {"run": self._session.clock.run.uuid}).encode() + b"\n"
        if head != self._head or file.st_size != len(head):
            os.ftruncate(self._file, 0)
            os.write(self._file, head)
            self._head = head
        # The loop may go on for an interval before it keeps this thread from setting it again.
        left_s = self._limit_s + INTERVAL_S - (time.perf_counter() - alive_s)
        _timer.set(max(left_s, _SHORTEST_S), self._file)
        self._set_s = alive_s

    def _judge(self, written_s: float) -> None:
        """Log where the loop was, unless it waited for Webots or was not silent at all."""
        if written_s == self._judged_s or self._logged >= _MOST_LOGGED:
            return
        self._judged_s = written_s
        with open(self._file, "rb", closefd=False) as file:
            stacks = read_stacks(file)
        if stacks is None or not stacks.is_hang or not self._was_silent(written_s):
            return
        self._logged += 1
        clock = self._session.clock
        self._session.recorder.record("stacks", clock.run, stacks.log_values(clock.sim_time_s))

    def _was_silent(self, wall_time_s: float) -> bool:
        """Whether the loop had begun, and gave no sign of life for the limit up to then.

        The maintainer's thread may be late, and the timer run out although the loop goes on.
        """
        at_s = time.perf_counter() - (time.time() - wall_time_s)
        since_s, until_s = self._meter.silence
        if self._meter.at_s <= at_s:
            since_s, until_s = self._meter.at_s, at_s
        return since_s > self._began_s and since_s + self._meter.limit_s <= at_s <= until_s


# -- the timer of this process ---------------------------------------------------------------------


class _Timer:
    """The one timer of `faulthandler`.

    There is no call that answers whether it is set. So calls of others are noted from here on. For
    those before: on Linux its thread is known by the signals that it blocks, all; elsewhere it
    counts as set where `faulthandler` was imported and not enabled, and in pytest.

    Attributes:
        is_others: Code that is not the bridge's has set it.
        is_forking: The process is being forked; a child could not cancel the timer of its parent,
            and would wait for that for ever when it exits.
    """

    def __init__(self) -> None:
        was_imported = "faulthandler" in sys.modules
        import faulthandler as module

        self._module = module
        self._set = module.dump_traceback_later
        self._is_ours = self.is_forking = False
        self.is_others = was_imported and _is_set(was_enabled=module.is_enabled())

        @functools.wraps(self._set)
        def set_by_others(*args: Any, **kwargs: Any) -> None:
            self.is_others, self._is_ours = True, False
            self._set(*args, **kwargs)

        module.dump_traceback_later = set_by_others

    def set(self, timeout_s: float, file: int) -> None:
        """Set it, in place of what another bridge of this process has set."""
        self._set(timeout_s, file=file)
        self._is_ours = True

    def cancel(self) -> None:
        """Cancel it, where a bridge has set it."""
        if self._is_ours:
            self._is_ours = False
            self._module.cancel_dump_traceback_later()

    def fork(self, *, is_over: bool) -> None:
        """Before a fork, and after it in both processes; the maintainer's thread sets it again."""
        self.is_forking = not is_over
        self.cancel()


def _is_set(*, was_enabled: bool) -> bool:
    """Whether a thread blocks the signals 1 to 30, as far as they can be; else what is likely."""
    if not sys.platform.startswith("linux"):
        return not was_enabled or "_pytest" in sys.modules
    threads = [status.read_text() for status in Path("/proc/self/task").glob("*/status")]
    blocked = re.findall(r"^SigBlk:\s*(\w+)", "\n".join(threads), re.MULTILINE)
    return any(int(mask, 16) & _ALL == _ALL for mask in blocked)


_timer: Final = _Timer()
if hasattr(os, "register_at_fork"):
    _over = functools.partial(_timer.fork, is_over=True)
    _before = functools.partial(_timer.fork, is_over=False)
    os.register_at_fork(before=_before, after_in_parent=_over, after_in_child=_over)
