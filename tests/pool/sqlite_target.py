"""A pool in one SQLite file: the smallest that keeps what `Target` promises."""

from __future__ import annotations

import fcntl
import sqlite3
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from webots_mcp.errors import PoolBusyError, PoolError, PoolUnavailableError
from webots_mcp.plugins.pool.pool_interface import (
    LISTED,
    Batch,
    PooledSize,
    SQLValue,
    Table,
    batches,
    tables,
)
from webots_mcp.store.questions.sql import Result, query_sql


class SQLiteTarget:
    """As `open_target` gives one, for a file; it calls `before_write` before each transaction."""

    def __init__(self, file: Path, before_write: Callable[[], object] = lambda: None) -> None:
        self._before_write = before_write
        self.address = f"sqlite:{file}"
        self._file = file
        self._connection: sqlite3.Connection

    def __enter__(self) -> SQLiteTarget:
        if not self._file.parent.is_dir():
            raise PoolUnavailableError(f"the pool {self.address} does not answer")
        self._connection = sqlite3.connect(self._file, isolation_level=None, timeout=20)
        return self

    def __exit__(self, *exception: object) -> None:
        self._connection.close()

    def prepare(self) -> None:
        try:
            with _transaction(self._connection):
                for table in tables():
                    self._connection.execute(_create(table))
                self._connection.execute(
                    "CREATE TABLE IF NOT EXISTS progress (recording_uuid, name, value, "
                    "PRIMARY KEY (recording_uuid, name))"
                )
                self._connection.execute(
                    "CREATE TABLE IF NOT EXISTS picture (recording_uuid, path, content, "
                    "PRIMARY KEY (recording_uuid, path))"
                )
        except sqlite3.OperationalError as error:
            raise PoolError(f"the pool {self.address} cannot be written: {error}") from error

    @contextmanager
    def shipment(self, recording_uuid: str) -> Generator[SQLiteShipment]:
        with self._file.with_suffix(f".{recording_uuid}").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise PoolBusyError(f"another ships {recording_uuid}") from error
            yield SQLiteShipment(self._connection, recording_uuid, self._before_write)


class SQLiteShipment:
    def __init__(
        self, connection: sqlite3.Connection, recording: str, before_write: Callable[[], object]
    ) -> None:
        self._before_write = before_write
        self._connection = connection
        self._recording = recording
        self._pictures: list[tuple[str, str, bytes]] = []

    def progress(self) -> dict[str, int]:
        query = "SELECT name, value FROM progress WHERE recording_uuid = ?"
        return dict(self._connection.execute(query, (self._recording,)).fetchall())

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        query = "SELECT uuid, recording_uuid FROM run WHERE recording_uuid <> ?"
        found = dict(self._connection.execute(query, (self._recording,)).fetchall())
        return {uuid: found[uuid] for uuid in run_uuids if uuid in found}

    def write_picture(self, path: str, content: bytes) -> None:
        self._pictures.append((self._recording, path, content))

    def write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> dict[str, int]:
        self._before_write()
        with _transaction(self._connection):
            for batch in batches:
                rows = [(self._recording, *row) for row in batch.rows]
                self._connection.executemany(_write(batch.table), rows)
            told = [(self._recording, *each) for each in progress.items()]
            self._connection.executemany("INSERT OR REPLACE INTO progress VALUES (?, ?, ?)", told)
            pictures, self._pictures = self._pictures, []
            self._connection.executemany(
                "INSERT OR REPLACE INTO picture VALUES (?, ?, ?)", pictures
            )
        return {}


def pooled(file: Path, recording: str) -> dict[str, list[tuple[SQLValue, ...]]]:
    """All rows of a recording that a pool holds, by table, in the order of their keys."""
    connection = sqlite3.connect(file)
    try:
        return {
            table.name: connection.execute(
                f"SELECT {', '.join(table.columns)} FROM {table.name} WHERE recording_uuid = ? "
                f"ORDER BY {', '.join(table.key)}",
                (recording,),
            ).fetchall()
            for table in tables()
        }
    finally:
        connection.close()


def recorded(connection: sqlite3.Connection) -> dict[str, list[tuple[SQLValue, ...]]]:
    """The same of a recording, as a pool of full rate should hold it."""
    return {
        table.name: connection.execute(
            f"SELECT {', '.join(table.columns)} FROM {table.name} ORDER BY {', '.join(table.key)}"
        ).fetchall()
        for table in tables()
    }


@contextmanager
def _transaction(connection: sqlite3.Connection) -> Generator[None]:
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        connection.execute("ROLLBACK")
        raise


def _create(table: Table) -> str:
    key = ", ".join(("recording_uuid", *table.key))
    columns = ", ".join(("recording_uuid", *table.columns))
    return f"CREATE TABLE IF NOT EXISTS {table.name} ({columns}, PRIMARY KEY ({key}))"


def _write(table: Table) -> str:
    columns = ("recording_uuid", *table.columns)
    marks = ", ".join("?" * len(columns))
    insert = f"INSERT INTO {table.name} ({', '.join(columns)}) VALUES ({marks})"
    if table.is_appended:
        return f"{insert} ON CONFLICT DO NOTHING"
    key = ", ".join(("recording_uuid", *table.key))
    changes = ", ".join(
        f"{name} = coalesce(excluded.{name}, {name})"
        if name in table.lasting
        else f"{name} = excluded.{name}"
        for name in table.columns
    )
    return f"{insert} ON CONFLICT ({key}) DO UPDATE SET {changes}"


class SQLitePool:
    """As `open_pool` gives one, for a file that `SQLiteTarget` writes."""

    def __init__(self, file: Path) -> None:
        self.address = f"sqlite:{file}"
        self._connection = sqlite3.connect(file, isolation_level=None)

    def __enter__(self) -> SQLitePool:
        return self

    def __exit__(self, *exception: object) -> None:
        self._connection.close()

    def listed(self, name: str) -> Iterator[tuple[str, Sequence[Any]]]:
        query = f"SELECT recording_uuid, {', '.join(LISTED[name])} FROM {name}"
        for owner, *row in self._connection.execute(query).fetchall():
            yield owner, row

    def sizes(self) -> Iterator[PooledSize]:
        for each in tables():
            (rows,) = self._connection.execute(f"SELECT count(*) FROM {each.name}").fetchone()
            yield PooledSize(each.name, rows, None)

    def progress(self, recording_uuid: str) -> dict[str, int]:
        query = "SELECT name, value FROM progress WHERE recording_uuid = ?"
        return dict(self._connection.execute(query, (recording_uuid,)).fetchall())

    def rows(
        self, recording_uuid: str, table: Table, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        wanted = "".join(
            f" AND {column} IN ({', '.join(map(str, values))})" for column, values in where.items()
        )
        query = (
            f"SELECT {', '.join(table.columns)} FROM {table.name} WHERE recording_uuid = ?{wanted} "
            f"ORDER BY {', '.join(table.key)}"
        )
        return batches(table, self._connection.execute(query, (recording_uuid,)))

    def picture(self, recording_uuid: str, path: str) -> bytes | None:
        query = "SELECT content FROM picture WHERE recording_uuid = ? AND path = ?"
        row = self._connection.execute(query, (recording_uuid, path)).fetchone()
        return row and row[0]

    def select(self, sql: str, max_rows: int) -> Result:
        return query_sql(self._connection, sql, max_rows=max_rows)
