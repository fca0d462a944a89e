"""The ring buffer: calls of `publish` of the last seconds, held in memory until they are kept."""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.state_copies import StateCopy

MAX_RING_BYTES: Final = 8_000_000


class RingRow(NamedTuple):
    """A call of `publish` that may be kept.

    Attributes:
        call: Its number in the session.
        data: The text that would have been recorded, or a state or its copy, to encode later.
        replaced: The value of the column `replaced`, where `data` is a text.
        size_bytes: The memory that it takes, about.
    """

    call: int
    sim_time_s: float
    wall_time_s: float
    data: object
    replaced: str | None
    size_bytes: int

    def encode(self) -> tuple[int, float, float, str, str | None]:
        """Return the row as it would have been recorded."""
        if isinstance(self.data, str):
            return (*self[:3], self.data, self.replaced)
        data = self.data.state() if isinstance(self.data, StateCopy) else self.data
        if isinstance(data, bytes):
            from webots_mcp.bridge.state_pickles import encode_copy

            encoded = encode_copy(data)
        else:
            encoded = encode(data)
        return (*self[:3], encoded.text, encoded.replaced_text)


class Ring:
    """Rows of one run, oldest first; the oldest are forgotten where they are too old or too many.

    Args:
        last_s: Seconds of simulation time that are held.
        most_bytes: The limit of memory in bytes; a single larger row is not held.

    Attributes:
        size_bytes: The memory that the rows take.
        starts_s: The simulation time since which no row is missing.
    """

    def __init__(self, last_s: float, most_bytes: int = MAX_RING_BYTES) -> None:
        self._last_s = last_s
        self._most_bytes = most_bytes
        self._rows: deque[RingRow] = deque()
        self.size_bytes = 0
        self.starts_s = 0.0

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: RingRow) -> None:
        """Add the newest row."""
        rows = self._rows
        rows.append(row)
        self.size_bytes += row.size_bytes
        oldest_s = row.sim_time_s - self._last_s
        while rows and (self.size_bytes > self._most_bytes or rows[0].sim_time_s < oldest_s):
            self._forget_oldest()

    def take(self) -> list[RingRow]:
        """Remove and return all rows."""
        rows = list(self._rows)
        self._rows.clear()
        self.size_bytes = 0
        return rows

    def begin(self, starts_s: float) -> None:
        """Empty the ring: from that simulation time on no row is missing."""
        self._rows.clear()
        self.size_bytes, self.starts_s = 0, starts_s

    def _forget_oldest(self) -> None:
        rows = self._rows
        row = rows.popleft()
        self.size_bytes -= row.size_bytes
        self.starts_s = rows[0].sim_time_s if rows else row.sim_time_s
