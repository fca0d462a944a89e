"""Recording what a controller prints: `capture_output=True`.

The file descriptors 1 and 2 are led through pipes, so that prints of C code count too. What comes
out is passed on to where it went before, in order, and its lines are recorded. A print of Python's
does that itself before it returns; for what C code prints a thread does it, which never touches
Webots' API. So a process that is killed loses what C code printed in its last milliseconds, and
what was not flushed, as ever.

Where the old place takes no more, what is printed waits in the pipe (1 MB on Linux, 64 kB
elsewhere); a print waits for it only when that is full too. It is recorded as any log line is,
within milliseconds also where the database is locked.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from webots_mcp.bridge.printed_lines import PrintedLines
from webots_mcp.errors import warn

_DESCRIPTORS: Final = {"stdout": 1, "stderr": 2}
_PIPE_BYTES: Final = 1 << 20
_CHUNK_BYTES: Final = 4096  # PIPE_BUF: a pipe that takes anything takes as many at once
_MOST_UNPASSED_BYTES: Final = 1 << 16
_MOST_SELECTABLE: Final = 1024
_LAST_WAIT_S: Final = 1.0  # at the end, for an old place that takes no more
_PATIENCE_S: Final = 0.02  # of a print, with the thread that records just now
_POLLS: Final = os.name == "posix"  # Windows cannot ask whether a pipe has something

Record = Callable[[str, Sequence[str]], object]


class Capture:
    """The output of this process, captured from `begin` to `close`.

    Args:
        record: Takes the lines of `stdout` or `stderr`; called in any thread.
    """

    _current: Capture | None = None  # a process has one stdout

    def __init__(self, record: Record) -> None:
        self._record = record
        self._channels: list[_Channel] = []

    def begin(self) -> None:
        """Lead the output through here, unless another bridge of this process does already."""
        if Capture._current is not None:
            warn("another bridge of this process records its output already: this one does not")
            return
        Capture._current = self
        for name in _DESCRIPTORS:
            self._begin(name)

    def _begin(self, name: str) -> None:
        try:
            self._channels.append(_Channel(name, self._record))
        except (OSError, ValueError) as error:
            warn(f"{name} cannot be recorded: {error}")

    def close(self) -> None:
        """Put back what was there before, and record the rest."""
        self._end(_Channel.close)

    def abandon(self) -> None:
        """In a forked child: what it prints goes where its parent's went before."""
        self._end(_Channel.abandon)

    def _end(self, end: Callable[[_Channel], object]) -> None:
        if Capture._current is self:
            Capture._current = None
        for channel in self._channels:
            end(channel)
        self._channels.clear()


class _Channel:
    """`stdout` or `stderr`: the pipe that it is led through, and where it went before."""

    def __init__(self, name: str, record: Record) -> None:
        self._name = name
        self._record = record
        self._descriptor = _DESCRIPTORS[name]
        self._lines = PrintedLines()
        self._lock = threading.RLock()  # of what comes out and is passed on
        self._recording = threading.Lock()
        self._recorder: int | None = None  # the thread that has it
        self._unpassed = bytearray()
        self._place_gone = False
        self._ended = False
        self._stream: Any = getattr(sys, name)
        self._tee: _Tee | None = None
        self._passes = _writes_to(self._stream, self._descriptor)
        self._lead_through_pipe()
        self._thread = threading.Thread(target=self._follow, name=f"webots-mcp {name}", daemon=True)
        self._thread.start()
        if self._stream is not None:
            self._tee = _Tee(self._stream, self._printed)
            setattr(sys, name, self._tee)

    def close(self) -> None:
        """Put the old place back, pass on and record what is still here."""
        _flush(self._stream)
        _flush_c()
        self._put_back()
        deadline_s = time.monotonic() + _LAST_WAIT_S
        while self._has_unpassed() and time.monotonic() < deadline_s:
            self._thread.join(0.02)
        with self._lock:
            self._lines.end()
        self._record_lines(_PATIENCE_S)

    def abandon(self) -> None:
        """In a forked child: locks and thread are the parent's, and so is what waits."""
        self._put_back()
        os.close(self._outlet)
        os.close(self._old_place)

    # -- passing on ----------------------------------------------------------------------------

    def _printed(self, text: str) -> None:
        """Python has printed something."""
        if not self._passes:  # a stream of somebody's own, as the one of Webots on Windows
            with self._lock:
                self._lines.take(text.encode("utf-8", "replace"))
        elif _POLLS:
            self._pump()
        self._record_lines(_PATIENCE_S)

    def _follow(self) -> None:
        """The thread: for as long as anybody has the pipe, a child of this process too."""
        while not (self._pump() if _POLLS else self._pass_on_waiting()):
            self._record_in_thread()
            if _POLLS:
                full = len(self._unpassed) >= _MOST_UNPASSED_BYTES
                old_place = [self._old_place] if self._unpassed else []
                _wait_for([] if full else [self._outlet], old_place)
        with self._lock:
            self._ended = True
            os.close(self._outlet)
            os.close(self._old_place)
        self._record_in_thread()

    def _has_unpassed(self) -> bool:
        """Whether something that was printed has not reached the old place yet."""
        if not _POLLS:
            return self._thread.is_alive()
        return not self._pump() and bool(self._unpassed)

    def _pump(self) -> bool:
        """Pass on what has come, as far as that needs no waiting; True when no more can come."""
        with self._lock:
            while not self._ended:
                self._pass_on()
                if len(self._unpassed) >= _MOST_UNPASSED_BYTES:
                    return False
                try:
                    data = os.read(self._outlet, _MOST_UNPASSED_BYTES)
                except BlockingIOError:
                    return False
                self._unpassed += data
                self._lines.take(data)
                if not data:
                    return not self._unpassed
        return True

    def _pass_on(self) -> None:
        while self._unpassed and (not _POLLS or _wait_for([], [self._old_place], 0)):
            try:
                written = os.write(self._old_place, self._unpassed[:_CHUNK_BYTES])
            except BlockingIOError:
                return
            except OSError as error:
                if not self._place_gone:
                    self._place_gone = True
                    self._lines.add_note(f"{self._name} leads nowhere any more: {error.strerror}")
                written = len(self._unpassed)
            del self._unpassed[:written]

    def _pass_on_waiting(self) -> bool:
        """For a system that cannot be asked; the lock must not be held by who waits for data."""
        data = os.read(self._outlet, _MOST_UNPASSED_BYTES)
        with self._lock:
            self._lines.take(data)
            self._unpassed += data
            self._pass_on()
        return not data

    def _record_in_thread(self) -> None:
        """Whatever becomes of the lines, what is printed has to be passed on."""
        try:
            self._record_lines()
        except Exception as error:  # noqa: BLE001  (only strict mode raises)
            warn(f"{self._name} could not be recorded: {error}")

    def _record_lines(self, patience_s: float = 0) -> None:
        """Record what waits; what the recording itself prints comes with the next line.

        Args:
            patience_s: How long to wait for another thread that is recording just now.
        """
        if self._recorder == threading.get_ident():
            return
        while self._recording.acquire(timeout=patience_s):
            try:
                self._recorder = threading.get_ident()
                if self._lines.waiting:
                    self._record(self._name, self._lines.remove())
            finally:
                self._recorder = None
                self._recording.release()
            if not self._lines.waiting:
                return

    # -- beginning and end ---------------------------------------------------------------------

    def _lead_through_pipe(self) -> None:
        _flush(self._stream)
        self._old_place = os.dup(self._descriptor)
        self._outlet, inlet = os.pipe()
        if max(self._outlet, self._old_place) >= _MOST_SELECTABLE:
            raise OSError("too many files are open")
        _enlarge(inlet)
        if _POLLS:
            os.set_blocking(self._outlet, False)
        os.dup2(inlet, self._descriptor)
        self._pipe = os.fstat(inlet)
        os.close(inlet)

    def _put_back(self) -> None:
        """Unless somebody has led it elsewhere since."""
        if getattr(sys, self._name) is self._tee:
            setattr(sys, self._name, self._stream)
        try:
            leads_here = os.path.samestat(os.fstat(self._descriptor), self._pipe)
        except OSError:  # somebody has closed it
            return
        if leads_here:
            os.dup2(self._old_place, self._descriptor)


class _Tee:
    """A stream of Python's that passes on at once what is printed."""

    def __init__(self, stream: Any, printed: Callable[[str], object]) -> None:
        self._stream = stream
        self._printed = printed

    def write(self, text: str) -> int:
        count = self._stream.write(text)
        self._printed(text)
        return count

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        self._stream.flush()
        self._printed("")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _writes_to(stream: Any, descriptor: int) -> bool:
    try:
        return stream.fileno() == descriptor
    except (AttributeError, OSError, ValueError):
        return False


def _flush(stream: Any) -> None:
    try:
        if stream is not None:
            stream.flush()
    except (OSError, ValueError) as error:
        warn(f"what was printed before could not be flushed: {error}")


def _flush_c() -> None:
    """What C code printed waits in a buffer of its own until the process ends."""
    if _POLLS and (ctypes := sys.modules.get("ctypes")) is not None:
        ctypes.CDLL(None).fflush(None)


def _wait_for(readable: list[int], writable: list[int], timeout_s: float | None = None) -> bool:
    import select  # only where output is captured

    return any(select.select(readable, writable, [], timeout_s))


def _enlarge(pipe: int) -> None:
    """Where the system lets one: Linux."""
    if sys.platform == "linux":
        import fcntl

        try:
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        except OSError:  # this user has many pipes: it stays as it is
            return
