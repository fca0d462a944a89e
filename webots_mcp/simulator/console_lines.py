"""Turn lines of Webots' console into rows of a recording.

At most 500 lines a second become rows. If more arrive, one row says how many were left out.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Final

from webots_mcp.contract import LogLevel, LogSource
from webots_mcp.simulator.orders import (
    Message,
    WebotsLine,
    console_lines,
)
from webots_mcp.store.logs import Said

MOST_LINES_PER_S: Final = 500  # per second of wall time
# the newest of the lines that were printed before the console was followed
MOST_OLD_LINES: Final = 2_000
_LEVELS: Final[dict[str, LogLevel]] = {"stdout": "info", "stderr": "warning"}
# How Webots' own lines begin, by the stream that they come on.
_OWN: Final[dict[str, dict[str, LogLevel]]] = {
    "stdout": {"INFO: ": "info"},
    "stderr": {
        "WARNING: ": "warning", "ERROR: ": "error", "FATAL: ": "critical", "ODE ": "warning",
    },
}  # fmt: skip


class ConsoleLines:
    """Turns Webots' messages into rows, in the order in which they arrive.

    Args:
        old: Whether the first lines may have been printed long before they were read.
    """

    def __init__(self, *, old: bool) -> None:
        self._is_old = old
        self._is_first = True
        self._second = 0
        self._lines_in_second = 0
        self._left_out = 0

    def take(self, message: Message) -> Iterator[Said]:
        """Return the rows of a message; none if it is not about the console."""
        lines = list(console_lines(message.text))
        if lines and self._is_first:
            self._is_first = False
            yield from self._first_lines(lines)
        else:
            for line in lines:
                yield from self.take_line(line)
        if lines and message.dropped_bytes:
            yield note(f"{message.dropped_bytes} bytes of the console in one burst")

    def _first_lines(self, lines: list[WebotsLine]) -> Iterator[Said]:
        newest = lines[-MOST_OLD_LINES:]
        text = f"the next {len(newest)} lines were printed before the console was followed"
        if len(newest) < len(lines):
            text += f", the last of {len(lines)}"
        if self._is_old or len(newest) < len(lines):
            yield _about(f"({text}: when they were printed is not known)")
        for line in newest:
            yield as_row(line)._replace(is_old=True)

    def idle(self) -> Iterator[Said]:
        """Return the notes that are due although no line has arrived."""
        if int(time.monotonic()) != self._second:
            yield from self._note_left_out()

    def rest(self) -> Iterator[Said]:
        """Return a note of the lines left out so far, at the end."""
        yield from self._note_left_out()

    def take_line(self, line: WebotsLine) -> Iterator[Said]:
        """Return the row of a line that has just been printed, unless there were too many."""
        second = int(time.monotonic())
        if second != self._second:
            yield from self._note_left_out()
            self._second, self._lines_in_second = second, 0
        self._lines_in_second += 1
        if self._lines_in_second > MOST_LINES_PER_S:
            self._left_out += 1
        else:
            yield as_row(line)

    def _note_left_out(self) -> Iterator[Said]:
        if self._left_out:
            lost = f"{self._left_out} lines of the console"
            yield note(f"{lost}: more than {MOST_LINES_PER_S} in a second")
            self._left_out = 0


def as_row(line: WebotsLine) -> Said:
    """Return a line as a row of this moment: its source, and its severity."""
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
    """Return a row that says what was left out."""
    return _about(f"(not recorded: {lost})")


def _about(text: str) -> Said:
    """Return a row with a note about the console."""
    return Said(time.time(), "warning", "console", text, None)
