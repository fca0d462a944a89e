"""Splits what a controller prints into lines, of which at most 500 a second are recorded."""

from __future__ import annotations

import time
from collections import deque
from typing import Final

MOST_LINES_PER_S: Final = 500  # of wall time
_MOST_LINE_BYTES: Final = 40_000  # a log row has the first 10,000 characters


class PrintedLines:
    """Splits a stream of bytes into whole lines and leaves out the empty ones.

    Attributes:
        waiting: Lines that have not been removed yet.
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
        """Treat the rest without a newline as a line, and note how many lines were left out."""
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
        # The text after the last carriage return is what a terminal shows of a progress bar.
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
