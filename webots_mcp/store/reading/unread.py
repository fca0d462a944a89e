"""Describe parts of a range that an answer does not cover, each with the reason."""

from __future__ import annotations

from typing import Final, NamedTuple

NOT_READ: Final = "not read from"  # the beginning of each note about such a part


class Unread(NamedTuple):
    """A part of the requested range that is not in a frame: [start_s, end_s], and why."""

    start_s: float
    end_s: float
    why: str

    def __str__(self) -> str:
        return f"{NOT_READ} {self.start_s:.3f} to {self.end_s:.3f} s: {self.why}"
