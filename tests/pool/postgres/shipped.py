"""Recordings in a PostgreSQL pool, and what a pool has to hold of one."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from typing import Any
from uuid import UUID

from tests.postgres import Server
from webots_mcp.plugins.pool.pool_interface import Batch, Table, batches, tables
from webots_mcp.plugins.pool.postgres_pool import PostgresTarget


def uuid_of(recording: sqlite3.Connection) -> str:
    return str(recording.execute("SELECT uuid FROM recording").fetchone()[0])


def rows_of(recording: sqlite3.Connection, table: Table) -> list[tuple[Any, ...]]:
    """What a recording has of a table, in the order of its key."""
    columns = ", ".join(f'"{each}"' for each in table.columns)
    query = f"SELECT {columns} FROM {table.name} ORDER BY {', '.join(table.key)}"
    return recording.execute(query).fetchall()


def all_batches(recording: sqlite3.Connection) -> Iterator[Batch]:
    for table in tables():
        yield from batches(table, rows_of(recording, table))


def ship(server: Server, pool: str, recording: sqlite3.Connection) -> None:
    """Ship all of a recording, at full rate."""
    uuid = uuid_of(recording)
    with PostgresTarget(server.url(pool)) as target, target.shipment(uuid) as shipment:
        shipment.write(list(all_batches(recording)), {"shipped": 1})


def pooled_rows(server: Server, pool: str, uuid: str, table: Table) -> list[tuple[Any, ...]]:
    columns = ", ".join(f'"{each}"' for each in table.columns)
    return server.execute(
        pool,
        f"SELECT {columns} FROM {table.name} WHERE recording_uuid = %s "
        f"ORDER BY {', '.join(table.key)}",
        UUID(uuid),
    )


def parsed(table: Table, rows: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    """Rows of SQLite with JSON as the values that it stands for."""
    return [
        tuple(
            json.loads(value) if column in table.json_columns and value is not None else value
            for column, value in zip(table.columns, row, strict=True)
        )
        for row in rows
    ]


def assert_equal(server: Server, pool: str, recording: sqlite3.Connection) -> None:
    """Every row of a recording is in the pool as it was, and no other is."""
    for table in tables():
        found = pooled_rows(server, pool, uuid_of(recording), table)
        assert found == parsed(table, rows_of(recording, table)), table.name
