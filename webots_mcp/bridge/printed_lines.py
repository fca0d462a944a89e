"""The lines of what a process prints: as many as one can read, and how many more there were."""

from __future__ import annotations

import time
from collections import deque
from typing import Final

MOST_LINES_PER_S: Final = 500  # of wall time
_MOST_LINE_BYTES: Final = 40_000  # a log row has the first 10,000 characters


class PrintedLines:
    """Takes bytes as they come, gives whole lines; empty ones are left out.

    Attributes:
        waiting: Lines that nobody has removed yet: those of some seconds at most.
    """

    def __init__(self) -> None:
        self.waiting: deque[str] = deque()
        self._unfinished = bytearray()
        self._second = 0
        self._lines_in_second = 0
        self._left_out = 0

    def take(self, data: bytes) -> None:
        """Take in what was printed."""
        *lines, rest = data.split(b"\n")
        for line in lines:
            self._add(bytes(self._unfinished) + line)
            self._unfinished.clear()
        self._unfinished += rest[: _MOST_LINE_BYTES - len(self._unfinished)]

    def end(self) -> None:
        """Nothing more comes: what has no newline is a line too."""
        self.take(b"\n")
        self._tell_left_out()

    def remove(self) -> list[str]:
        """The lines that wait."""
        return [self.waiting.popleft() for _ in range(len(self.waiting))]

    def add_note(self, text: str) -> None:
        """A line about the lines."""
        self.waiting.append(f"({text})")

    def _add(self, line: bytes) -> None:
        second = int(time.monotonic())
        if second != self._second:
            self._tell_left_out()
            self._second, self._lines_in_second = second, 0
        # What a terminal shows of a line that was written over, as by a progress bar.
        text = line.rstrip(b"\r").rpartition(b"\r")[2].decode("utf-8", "replace")
        if not text.strip():
            return
        self._lines_in_second += 1
        if self._lines_in_second > MOST_LINES_PER_S:
            self._left_out += 1
        else:
            self.waiting.append(text)

    def _tell_left_out(self) -> None:
        if self._left_out:
            self.add_note(
                f"{self._left_out} lines are not recorded: more than {MOST_LINES_PER_S} in a second"
            )
            self._left_out = 0
