"""Rows of recordings as batches, and back."""

from __future__ import annotations

import sqlite3
from collections.abc import Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

from webots_mcp.plugins.pool.parquet_pool import ParquetPool, ParquetShipment, ParquetTarget
from webots_mcp.plugins.pool.pool_interface import (
    Batch,
    Row,
    SQLValue,
    Table,
    batches,
    table,
    tables,
)

parquet: Any = import_module("pyarrow.parquet")  # it has no types

OTHER_UUID = "0e7f2b1c-0000-4000-8000-000000000002"
UUID = "0e7f2b1c-0000-4000-8000-000000000001"


def uuid_of(file: Path) -> str:
    with closing(sqlite3.connect(file)) as connection:
        return str(connection.execute("SELECT uuid FROM recording").fetchone()[0])


def rows_of(file: Path, each: Table) -> list[Row]:
    """As SQLite has them, in the order of the key."""
    columns, key = ", ".join(each.columns), ", ".join(each.key)
    select = f"SELECT {columns} FROM {each.name}"
    with closing(sqlite3.connect(file)) as connection:
        return connection.execute(f"{select} ORDER BY {key}").fetchall()


def batches_of(file: Path) -> Iterator[Batch]:
    """All of a recording."""
    for each in tables():
        yield from batches(each, rows_of(file, each))


def ship(file: Path, url: str) -> None:
    """All of a recording in one write."""
    with ParquetTarget(url) as target:
        target.prepare()
        with target.shipment(uuid_of(file)) as shipment:
            shipment.write(list(batches_of(file)), {})


def pooled(
    url: str, uuid: str, name: str, where: Mapping[str, tuple[int, ...]] | None = None
) -> list[Row]:
    """Rows of a table as the pool gives them, in the order of the key."""
    each = table(name)
    places = [each.columns.index(column) for column in each.key]
    with ParquetPool(url) as pool:
        found = [row for batch in pool.rows(uuid, each, where or {}) for row in batch.rows]
    if name == "chunk":  # they are made anew, and have no ids
        return found
    return sorted(found, key=lambda row: [f"{row[at]:>20}" for at in places])


@contextmanager
def shipping(url: str | Path, uuid: str = UUID) -> Generator[ParquetShipment]:
    with ParquetTarget(str(url)) as target:
        target.prepare()
        with target.shipment(uuid) as shipment:
            yield shipment


def batch(name: str, *rows: Mapping[str, SQLValue]) -> Batch:
    each = table(name)
    return Batch(each, [tuple(row.get(column) for column in each.columns) for row in rows])


def logs(*ids: int, wall_time_s: float = 1_700_000_000.0, message: str = "driving") -> Batch:
    """Rows of `log` with these ids, a second apart."""
    rows: list[dict[str, SQLValue]] = [
        {
            "id": row_id, "run_id": 1, "sim_time_s": float(row_id),
            "wall_time_s": wall_time_s + row_id, "level": "info", "source": "controller",
            "message": f"{message} {row_id}",
        }
        for row_id in ids
    ]  # fmt: skip
    return batch("log", *rows)


def globbed(folder: Path, name: str) -> list[dict[str, Any]]:
    """What somebody reads who knows nothing but the names of the files."""
    files = sorted(folder.glob(f"recording=*/table={name}/**/*.parquet"))
    return [row for file in files for row in records(file)]


def records(file: Path | BytesIO) -> list[dict[str, Any]]:
    """The rows of one file."""
    return parquet.ParquetFile(file).read().to_pylist()
