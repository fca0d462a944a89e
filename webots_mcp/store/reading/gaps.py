"""Recording gaps: where the next row came much later than the rows usually do."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Final

from webots_mcp.store.analysis.arrays import median, np
from webots_mcp.store.analysis.rhythm import (
    GAP_INTERVALS,
    Gap,
    Rhythm,
    gaps_in,
    interruptions,
    usual_interval_s,
)
from webots_mcp.store.reading.coverage import purged_until_s
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.rollup.buckets import BUCKET_S, FINE, Grain, bucket_of

_SAMPLE_ROWS: Final = 2000
_ROWS_AROUND: Final = 20  # before and after a stretch: they tell what is usual
_MOST_BUCKETS: Final = 300  # of a long stretch that are looked into row by row

_TIMES: Final = (  # answered by the index alone
    "SELECT sim_time_s FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ? "
    "ORDER BY sim_time_s LIMIT ?"
)
_BEFORE: Final = (
    "SELECT sim_time_s FROM state WHERE run_id = ? AND sim_time_s < ? "
    "ORDER BY sim_time_s DESC LIMIT ?"
)
# The signal that is in most rows shows how many a bucket has, and its first and last time.
_IN_MOST_ROWS: Final = (
    "FROM {table} WHERE run_id = :run AND bucket >= :first AND bucket < :end AND signal_id = "
    "(SELECT id FROM signal s WHERE robot_id = (SELECT robot_id FROM run WHERE id = :run) "
    "AND EXISTS (SELECT 1 FROM all_rollup WHERE run_id = :run AND signal_id = s.id) "
    "ORDER BY s.rows - s.null_row_count DESC LIMIT 1)"
)
_BUCKETS: Final = (
    f"SELECT bucket, rows, first_sim_time_s, last_sim_time_s {_IN_MOST_ROWS} ORDER BY bucket"
)
_THERE: Final = f"SELECT bucket {_IN_MOST_ROWS.format(table=FINE.table)} ORDER BY bucket"
# A gap between two buckets reaches half its length into one of them.
_LACKING: Final = (
    f"SELECT bucket {_IN_MOST_ROWS.format(table=FINE.table)} AND (rows < :least "
    f"OR first_sim_time_s IS NULL OR first_sim_time_s - bucket * {BUCKET_S} > :margin_s "
    f"OR (bucket + 1) * {BUCKET_S} - last_sim_time_s > :margin_s) ORDER BY bucket"
)


def with_rows_around(connection: sqlite3.Connection, segment: Segment) -> Segment:
    """The segment with some rows before and after it: a gap at its end, or all around it, shows."""
    before = connection.execute(_BEFORE, (segment.run_id, segment.start_s, _ROWS_AROUND)).fetchall()
    after = _times(connection, segment.run_id, segment.end_s, math.inf, _ROWS_AROUND)
    start_s = before[-1][0] if before else segment.start_s
    end_s = math.nextafter(after[-1], math.inf) if after else segment.end_s
    return Segment(segment.run_id, start_s, end_s)


def rhythm_in(connection: sqlite3.Connection, segment: Segment) -> Rhythm:
    """The rhythm of a long segment, from the rollups: rows are read only where some are missing.

    The median is that of the first 2,000 rows, of purged ones that of their buckets. Where more
    than 300 buckets lack rows, recording is irregular rather than interrupted, and within the
    others only whole missing buckets count.
    """
    interval_s = _usual_interval_s(connection, segment)
    if interval_s is None:
        return Rhythm(None, ())
    irregular = _irregular(connection, segment, interval_s)
    parts = [segment] if len(irregular) > _MOST_BUCKETS else irregular
    gaps = [gap for part in parts for gap in _gaps(connection, part, interval_s)]
    return Rhythm(interval_s, interruptions(tuple(dict.fromkeys(gaps))))


def _usual_interval_s(connection: sqlite3.Connection, segment: Segment) -> float | None:
    sample = _times(connection, segment.run_id, segment.start_s, segment.end_s, _SAMPLE_ROWS)
    interval_s = usual_interval_s(sample)
    is_purged = purged_until_s(connection, segment.run_id, segment.start_s) is not None
    if interval_s is not None or not is_purged:
        return interval_s
    intervals = [
        (last_s - first_s) / (rows - 1)
        for _, rows, first_s, last_s in _counted(connection, segment.run_id, FINE, _span(segment))
        if rows > 1 and first_s is not None
    ]
    return median(np.array(intervals)) if intervals else None


def hidden_gaps(
    connection: sqlite3.Connection, segment: Segment, until_s: float, interval_s: float
) -> list[tuple[float, float]]:
    """Between which times rows were missing in a bucket whose rows were purged since.

    Args:
        connection: Any.
        segment: What is asked for.
        until_s: The rows before that time were purged.
        interval_s: At which rows usually came. Of n rows n - 2 such intervals and the gap fit.
    """
    purged = replace(segment, end_s=min(segment.end_s, until_s))
    return [
        (first_s, last_s)
        for _, rows, first_s, last_s in _counted(connection, segment.run_id, FINE, _span(purged))
        if first_s is not None and last_s - first_s > (rows - 2 + GAP_INTERVALS) * interval_s
    ]


def _span(segment: Segment) -> range:
    """The buckets that the segment touches."""
    return range(bucket_of(segment.start_s), bucket_of(segment.end_s) + 1)


def _irregular(
    connection: sqlite3.Connection, segment: Segment, interval_s: float
) -> list[Segment]:
    """The parts in which a gap may be: around buckets that lack rows, or one at their border."""
    run_id, span = segment.run_id, _span(segment)
    values = {
        **_bounds(run_id, span),
        "least": _least_rows(interval_s),
        "margin_s": GAP_INTERVALS / 2 * interval_s,
    }
    there = [bucket for (bucket,) in connection.execute(_THERE, values)]
    lacking = [(bucket, bucket) for (bucket,) in connection.execute(_LACKING, values)]
    missing = [(a, b) for a, b in pairwise(there) if b - a > 1]
    edges = [
        (span.start, min(there, default=span.stop)),
        (max(there, default=span.start), span.stop),
    ]
    return [
        replace(segment, start_s=max(segment.start_s, a), end_s=min(segment.end_s, b))
        for a, b in _joined(sorted([*lacking, *missing, *edges]))
    ]


def _least_rows(interval_s: float) -> float:
    """With fewer rows a bucket may hold a gap: of n rows n - 2 usual intervals and the gap fit."""
    return BUCKET_S / interval_s - GAP_INTERVALS + 2


def _joined(buckets: Sequence[tuple[int, int]]) -> Iterator[tuple[float, float]]:
    """From and up to when each lies, with two more at both ends; those that then touch are one."""
    start, end = buckets[0]
    for first, last in buckets[1:]:
        if first - end > 4:
            yield (start - 2) * BUCKET_S, (end + 3) * BUCKET_S
            start = first
        end = max(end, last)
    yield (start - 2) * BUCKET_S, (end + 3) * BUCKET_S


def _gaps(connection: sqlite3.Connection, segment: Segment, interval_s: float) -> Iterator[Gap]:
    before: Sequence[float] = ()
    for times, complete in _stretches(connection, segment, interval_s):
        yield from gaps_in((*before[-1:], times[0]), interval_s)
        yield from () if complete else gaps_in(times, interval_s)
        before = times


def _stretches(
    connection: sqlite3.Connection, segment: Segment, interval_s: float
) -> Iterator[tuple[Sequence[float], bool]]:
    """Times in order: the ends of each bucket that is complete, all times of another."""
    run_id, reached_s, looked = segment.run_id, segment.start_s, 0
    span = range(bucket_of(segment.start_s) + 1, bucket_of(segment.end_s))
    for bucket, rows, first_s, last_s in _counted(connection, run_id, FINE, span):
        start_s, end_s = bucket * BUCKET_S, (bucket + 1) * BUCKET_S
        if start_s > reached_s and (head := _times(connection, run_id, reached_s, start_s)):
            yield head, False
        complete = rows >= _least_rows(interval_s) or looked >= _MOST_BUCKETS
        looked += not complete
        reached_s = end_s
        if complete and first_s is not None:
            yield (first_s, last_s), True
            continue
        times = _times(connection, run_id, start_s, end_s)
        if first_s is not None and (not times or first_s < times[0]):  # purged: `hidden_gaps`
            yield (first_s, times[0] if times else last_s), True
        if times:
            yield times, False
    if foot := _times(connection, run_id, reached_s, segment.end_s):
        yield foot, False


def rows_by_bucket(
    connection: sqlite3.Connection, run_id: int, grain: Grain, span: range
) -> dict[int, int]:
    """How many rows each bucket has in the rollups: also of a signal that not all of them hold."""
    return {bucket: rows for bucket, rows, *_ in _counted(connection, run_id, grain, span)}


def _counted(
    connection: sqlite3.Connection, run_id: int, grain: Grain, span: range
) -> list[tuple[int, int, Any, Any]]:
    """Bucket, rows, and the times of the first and last value; None where there is no value."""
    query = _BUCKETS.format(table=grain.table)
    return connection.execute(query, _bounds(run_id, span)).fetchall()


def _bounds(run_id: int, span: range) -> dict[str, float]:
    return {"run": run_id, "first": span.start, "end": span.stop}


def _times(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float, limit: int = -1
) -> list[float]:
    rows = connection.execute(_TIMES, (run_id, start_s, end_s, limit))
    return [time_s for (time_s,) in rows]
