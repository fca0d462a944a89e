"""Records what a controller prints, for `capture_output=True`.

The file descriptors 1 and 2 are redirected into pipes, so that the output of C code is recorded
too. The output is forwarded to where it would have gone, in order, and its lines are recorded.

A killed process loses what C code printed in its last milliseconds, and what was never flushed.
While the original destination accepts no data, the output waits in the pipe (1 MB on Linux, 64 kB
elsewhere); a print blocks only once the pipe is full. Lines are recorded like any log line, within
milliseconds even while the database is locked.
"""

from __future__ import annotations

import sys
from typing import Any, Final

from webots_mcp.bridge.output_channel import POLLS, OutputChannel, Record, flush
from webots_mcp.bridge.printed_lines import PrintedLines
from webots_mcp.bridge.redirection import Redirection
from webots_mcp.errors import warn

_DESCRIPTORS: Final = {"stdout": 1, "stderr": 2}


class Capture:
    """Captures the output of this process from `begin` to `close`.

    Args:
        record: Receives the name of the stream and its lines; called in any thread.
    """

    _current: Capture | None = None  # a process has one stdout

    def __init__(self, record: Record) -> None:
        self._record = record
        self._channels: list[OutputChannel] = []

    def begin(self) -> None:
        """Capture the output, unless another bridge of this process does already."""
        if Capture._current is not None:
            warn("another bridge of this process records its output already: this one does not")
            return
        Capture._current = self
        for name, descriptor in _DESCRIPTORS.items():
            try:
                self._channels.append(_open_channel(name, descriptor, self._record))
            except (OSError, ValueError) as error:  # noqa: PERF203
                warn(f"{name} cannot be recorded: {error}")

    def close(self) -> None:
        """Restore the original streams, and record the rest of their output."""
        for channel in self._end():
            channel.close()

    def abandon(self) -> None:
        """Restore the original streams in a forked child, which records nothing."""
        for channel in self._end():
            channel.abandon()

    def _end(self) -> list[OutputChannel]:
        """Let another bridge capture from now on; return the channels to end."""
        if Capture._current is self:
            Capture._current = None
        channels, self._channels = self._channels, []
        return channels


def _open_channel(name: str, descriptor: int, record: Record) -> OutputChannel:
    """Redirect a stream of this process.

    Raises:
        OSError: It cannot be redirected.
    """
    stream: Any = getattr(sys, name)
    try:
        writes_to_descriptor = stream.fileno() == descriptor
    except (AttributeError, OSError, ValueError):
        writes_to_descriptor = False
    flush(stream)  # what was printed before is not captured
    redirection = Redirection(descriptor, blocking=not POLLS)
    return OutputChannel(
        name, redirection, PrintedLines(), record, writes_to_descriptor=writes_to_descriptor
    )
