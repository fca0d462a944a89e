"""Some rows of a long segment: one every so often, or the newest."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.reading.rows import RAW_ROWS, Columns, cleaned, extracted, values_at
from webots_mcp.store.signals.registry import Signal

MOST_SAMPLES: Final = 60_000  # about 12 us each
STRETCH_ROWS: Final = 10_000  # that are searched at once
ACROSS_S: Final = 20.0  # of the stretch next to it

_TICKS: Final = (
    "WITH RECURSIVE tick(t) AS (SELECT ? UNION ALL SELECT t + ? FROM tick WHERE t < ?) "
    "SELECT s.id, s.sim_time_s, s.wall_time_s, {extract} FROM tick "
    "JOIN state s ON s.id = (SELECT id FROM state WHERE run_id = ? AND sim_time_s >= t "
    "AND sim_time_s < ? ORDER BY sim_time_s, id LIMIT 1)"
)
_NTH_NEWEST: Final = (
    "SELECT sim_time_s FROM state WHERE run_id = ? AND sim_time_s < ? "
    "ORDER BY sim_time_s DESC LIMIT 1 OFFSET ?"
)


def read_sampled(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    every_s: float,
    deadline: Deadline,
) -> Columns:
    """The first row at or after every `every_s` seconds; fewer if the deadline passes.

    Args:
        connection: Any.
        segment: Of any length.
        signals: Plain ones (`Signal.is_plain`).
        every_s: Simulated seconds.
        deadline: After it no further rows are read.
    """
    paths = tuple(dict.fromkeys(signal.path for signal in signals))
    extract, asked = extracted("s.data", paths)
    query = _TICKS.format(extract=extract)
    ticks = (segment.start_s, every_s, segment.end_s - every_s)
    rows: list[tuple[Any, ...]] = []
    columns = Columns(segment.run_id)
    try:
        with deadline.interrupting(connection):
            parameters = (*ticks, *asked, segment.run_id, segment.end_s)
            rows.extend(connection.execute(query, parameters))
    except sqlite3.OperationalError:
        if not deadline.passed:
            raise
        columns.cut_at_s = rows[-1][1] if rows else segment.start_s
    distinct = list({row[0]: row for row in rows}.values())  # a gap gives one row several times
    *heads, texts = list(zip(*distinct, strict=True)) or [()] * 4
    columns.ids, columns.times, columns.walls = (list(column) for column in heads)
    by_path = values_at(paths, texts)
    columns.values = {signal.name: cleaned(signal, by_path[signal.path]) for signal in signals}
    return columns


def newest_part(connection: sqlite3.Connection, segment: Segment, rows: int = RAW_ROWS) -> Segment:
    """The part of a segment that holds its newest rows, at most so many."""
    found = connection.execute(_NTH_NEWEST, (segment.run_id, segment.end_s, rows)).fetchone()
    if found is None or found[0] < segment.start_s:
        return segment
    return replace(segment, start_s=found[0])
