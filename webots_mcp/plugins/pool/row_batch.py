"""Rows of one table that are written together, bounded in bytes: memory is bounded as well."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.plugins.pool.shipped_tables import SQLValue, Table

BATCH_BYTES: Final = 4_000_000
BATCH_ROWS: Final = 20_000
_VALUE_BYTES: Final = 8
_SIZED: Final = (str, bytes)

Row = tuple[SQLValue, ...]


@dataclass(frozen=True)
class Batch:
    """Rows in the order of the table's columns, with the values that SQLite holds.

    JSON is text, a flag 0 or 1. SQLite may hold any type in any column: what a target cannot hold
    it turns into what comes nearest, and counts.
    """

    table: Table
    rows: Sequence[Row]


def batches(table: Table, rows: Iterable[Row]) -> Iterator[Batch]:
    """Rows as batches of bounded size; a row that is larger by itself is a batch of its own."""
    held: list[Row] = []
    size = 0
    for row in rows:
        added = row_bytes(row)
        if held and (size + added > BATCH_BYTES or len(held) >= BATCH_ROWS):
            yield Batch(table, held)
            held, size = [], 0
        held.append(row)
        size += added
    if held:
        yield Batch(table, held)


def row_bytes(row: Row) -> int:
    """About how many bytes of memory a row's values take."""
    sized = sum([len(value) for value in row if isinstance(value, _SIZED)])
    return sized + _VALUE_BYTES * len(row)
