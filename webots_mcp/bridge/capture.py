"""Recording what a controller prints: `capture_output=True`.

What Python prints is recorded by the print itself, and appears where it did before. The file
descriptors 1 and 2 are redirected into pipes in addition, so that the output of C code and of child
processes is recorded too: a thread forwards and records it, which never calls Webots' API. So a
process that is killed loses what C code printed in its last milliseconds, and what Python and C
print at the same time may change places where it appears.

Lines are recorded as any log line is, within milliseconds also while the database is locked.
"""

from __future__ import annotations

import io
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
_READ_BYTES: Final = 1 << 16
_LAST_WAIT_S: Final = 1.0  # on closing, for a destination that accepts no data

Record = Callable[[str, Sequence[str]], object]

_of_parents: list[_Channel] = []  # kept, since dropping a stream would print what its buffer holds


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
            try:
                self._channels.append(_Channel(name, self._record))
            except (OSError, ValueError) as error:  # noqa: PERF203
                warn(f"{name} cannot be recorded: {error}")

    def close(self) -> None:
        """Restore the original streams, and record the rest."""
        self._end(_Channel.close)

    def abandon(self) -> None:
        """In a forked child: its output goes to the original destination, unrecorded."""
        _of_parents.extend(self._channels)
        self._end(_Channel.restore)

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
        self._lock = threading.RLock()  # of the lines; a print within a recording takes it again
        self._stream: Any = getattr(sys, name)
        self._redirect()
        self._thread = threading.Thread(target=self._follow, name=f"webots-mcp {name}", daemon=True)
        self._thread.start()
        self._tee: _Tee | None = None
        if self._stream is not None:
            target = _past_the_pipe(self._stream, self._descriptor, self._destination)
            self._tee = _Tee(target, self._printed)
            setattr(sys, name, self._tee)

    def close(self) -> None:
        """Restore the stream, forward and record what is still in the pipe."""
        _flush(self._stream)
        _flush_c()  # before restoring: C's buffer must still go through the pipe
        if self._tee is not None:
            _flush(self._tee.stream)
            self._tee.stream = self._stream  # other code may still have the tee
        self.restore()
        self._thread.join(_LAST_WAIT_S)
        with self._lock:
            self._lines.end()
            self._record_lines()

    def restore(self) -> None:
        """Restore the stream and the descriptor, unless other code has redirected them since."""
        if getattr(sys, self._name) is self._tee:
            setattr(sys, self._name, self._stream)
        try:
            is_ours = os.path.samestat(os.fstat(self._descriptor), self._pipe)
        except OSError:  # other code has closed it
            return
        if is_ours:
            os.dup2(self._destination, self._descriptor)

    def _redirect(self) -> None:
        _flush(self._stream)
        self._destination = os.dup(self._descriptor)
        self._read_end, write_end = os.pipe()
        _enlarge(write_end)
        os.dup2(write_end, self._descriptor)
        self._pipe = os.fstat(write_end)
        os.close(write_end)

    def _printed(self, text: str) -> None:
        """Called when Python prints something."""
        self._take(text.encode("utf-8", "replace"))

    def _follow(self) -> None:
        """The thread's loop, until every writer has closed the pipe, child processes included."""
        while data := os.read(self._read_end, _READ_BYTES):
            try:
                self._take(data)
            except Exception as error:  # noqa: BLE001  (only strict mode raises)
                self._lines.add_note(f"not recorded: {error}")
            self._forward(data)
        os.close(self._read_end)
        os.close(self._destination)

    def _forward(self, data: bytes) -> None:
        """Write to the original destination; what it does not take any more is recorded alone."""
        try:
            while data:
                data = data[os.write(self._destination, data) :]
        except OSError:
            return

    def _take(self, data: bytes) -> None:
        with self._lock:
            self._lines.take(data)
            self._record_lines()

    def _record_lines(self) -> None:
        if self._lines.waiting:
            self._record(self._name, self._lines.remove())


class _Tee:
    """A Python stream that reports each write at once.

    Attributes:
        stream: Where it writes.
    """

    def __init__(self, stream: Any, printed: Callable[[str], object]) -> None:
        self.stream = stream
        self._printed = printed

    def write(self, text: str) -> int:
        try:
            count = self.stream.write(text)
        finally:
            self._printed(text)
        return count

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def _past_the_pipe(stream: Any, descriptor: int, destination: int) -> Any:
    """A stream like Python's own that writes to the destination; a replaced one stays as it is."""
    try:
        if stream.fileno() != descriptor:
            return stream
    except (AttributeError, OSError, ValueError):  # such as the stream of Webots on Windows
        return stream
    file = os.fdopen(destination, "wb", 0 if stream.write_through else -1, closefd=False)
    ways = {"line_buffering": stream.line_buffering, "write_through": stream.write_through}
    return io.TextIOWrapper(file, stream.encoding, stream.errors, **ways)


def _flush(stream: Any) -> None:
    try:
        if stream is not None:
            stream.flush()
    except (OSError, ValueError) as error:
        warn(f"earlier output could not be flushed: {error}")


def _flush_c() -> None:
    """Flush the buffer of the C library, which else stays until the process ends."""
    if os.name == "posix" and (ctypes := sys.modules.get("ctypes")) is not None:
        ctypes.CDLL(None).fflush(None)


def _enlarge(pipe: int) -> None:
    """Enlarge a pipe where the system allows it: on Linux."""
    if sys.platform == "linux":
        import fcntl

        try:
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        except OSError:  # the user's limit for pipes is reached: the default size remains
            return


# -- printed lines: up to 500 a second -------------------------------------------------------------


MOST_LINES_PER_S: Final = 500  # of wall time
_MOST_LINE_BYTES: Final = 40_000  # a log row has the first 10,000 characters


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
