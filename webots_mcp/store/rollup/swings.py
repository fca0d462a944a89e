"""Swings of what a robot swings with: found where 500 s are over, and stored with their rollups.

They show in all rows of a signal only, for which a question about hours has no time.
"""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, replace
from typing import Final

from webots_mcp.store.analysis.features import unwrap
from webots_mcp.store.analysis.swings import LEAST_HALF_SWINGS, Swing, find_swings, joined_swings
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.reading.rows import Numbers, numbers_of, read_columns
from webots_mcp.store.reading.sampling import newest_part
from webots_mcp.store.rollup.buckets import COARSE, COARSE_BUCKETS, COARSE_S, by_grain
from webots_mcp.store.signals.registry import Signal, registered
from webots_mcp.units import in_snake_case

LONGEST_PERIOD_S: Final = 5.0
ACROSS_S: Final = 20.0  # of the stretch beside: longer than six half swings of that period
STRETCH_ROWS: Final = 10_000  # that are searched at once
MOST_SIGNALS: Final = 20  # of which swings are stored
MOST_ROWS: Final = 100_000  # in 500 s: of more a maintainer had to read too much at once
_LONGEST_S: Final = 60.0  # that it reads

# Sensors swing by nature while a robot drives.
_SWINGING: Final = re.compile(
    r"(^|[._])(heading|yaw|roll|pitch|theta|bearing|steer\w*|wheels?|motors?|speed|velocity|pose|position"
    r"|left|right|cmd|command\w*|error)([._]|$)",
    re.IGNORECASE,
)
_STORED: Final = (
    "SELECT swings FROM coarse_rollup WHERE run_id = ? AND signal_id = ? "
    "AND bucket >= ? AND bucket < ? AND present > 0 ORDER BY bucket"
)


def may_swing(signal: Signal) -> bool:
    """Whether it is named like something that a robot swings with."""
    return signal.is_number and _SWINGING.search(in_snake_case(signal.name)) is not None


def swings_in(numbers: Numbers, signal: Signal, half_swings: int, period_s: float) -> list[Swing]:
    """The swings of a signal in rows one after the other, of so many half swings at least."""
    times, values = numbers.of(signal.name)
    values = unwrap(values, signal.turn) if signal.turn else values
    return find_swings(times, values, least_half_swings=half_swings, longest_period_s=period_s)


def swings_to_store(
    connection: sqlite3.Connection, run_id: int, robot_id: int, bucket: int, rows: Mapping[int, int]
) -> dict[int, str]:
    """What is stored of a coarse bucket, by the ids of its signals.

    Nothing where rows of it are missing, which were purged, or where it has too many.

    Args:
        connection: Any.
        run_id: Of which run.
        robot_id: Of which robot.
        bucket: The number of the bucket, of 500 s.
        rows: How many of its rows each signal is in.
    """
    known = registered(connection, robot_id).values()
    signals = [signal for signal in known if signal.id in rows and may_swing(signal)]
    segment = Segment(run_id, bucket * COARSE_S, (bucket + 1) * COARSE_S)
    most = max(rows.values(), default=0)
    if not signals or most > MOST_ROWS:
        return {}
    found: dict[str, list[Swing]] = {}
    left = 0
    for numbers, own_rows in _stretches(connection, segment, signals[:MOST_SIGNALS]):
        left += own_rows
        for name in numbers.values:
            signal = next(each for each in signals if each.name == name)
            swings = swings_in(numbers, signal, LEAST_HALF_SWINGS, LONGEST_PERIOD_S)
            found.setdefault(name, []).extend(swings)
    if left < most:
        return {}
    return {
        signal.id: json.dumps([astuple(swing) for swing in joined_swings(found[signal.name])])
        for signal in signals[:MOST_SIGNALS]
        if signal.id is not None
    }


def _stretches(
    connection: sqlite3.Connection, segment: Segment, signals: Sequence[Signal]
) -> Iterator[tuple[Numbers, int]]:
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
        yield numbers_of(columns, signals), sum(time_s >= reached_s for time_s in columns.times)
        left = replace(left, end_s=reached_s)


def stored_swings(
    connection: sqlite3.Connection, segment: Segment, span: range, signals: Sequence[Signal]
) -> tuple[range, dict[str, list[Swing]]]:
    """The swings that are stored of signals, and of which coarse buckets all of them are.

    Args:
        connection: Any.
        segment: Of which run.
        span: Buckets of 10 s that lie inside of what is asked for.
        signals: Which; those that have to be searched are left out.
    """
    coarse = next(
        (part for grain, part in by_grain(connection, segment.run_id, span) if grain is COARSE),
        range(0),
    )
    found: dict[str, list[Swing]] = {}
    for signal in signals:
        asked = (segment.run_id, signal.id, coarse.start, coarse.stop)
        texts = [text for (text,) in connection.execute(_STORED, asked)]
        if coarse and None not in texts:
            found[signal.name] = [Swing(*each) for text in texts for each in json.loads(text)]
    return range(coarse.start * COARSE_BUCKETS, coarse.stop * COARSE_BUCKETS), found
