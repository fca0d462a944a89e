"""Recording what a controller prints: `capture_output=True`.

The file descriptors 1 and 2 are redirected into pipes, so that the output of C code is recorded
too. The data is forwarded to the original destination, in order, and its lines are recorded. A
`print` in Python does that itself before it returns; for the output of C code a thread does it,
which never calls Webots' API. So a process that is killed loses what C code printed in its last
milliseconds, and what was never flushed.

While the original destination accepts no data, the output waits in the pipe (1 MB on Linux, 64 kB
elsewhere); a print blocks only when the pipe is full too. Lines are recorded as any log line is,
within milliseconds also while the database is locked.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from webots_mcp.errors import warn

_DESCRIPTORS: Final = {"stdout": 1, "stderr": 2}
_PIPE_BYTES: Final = 1 << 20
_CHUNK_BYTES: Final = 4096  # PIPE_BUF: a writable pipe takes so many bytes without blocking
_MOST_UNFORWARDED_BYTES: Final = 1 << 16  # beyond it, data is left in the pipe
_MOST_SELECTABLE: Final = 1024  # FD_SETSIZE: select() cannot watch a higher descriptor
_LAST_WAIT_S: Final = 1.0  # on closing, for a destination that accepts no data
_PATIENCE_S: Final = 0.02  # how long a print waits for the thread that is recording
_POLLS: Final = os.name == "posix"  # Windows has no select() for pipes

Record = Callable[[str, Sequence[str]], object]
MOST_LINES_PER_S: Final = 500  # of wall time
_MOST_LINE_BYTES: Final = 40_000  # a log row has the first 10,000 characters


class Capture:
    """The output of this process, captured from `begin` to `close`.

    Args:
        record: Receives the lines of `stdout` or `stderr`; called in any thread.
    """

    _current: Capture | None = None  # a process has one stdout

    def __init__(self, record: Record) -> None:
        self._record = record
        self._channels: list[_Channel] = []

    def begin(self) -> None:
        """Capture the output, unless another bridge of this process does already."""
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
        """Restore the original streams, and record the rest."""
        self._end(_Channel.close)

    def abandon(self) -> None:
        """In a forked child: its output goes to the original destination, unrecorded."""
        self._end(_Channel.abandon)

    def _end(self, end: Callable[[_Channel], object]) -> None:
        if Capture._current is self:
            Capture._current = None
        for channel in self._channels:
            end(channel)
        self._channels.clear()


class _Channel:
    """`stdout` or `stderr`: the pipe that it is redirected into, and its original destination."""

    def __init__(self, name: str, record: Record) -> None:
        self._name = name
        self._record = record
        self._descriptor = _DESCRIPTORS[name]
        self._lines = PrintedLines()
        # Two locks, so that forwarding goes on while lines are being recorded.
        self._lock = threading.RLock()  # guards reading the pipe and forwarding
        self._recording = threading.Lock()
        self._recorder: int | None = None  # the thread that holds `_recording`
        self._unforwarded = bytearray()
        self._destination_failed = False
        self._ended = False
        self._stream: Any = getattr(sys, name)
        self._tee: _Tee | None = None
        self._reaches_descriptor = _writes_to(self._stream, self._descriptor)
        self._redirect()
        self._thread = threading.Thread(target=self._follow, name=f"webots-mcp {name}", daemon=True)
        self._thread.start()
        if self._stream is not None:
            self._tee = _Tee(self._stream, self._printed)
            setattr(sys, name, self._tee)

    def close(self) -> None:
        """Restore the stream, forward and record what is still in the pipe."""
        _flush(self._stream)
        _flush_c()  # before restoring: C's buffer must still go through the pipe
        self._restore()
        deadline_s = time.monotonic() + _LAST_WAIT_S
        while self._has_unforwarded() and time.monotonic() < deadline_s:
            self._thread.join(0.02)
        with self._lock:
            self._lines.end()
        self._record_lines(_PATIENCE_S)

    def abandon(self) -> None:
        """In a forked child: locks, thread and unforwarded data belong to the parent."""
        self._restore()
        os.close(self._read_end)
        os.close(self._destination)

    # -- forwarding ----------------------------------------------------------------------------

    def _printed(self, text: str) -> None:
        """Called when Python has printed something."""
        if not self._reaches_descriptor:  # a replaced stream, as that of Webots on Windows
            with self._lock:
                self._lines.take(text.encode("utf-8", "replace"))
        elif _POLLS:
            self._pump()
        self._record_lines(_PATIENCE_S)

    def _follow(self) -> None:
        """The thread's loop, until every writer has closed the pipe, child processes included."""
        while not (self._pump() if _POLLS else self._forward_blocking()):
            self._record_in_thread()
            if _POLLS:
                full = len(self._unforwarded) >= _MOST_UNFORWARDED_BYTES
                destination = [self._destination] if self._unforwarded else []
                _wait_for([] if full else [self._read_end], destination)
        with self._lock:
            self._ended = True
            os.close(self._read_end)
            os.close(self._destination)
        self._record_in_thread()

    def _has_unforwarded(self) -> bool:
        """Whether some output has not reached the destination yet."""
        if not _POLLS:
            return self._thread.is_alive()
        return not self._pump() and bool(self._unforwarded)

    def _pump(self) -> bool:
        """Forward what has arrived, as far as that does not block; True at the end of the pipe."""
        with self._lock:
            while not self._ended:
                self._forward()
                if len(self._unforwarded) >= _MOST_UNFORWARDED_BYTES:
                    return False
                try:
                    data = os.read(self._read_end, _MOST_UNFORWARDED_BYTES)
                except BlockingIOError:
                    return False
                self._unforwarded += data
                self._lines.take(data)
                if not data:
                    return not self._unforwarded
        return True

    def _forward(self) -> None:
        while self._unforwarded and (not _POLLS or _wait_for([], [self._destination], 0)):
            try:
                written = os.write(self._destination, self._unforwarded[:_CHUNK_BYTES])
            except BlockingIOError:
                return
            except OSError as error:
                if not self._destination_failed:
                    self._destination_failed = True
                    self._lines.add_note(
                        f"{self._name} cannot be written any more: {error.strerror}"
                    )
                written = len(self._unforwarded)  # discarded: the lines are still recorded
            del self._unforwarded[:written]

    def _forward_blocking(self) -> bool:
        """Forward the next data, where a pipe cannot be polled."""
        # Outside of the lock: this read blocks, and a print needs the lock meanwhile.
        data = os.read(self._read_end, _MOST_UNFORWARDED_BYTES)
        with self._lock:
            self._lines.take(data)
            self._unforwarded += data
            self._forward()
        return not data

    def _record_in_thread(self) -> None:
        """Record in the thread, which must survive any error: it has to go on forwarding."""
        try:
            self._record_lines()
        except Exception as error:  # noqa: BLE001  (only strict mode raises)
            warn(f"{self._name} could not be recorded: {error}")

    def _record_lines(self, patience_s: float = 0) -> None:
        """Record the waiting lines; output of the recording itself follows with the next line.

        Args:
            patience_s: How long to wait for another thread that is recording.
        """
        if self._recorder == threading.get_ident():
            return  # a warning printed while recording must not record itself
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

    # -- redirecting ---------------------------------------------------------------------------

    def _redirect(self) -> None:
        _flush(self._stream)
        self._destination = os.dup(self._descriptor)
        self._read_end, write_end = os.pipe()
        if max(self._read_end, self._destination) >= _MOST_SELECTABLE:
            raise OSError("too many files are open")
        _enlarge(write_end)
        if _POLLS:
            os.set_blocking(self._read_end, False)
        os.dup2(write_end, self._descriptor)
        self._pipe = os.fstat(write_end)
        os.close(write_end)

    def _restore(self) -> None:
        """Restore the stream and the descriptor, unless other code has redirected them since."""
        if getattr(sys, self._name) is self._tee:
            setattr(sys, self._name, self._stream)
        try:
            is_ours = os.path.samestat(os.fstat(self._descriptor), self._pipe)
        except OSError:  # other code has closed it
            return
        if is_ours:
            os.dup2(self._destination, self._descriptor)


class _Tee:
    """A Python stream that reports each write at once."""

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

    def __enter__(self) -> _Tee:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _writes_to(stream: Any, descriptor: int) -> bool:
    try:
        return stream.fileno() == descriptor
    except (AttributeError, OSError, ValueError):
        return False


def _flush(stream: Any) -> None:
    try:
        if not getattr(stream, "closed", stream is None):  # closing has flushed it
            stream.flush()
    except (OSError, ValueError) as error:
        warn(f"earlier output could not be flushed: {error}")


def _flush_c() -> None:
    """Flush the buffer of the C library, which else stays until the process ends."""
    if _POLLS and (ctypes := sys.modules.get("ctypes")) is not None:
        ctypes.CDLL(None).fflush(None)


def _wait_for(readable: list[int], writable: list[int], timeout_s: float | None = None) -> bool:
    import select  # only where output is captured

    return any(select.select(readable, writable, [], timeout_s))


def _enlarge(pipe: int) -> None:
    """Enlarge a pipe where the system allows it: on Linux."""
    if sys.platform == "linux":
        import fcntl

        try:
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        except OSError:  # the user's limit for pipes is reached: the default size remains
            return


# -- printed lines: up to 500 a second -------------------------------------------------------------


class PrintedLines:
    """Splits a stream of bytes into whole lines, without the empty ones.

    Attributes:
        waiting: Lines that have not been removed yet: those of some seconds at most.
    """

    def __init__(self) -> None:
        self.waiting: deque[str] = deque()
        self._unfinished = bytearray()
        self._second = 0
        self._lines_in_second = 0
        self._left_out = 0

    def take(self, data: bytes) -> None:
        """Add printed bytes."""
        *lines, rest = data.split(b"\n")
        for line in lines:
            self._add(bytes(self._unfinished) + line)
            self._unfinished.clear()
        self._unfinished += rest[: _MOST_LINE_BYTES - len(self._unfinished)]

    def end(self) -> None:
        """Finish: the rest without a newline is a line too."""
        self.take(b"\n")
        self._note_left_out()

    def remove(self) -> list[str]:
        """Remove and return the waiting lines."""
        return [self.waiting.popleft() for _ in range(len(self.waiting))]

    def add_note(self, text: str) -> None:
        """Add a note of the bridge, in parentheses."""
        self.waiting.append(f"({text})")

    def _add(self, line: bytes) -> None:
        second = int(time.monotonic())
        if second != self._second:
            self._note_left_out()
            self._second, self._lines_in_second = second, 0
        # The text after the last carriage return: what a terminal shows of a progress bar.
        text = line.rstrip(b"\r").rpartition(b"\r")[2].decode("utf-8", "replace")
        if not text.strip():
            return
        self._lines_in_second += 1
        if self._lines_in_second > MOST_LINES_PER_S:
            self._left_out += 1
        else:
            self.waiting.append(text)

    def _note_left_out(self) -> None:
        if self._left_out:
            self.add_note(
                f"{self._left_out} lines were not recorded: more than {MOST_LINES_PER_S} were "
                "printed in a second"
            )
            self._left_out = 0


# -- Python's logging ------------------------------------------------------------------------------


class LogHandler(logging.Handler):
    """Records each line with its level and the name of its logger.

    Args:
        record: Receives the text, the level's number and the logger's name; called in any thread.
        level: Lines of this level and those above it are recorded.
    """

    def __init__(
        self, record: Callable[[object, object, str | None], None], level: int | str
    ) -> None:
        super().__init__(level.upper() if isinstance(level, str) else level)
        self._record = record
        self._inside = threading.local()

    def emit(self, record: logging.LogRecord) -> None:
        """Record a line; one that is logged by the recording itself is ignored."""
        if getattr(self._inside, "busy", False):
            return
        self._inside.busy = True
        try:
            self._record(self._text_of(record), record.levelno, record.name)
        finally:
            self._inside.busy = False

    def _text_of(self, record: logging.LogRecord) -> str:
        try:
            return self.format(record)
        except Exception as error:  # noqa: BLE001  (a message's arguments may raise anything)
            return f"{_as_given(record.msg)} (not formatted: {type(error).__name__})"


def _as_given(message: object) -> str:
    return message if isinstance(message, str) else f"a {type(message).__name__} without text"
