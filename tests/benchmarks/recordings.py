"""The recordings that questions about the past are asked of."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Final

from tests.recordings.long import CYCLE_S, INTERVAL_S, build
from tests.recordings.rover import WALL_START_S
from webots_mcp.connection import connect
from webots_mcp.store.chunk_making import make_chunks

LINE_INTERVAL_S: Final = 1.0
_PART_ROWS: Final = 16 * round(CYCLE_S / INTERVAL_S)  # whole cycles: the story goes on at a seam
_ROLLED_ROWS: Final = 100_000
_REPEAT: Final = (
    "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) "
    "SELECT run_id, round(sim_time_s + :later_s, 3), wall_time_s + :later_s, data "
    "FROM state WHERE id <= :rows ORDER BY id"
)
_END_RUN: Final = (
    "UPDATE run SET row_count = :rows, last_sim_time_s = :sim_s, last_wall_time_s = :wall_s, "
    "ended_wall_time_s = :wall_s"
)
_LOG: Final = (
    "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message) "
    "VALUES (1, ?, ?, 'info', 'controller', ?)"
)


def record(file: Path, rows: int) -> None:
    """One run of that many rows, in chunks, with a log line a second; every 97th tells of slip.

    Only the first 50,000 rows are made one by one. The others repeat their texts.
    """
    build(file, min(rows, _PART_ROWS), chunked=False)
    with closing(connect(file, "writer")) as connection:
        connection.execute("BEGIN IMMEDIATE")
        _lengthen(connection, rows)
        lines = range(int(end_s(rows) / LINE_INTERVAL_S))
        connection.executemany(_LOG, map(_log_line, lines))
        connection.execute("COMMIT")
        while not make_chunks(connection, _ROLLED_ROWS).done:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        while not make_chunks(connection, _ROLLED_ROWS).done:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()


def end_s(rows: int) -> float:
    """Simulation time of the row after the last."""
    return rows * INTERVAL_S


def _lengthen(connection: sqlite3.Connection, rows: int) -> None:
    for there in range(_PART_ROWS, rows, _PART_ROWS):
        values = {"later_s": end_s(there), "rows": min(_PART_ROWS, rows - there)}
        connection.execute(_REPEAT, values)
    last_s = end_s(rows - 1)
    ended = {"rows": rows, "sim_s": round(last_s, 3), "wall_s": WALL_START_S + last_s}
    connection.execute(_END_RUN, ended)


def _log_line(number: int) -> tuple[float, float, str]:
    time_s = number * LINE_INTERVAL_S
    what = "wheel slip" if number % 97 == 0 else "waypoint reached, turning to the next"
    return time_s, WALL_START_S + time_s, f"{what} ({number})"
