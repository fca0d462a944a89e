"""The rows of a range as they are, page by page."""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.naming import Value, flatten
from webots_mcp.store.analysis.arrays import np
from webots_mcp.store.reading.deadline import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.snapshot import in_one_snapshot
from webots_mcp.store.signals.catalogue import signals_of
from webots_mcp.store.signals.flatten import parse
from webots_mcp.store.signals.registry import Signal, cleaned

MOST_ROWS: Final = 1000
_STATES: Final = "SELECT id, data FROM state WHERE id IN (SELECT value FROM json_each(?))"
_KEPT_STATES: Final = "SELECT id, data FROM kept_state WHERE id IN (SELECT value FROM json_each(?))"


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
    deadline = Deadline(deadline_s)
    parts: list[Frame] = []
    room, cut = limit + 1, False  # one more, to know whether there is a next page
    for segment in time_range.segments:
        if room <= 0 or cut:
            break
        frame = read_frame(connection, segment, deadline)
        start = _place_after(frame, after_id)
        parts.append(frame.rows(start, start + room))
        room -= len(parts[-1])
        cut = frame.cut_at_s is not None and room > 0
    return _page(connection, time_range, signals, parts, limit, cut=cut)


def _place_after(frame: Frame, after_id: int) -> int:
    """The place of the row after that one; where it is gone, of the first one with a greater id."""
    if after_id == 0:
        return 0
    ids = frame.ids
    at = np.flatnonzero(ids == after_id)
    if len(at):
        return int(at[0]) + 1
    later = np.flatnonzero(ids > after_id)
    return int(later[0]) if len(later) else len(frame)


def _page(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    signals: Sequence[Signal],
    parts: Sequence[Frame],
    limit: int,
    *,
    cut: bool,
) -> Page:
    rows = sum(map(len, parts))
    more = rows > limit or (cut and rows > 0)
    shown = [*parts[:-1], parts[-1].rows(0, len(parts[-1]) - max(0, rows - limit))] if parts else []
    ids = [row_id for part in shown for row_id in part.ids.tolist()]
    states = _states_by_id(connection, ids)
    values: dict[str, list[Value]] = {}
    replaced: dict[str, dict[str, int]] = {}
    for signal in signals:
        name = signal.name
        held = [value for part in shown for value in part.values(name)]
        exact = [  # as recorded, where the rows are there
            states[row_id].get(name) if row_id in states else value
            for row_id, value in zip(ids, held, strict=True)
        ]
        values[name] = cleaned(signal, exact)
        if found := sum((part.replaced(name) for part in shown), Counter[str]()):
            replaced[name] = dict(found)
    return Page(
        time_range.robot,
        [part.run_id for part in shown for _ in range(len(part))],
        ids,
        [time_s for part in shown for time_s in part.times.tolist()],
        [time_s for part in shown for time_s in part.wall_times.tolist()],
        values,
        replaced,
        ids[-1] if more else None,
        (*time_range.notes, *(str(each) for part in shown for each in part.unread)),
        cut,
    )


def _states_by_id(
    connection: sqlite3.Connection, ids: Sequence[int]
) -> dict[int, dict[str, Value]]:
    listed = json.dumps([abs(row_id) for row_id in ids])
    return {
        sign * row_id: flatten(parse(data))
        for query, sign in ((_STATES, 1), (_KEPT_STATES, -1))
        if any(row_id * sign > 0 for row_id in ids)
        for row_id, data in connection.execute(query, (listed,))
    }
