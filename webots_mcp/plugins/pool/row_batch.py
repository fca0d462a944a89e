"""Rows of one table that are written together, bounded in bytes: memory is bounded as well."""

from __future__ import annotations

import math
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


def nearest(value: SQLValue, kind: type, *, nullable: bool) -> SQLValue:
    """The value of a type that comes nearest to one that SQLite holds."""
    if value is None:
        return None if nullable else kind()
    if kind is str:
        text = value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
        return text.encode("utf-8", "surrogatepass").decode("utf-8", "replace")
    if kind is bytes:
        return value if isinstance(value, bytes) else None
    number = number_in(value)
    if number is None:
        return None if nullable else kind()
    if kind is float:
        return float(number)
    if math.isfinite(number) and abs(number) < 2**63:
        return int(number)
    return None if nullable else 0


def number_in(value: SQLValue) -> int | float | None:
    """The number that it is, or says; None of what is none."""
    if isinstance(value, int | float):
        return value
    try:
        return float(value or "")
    except ValueError:
        return None


def row_bytes(row: Row) -> int:
    """About how many bytes of memory a row's values take."""
    sized = sum([len(value) for value in row if isinstance(value, _SIZED)])
    return sized + _VALUE_BYTES * len(row)
