"""A recording as it is read in order to ship it to a pool."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from hashlib import blake2b
from typing import Final

from webots_mcp.errors import (
    DatabaseError,
)
from webots_mcp.plugins.pool.pool_interface import (
    BATCH_BYTES,
    BATCH_ROWS,
    PoolRow,
    ShippedTable,
    row_bytes,
)

UNCHECKED: Final = -1


class ShippingSource:
    """A recording to ship, without the runs that another recording ships.

    Args:
        connection: Connection in the role "reader".
    """

    def __init__(self, connection: sqlite3.Connection) -> None:
        self.connection = connection
        connection.text_factory = _text
        self.foreign = set[int]()
        self._foreign_sessions = set[int]()

    def uuid(self) -> str:
        """Return the UUID of the recording.

        Raises:
            DatabaseError: It has none, or several.
        """
        rows = self.connection.execute("SELECT uuid FROM recording LIMIT 2").fetchall()
        if len(rows) != 1 or not isinstance(rows[0][0], str) or not rows[0][0]:
            raise DatabaseError(
                f"the recording has {len(rows) or 'no'} UUIDs, by which a pool tells recordings "
                "apart: import it into a new one ('webots-mcp import FILE --data-dir NEW') and "
                "ship that"
            )
        return rows[0][0]

    def number(self, query: str, *values: object) -> int:
        """Return the number that a query yields."""
        return int(self.connection.execute(query, values).fetchone()[0])

    def runs(self) -> dict[int, str | None]:
        """Return the UUIDs of runs by id; runs of old versions have none."""
        return dict(self.connection.execute("SELECT id, uuid FROM run").fetchall())

    def ended_runs(self) -> set[int]:
        """Return the ids of runs that have ended."""
        query = "SELECT id FROM run WHERE ended_wall_time_s IS NOT NULL"
        return {run_id for (run_id,) in self.connection.execute(query)}

    def leave_out(self, runs: set[int]) -> None:
        """Leave out runs that another recording ships, and sessions that have no other runs."""
        self.foreign = runs
        query = "SELECT id, session_id FROM run"
        sessions = dict(self.connection.execute(query).fetchall() if runs else ())
        ours = {session for run_id, session in sessions.items() if run_id not in runs}
        self._foreign_sessions = set(sessions.values()) - ours

    def fingerprint(self, table: ShippedTable, row_id: int) -> int:
        """Return a hash of a row's values; `UNCHECKED` if retention has deleted it."""
        query = f"SELECT {', '.join(table.columns)} FROM {table.name} WHERE id = ?"
        rows = self.connection.execute(query, (row_id,)).fetchall()
        return digest_of_rows(rows) if rows else UNCHECKED

    def rows(self, table: ShippedTable, where: str, *values: object) -> list[PoolRow]:
        """Return the rows to ship of a small part of a table."""
        return self.connection.execute(self._query(table, where), values).fetchall()

    def piece(self, table: ShippedTable, where: str, *values: object) -> tuple[list[PoolRow], bool]:
        """Return rows up to a size limit, and whether they are all."""
        rows: list[PoolRow] = []
        size = 0
        with closing(self.connection.execute(self._query(table, where), values)) as cursor:
            for row in cursor:
                rows.append(row)
                size += row_bytes(row)
                if size >= BATCH_BYTES or len(rows) >= BATCH_ROWS:
                    return rows, False
        return rows, True

    def _query(self, table: ShippedTable, where: str) -> str:
        """Return a query without rows of left-out runs, or without references to them."""
        columns, conditions = [*table.columns], [where]
        others = {table.run_column: self.foreign, table.session_column: self._foreign_sessions}
        for column, foreign in others.items():
            if column is not None and foreign:
                listed = f"({', '.join(map(str, foreign))})"
                if table.outlasts_runs:
                    at = columns.index(column)
                    columns[at] = f"CASE WHEN {column} NOT IN {listed} THEN {column} END"
                else:
                    conditions.append(f"coalesce({column}, 0) NOT IN {listed}")
        order = f" ORDER BY {', '.join(table.key)}"
        return (
            f"SELECT {', '.join(columns)} FROM {table.name} WHERE {' AND '.join(conditions)}{order}"
        )


def _text(stored: bytes) -> str:
    """Decode a text, replacing bytes that are no UTF-8, which other programs may write."""
    return stored.decode("utf-8", "replace")


def digest_of_rows(rows: Sequence[PoolRow]) -> int:
    """Return a hash of rows, which other rows have with a chance of one in 2**63."""
    text = repr([tuple(row) for row in rows]).encode("utf-8", "surrogatepass")
    return int.from_bytes(blake2b(text, digest_size=8).digest(), "big") >> 1
