"""The lines of Webots' console: as many as one can read, and how many more there were."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Final

from webots_mcp.contract import LogLevel, LogSource
from webots_mcp.store.console import Said
from webots_mcp.webots.stream import Message, WebotsLine, console_lines

MOST_LINES_PER_S: Final = 500  # of wall time
MOST_OLD_LINES: Final = 2_000  # of those that were said before somebody listened, the newest

_LEVELS: Final[dict[str, LogLevel]] = {"stdout": "info", "stderr": "warning"}
# How Webots' own lines begin, by the stream that they come on.
_OWN: Final[dict[str, dict[str, LogLevel]]] = {
    "stdout": {"INFO: ": "info"},
    "stderr": {
        "WARNING: ": "warning", "ERROR: ": "error", "FATAL: ": "critical", "ODE ": "warning",
    },
}  # fmt: skip


class ConsoleLines:
    """Takes Webots' messages as they come, gives its lines.

    Args:
        old: Whether what waited until somebody listened may have been said long before.
    """

    def __init__(self, *, old: bool) -> None:
        self._is_old = old
        self._is_first = True
        self._second = 0
        self._lines_in_second = 0
        self._left_out = 0

    def take(self, message: Message) -> Iterator[Said]:
        """The lines of a message; none of one that is about something else."""
        lines = list(console_lines(message.text))
        if lines and self._is_first:
            self._is_first = False
            yield from self._that_waited(lines)
        else:
            for line in lines:
                yield from self._within_limit(line)
        if lines and message.dropped_bytes:
            yield note(f"{message.dropped_bytes} bytes of the console that came at once")

    def _that_waited(self, lines: list[WebotsLine]) -> Iterator[Said]:
        newest = lines[-MOST_OLD_LINES:]
        told = f"the next {len(newest)} lines are from before somebody followed the console"
        if len(newest) < len(lines):
            told += f", the last of {len(lines)}"
        if self._is_old or len(newest) < len(lines):
            yield _about(f"({told}: when they were printed is not known)")
        for line in newest:
            yield said(line)._replace(is_old=True)

    def idle(self) -> Iterator[Said]:
        """What is to be said although nothing came."""
        if int(time.monotonic()) != self._second:
            yield from self._tell_left_out()

    def _within_limit(self, line: WebotsLine) -> Iterator[Said]:
        second = int(time.monotonic())
        if second != self._second:
            yield from self._tell_left_out()
            self._second, self._lines_in_second = second, 0
        self._lines_in_second += 1
        if self._lines_in_second > MOST_LINES_PER_S:
            self._left_out += 1
        else:
            yield said(line)

    def _tell_left_out(self) -> Iterator[Said]:
        if self._left_out:
            lost = f"{self._left_out} lines of the console"
            yield note(f"{lost}: more than {MOST_LINES_PER_S} in a second")
            self._left_out = 0


def said(line: WebotsLine) -> Said:
    """A line as a row, now: who said it, and how grave it is."""
    # What a terminal shows of a line that was written over, as by a progress bar.
    text = line.text.rstrip("\r").rpartition("\r")[2].replace("\0", "�")
    level, source = _judged(line.stream, text)
    return Said(time.time(), level, source, text, line.stream)


def _judged(stream: str, text: str) -> tuple[LogLevel, LogSource]:
    for begin, level in _OWN[stream].items():
        if text.startswith(begin):
            return level, "webots"
    return _LEVELS[stream], "console"


def note(lost: str) -> Said:
    """A line about what was left out."""
    return _about(f"(not recorded: {lost})")


def _about(text: str) -> Said:
    """A line about the lines."""
    return Said(time.time(), "warning", "console", text, None)
