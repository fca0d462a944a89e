"""Where a condition held in recorded rows, one stretch after the other."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.conditions import Condition, Evaluator
from webots_mcp.errors import ConditionFailedError, InvalidInputError
from webots_mcp.naming import Value
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.kept import kept_parts
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.signals.flatten import parse

_IN: Final = (
    "WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ? "
    "AND wall_time_s >= ? AND wall_time_s < ?"
)
_ROWS: Final = f"SELECT sim_time_s, data FROM state {_IN} ORDER BY sim_time_s, id"
_EVERY_ROW: Final = (  # each part comes in the order of its index
    f"SELECT sim_time_s, wall_time_s, data FROM state {_IN} UNION ALL "
    f"SELECT sim_time_s, wall_time_s, data FROM kept_state {_IN} ORDER BY sim_time_s, wall_time_s"
)
_SOME_BEFORE: Final = (  # what was there last, for `changed` and `rate`
    "SELECT min(sim_time_s) FROM (SELECT sim_time_s FROM state WHERE run_id = ? "
    "AND sim_time_s < ? ORDER BY sim_time_s DESC LIMIT 20)"
)
_RECORDED: Final = (
    "SELECT s.throttle_interval, EXISTS (SELECT 1 FROM event WHERE run_id = r.id "
    "AND kind = 'dropped') FROM run r JOIN session s ON s.id = r.session_id WHERE r.id = ?"
)

Row = tuple[float, Any]


@dataclass
class Stretch:
    """Rows, one after the other, in all of which a condition held.

    Attributes:
        values: Its signals in the first of them.
        rows: How many there are.
    """

    start_s: float
    end_s: float
    values: dict[str, Value]
    rows: int = 1


@dataclass
class Held:
    """What was found in a segment.

    Attributes:
        reached_s: The simulation time of the last row that was looked at; None without any.
        cut: The deadline passed; later rows were not looked at.
        never_there: What the condition reads and no row had a value of.
    """

    stretches: list[Stretch]
    rows: int = 0
    reached_s: float | None = None
    cut: bool = False
    never_there: set[str] | None = None


def where_held(
    connection: sqlite3.Connection, segment: Segment, condition: Condition, deadline: Deadline
) -> Held:
    """The stretches of a segment in which a condition held.

    Rows before it are read as far as the condition remembers.

    Raises:
        InvalidInputError: The values are not of the kinds that it can be asked of.
    """
    (before_s,) = connection.execute(_SOME_BEFORE, (segment.run_id, segment.start_s)).fetchone()
    known_from_s = segment.start_s if before_s is None else before_s
    from_s = min(known_from_s, segment.start_s - condition.remembers_s)
    bounds = (segment.run_id, from_s, segment.end_s, segment.wall_start_s, segment.wall_end_s)
    held = Held([])
    evaluator = condition.evaluator()
    if kept_parts(connection, segment.run_id, from_s, segment.end_s):
        every = connection.execute(_EVERY_ROW, bounds * 2)
        rows = _within(((time_s, data) for time_s, _, data in every), deadline, held, evaluator)
    else:
        rows = _within(connection.execute(_ROWS, bounds), deadline, held, evaluator)
    try:
        held.stretches += stretches_in(rows, condition, segment.start_s)
    except ConditionFailedError as error:
        place = f"in run {segment.run_id}, after {held.reached_s or from_s:.3f} s"
        raise InvalidInputError(f"{error} ({place})") from None
    return held


def _within(
    rows: Iterable[tuple[float, str]], deadline: Deadline, held: Held, reading: Evaluator
) -> Iterator[Row]:
    for time_s, data in rows:
        if held.rows % 500 == 499 and deadline.passed:
            held.cut = True
            return
        state = parse(data)
        if held.never_there is None:
            held.never_there = reading.lacks(state)
        elif held.never_there:
            held.never_there &= reading.lacks(state)
        yield time_s, state
        held.rows += 1
        held.reached_s = time_s


def stretches_in(rows: Iterable[Row], condition: Condition, from_s: float) -> Iterator[Stretch]:
    """Where a condition held in rows; those before `from_s` are for its memory alone.

    Raises:
        ConditionFailedError: See `Evaluator.holds`.
    """
    evaluator, stretch = condition.evaluator(), None
    for time_s, state in rows:
        if not evaluator.holds(state, time_s) or time_s < from_s:
            if stretch is not None:
                yield stretch
            stretch = None
        elif stretch is None:
            stretch = Stretch(time_s, time_s, evaluator.values(state))
        else:
            stretch.end_s, stretch.rows = time_s, stretch.rows + 1
    if stretch is not None:
        yield stretch


def recorded_share(connection: sqlite3.Connection, run_id: int) -> str:
    """How many of the published states a run's rows are, in a sentence."""
    return unrecorded(connection, run_id) or "every publish() call is a row, so nothing was missed"


def unrecorded(connection: sqlite3.Connection, run_id: int) -> str | None:
    """What of the published states is not in a run's rows; None where all of them are."""
    row = connection.execute(_RECORDED, (run_id,)).fetchone()
    interval, dropped = row or (None, False)  # of a robot that cannot be read nothing is known
    if interval == 1:
        return "rows were dropped, so their values are missing" if dropped else None
    fewer = "rows may be fewer than publish() calls"
    share = f"one publish() call in {interval} is a row" if interval else fewer
    share += " and some were dropped" if dropped else ""
    return f"{share}: what happened in between is not seen"
