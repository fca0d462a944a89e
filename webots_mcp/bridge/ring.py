"""The ring buffer: the last seconds of calls that were not recorded, in bounded memory."""

from __future__ import annotations

import sys
from collections import deque
from typing import Final, NamedTuple

from webots_mcp.bridge.encoding import encode_copy

MAX_RING_BYTES: Final = 8_000_000
_ROW_BYTES: Final = 400  # of a row in addition to its state: a tuple, three numbers, its place


class RingRow(NamedTuple):
    """A call of `publish` that may be kept.

    Attributes:
        call: Its number in the session.
        data: The text that would have been recorded, or a copy of the state to encode later.
        replaced: The value of the column `replaced`, where `data` is a text.
    """

    call: int
    sim_time_s: float
    wall_time_s: float
    data: str | bytes
    replaced: str | None

    @property
    def size_bytes(self) -> int:
        """The approximate memory that it takes."""
        replaced_bytes = sys.getsizeof(self.replaced) if self.replaced else 0
        return _ROW_BYTES + sys.getsizeof(self.data) + replaced_bytes

    def encode(self) -> RingRow:
        """The row as it would have been recorded."""
        if isinstance(self.data, str):
            return self
        encoded = encode_copy(self.data)
        return RingRow(*self[:3], encoded.text, encoded.replaced_text)


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
        self._rows: deque[tuple[int, RingRow]] = deque()
        self.size_bytes = 0
        self.starts_s = 0.0

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: RingRow) -> None:
        """Add the newest row."""
        size_bytes = row.size_bytes
        self._rows.append((size_bytes, row))
        self.size_bytes += size_bytes
        oldest_s = row.sim_time_s - self._last_s
        while self._rows and (
            self.size_bytes > self._most_bytes or self._rows[0][1].sim_time_s < oldest_s
        ):
            self._forget_oldest()

    def take(self) -> list[RingRow]:
        """Remove and return all rows."""
        rows = [row for _, row in self._rows]
        self._rows.clear()
        self.size_bytes = 0
        return rows

    def begin(self, starts_s: float) -> None:
        """Empty the ring; rows are complete from that simulation time on."""
        self._rows.clear()
        self.size_bytes, self.starts_s = 0, starts_s

    def _forget_oldest(self) -> None:
        size_bytes, row = self._rows.popleft()
        self.size_bytes -= size_bytes
        self.starts_s = self._rows[0][1].sim_time_s if self._rows else row.sim_time_s
