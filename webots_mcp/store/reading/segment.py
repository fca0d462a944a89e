"""Define what every reader of the past takes: a segment of one run, a deadline, a snapshot.

It also finds the parts of a run that are kept at full rate.
"""

from __future__ import annotations

import contextlib
import functools
import math
import sqlite3
import time
from collections.abc import Callable, Generator
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any, Concatenate, Final, NamedTuple, ParamSpec, TypeVar

from webots_mcp.database.connection import keep_deadline
from webots_mcp.errors import NothingRecordedError
from webots_mcp.store.robots import RobotRecord, resolve_robot, robot_name
from webots_mcp.store.run_rows import RunRecord, current_run, fetch_run

HAS_LOST_ROWS: Final = (  # for a run `r`: rows were deleted whose chunks are deleted, too
    "r.purged_rows > coalesce((SELECT sum(row_count - stored_row_count) FROM row_group "
    "WHERE run_id = r.id AND is_complete = 1), 0)"
)
QUESTION_DEADLINE_S: Final = 2.0
SEARCH_DEADLINE_S: Final = 6.0  # of a search for events, also of that within a check
MOST_ROWS: Final = 30_000  # rows of a range that is answered from each call
_IS_NUMBER: Final = "IN ('real', 'integer')"
_FULL_RATE_SEGMENTS: Final = (
    "SELECT start_sim_time_s, end_sim_time_s, CAST(reason AS TEXT), wall_time_s FROM kept_stretch "
    "WHERE run_id = ? AND end_sim_time_s >= ? AND start_sim_time_s < ? "
    f"AND typeof(start_sim_time_s) {_IS_NUMBER} AND typeof(end_sim_time_s) {_IS_NUMBER} "
    "ORDER BY start_sim_time_s DESC LIMIT ?"
)
_IN: Final = "WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ?"


@dataclass(frozen=True)
class SegmentReading:
    """How segments are read and named.

    Attributes:
        decimals: Decimals of a shown time in seconds.
        steps_per_check: Instructions of SQLite's virtual machine between two checks of a deadline:
            about 0.5 ms.
        full_rate_segments: Newest segments of a range that are checked.
        named: Segments that a note names.
    """

    decimals: int = 3
    steps_per_check: int = 20_000
    full_rate_segments: int = 200
    named: int = 2


_READING: Final = SegmentReading()


def shown_time(time_s: float) -> float:
    """Return a simulation time as answers show it, rounded to the millisecond."""
    return round(time_s, _READING.decimals)


def moment_of(time_s: float) -> float:
    """Return the earliest time that is shown like this one: the real place of a bound."""
    shown_s = shown_time(time_s)
    moment_s = shown_s - 0.5 / 10**_READING.decimals
    while shown_time(moment_s) < shown_s:
        moment_s = math.nextafter(moment_s, math.inf)
    while shown_time(before_s := math.nextafter(moment_s, -math.inf)) >= shown_s:
        moment_s = before_s
    return moment_s


def just_after(time_s: float) -> float:
    """Return the end of a half-open range that includes `time_s` as its last moment."""
    return math.nextafter(time_s, math.inf)


@dataclass(frozen=True)
class Segment:
    """The part of a range that lies in one run: [start_s, end_s) of simulation time.

    The limits in wall time matter while simulation time stood still (a paused simulation).

    Attributes:
        open_start: Whether the start is that of the first row; the range then includes what was
            stored before it (the start of the run, a log line).
        open_end: The same for the newest row: a last log line, the end of the run.
        full_rate: Whether it lies in a full-rate segment, so that each call of `publish` is a row.
    """

    run_id: int
    start_s: float
    end_s: float
    wall_start_s: float = -math.inf
    wall_end_s: float = math.inf
    open_start: bool = False
    open_end: bool = False
    full_rate: bool = False

    def until(self, end_s: float) -> Segment:
        """Return its part before a time."""
        return replace(self, end_s=end_s, open_end=False)

    def through(self, last_s: float) -> Segment:
        """Return its part up to a time, including what is shown with that time."""
        return self.until(moment_of(shown_time(last_s) + 0.001))

    @property
    def holds_from_s(self) -> float:
        """Where the range begins for what is not a state row."""
        return -math.inf if self.open_start else self.start_s

    @property
    def holds_to_s(self) -> float:
        """Where the range ends for what is not a state row."""
        return math.inf if self.open_end else self.end_s


# -- a limit in wall time on what a question may cost ----------------------------------------------


class Deadline:
    """The time by which a question is answered with what is known."""

    def __init__(
        self, limit_s: float = QUESTION_DEADLINE_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._until_s = clock() + limit_s

    def part(self, share: float) -> Deadline:
        """Return a deadline for a part of the work: that share of the remaining time."""
        return Deadline(share * self.left_s, self._clock)

    @property
    def passed(self) -> bool:
        """Whether the time is over."""
        return self._clock() >= self._until_s

    @property
    def left_s(self) -> float:
        """Remaining seconds; 0 once it has passed."""
        return max(0.0, self._until_s - self._clock())

    @contextlib.contextmanager
    def interrupting(self, connection: sqlite3.Connection) -> Generator[None]:
        """Interrupt the connection's statements once the time is over."""
        connection.set_progress_handler(lambda: self.passed, _READING.steps_per_check)
        try:
            yield
        finally:
            keep_deadline(connection)


# -- one state of the database for a whole answer, while a robot records ---------------------------


P = ParamSpec("P")
T = TypeVar("T")


def in_one_snapshot(
    question: Callable[Concatenate[sqlite3.Connection, P], T],
) -> Callable[Concatenate[sqlite3.Connection, P], T]:
    """Let the statements of a question see one state of the database.

    Otherwise rows could move into chunks between two of its statements and count twice. It neither
    waits nor makes another process wait (write-ahead log). A transaction that is already open is
    used.
    """

    @functools.wraps(question)
    def answer(connection: sqlite3.Connection, *args: P.args, **kwargs: P.kwargs) -> T:
        with one_reading(connection):
            if connection.in_transaction:
                return question(connection, *args, **kwargs)
            connection.execute("BEGIN")
            try:
                return question(connection, *args, **kwargs)
            finally:
                connection.execute("COMMIT")

    return answer


_readings: ContextVar[tuple[sqlite3.Connection, dict[Any, Any]] | None] = ContextVar(
    "readings", default=None
)


@contextlib.contextmanager
def one_reading(connection: sqlite3.Connection) -> Generator[None]:
    """Let the parts of a question share what they read, also with an enclosing question."""
    known = _readings.get()
    if known is not None and known[0] is connection:
        yield
        return
    before = _readings.set((connection, {}))
    try:
        yield
    finally:
        _readings.reset(before)


def read_so_far(connection: sqlite3.Connection) -> dict[Any, Any]:
    """Return what the current question has read; nothing outside of a question."""
    known = _readings.get()
    return known[1] if known is not None and known[0] is connection else {}


# -- full-rate segments: seconds of a run of which each call of `publish` is a row -----------------
#
# Rows that only they have are in `kept_state`, apart from those that the throttle let through. A
# range inside such a segment is answered from both. In a longer range, means and counts use the
# rows that were let through, which are evenly spaced; extremes, changes and conditions use both.


class FullRateSegment(NamedTuple):
    """A full-rate segment with its reason; `wall_time_s` is when it was requested."""

    start_s: float
    end_s: float
    reason: str
    wall_time_s: float

    @property
    def after_s(self) -> float:
        """Return a time just after the end, beyond the rounding of clocks that add up steps."""
        return self.end_s + 1e-9


def full_rate_segments(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> list[FullRateSegment]:
    """Return the full-rate segments that overlap [start_s, end_s) of a run, as far as written."""
    rows = connection.execute(
        _FULL_RATE_SEGMENTS, (run_id, start_s, end_s, _READING.full_rate_segments)
    ).fetchall()
    return [_as_written(connection, run_id, FullRateSegment(*row)) for row in reversed(rows)]


def newest_kept(connection: sqlite3.Connection, run_id: int) -> FullRateSegment | None:
    """Return the full-rate segment of a run that begins last."""
    row = connection.execute(_FULL_RATE_SEGMENTS, (run_id, -math.inf, math.inf, 1)).fetchone()
    return row and _as_written(connection, run_id, FullRateSegment(*row))


def _as_written(
    connection: sqlite3.Connection, run_id: int, stretch: FullRateSegment
) -> FullRateSegment:
    """Return full-rate segments up to their last row.

    A killed controller writes only the first rows.
    """
    values = {"run": run_id, "start": stretch.start_s, "end": stretch.end_s}
    # For a segment that was not ended: up to when its rows exist, which are written in order, and
    # whether rows that the throttle let through follow each other after that. NULL if it is
    # complete.
    (until_s,) = connection.execute(
        "SELECT CASE WHEN (SELECT count(*) FROM (SELECT 1 FROM state WHERE run_id = :run "
        "AND sim_time_s > time_s AND sim_time_s <= :end LIMIT 2)) = 2 THEN time_s END FROM ("
        "SELECT coalesce(max(sim_time_s), :start) AS time_s FROM kept_state "
        "WHERE run_id = :run AND sim_time_s BETWEEN :start AND :end) "
        "WHERE EXISTS (SELECT 1 FROM run r JOIN session s ON s.id = r.session_id "
        "WHERE r.id = :run AND r.last_sim_time_s < :end AND s.throttle_interval > 1)",
        values,
    ).fetchone() or (None,)
    if until_s is None:
        return stretch
    reason = f"{stretch.reason}; rows after {until_s:.3f} s are not written"
    return stretch._replace(end_s=until_s, reason=reason)


def full_rate_parts(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> list[FullRateSegment]:
    """Return those parts of full-rate segments that have rows of their own."""
    found = full_rate_segments(connection, run_id, start_s, end_s)
    spans = [(each, (each.start_s, each.after_s)) for each in found]  # includes the last row
    return [each for each, span in spans if rows_in("kept_state", connection, run_id, span, 1)]


def kept_notes(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> list[str]:
    """Note which parts of a range are kept at full rate, and why."""
    found = full_rate_parts(connection, run_id, start_s, end_s)
    if not found:
        return []
    named = [
        f"{each.start_s:.3f}-{each.end_s:.3f} s ({each.reason})"
        for each in found[-_READING.named :]
    ]
    more = f", and {len(found) - _READING.named} before" if len(found) > _READING.named else ""
    return [f"run {run_id} is kept at full rate: {', '.join(named)}{more}"]


def rows_in(
    table: str, connection: sqlite3.Connection, run_id: int, span: tuple[float, float], most: int
) -> int:
    """Return how many rows of a run lie in [start, end), counted only up to a limit.

    Args:
        table: `state` or `kept_state`.
        connection: Any.
        run_id: The run.
        span: Simulation times in s.
        most: The number at which counting ends.
    """
    asked = (run_id, *span, most)
    query = f"SELECT count(*) FROM (SELECT 1 FROM {{table}} {_IN} LIMIT ?)"
    return int(connection.execute(query.format(table=table), asked).fetchone()[0])


@dataclass(frozen=True)
class Subject:
    """A robot, and the run that a question means unless it is about all runs."""

    robot_id: int
    robot: str
    run_id: int


def choose(
    connection: sqlite3.Connection, robot: str | None, run_id: int | None, now_s: float
) -> tuple[RobotRecord, RunRecord | None]:
    """Return the given run, or the newest run of the given robot or of the only one.

    The run is None if the robot's controller has never recorded.

    Raises:
        UnknownRobotError, AmbiguousRobotError: As they say.
        UnknownRunError: There is no such run, or it is another robot's.
        NothingRecordedError: No robot has been recorded.
    """
    if robot is None and run_id is not None:
        robot = robot_name(connection, fetch_run(connection, run_id).robot_id)
    chosen = resolve_robot(connection, robot, now_s)
    if run_id is not None:
        return chosen, fetch_run(connection, run_id, chosen.id)
    return chosen, current_run(connection, chosen.id)


def require_run(robot: RobotRecord, run: RunRecord | None) -> RunRecord:
    """Return the run.

    Raises:
        NothingRecordedError: The robot's controller has not begun one.
    """
    if run is None:
        raise NothingRecordedError(
            f"Robot {robot.name!r} has no run yet: its controller never recorded. "
            "Start its simulation"
        )
    return run
