"""Forwards and records what this process prints on one of its streams, `stdout` or `stderr`.

A `print` in Python forwards and records its text before it returns. For the output of C code a
thread does so, which never calls Webots' API.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.bridge.printed_lines import PrintedLines
from webots_mcp.bridge.redirection import Redirection
from webots_mcp.errors import warn

POLLS: Final = os.name == "posix"  # Windows has no select() for pipes
_PATIENCE_S: Final = 0.02  # how long a print waits for the thread that is recording

Record = Callable[[str, Sequence[str]], object]


@dataclass(frozen=True)
class ChannelLimits:
    """Sizes and times of forwarding what a controller prints.

    Attributes:
        chunk_bytes: PIPE_BUF: a writable pipe accepts this much without blocking.
        unforwarded_bytes: Size from which further data is left in the pipe.
    """

    chunk_bytes: int = 4096
    unforwarded_bytes: int = 1 << 16


_CHANNEL: Final = ChannelLimits()


class OutputChannel:
    """One redirected stream: forwards its output to the original destination and records it.

    Args:
        name: The stream's name in `sys`: `stdout` or `stderr`.
        redirection: Its descriptor, redirected into a pipe.
        writes_to_descriptor: Whether Python's stream writes to that descriptor; if not, its text
            never reaches the pipe.
        lines: Splits the output into lines.
        record: Receives the name and new lines; called in any thread.
    """

    def __init__(
        self,
        name: str,
        redirection: Redirection,
        lines: PrintedLines,
        record: Record,
        *,
        writes_to_descriptor: bool,
    ) -> None:
        self._name = name
        self._redirection = redirection
        self._lines = lines
        self._record = record
        self._writes_to_descriptor = writes_to_descriptor
        # Two locks, so that forwarding goes on while lines are being recorded.
        self._lock = threading.RLock()  # guards reading the pipe and forwarding
        self._recording = threading.Lock()
        self._recorder: int | None = None  # the thread that holds `_recording`
        self._unforwarded = bytearray()
        self._destination_failed = False
        self._ended = False
        self._stream: Any = getattr(sys, name)
        self._tee: _Tee | None = None
        self._thread = threading.Thread(target=self._follow, name=f"webots-mcp {name}", daemon=True)
        self._thread.start()
        if self._stream is not None:
            self._tee = _Tee(self._stream, self._printed)
            setattr(sys, name, self._tee)

    def close(self) -> None:
        """Restore the stream, then forward and record what is still in the pipe."""
        flush(self._stream)
        _flush_c()  # before restoring: C's buffer must still go through the pipe
        self._restore()
        # A destination that accepts no data delays the end of the controller by this much at most.
        deadline_s = time.monotonic() + 1.0
        while self._has_unforwarded() and time.monotonic() < deadline_s:
            self._thread.join(0.02)
        with self._lock:
            self._lines.end()
        self._record_lines(_PATIENCE_S)

    def abandon(self) -> None:
        """Restore the stream in a forked child; locks, thread and data belong to the parent."""
        self._restore()
        self._redirection.close()

    def _restore(self) -> None:
        """Restore Python's stream and the descriptor, unless other code has replaced them."""
        if getattr(sys, self._name) is self._tee:
            setattr(sys, self._name, self._stream)
        self._redirection.restore()

    # -- forwarding ----------------------------------------------------------------------------

    def _printed(self, text: str) -> None:
        """Forward and record what Python has just printed."""
        if not self._writes_to_descriptor:  # a replaced stream, as that of Webots on Windows
            with self._lock:
                self._lines.take(text.encode("utf-8", "replace"))
        elif POLLS:
            self._pump()
        self._record_lines(_PATIENCE_S)

    def _follow(self) -> None:
        """Run the thread until every writer, child processes included, has closed the pipe."""
        ends = self._redirection
        while not (self._pump() if POLLS else self._forward_blocking()):
            self._record_in_thread()
            if POLLS:
                full = len(self._unforwarded) >= _CHANNEL.unforwarded_bytes
                destination = [ends.destination] if self._unforwarded else []
                _wait_for([] if full else [ends.read_end], destination)
        with self._lock:
            self._ended = True
            ends.close()
        self._record_in_thread()

    def _has_unforwarded(self) -> bool:
        """Return whether some output has not reached the destination yet."""
        if not POLLS:
            return self._thread.is_alive()
        return not self._pump() and bool(self._unforwarded)

    def _pump(self) -> bool:
        """Forward what has arrived, as far as that does not block; True at the end of the pipe."""
        with self._lock:
            while not self._ended:
                self._forward()
                if len(self._unforwarded) >= _CHANNEL.unforwarded_bytes:
                    return False
                try:
                    data = os.read(self._redirection.read_end, _CHANNEL.unforwarded_bytes)
                except BlockingIOError:
                    return False
                self._unforwarded += data
                self._lines.take(data)
                if not data:
                    return not self._unforwarded
        return True

    def _forward(self) -> None:
        """Write to the destination as much as it accepts without blocking."""
        destination = self._redirection.destination
        while self._unforwarded and (not POLLS or _wait_for([], [destination], 0)):
            try:
                written = os.write(destination, self._unforwarded[: _CHANNEL.chunk_bytes])
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
        """Wait for data and forward it, where a pipe cannot be polled; True at its end."""
        # Outside of the lock: this read blocks, and a print needs the lock meanwhile.
        data = os.read(self._redirection.read_end, _CHANNEL.unforwarded_bytes)
        with self._lock:
            self._lines.take(data)
            self._unforwarded += data
            self._forward()
        return not data

    # -- recording -----------------------------------------------------------------------------

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


def flush(stream: Any) -> None:
    """Flush a Python stream, which may be closed, broken or None."""
    try:
        if not getattr(stream, "closed", stream is None):  # closing has flushed it
            stream.flush()
    except (OSError, ValueError) as error:
        warn(f"earlier output could not be flushed: {error}")


def _flush_c() -> None:
    """Flush the buffer of the C library, which else stays until the process ends."""
    if POLLS and (ctypes := sys.modules.get("ctypes")) is not None:
        ctypes.CDLL(None).fflush(None)


def _wait_for(readable: list[int], writable: list[int], timeout_s: float | None = None) -> bool:
    import select  # only where output is captured

    return any(select.select(readable, writable, [], timeout_s))
