"""What is found where 500 s of a run are over, and stored with their rollups.

Swings show in all rows only, for which a question about hours has no time.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.reading.rows import Columns, read_columns
from webots_mcp.store.reading.sampling import ACROSS_S, STRETCH_ROWS, newest_part
from webots_mcp.store.rollup.buckets import COARSE_S
from webots_mcp.store.rollup.swings import ACROSS_S, STRETCH_ROWS, SwingsToStore
from webots_mcp.store.signals.registry import Signal, registered

FINDINGS: Final = ("swings",)  # columns of the table
MOST_ROWS: Final = 100_000  # in 500 s: of more a maintainer had to read too much at once
_LONGEST_S: Final = 60.0  # that it reads


def findings_to_store(
    connection: sqlite3.Connection, run_id: int, robot_id: int, bucket: int, rows: Mapping[int, int]
) -> list[dict[int, str]]:
    """What is stored of a coarse bucket in each of the columns, by the ids of its signals.

    Nothing where rows of it are missing, which were purged, or where it has too many.

    Args:
        connection: Any.
        run_id: Of which run.
        robot_id: Of which robot.
        bucket: The number of the bucket, of 500 s.
        rows: How many of its rows each signal is in.
    """
    known = registered(connection, robot_id)
    here = {name: signal for name, signal in known.items() if signal.id in rows}
    swings = SwingsToStore(here.values())
    signals = list(swings.signals)
    segment = Segment(run_id, bucket * COARSE_S, (bucket + 1) * COARSE_S)
    most = max(rows.values(), default=0)
    left = 0
    if signals and most <= MOST_ROWS:
        for columns, own_rows in _stretches(connection, segment, signals):
            left += own_rows
            swings.add(columns)
    return [swings.stored() if 0 < most <= left else {}]


def _stretches(
    connection: sqlite3.Connection, segment: Segment, signals: Sequence[Signal]
) -> Iterator[tuple[Columns, int]]:
    """Its rows and some before them, the newest first, and how many of them are its own."""
    deadline = Deadline(_LONGEST_S)
    left = segment
    while left.end_s > left.start_s:
        part = newest_part(connection, left, STRETCH_ROWS)
        reached_s = part.start_s
        whole = replace(part, start_s=reached_s - ACROSS_S)
        columns = read_columns(connection, whole, signals, deadline)
        if columns.cut:
            return
        yield columns, sum(time_s >= reached_s for time_s in columns.times)
        left = replace(left, end_s=reached_s)
