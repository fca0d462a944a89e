"""A recording as it is shipped: read in short transactions, a bounded piece at a time.

No read transaction lasts while a pool is written to: the log of the database could not be cut back
meanwhile, and the robot's disk would fill up because a server is slow.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Sequence
from hashlib import blake2b
from typing import Any, Final, NamedTuple

from webots_mcp.errors import DatabaseError
from webots_mcp.plugins.pool.row_batch import (
    BATCH_BYTES,
    BATCH_ROWS,
    Batch,
    Row,
    row_bytes,
)
from webots_mcp.plugins.pool.shipped_tables import SQLValue, Table, table
from webots_mcp.store.chunks import reached

CHUNK_ROWS: Final = 32
GROUPS_AT_ONCE: Final = 64
_UUID: Final = "SELECT uuid FROM recording LIMIT 2"
_RUNS: Final = "SELECT id, uuid FROM run"
_SESSIONS: Final = "SELECT id, session_id FROM run"
_ENDED: Final = "SELECT id FROM run WHERE ended_wall_time_s IS NOT NULL"
_SEQUENCE: Final = "SELECT coalesce(max(seq), 0) FROM sqlite_sequence WHERE name = ?"
_LAST: Final = "SELECT coalesce(max(id), 0) FROM {table}"
# Up to the first that somebody is still making: its id is not looked at again later.
_COMPLETE: Final = (
    "SELECT coalesce((SELECT min(id) - 1 FROM row_group WHERE is_complete = 0), "
    "(SELECT max(id) FROM row_group), 0)"
)
_IN_NO_CHUNK: Final = (
    "SELECT count(*) FROM state WHERE run_id = ? AND (sim_time_s, id) > (?, ?) AND id > ?"
)
_STRETCHES: Final = (
    "SELECT k.id, k.run_id, k.start_sim_time_s, k.end_sim_time_s, u.ended_wall_time_s IS NOT NULL "
    "FROM kept_stretch k JOIN run u ON u.id = k.run_id ORDER BY k.id"
)
_IN_STRETCH: Final = (
    "SELECT {columns} FROM state WHERE run_id = ? AND sim_time_s BETWEEN ? AND ? "
    "AND id > ? AND id <= ? ORDER BY id"
)
_PICTURES: Final = (
    "SELECT id, run_id, path FROM image WHERE id > ? AND id <= ? ORDER BY id LIMIT 100"
)


class Stretch(NamedTuple):
    """Seconds that are kept at full rate; `is_over` where their run has ended."""

    id: int
    run_id: int
    start_sim_time_s: float
    end_sim_time_s: float
    is_over: bool

    def holds(self, run_id: SQLValue, sim_time_s: SQLValue) -> bool:
        """Whether a state is one of them."""
        is_time = isinstance(sim_time_s, int | float)
        return (
            is_time
            and run_id == self.run_id
            and (self.start_sim_time_s <= sim_time_s <= self.end_sim_time_s)
        )


class Source:
    """A connection to a recording, and which of its runs are another's to ship.

    Args:
        connection: A reader.
    """

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        connection.text_factory = _text
        self.foreign = set[int]()
        self._foreign_sessions = set[int]()

    def uuid(self) -> str:
        """The recording's.

        Raises:
            DatabaseError: It has none, or several.
        """
        rows = self._connection.execute(_UUID).fetchall()
        if len(rows) != 1 or not isinstance(rows[0][0], str) or not rows[0][0]:
            raise DatabaseError(
                f"the recording has {len(rows) or 'no'} UUIDs, by which a pool tells recordings "
                "apart: import it into a new one ('webots-mcp import FILE --data-dir NEW') and "
                "ship that"
            )
        return rows[0][0]

    def runs(self) -> dict[int, str | None]:
        """The UUIDs of the runs; those that an old version has recorded have none."""
        return dict(self._connection.execute(_RUNS).fetchall())

    def leave_out(self, runs: set[int]) -> None:
        """These runs are another's to ship, and sessions that have no others are as well."""
        self.foreign = runs
        sessions = dict(self._connection.execute(_SESSIONS).fetchall() if runs else ())
        ours = {session for run_id, session in sessions.items() if run_id not in runs}
        self._foreign_sessions = set(sessions.values()) - ours

    def ended_runs(self) -> set[int]:
        """The runs that are over."""
        return {run_id for (run_id,) in self._connection.execute(_ENDED)}

    def sequence(self, table: Table) -> int:
        """The largest id that a row of the table ever had."""
        last = self._first(_LAST.format(table=table.name))
        return max(last, self._first(_SEQUENCE, table.name))

    def in_one_moment(self, read: Callable[[], bool]) -> bool:
        """Read several things from one state of the database."""
        self._connection.execute("BEGIN")
        try:
            return read()
        finally:
            self._connection.execute("COMMIT")

    def last_id(self, table: Table) -> int:
        """The largest id in the table now; 0 where it is empty."""
        return self._first(_LAST.format(table=table.name))

    def row(self, table: Table, row_id: int) -> Row | None:
        """One row of an appended table; None where retention has deleted it."""
        query = f"SELECT {', '.join(table.columns)} FROM {table.name} WHERE id = ?"
        return self._connection.execute(query, (row_id,)).fetchone()

    def appended(self, table: Table, after: int, upto: int) -> tuple[Batch, int, int]:
        """The next rows of an appended table.

        Returns:
            Those that are ours to ship; the last id that was looked at; how many rows were there.
        """
        query = (
            f"SELECT {', '.join(table.columns)} FROM {table.name} "
            "WHERE id > ? AND id <= ? ORDER BY id"
        )
        rows, is_all = self._some(query, (after, upto))
        last = upto if is_all else int(str(rows[-1][0]))
        return Batch(table, self.ours(table, rows)), last, len(rows)

    def chunk(self, table: Table, number: int) -> list[Row]:
        """The rows of a changing table whose ids lie in that chunk; all where it has no ids."""
        columns = ", ".join(table.columns)
        if table.key != ("id",):
            rows = self._connection.execute(f"SELECT {columns} FROM {table.name}").fetchall()
        else:
            query = f"SELECT {columns} FROM {table.name} WHERE id >= ? AND id < ? ORDER BY id"
            bounds = (number * CHUNK_ROWS, (number + 1) * CHUNK_ROWS)
            rows = self._connection.execute(query, bounds).fetchall()
        return self.ours(table, rows)

    def chunks(self, table: Table, since: int) -> range:
        """The numbers of the chunks from the one that holds that id on."""
        if table.key != ("id",):
            return range(1)
        return range(since // CHUNK_ROWS, self.last_id(table) // CHUNK_ROWS + 1)

    def last_group(self) -> int:
        """The id of the last row group up to which all are complete."""
        return self._first(_COMPLETE)

    def groups(self, after: int, upto: int) -> Iterator[tuple[int, list[Batch]]]:
        """The next row groups by their ids, each with its chunks; nothing of another's runs."""
        groups, chunks = table("row_group"), table("chunk")
        query = f"SELECT {', '.join(groups.columns)} FROM row_group WHERE id > ? AND id <= ?"
        of_group = f"SELECT {', '.join(chunks.columns)} FROM chunk WHERE group_id = ? ORDER BY id"
        found = self._connection.execute(
            f"{query} ORDER BY id LIMIT ?", (after, upto, GROUPS_AT_ONCE)
        )
        for group in found.fetchall():
            rows = self._connection.execute(of_group, group[:1]).fetchall()
            both = (groups, self.ours(groups, [group])), (chunks, self.ours(chunks, rows))
            yield int(group[0]), [Batch(*each) for each in both]

    def in_no_chunk(self, shipped: int) -> int:
        """How many states after that one are in no row group, of the runs that are ours to ship."""
        found = 0
        for run_id in self.runs().keys() - self.foreign:
            at = reached(self._connection, run_id)
            found += self._first(_IN_NO_CHUNK, run_id, at.end_s, at.last_state_id, shipped)
        return found

    def stretches(self) -> list[Stretch]:
        """Kept stretches of the runs that are ours to ship."""
        found = map(Stretch._make, self._connection.execute(_STRETCHES).fetchall())
        return [stretch for stretch in found if stretch.run_id not in self.foreign]

    def kept(self, stretch: Stretch, after: int, upto: int) -> tuple[Batch, bool]:
        """The next states of a kept stretch, and whether they are all."""
        states = table("state")
        query = _IN_STRETCH.format(columns=", ".join(states.columns))
        bounds = (stretch.start_sim_time_s, stretch.end_sim_time_s)
        rows, is_all = self._some(query, (stretch.run_id, *bounds, after, upto))
        return Batch(states, rows), is_all

    def pictures(self, after: int, upto: int) -> list[tuple[int, int, str]]:
        """The next pictures: their ids, runs and paths."""
        return self._connection.execute(_PICTURES, (after, upto)).fetchall()

    def ours(self, table: Table, rows: Sequence[Row]) -> list[Row]:
        """Without what belongs to runs and sessions of another recording, or refers to them."""
        rows = _without(table, rows, table.run_column, self.foreign)
        return _without(table, rows, table.session_column, self._foreign_sessions)

    def _some(self, query: str, values: tuple[Any, ...]) -> tuple[list[Row], bool]:
        """Rows up to a bounded size, and whether they are all; the transaction is over then."""
        rows: list[Row] = []
        size = 0
        cursor = self._connection.execute(query, values)
        try:
            for row in cursor:
                rows.append(row)
                size += row_bytes(row)
                if size >= BATCH_BYTES or len(rows) >= BATCH_ROWS:
                    return rows, False
            return rows, True
        finally:
            cursor.close()

    def _first(self, query: str, *values: object) -> int:
        return int(self._connection.execute(query, values).fetchone()[0])


def _without(table: Table, rows: Sequence[Row], column: str | None, foreign: set[int]) -> list[Row]:
    """Rows whose column names none of these; what outlasts them names nothing then."""
    if column is None or not foreign:
        return list(rows)
    at = table.columns.index(column)
    if table.outlasts_runs:
        return [(*row[:at], None, *row[at + 1 :]) if row[at] in foreign else row for row in rows]
    return [row for row in rows if row[at] not in foreign]


def digest(rows: Sequence[Sequence[SQLValue]]) -> int:
    """A number that other rows have with a chance of one in 2**63."""
    text = repr([tuple(row) for row in rows]).encode("utf-8", "surrogatepass")
    return int.from_bytes(blake2b(text, digest_size=8).digest(), "big") >> 1


def _text(value: bytes) -> str:
    """Bytes that are no UTF-8, which another program has written, are read as what comes near."""
    return value.decode("utf-8", "replace")
