"""Kept stretches: seconds of a run of which each call of `publish` is a row.

The rows that only they have stand in `kept_state`, apart from those that the throttle let through.
A range inside a stretch is answered from both. In a longer one means and counts are those of the
rows that were let through, of which there are equally many in each second; what is about single
states (extremes, changes, conditions) takes in both.
"""

from __future__ import annotations

import math
import sqlite3
from typing import Final, NamedTuple

from webots_mcp.store.chunks import SIM_TIMES, Decoded, groups_in, values_in

MOST_STRETCHES: Final = 200  # newest of a range that are looked at
MOST_ROWS: Final = 30_000  # of a range that is answered from each call
_NAMED: Final = 2

_IS_NUMBER: Final = "IN ('real', 'integer')"
_STRETCHES: Final = (
    "SELECT start_sim_time_s, end_sim_time_s, CAST(reason AS TEXT), wall_time_s FROM kept_stretch "
    "WHERE run_id = ? AND end_sim_time_s >= ? AND start_sim_time_s < ? "
    f"AND typeof(start_sim_time_s) {_IS_NUMBER} AND typeof(end_sim_time_s) {_IS_NUMBER} "
    "ORDER BY start_sim_time_s DESC LIMIT ?"
)
# Of a stretch that was not ended, up to when its rows are there, which are written in order; and
# whether rows that the throttle let through follow each other after that. NULL where it is whole.
_WRITTEN: Final = (
    "SELECT CASE WHEN (SELECT count(*) FROM (SELECT 1 FROM state WHERE run_id = :run "
    "AND sim_time_s > time_s AND sim_time_s <= :end LIMIT 2)) = 2 THEN time_s END FROM ("
    "SELECT coalesce(max(sim_time_s), :start) AS time_s FROM kept_state "
    "WHERE run_id = :run AND sim_time_s BETWEEN :start AND :end) "
    "WHERE EXISTS (SELECT 1 FROM run r JOIN session s ON s.id = r.session_id "
    "WHERE r.id = :run AND r.last_sim_time_s < :end AND s.throttle_interval > 1)"
)
_IN: Final = "WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ?"
_ANY: Final = f"SELECT EXISTS (SELECT 1 FROM {{table}} {_IN})"
_COUNT: Final = f"SELECT count(*) FROM (SELECT 1 FROM {{table}} {_IN} LIMIT {MOST_ROWS + 1})"


class KeptStretch(NamedTuple):
    """From when to when, and why; `wall_time_s` is when it was asked for."""

    start_s: float
    end_s: float
    reason: str
    wall_time_s: float


def kept_stretches(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> list[KeptStretch]:
    """The stretches that touch [start_s, end_s) of a run, in order, as far as they are written."""
    rows = connection.execute(_STRETCHES, (run_id, start_s, end_s, MOST_STRETCHES)).fetchall()
    return [_as_written(connection, run_id, KeptStretch(*row)) for row in reversed(rows)]


def newest_kept(connection: sqlite3.Connection, run_id: int) -> KeptStretch | None:
    """The stretch of a run that begins last."""
    row = connection.execute(_STRETCHES, (run_id, -math.inf, math.inf, 1)).fetchone()
    return row and _as_written(connection, run_id, KeptStretch(*row))


def _as_written(connection: sqlite3.Connection, run_id: int, stretch: KeptStretch) -> KeptStretch:
    """A controller that is killed leaves a stretch whose first rows are there, and not the last."""
    values = {"run": run_id, "start": stretch.start_s, "end": stretch.end_s}
    (until_s,) = connection.execute(_WRITTEN, values).fetchone() or (None,)
    if until_s is None:
        return stretch
    reason = f"{stretch.reason}; rows after {until_s:.3f} s are not written"
    return stretch._replace(end_s=until_s, reason=reason)


def kept_parts(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> list[KeptStretch]:
    """Of those the ones that have rows of their own."""
    found = kept_stretches(connection, run_id, start_s, end_s)
    spans = [(each, each.start_s, _after(each.end_s)) for each in found]  # the last row is in it
    return [each for each, *span in spans if _any(connection, "kept_state", run_id, *span)]


def is_at_full_rate(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> bool:
    """Whether [start_s, end_s) holds nothing but rows of one stretch, and not too many of them."""
    for each in kept_parts(connection, run_id, start_s, end_s):
        outside = ((start_s, each.start_s), (_after(each.end_s), end_s))
        if not any(
            _any(connection, "state", run_id, *span) or _any_in_chunks(connection, run_id, *span)
            for span in outside
        ):
            bounds = (run_id, start_s, end_s)
            counts = [
                connection.execute(_COUNT.format(table=table), bounds).fetchone()[0]
                for table in ("state", "kept_state")
            ]
            return counts[1] > 0 and sum(counts) <= MOST_ROWS
    return False


def kept_notes(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> list[str]:
    """Which parts of a range are kept at full rate, and why."""
    found = kept_parts(connection, run_id, start_s, end_s)
    if not found:
        return []
    named = [f"{each.start_s:.3f}-{each.end_s:.3f} s ({each.reason})" for each in found[-_NAMED:]]
    more = f", and {len(found) - _NAMED} before" if len(found) > _NAMED else ""
    return [f"run {run_id} is kept at full rate: {', '.join(named)}{more}"]


def _any(
    connection: sqlite3.Connection, table: str, run_id: int, start_s: float, end_s: float
) -> bool:
    query = _ANY.format(table=table)
    return bool(connection.execute(query, (run_id, start_s, end_s)).fetchone()[0])


def _any_in_chunks(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> bool:
    """Whether a row is there that may have been deleted since it was put into a chunk."""
    groups = groups_in(connection, run_id, start_s, end_s) if start_s < end_s else []
    if any(group.start_s >= start_s or group.end_s < end_s for group in groups):
        return True
    wanted = {group.id: group.row_count for group in groups}
    times = (values for _, values in values_in(connection, run_id, SIM_TIMES, wanted))
    return any(
        bool(((each.numbers >= start_s) & (each.numbers < end_s)).any())
        for each in times
        if isinstance(each, Decoded)
    )


def _after(time_s: float) -> float:
    """Beyond what simulation times differ by where a clock adds up steps."""
    return time_s + 1e-9
