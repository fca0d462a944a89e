"""Notes on what a range asks for and the recording does not have."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator
from typing import Final

from webots_mcp.store.reading.moments import moment_of

_ROW_IN: Final = (
    "SELECT 1 FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ? LIMIT 1"
)
_LAST_BEFORE: Final = "SELECT max(sim_time_s) FROM state WHERE run_id = ? AND sim_time_s < ?"
_FIRST_FROM: Final = "SELECT min(sim_time_s) FROM state WHERE run_id = ? AND sim_time_s >= ?"

# Of the rows of a throttled recording those that a breakpoint's hit let through: so many at least,
# and how many rows there are, counted no further than matters.
_HITS: Final = (
    "SELECT count(*) FROM (SELECT 1 FROM event WHERE run_id = :run AND sim_time_s >= :start "
    "AND sim_time_s < :end AND kind = 'breakpoint' GROUP BY sim_time_s LIMIT :most)"
)
_ROWS: Final = (
    "SELECT count(*) FROM (SELECT 1 FROM state WHERE run_id = :run AND sim_time_s >= :start "
    "AND sim_time_s < :end LIMIT :most)"
)
_IS_THROTTLED: Final = (
    "SELECT 1 FROM run r JOIN session s ON s.id = r.session_id "
    "WHERE r.id = ? AND s.throttle_interval > 1"
)
_RECORDED: Final = (
    "SELECT s.throttle_interval, EXISTS (SELECT 1 FROM event WHERE run_id = r.id "
    "AND kind = 'dropped') FROM run r JOIN session s ON s.id = r.session_id WHERE r.id = ?"
)
_MOST_HITS: Final = 1000
_LEAST_ROWS_PER_HIT: Final = 200  # fewer than 0.5 % of the rows hardly move a mean


def row_before(connection: sqlite3.Connection, run_id: int, sim_time_s: float) -> float | None:
    """The time of a run's newest row before a time; None where there is none."""
    before_s: float | None = connection.execute(_LAST_BEFORE, (run_id, sim_time_s)).fetchone()[0]
    return before_s


def coverage_notes(
    connection: sqlite3.Connection,
    run_id: int,
    span: tuple[float, float],
    recorded: tuple[float, float],
) -> Iterator[str]:
    """Notes on [start, end) of a run that was recorded from the first to the newest time."""
    (start_s, end_s), (first_s, newest_s) = span, recorded
    run = f"run {run_id}"
    if end_s <= first_s:
        yield f"no row: the range ends before the first row of {run} at {first_s:g} s"
    elif start_s > newest_s:
        yield f"no row: the range begins after the newest row of {run} at {newest_s:g} s"
    else:
        if start_s < moment_of(first_s):
            yield f"the recording of {run} begins at {first_s:g} s, within the range"
        if end_s > math.nextafter(newest_s, math.inf):
            yield f"the recording of {run} ends at {newest_s:g} s, within the range"
        yield from _gap_notes(connection, run_id, start_s, end_s)


def _gap_notes(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> Iterator[str]:
    """That the range lies between two rows."""
    if connection.execute(_ROW_IN, (run_id, start_s, end_s)).fetchone():
        return
    before_s = row_before(connection, run_id, start_s)
    after_s = connection.execute(_FIRST_FROM, (run_id, end_s)).fetchone()[0]
    if before_s is not None and after_s is not None:
        yield f"no row: nothing was recorded between {before_s:g} and {after_s:g} s of run {run_id}"


def hit_notes(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> Iterator[str]:
    """That means lean towards the rows that a breakpoint's hits have added to a throttled run."""
    if connection.execute(_IS_THROTTLED, (run_id,)).fetchone() is None:
        return
    values = {"run": run_id, "start": start_s, "end": end_s, "most": _MOST_HITS}
    (hits,) = connection.execute(_HITS, values).fetchone()
    values["most"] = _LEAST_ROWS_PER_HIT * hits
    (rows,) = connection.execute(_ROWS, values).fetchone()
    if hits and rows < _LEAST_ROWS_PER_HIT * hits:
        yield (
            f"up to {hits} of {rows} rows of run {run_id} were recorded because a breakpoint was "
            "hit: means and counts are biased towards them"
        )


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
