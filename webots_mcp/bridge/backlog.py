"""Rows that could not be written yet."""

from __future__ import annotations

from collections import deque
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.run import Run

MAX_WAITING_ROWS: Final = 10_000
MAX_WAITING_BYTES: Final = 16_000_000

Values = tuple[Any, ...] | dict[str, Any]


class Row(NamedTuple):
    """A statement that writes one row, and the run that the row belongs to."""

    statement: str
    run: Run | None
    values: Values


class Backlog:
    """The rows that wait, oldest first.

    Any thread may add at the end; the rest belongs to the thread that holds the recorder's lock.
    """

    def __init__(self) -> None:
        self.rows: deque[Row] = deque()
        self._bytes = 0

    def add(self, row: Row) -> None:
        """Keep the newest row."""
        self.rows.append(row)
        self._bytes += _weight(row)

    def add_first(self, row: Row) -> None:
        """Keep a row that is to be written before all others."""
        self.rows.appendleft(row)
        self._bytes += _weight(row)

    def oldest(self, most: int) -> list[Row]:
        """The rows to be written next; they stay until they are removed."""
        return [self.rows[i] for i in range(min(len(self.rows), most))]

    def remove_oldest(self) -> Row:
        """Take the oldest row out."""
        row = self.rows.popleft()
        self._bytes -= _weight(row)
        return row

    def is_over_limit(self) -> bool:
        """Whether more waits than may."""
        return len(self.rows) > MAX_WAITING_ROWS or self._bytes > MAX_WAITING_BYTES


def bind(run: Run | None, values: Values) -> Values:
    """The parameters of a row's statement, with what is known of its run by now.

    Positional ones begin with the run's id; named ones may use `run` and `rows`.
    """
    if run is None:
        return values
    if isinstance(values, tuple):
        return (run.id, *values)
    return {"run": run.id, "rows": run.rows, **values}


def _weight(row: Row) -> int:
    """About the bytes that a waiting row holds: its texts."""
    values = row.values if isinstance(row.values, tuple) else row.values.values()
    return 200 + sum(len(value) for value in values if isinstance(value, str))
