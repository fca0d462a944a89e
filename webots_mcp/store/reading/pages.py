"""The rows of a range as they are, page by page."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.naming import Value
from webots_mcp.store.reading.deadline import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.reading.ranges import Segment, TimeRange
from webots_mcp.store.reading.rollups import rows_after
from webots_mcp.store.reading.rows import Columns, read_columns
from webots_mcp.store.reading.snapshot import in_one_snapshot
from webots_mcp.store.run_rows import State, fetch_state
from webots_mcp.store.signals.catalogue import signals_of
from webots_mcp.store.signals.registry import Signal

MOST_ROWS: Final = 1000


@dataclass(frozen=True)
class Page:
    """State rows as columns, in order.

    Attributes:
        values: Per signal one value per row; None where the row has none.
        replaced: Per signal, how often each value that JSON cannot hold.
        cursor: Give it as `after_id` for the next page; None after the last row, or where the time
            was over before any was read.
        cut: The time was over: there may be more rows even where none is here.
    """

    robot: str
    run_ids: list[int]
    ids: list[int]
    sim_time_s: list[float]
    wall_time_s: list[float]
    values: dict[str, list[Value]]
    replaced: dict[str, dict[str, int]]
    cursor: int | None
    notes: tuple[str, ...]
    cut: bool = False


@in_one_snapshot
def query_rows(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    names: Sequence[str],
    *,
    limit: int = 50,
    after_id: int = 0,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> Page:
    """The rows of a range with the values of some signals, at most `limit` of them.

    Args:
        connection: Any.
        time_range: From `find_range`.
        names: Signals, with `*`.
        limit: 1 to 1,000.
        after_id: The `cursor` of the page before. Ids never come back, so rows that are recorded
            or deleted meanwhile make no page repeat or miss one.
        deadline_s: After it the page ends early; its cursor goes on from there.

    Raises:
        UnknownSignalError, InvalidInputError: A name meets nothing; `limit` is out of bounds.
    """
    if not 1 <= limit <= MOST_ROWS:
        raise InvalidInputError(f"limit={limit} must be from 1 to {MOST_ROWS}")
    signals = signals_of(connection, time_range, names)
    parts: list[Columns] = []
    room = limit + 1  # one more, to know whether there is a next page
    deadline = Deadline(deadline_s)
    for segment in time_range.segments:
        rest, after = _rest(connection, segment, after_id)
        if rest is not None and room > 0 and not any(part.cut for part in parts):
            parts.append(
                read_columns(
                    connection, rest, signals, deadline, after=after, limit=room, exact=True
                )
            )
            room -= len(parts[-1].ids)
    return _page(time_range, signals, parts, limit, cut=any(part.cut for part in parts))


def _rest(
    connection: sqlite3.Connection, segment: Segment, after_id: int
) -> tuple[Segment | None, int | State]:
    """The part that may have rows after that one, and after what they come.

    At full rate ids do not rise with time: there the row itself has its place.
    """
    if segment.full_rate and after_id == 0:
        return segment, 0
    row = fetch_state(connection, after_id) if segment.full_rate else None
    if row is None or row.run_id != segment.run_id:
        return rows_after(connection, segment, max(after_id, 0)), max(after_id, 0)
    start_s = max(segment.start_s, row.sim_time_s)
    return (replace(segment, start_s=start_s) if start_s < segment.end_s else None), row


def _page(
    time_range: TimeRange, signals: Sequence[Signal], parts: list[Columns], limit: int, *, cut: bool
) -> Page:
    ids = [row_id for part in parts for row_id in part.ids]
    replaced: dict[str, Counter[str]] = {}
    for part in parts:
        for name, counts in part.replaced.items():
            replaced.setdefault(name, Counter()).update(counts)
    more = (cut or len(ids) > limit) and bool(ids)
    return Page(
        time_range.robot,
        [part.run_id for part in parts for _ in part.ids][:limit],
        ids[:limit],
        [time_s for part in parts for time_s in part.times][:limit],
        [time_s for part in parts for time_s in part.walls][:limit],
        {s.name: [v for part in parts for v in part.values[s.name]][:limit] for s in signals},
        {name: dict(counts) for name, counts in replaced.items()},
        ids[:limit][-1] if more else None,
        time_range.notes,
        cut,
    )
