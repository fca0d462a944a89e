"""How much each run holds, and about how much room it takes on the disk."""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import KEPT_FRAME
from webots_mcp.store.retention.pages import INDEX_BYTES, disk_shares
from webots_mcp.store.retention.policy import KEPT

TABLES: Final = ("state", "kept_state", "log", "event", "image")
# The frames of a kept stretch count with its states, and go with them.
_OWN: Final = {"image": f"AND kind <> '{KEPT_FRAME}'"}

_RUNS: Final = (
    f"SELECT id, robot_id, row_count, started_wall_time_s, last_wall_time_s, {KEPT}, "
    "ended_wall_time_s IS NULL OR id = (SELECT max(id) FROM run n WHERE n.robot_id = run.robot_id)"
    " AS is_current FROM run WHERE typeof(started_wall_time_s) IN ('real', 'integer') "
    "AND typeof(last_wall_time_s) IN ('real', 'integer') ORDER BY started_wall_time_s, id"
)
_ROWS_BY_RUN: Final = "SELECT run_id, count(*) FROM {table} WHERE 1 {own} GROUP BY run_id"
_ROWS: Final = "SELECT count(*) FROM {table} WHERE run_id = ?"
# Rows of a run in the order of its simulation time are in the order of their ids.
_NTH_ID: Final = (
    "SELECT id FROM {table} WHERE run_id = ? {own} ORDER BY sim_time_s, id LIMIT 1 OFFSET ? - 1"
)
_FIRST_TIME: Final = "SELECT min(sim_time_s) FROM {table} WHERE run_id = ? {own}"
# Any text and any blob is greater than any number.
_LAST_TIME: Final = (
    "SELECT max(sim_time_s) FROM {table} WHERE run_id = ? AND sim_time_s <= 9e999 {own}"
)
_WALL_AT: Final = (
    "SELECT wall_time_s FROM {table} WHERE run_id = ? AND sim_time_s <= ? "
    "AND wall_time_s <= 9e999 {own} ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)
_ROWS_UP_TO: Final = "SELECT count(*) FROM {table} WHERE run_id = ? AND sim_time_s <= ? {own}"
_ROWS_BELOW: Final = "SELECT count(*) FROM {table} WHERE run_id = ? AND id < ? {own}"
_OF_RUNS: Final = "run_id IN (SELECT value FROM json_each(:runs))"
# In the order of their ids: only what goes is looked at, and what lies in between.
_OLDEST: Final = (
    "SELECT run_id, count(*), max(id) FROM (SELECT run_id, id FROM {table} NOT INDEXED "
    f"WHERE id >= :first AND {_OF_RUNS} {{own}} ORDER BY id LIMIT :rows) GROUP BY run_id"
)
_NTH_NEWEST: Final = (
    f"SELECT id FROM {{table}} NOT INDEXED WHERE {_OF_RUNS} {{own}} "
    "ORDER BY id DESC LIMIT 1 OFFSET :rows - 1"
)
_ID_RANGE: Final = "SELECT coalesce(min(id), 0), coalesce(max(id), -1) FROM {table}"
_WINDOW: Final = (
    "SELECT run_id, {payload} FROM {table} NOT INDEXED WHERE id >= ? ORDER BY id LIMIT ?"
)
_FILE_BYTES: Final = "iif(size_bytes BETWEEN 0 AND 1e12, size_bytes, 0)"
_PICTURES: Final = (
    f"SELECT run_id, avg({_FILE_BYTES}) FROM image WHERE kind <> '{KEPT_FRAME}' GROUP BY run_id"
)
_FRAMES: Final = (
    f"SELECT run_id, sum({_FILE_BYTES}) FROM image WHERE kind = '{KEPT_FRAME}' GROUP BY run_id"
)
_COLUMNS: Final = "SELECT name, type, pk FROM pragma_table_info(?)"
_WINDOWS: Final = 32
_WINDOW_ROWS: Final = 40
_BISECTIONS: Final = 50


class Run(NamedTuple):
    """A run as retention sees it."""

    id: int
    robot_id: int
    recorded_rows: int
    started_wall_time_s: float
    last_wall_time_s: float
    is_kept: bool
    is_current: bool


class Holding(NamedTuple):
    """What a run has in one table, and about what a row of it takes."""

    run: Run
    table: str
    rows: int
    row_bytes: float

    @property
    def size_bytes(self) -> float:
        """About what all of it takes."""
        return self.rows * self.row_bytes


class Oldest(NamedTuple):
    """Of a run the oldest rows of a table: how many, and the last id of them."""

    rows: int
    bound: float


def rows_of(query: str, table: str) -> str:
    """A query about the rows of a table that a limit of their own holds for."""
    return query.format(table=table, own=_OWN.get(table, ""))


def read_runs(connection: sqlite3.Connection) -> list[Run]:
    """All runs in the order in which they began.

    A run whose times are no numbers, which no bridge writes, has no place in it: it stays.
    """
    return [Run(*row) for row in connection.execute(_RUNS).fetchall()]


def holdings(connection: sqlite3.Connection, table: str, runs: Sequence[Run]) -> list[Holding]:
    """What these runs have in a table; those that have nothing are left out."""
    rows: dict[int, int] = dict(connection.execute(rows_of(_ROWS_BY_RUN, table)).fetchall())
    row_bytes, usual = _row_bytes(connection, table)
    frame_bytes: dict[int, int] = {}
    if table == "kept_state":
        frame_bytes = dict(connection.execute(_FRAMES).fetchall())
    return [
        Holding(
            run,
            table,
            rows[run.id],
            row_bytes.get(run.id, usual) + frame_bytes.get(run.id, 0) / rows[run.id],
        )
        for run in runs
        if run.id in rows
    ]


def file_sizes(connection: sqlite3.Connection) -> dict[str, int]:
    """Bytes of the database on the disk: the file, what of it is free, and the log next to it."""

    def pragma(name: str) -> int:
        return int(connection.execute(f"PRAGMA {name}").fetchone()[0])

    page_bytes = pragma("page_size")
    sizes = {
        "file_bytes": pragma("page_count") * page_bytes,
        "free_in_file_bytes": pragma("freelist_count") * page_bytes,
    }
    (file,) = connection.execute("SELECT file FROM pragma_database_list").fetchone()
    log = Path(f"{file}-wal")
    return sizes | {"log_beside_bytes": log.stat().st_size if file and log.exists() else 0}


def count_rows(connection: sqlite3.Connection, table: str, run_id: int) -> int:
    """How many rows a run has in a table."""
    return int(connection.execute(_ROWS.format(table=table), (run_id,)).fetchone()[0])


def rows_below(connection: sqlite3.Connection, holding: Holding, row_id: float) -> int:
    """How many of the rows have smaller ids."""
    query = rows_of(_ROWS_BELOW, holding.table)
    return int(connection.execute(query, (holding.run.id, row_id)).fetchone()[0])


def nth_id(connection: sqlite3.Connection, holding: Holding, number: int) -> int:
    """The id of the row of that number, from 1, counted from the oldest."""
    query = rows_of(_NTH_ID, holding.table)
    return int(connection.execute(query, (holding.run.id, number)).fetchone()[0])


def oldest(connection: sqlite3.Connection, held: Sequence[Holding], rows: int) -> dict[int, Oldest]:
    """The oldest rows of all of these together, by run; `held` is of one table."""
    table = held[0].table
    values = {
        "runs": _as_json(held),
        "first": first_id(connection, table, [holding.run.id for holding in held]),
        "rows": rows,
    }
    found = connection.execute(rows_of(_OLDEST, table), values).fetchall()
    return {run_id: Oldest(count, bound) for run_id, count, bound in found}


def first_id(connection: sqlite3.Connection, table: str, run_ids: Sequence[int]) -> int:
    """An id that no row of these runs is below; what kept stretches took over came later."""
    if table == "kept_state":
        return 0
    query = rows_of(_NTH_ID, table)
    found = (connection.execute(query, (run_id, 1)).fetchone() for run_id in run_ids)
    return min((row[0] for row in found if row is not None), default=0)


def nth_newest_id(connection: sqlite3.Connection, held: Sequence[Holding], number: int) -> float:
    """The id of the newest row but `number` - 1 of all of these; below all ids with fewer rows."""
    if number == 0:
        return float("inf")
    values = {"runs": _as_json(held), "rows": number}
    row = connection.execute(rows_of(_NTH_NEWEST, held[0].table), values).fetchone()
    return row[0] if row else 0


def rows_before(connection: sqlite3.Connection, holding: Holding, wall_time_s: float) -> int:
    """How many of the rows are older than that: wall time rises with simulation time."""
    table, run_id = holding.table, holding.run.id

    def is_older(time_s: float) -> bool:
        query = rows_of(_WALL_AT, table)
        row = connection.execute(query, (run_id, time_s)).fetchone()
        return row is not None and row[0] < wall_time_s

    older_s, younger_s = _bounds(connection, table, run_id)
    if older_s is None or younger_s is None:
        return 0
    if is_older(younger_s):
        return holding.rows
    if not is_older(older_s):
        return 0
    for _ in range(_BISECTIONS):
        middle_s = (older_s + younger_s) / 2
        older_s, younger_s = (middle_s, younger_s) if is_older(middle_s) else (older_s, middle_s)
    query = rows_of(_ROWS_UP_TO, table)
    return int(connection.execute(query, (run_id, older_s)).fetchone()[0])


def _as_json(held: Sequence[Holding]) -> str:
    return f"[{','.join(str(holding.run.id) for holding in held)}]"


def _row_bytes(connection: sqlite3.Connection, table: str) -> tuple[dict[int, float], float]:
    """About what a row of each run takes on the disk, and what it usually is."""
    if table == "image":
        means: dict[int, float] = dict(connection.execute(_PICTURES).fetchall())
        return means, 0.0
    page_bytes = int(connection.execute("PRAGMA page_size").fetchone()[0])
    by_run = defaultdict[int, list[float]](list)
    for rows in _windows(connection, table):
        shares = disk_shares([payload for _, payload in rows], page_bytes)
        for (run_id, _), share in zip(rows, shares, strict=True):
            by_run[run_id].append(share + INDEX_BYTES)
    every = [share for shares in by_run.values() for share in shares]
    usual = sum(every) / max(len(every), 1)
    return {run_id: sum(shares) / len(shares) for run_id, shares in by_run.items()}, usual


def _windows(connection: sqlite3.Connection, table: str) -> Iterator[list[Any]]:
    """(run, bytes of the record) of rows that follow each other, in windows over the table."""
    query = _WINDOW.format(table=table, payload=_payload(connection, table))
    first, last = connection.execute(_ID_RANGE.format(table=table)).fetchone()
    if last - first < _WINDOWS * _WINDOW_ROWS:
        yield connection.execute(query, (first, -1)).fetchall()
        return
    for number in range(_WINDOWS):
        start = first + (last - first) * number // _WINDOWS
        yield connection.execute(query, (start, _WINDOW_ROWS)).fetchall()


def _payload(connection: sqlite3.Connection, table: str) -> str:
    """SQL for the bytes of a record: each column takes a byte or two in its head, and its value."""
    parts = ["2"]
    for name, kind, is_key in connection.execute(_COLUMNS, (table,)).fetchall():
        if kind == "TEXT":
            parts.append(f"coalesce(length(CAST({name} AS BLOB)) + 1, 1)")
        elif not is_key:
            parts.append("9" if kind == "FLOAT" else "3")
    return " + ".join(parts)


def _bounds(
    connection: sqlite3.Connection, table: str, run_id: int
) -> tuple[float, float] | tuple[None, None]:
    """Simulation times of the run's first and last row in a table; None where no row has one."""
    first = connection.execute(rows_of(_FIRST_TIME, table), (run_id,)).fetchone()[0]
    last = connection.execute(rows_of(_LAST_TIME, table), (run_id,)).fetchone()[0]
    return (None, None) if last is None else (first, last)
