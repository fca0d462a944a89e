"""Rows of recordings as batches, and back from a pool of either kind."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from webots_mcp.plugins.pool.pool_contents import open_pool
from webots_mcp.plugins.pool.pool_interface import (
    Batch,
    PoolRow,
    Shipment,
    ShippedTable,
    SQLValue,
    batches,
    table,
    tables,
)
from webots_mcp.store.chunks import SIM_TIMES, EncodedChunk, Statistics, decode

UUID = "0e7f2b1c-0000-4000-8000-000000000001"
OTHER_UUID = "0e7f2b1c-0000-4000-8000-000000000002"
_OF_CHUNK = table("chunk").columns


def uuid_of(recording: sqlite3.Connection) -> str:
    return str(recording.execute("SELECT uuid FROM recording").fetchone()[0])


def rows_of(recording: sqlite3.Connection, each: ShippedTable) -> list[PoolRow]:
    """As SQLite has them, in the order of the key."""
    columns = ", ".join(f'"{name}"' for name in each.columns)
    query = f"SELECT {columns} FROM {each.name} ORDER BY {', '.join(each.key)}"
    return recording.execute(query).fetchall()


def all_batches(recording: sqlite3.Connection) -> Iterator[Batch]:
    for each in tables():
        yield from batches(each, rows_of(recording, each))


def recorded(recording: sqlite3.Connection) -> dict[str, Any]:
    """All of a recording by table, as `pooled` gives it of a pool."""
    return {each.name: _comparable(each, rows_of(recording, each)) for each in tables()}


@contextmanager
def shipping(url: str | Path, uuid: str = UUID) -> Generator[Shipment]:
    with open_pool(str(url), ships=True) as pool, pool.shipment(uuid) as shipment:
        yield shipment


class BeforeWrite:
    """A pool to ship to, or its shipment, of which something is done before each transaction."""

    def __init__(self, inner: Any, happens: Callable[[], object]) -> None:
        self._inner, self._happens = inner, happens

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def __enter__(self) -> BeforeWrite:
        self._inner.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        self._inner.__exit__(*exception)

    @contextmanager
    def shipment(self, uuid: str) -> Generator[Any]:
        with self._inner.shipment(uuid) as shipment:
            yield BeforeWrite(shipment, self._happens)

    def write(self, *arguments: Any) -> Any:
        self._happens()
        return self._inner.write(*arguments)


def ship(recording: sqlite3.Connection, url: str) -> None:
    """All of a recording in one write."""
    with shipping(url, uuid_of(recording)) as shipment:
        shipment.write(list(all_batches(recording)), {"shipped": 1})


def pooled_rows(
    url: str | Path, uuid: str, name: str, where: Mapping[str, Collection[int]] | None = None
) -> list[PoolRow]:
    """Rows of a table as the pool gives them, in the order of the key."""
    each = table(name)
    with open_pool(str(url)) as pool:
        found = [row for batch in pool.rows(uuid, each, where or {}) for row in batch.rows]
    places = [each.columns.index(column) for column in each.key]
    return sorted(found, key=lambda row: [str(row[at]).rjust(20) for at in places])


def pooled(url: str | Path, uuid: str) -> dict[str, Any]:
    """All that a pool has of a recording, by table."""
    with open_pool(str(url)) as pool:
        found = {
            each: [row for part in pool.rows(uuid, each, {}) for row in part.rows]
            for each in tables()
        }
    return {each.name: _comparable(each, rows) for each, rows in found.items()}


def _comparable(each: ShippedTable, rows: Iterable[PoolRow]) -> Any:
    """In the order of the key; chunks by what they hold, since Parquet packs them anew."""
    if each.name == "chunk":
        return chunk_values(rows)
    places = [each.columns.index(column) for column in each.key]
    return sorted(rows, key=lambda row: [str(row[at]).rjust(20) for at in places])


def chunk_values(rows: Iterable[PoolRow]) -> dict[tuple[int, int], Any]:
    """Of each group and signal what the rows of `chunk` say: statistics, and a value for each row.

    A row has a number, a label, or `Ellipsis` where its state lacks the signal.
    """
    chunks: list[dict[str, Any]] = [dict(zip(_OF_CHUNK, row, strict=True)) for row in rows]
    lengths = {c["group_id"]: c["row_count"] for c in chunks if c["signal_id"] == SIM_TIMES}
    found: dict[tuple[int, int], Any] = {}
    for chunk in chunks:
        packed = EncodedChunk(*(chunk[name] for name in EncodedChunk._fields))
        values = decode(packed, lengths[chunk["group_id"]])
        codes = np.zeros(len(values.numbers), int) if values.codes is None else values.codes
        labels = [(type(each), each) for each in values.labels]
        listed = [
            repr(number) if code == 0 else [..., *labels][code - 1]
            for number, code in zip(values.numbers.tolist(), codes.tolist(), strict=True)
        ]
        figures = tuple(chunk[name] for name in Statistics._fields)
        found[chunk["group_id"], chunk["signal_id"]] = (chunk["run_id"], figures, listed)
    assert len(found) == len(chunks)
    return found


def batch(name: str, *rows: Mapping[str, SQLValue]) -> Batch:
    """Rows of a table, with the least of values where nothing is said."""
    each = table(name)
    least: dict[str, SQLValue] = {
        column: "{}" if column in each.json_columns else kind()
        for column, kind in zip(each.columns, each.types, strict=True)
        if column not in each.nullable
    }
    full: list[dict[str, SQLValue]] = [{**least, "id": 1, **row} for row in rows]
    return Batch(each, [tuple(row.get(column) for column in each.columns) for row in full])


def logs(*ids: int, wall_time_s: float = 1_700_000_000.0, message: str = "driving") -> Batch:
    """Rows of `log` with these ids, a second apart."""
    rows: list[dict[str, SQLValue]] = [
        {
            "id": row_id, "run_id": 1, "sim_time_s": float(row_id),
            "wall_time_s": wall_time_s + row_id, "level": "info", "message": f"{message} {row_id}",
        }
        for row_id in ids
    ]  # fmt: skip
    return batch("log", *rows)


def run_row(row_id: int, rows: int) -> dict[str, SQLValue]:
    return {"id": row_id, "session_id": 1, "robot_id": 1, "row_count": rows,
            "uuid": f"run-{row_id}"}  # fmt: skip
