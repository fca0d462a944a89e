"""Define what a question is about: robot, run and time range. No other module does.

A `Scope` says what was asked for, a `TimeRange` what that is in a recording. A range is half-open,
[start, end), and given in one of three ways:

- in simulation seconds of one run (`start_s`, `end_s`; either may be left out, then the range
  reaches to the run's first row, or up to and with its newest),
- in seconds back from a run's newest row (`last_s`; that row is in),
- in wall time (`since`, `until`: ISO 8601 or Unix seconds), across the runs of a robot.

Simulation times are compared to the millisecond, as they are shown: a
time from an answer, given back as `start_s`, finds its row, and as `end_s` leaves it to the next
range, whatever a clock that adds up steps has stored (47.519999 is shown as 47.52).

Without `run_id` the run is the robot's newest. Simulation time begins again in each run, so a
range over several runs is one segment per run.
"""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Final, Literal

from webots_mcp.errors import InvalidRangeError, NothingRecordedError
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.segment import (
    HAS_LOST_ROWS,
    MOST_ROWS,
    Deadline,
    Segment,
    Subject,
    choose,
    full_rate_parts,
    just_after,
    kept_notes,
    moment_of,
    require_run,
    rows_in,
    shown_time,
)

# What was stored just before a bound and is shown with its time; commands belong to no run, only to
# their robot.
_SHOWN_AS_BOUND: Final = "SELECT min(time_s) FROM ({})".format(
    " UNION ALL ".join(
        f"SELECT min({time}) AS time_s FROM {table} WHERE {subject} "
        f"AND {time} >= :moment AND {time} < :bound"
        for table, time, subject in (
            ("log", "sim_time_s", "run_id = :run"),
            ("event", "sim_time_s", "run_id = :run"),
            ("image", "sim_time_s", "run_id = :run"),
            ("command", "claimed_sim_time_s", "robot_id = :robot"),
        )
    )
)
USE_EVERY_ROW: Final = "; ask for such a segment alone to use every row"
MOST_RUNS: Final = 1000  # number of runs in one range of wall time


@dataclass(frozen=True)
class NoteLimits:
    """When and how a range is annotated.

    Attributes:
        hits: Hits of a breakpoint up to which they are counted.
        rows_per_hit: Rows for each hit above which hits hardly move a mean (below 0.5 %).
        shown_characters: Length at which an error cuts a time.
    """

    hits: int = 1000
    rows_per_hit: int = 200
    shown_characters: int = 80


_NOTES: Final = NoteLimits()


def row_before(connection: sqlite3.Connection, run_id: int, sim_time_s: float) -> float | None:
    """Return the time of a run's newest row before a time; None without such a row."""
    if (run := frame_of_purged(connection, run_id)) is not None:
        place = int(run.places([sim_time_s])[0])
        return float(run.rows(place - 1, place).times[0]) if place else None
    before_s: float | None = connection.execute(
        "SELECT max(sim_time_s) FROM state WHERE run_id = ? AND sim_time_s < ?",
        (run_id, sim_time_s),
    ).fetchone()[0]
    return before_s


def _row_from(connection: sqlite3.Connection, run_id: int, sim_time_s: float) -> float | None:
    """Return the time of a run's oldest row from a time on; None without such a row."""
    if (run := frame_of_purged(connection, run_id)) is not None:
        place = int(run.places([sim_time_s])[0])
        return float(run.rows(place, place + 1).times[0]) if place < len(run) else None
    from_s: float | None = connection.execute(
        "SELECT min(sim_time_s) FROM state WHERE run_id = ? AND sim_time_s >= ?",
        (run_id, sim_time_s),
    ).fetchone()[0]
    return from_s


def coverage_notes(
    connection: sqlite3.Connection,
    run_id: int,
    span: tuple[float, float],
    recorded: tuple[float, float],
) -> Iterator[str]:
    """Return notes on [start, end) of a run that was recorded from the first to the newest time."""
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
    """Note that the range lies between two rows."""
    after_s = _row_from(connection, run_id, start_s)
    if after_s is None or after_s < end_s:
        return
    before_s = row_before(connection, run_id, start_s)
    if before_s is not None:
        yield f"no row: nothing was recorded between {before_s:g} and {after_s:g} s of run {run_id}"


def hit_notes(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> Iterator[str]:
    """Note that hits of a breakpoint add rows to a throttled run, which biases means."""
    if (
        connection.execute(
            "SELECT 1 FROM run r JOIN session s ON s.id = r.session_id "
            "WHERE r.id = ? AND s.throttle_interval > 1",
            (run_id,),
        ).fetchone()
        is None
    ):
        return
    values = {"run": run_id, "start": start_s, "end": end_s, "most": _NOTES.hits}
    # The number of rows that a breakpoint's hit added to a throttled recording, and the number of
    # all rows, each counted no further than necessary.
    (hits,) = connection.execute(
        "SELECT count(*) FROM (SELECT 1 FROM event WHERE run_id = :run AND sim_time_s >= :start "
        "AND sim_time_s < :end AND kind IN ('breakpoint', 'violation') "
        "GROUP BY sim_time_s LIMIT :most)",
        values,
    ).fetchone()
    most = _NOTES.rows_per_hit * hits
    rows = rows_in("state", connection, run_id, (start_s, end_s), most)
    if (run := frame_of_purged(connection, run_id)) is not None:
        first, last = run.places([start_s, end_s]).tolist()
        rows = last - first
    if hits and rows < most:
        yield (
            f"up to {hits} of {rows} rows of run {run_id} were recorded because a breakpoint was "
            "hit: means and counts are biased towards them"
        )


def recorded_share(connection: sqlite3.Connection, run_id: int) -> str:
    """Return a sentence with the share of the published states that the run's rows contain."""
    return unrecorded(connection, run_id) or "every publish() call is a row, so nothing was missed"


def unrecorded(connection: sqlite3.Connection, run_id: int) -> str | None:
    """Return which published states are not in a run's rows; None if none are missing."""
    row = connection.execute(
        "SELECT s.throttle_interval, EXISTS (SELECT 1 FROM event WHERE run_id = r.id "
        "AND kind = 'dropped') FROM run r JOIN session s ON s.id = r.session_id WHERE r.id = ?",
        (run_id,),
    ).fetchone()
    interval, dropped = row or (None, False)  # nothing is known of an unreadable robot
    if interval == 1:
        return "rows were dropped, so their values are missing" if dropped else None
    fewer = "rows may be fewer than publish() calls"
    share = f"one publish() call in {interval} is a row" if interval else fewer
    share += " and some were dropped" if dropped else ""
    return f"{share}: what happened in between is not seen"


@dataclass(frozen=True)
class TimeRange:
    """A range as found in the recording.

    Attributes:
        segments: One per run, in order.
        notes: What the caller should know: where the range exceeds the recording, or covers what
            was purged or never recorded.
    """

    robot_id: int
    robot: str
    segments: tuple[Segment, ...]
    clock: Literal["simulation", "wall"]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Scope:
    """What a question is about, as the caller gave it; by default the whole newest run.

    Attributes:
        robot: May be omitted if only one robot is possible.
        run_id: None for the robot's newest run, or in wall time for all of its runs.
        start_s: Bound in one of three forms, as described in this module.

    Raises:
        InvalidRangeError: The range is reversed, empty, not finite, or given in two forms at once.
    """

    robot: str | None = None
    run_id: int | None = None
    start_s: float | None = None
    end_s: float | None = None
    last_s: float | None = None
    since_wall_time: float | str | None = None
    until_wall_time: float | str | None = None

    def __post_init__(self) -> None:
        if (self.in_simulation_time + self.in_wall_time + (self.last_s is not None)) > 1:
            raise InvalidRangeError(
                "The range is given in two ways, which exclude each other. Use start_s and end_s "
                "(simulated seconds), or last_s, or since_wall_time and until_wall_time."
            )
        if self.last_s is not None and not 0 < self.last_s < math.inf:
            raise InvalidRangeError(f"last_s={self.last_s} must be a number of seconds above 0.")
        for name, value in (("start_s", self.start_s), ("end_s", self.end_s)):
            if value is not None and not math.isfinite(value):
                raise InvalidRangeError(f"{name}={value} must be a finite number of seconds.")
        if self.start_s is not None and self.end_s is not None:
            _require_order(self.start_s, self.end_s, "start_s", "end_s")

    @property
    def in_simulation_time(self) -> bool:
        """Whether it begins or ends at a simulation time."""
        return self.start_s is not None or self.end_s is not None

    @property
    def in_wall_time(self) -> bool:
        """Whether it begins or ends at a wall time."""
        return self.since_wall_time is not None or self.until_wall_time is not None

    @property
    def in_one_run(self) -> bool:
        """Whether it names a run, or times that make sense in one run only."""
        return self.run_id is not None or self.in_simulation_time or self.last_s is not None


def find_range(
    connection: sqlite3.Connection, scope: Scope, subject: Subject | None = None
) -> TimeRange:
    """Find the part of the recording that a scope means.

    Args:
        connection: An open database.
        scope: The scope.
        subject: Its robot and run, if they are known already.

    Raises:
        InvalidRangeError: See `Scope`.
        UnknownRobotError, AmbiguousRobotError, UnknownRunError: As they say.
        NothingRecordedError: The run has no state row yet.
    """
    if not scope.in_wall_time:
        subject = subject or find_subject(connection, scope.robot, scope.run_id)
        return _in_simulation_time(connection, subject, scope)
    walls = (
        parse_wall_time(scope.since_wall_time, -math.inf),
        parse_wall_time(scope.until_wall_time, math.inf),
    )
    _require_order(*walls, "since_wall_time", "until_wall_time")
    subject = subject or find_subject(connection, scope.robot, scope.run_id)
    return _in_wall_time(connection, subject, scope.run_id, *walls)


def _require_order(start_s: float, end_s: float, start_name: str, end_name: str) -> None:
    if start_s >= end_s:
        what = "empty" if start_s == end_s else "reversed"
        fix = f"Give a greater {end_name}." if start_s == end_s else "Swap the two."
        raise InvalidRangeError(
            f"The range is {what}: {start_name}={_seconds(start_s)} must be less than "
            f"{end_name}={_seconds(end_s)}. {fix}"
        )


def _seconds(time_s: float) -> str:
    return f"{shown_time(time_s):.13g}"


def recorded_bounds(connection: sqlite3.Connection, run_id: int) -> tuple[float, float] | None:
    """Return the simulation times between which a run recorded; None if it has no row.

    Rows that retention deleted count: their chunks remain, or a frame reports what does not.
    """
    rows = _row_bounds(connection, run_id)
    lost = connection.execute(
        f"SELECT started_sim_time_s, last_sim_time_s FROM run r WHERE id = ? AND {HAS_LOST_ROWS}",
        (run_id,),
    ).fetchone()
    if lost is None:
        return rows
    return lost[0], rows[1] if rows else lost[1]


def _row_bounds(connection: sqlite3.Connection, run_id: int) -> tuple[float, float] | None:
    """Return simulation times of a run's first and newest row; None without rows."""
    query = (
        "SELECT {0}(time_s) FROM (SELECT {0}(sim_time_s) AS time_s FROM state "
        "WHERE run_id = :run UNION ALL SELECT {0}(sim_time_s) FROM kept_state "
        "WHERE run_id = :run UNION ALL SELECT {0}({1}_sim_time_s) FROM row_group "
        "WHERE run_id = :run AND is_complete = 1)"
    )
    bounds = [
        connection.execute(query.format(*which), {"run": run_id}).fetchone()[0]
        for which in (("min", "start"), ("max", "end"))
    ]
    return None if bounds[0] is None else (bounds[0], bounds[1])


def whole_run(connection: sqlite3.Connection, run_id: int) -> Segment | None:
    """Return all rows of a run; None without rows."""
    bounds = recorded_bounds(connection, run_id)
    if bounds is None:
        return None
    segment = Segment(run_id, bounds[0], just_after(bounds[1]), open_start=True, open_end=True)
    return _rated(connection, segment)


def _rated(connection: sqlite3.Connection, segment: Segment) -> Segment:
    """Return the segment, marked if it is kept at full rate.

    It is marked if it holds only rows of one full-rate segment, and not too many of them.
    """
    run_id, span = segment.run_id, (segment.start_s, segment.end_s)
    for each in full_rate_parts(connection, run_id, *span):
        outside = ((span[0], each.start_s), (each.after_s, span[1]))
        if not any(_has_rows(connection, run_id, part) for part in outside):
            both = ("state", "kept_state")
            rows = [rows_in(table, connection, run_id, span, MOST_ROWS + 1) for table in both]
            return replace(segment, full_rate=rows[1] > 0 and sum(rows) <= MOST_ROWS)
    return segment


def _has_rows(connection: sqlite3.Connection, run_id: int, span: tuple[float, float]) -> bool:
    """Return whether a row lies in [start, end), even if it is left only in a chunk."""
    if span[0] >= span[1] or rows_in("state", connection, run_id, span, 1):
        return span[0] < span[1]
    return len(read_frame(connection, Segment(run_id, *span), Deadline())) > 0


def _in_simulation_time(
    connection: sqlite3.Connection,
    subject: Subject,
    scope: Scope,
) -> TimeRange:
    run_id, start_s, end_s, last_s = subject.run_id, scope.start_s, scope.end_s, scope.last_s
    bounds = recorded_bounds(connection, run_id)
    if bounds is None:
        raise NothingRecordedError(
            f"Run {run_id} of robot {subject.robot!r} has no state row yet: its controller has "
            "not published, or not often enough to be recorded. Let the simulation run, or choose "
            "another run from webots_list_runs"
        )
    first_s, newest_s = bounds
    if last_s is not None:
        start_s = newest_s - last_s if last_s < newest_s - first_s else None
    start = first_s if start_s is None else _bound(connection, subject, start_s)
    # An open end includes the newest row, even if the start lies after it.
    end = just_after(max(newest_s, start)) if end_s is None else _bound(connection, subject, end_s)
    if start_s is None and end <= first_s:
        raise InvalidRangeError(
            f"Run {run_id} has no row before end_s={_seconds(end)}: "
            f"it reaches from {_seconds(first_s)} s to {_seconds(newest_s)} s. "
            f"Choose a range within that."
        )
    _require_order(start, end, "start_s", "end_s")
    segment = Segment(run_id, start, end, open_start=start_s is None, open_end=end_s is None)
    notes = [*coverage_notes(connection, run_id, (start, end), bounds)]
    notes += _too_young(connection, subject, last_s, newest_s - first_s)
    segment = _rated(connection, segment)
    notes += _rate_notes(connection, segment)
    return TimeRange(subject.robot_id, subject.robot, (segment,), "simulation", tuple(notes))


def _rate_notes(connection: sqlite3.Connection, segment: Segment) -> list[str]:
    """Note where rows exist in addition to those that the throttle let through."""
    span = (segment.run_id, segment.start_s, segment.end_s)
    kept = kept_notes(connection, *span)
    if segment.full_rate:
        return kept
    inside = [f"{each}{USE_EVERY_ROW}" for each in kept]
    return [*inside, *hit_notes(connection, *span)]


def _too_young(
    connection: sqlite3.Connection, subject: Subject, last_s: float | None, age_s: float
) -> list[str]:
    """Note that the run has not lasted for `last_s`, and which run came before it."""
    if last_s is None or moment_of(last_s) <= age_s:
        return []
    before, began_by = connection.execute(
        "SELECT (SELECT max(id) FROM run b WHERE b.robot_id = run.robot_id AND b.id < run.id), "
        "start_reason FROM run WHERE id = ?",
        (subject.run_id,),
    ).fetchone()
    young = f"run {subject.run_id} (started by {began_by}) has lasted only {_seconds(age_s)} s"
    return [young if before is None else f"{young}; the time before is in run {before}"]


def _bound(connection: sqlite3.Connection, subject: Subject, time_s: float) -> float:
    """Return the place of a bound: the first thing that is shown with this time or a later one."""
    names = {"run": subject.run_id, "robot": subject.robot_id}
    times = {"moment": moment_of(time_s), "bound": shown_time(time_s)}
    (before_s,) = connection.execute(_SHOWN_AS_BOUND, names | times).fetchone()
    row_s = _row_from(connection, subject.run_id, times["moment"])
    return min(each for each in (before_s, row_s, times["bound"]) if each is not None)


def _in_wall_time(
    connection: sqlite3.Connection,
    subject: Subject,
    run_id: int | None,
    wall_start_s: float,
    wall_end_s: float,
) -> TimeRange:
    wanted = (subject.robot_id, wall_end_s, wall_start_s, run_id, run_id, MOST_RUNS + 1)
    runs = [
        run
        for (run,) in connection.execute(
            "SELECT id FROM run WHERE robot_id = ? AND started_wall_time_s < ? "
            "AND (ended_wall_time_s IS NULL OR ended_wall_time_s >= ?) "
            "AND (? IS NULL OR id = ?) ORDER BY id DESC LIMIT ?",
            wanted,
        ).fetchall()
    ]
    notes: list[str] = []
    walls = (wall_start_s, wall_end_s)
    cuts = (_cut(connection, run, *walls) for run in reversed(runs[:MOST_RUNS]))
    segments = tuple(segment for segment in cuts if segment is not None)
    notes += [] if segments else [f"no row of robot {subject.robot!r} in that wall time"]
    for segment in segments:
        notes += _rate_notes(connection, segment)
    if len(runs) > MOST_RUNS:
        notes.append(f"only the newest {MOST_RUNS} runs in that wall time are looked at")
    return TimeRange(subject.robot_id, subject.robot, segments, "wall", tuple(notes))


def _cut(
    connection: sqlite3.Connection, run_id: int, wall_start_s: float, wall_end_s: float
) -> Segment | None:
    """Return the part of a run from its first to its last row in [wall_start_s, wall_end_s)."""
    recorded = recorded_bounds(connection, run_id)
    if recorded is None:
        return None
    whole = Segment(
        run_id, recorded[0], just_after(recorded[1]), wall_start_s, wall_end_s,
        open_start=True, open_end=True,
    )  # fmt: skip
    # Whether all rows of an ended run were recorded within these wall times.
    if connection.execute(
        "SELECT coalesce(started_wall_time_s >= ? AND ended_wall_time_s < ? "
        "AND last_wall_time_s <= ended_wall_time_s, 0) FROM run WHERE id = ?",
        (wall_start_s, wall_end_s, run_id),
    ).fetchone()[0]:
        return _rated(connection, whole)
    frame = read_frame(connection, whole, Deadline())
    if frame.cut_at_s is not None:  # the reader of the rows reports what there is no time for
        return _rated(connection, whole)
    if not len(frame):
        return None
    start_s, last_s = frame.bounds_s
    return _rated(connection, replace(whole, start_s=start_s, end_s=just_after(last_s)))


# -- wall times as a person gives them -------------------------------------------------------------


def parse_wall_time(value: float | str | None, default_s: float = math.nan) -> float:
    """Return the Unix seconds of a wall time, given as a number or in ISO 8601.

    ISO times without an offset are local times of this machine.

    Raises:
        InvalidRangeError: It is neither a finite number nor ISO 8601.
    """
    if value is None:
        return default_s
    try:
        seconds = float(value)
    except ValueError:
        seconds = _iso_seconds(str(value))
    if not math.isfinite(seconds):
        raise InvalidRangeError(f"{value!r} is not a finite time in Unix seconds.")
    return seconds


def _iso_seconds(text: str) -> float:
    try:
        return datetime.fromisoformat(text.strip().replace("Z", "+00:00")).timestamp()
    except (ValueError, OverflowError, OSError) as error:
        raise InvalidRangeError(
            f"{text[: _NOTES.shown_characters]!r} is not a time. "
            "Give Unix seconds or ISO 8601 such as "
            "2026-05-04T13:30:00+02:00."
        ) from error


def frame_of_purged(connection: sqlite3.Connection, run_id: int) -> Frame | None:
    """Return all rows of a run that has lost some from `state`; None if it has lost none."""
    if not connection.execute(
        "SELECT 1 FROM run WHERE id = ? AND purged_rows > 0", (run_id,)
    ).fetchone():
        return None
    return read_frame(connection, Segment(run_id, -math.inf, math.inf), Deadline())


# -- which robot and which run a question is about -------------------------------------------------


def find_subject(
    connection: sqlite3.Connection, robot: str | None = None, run_id: int | None = None
) -> Subject:
    """Return the subject of a question; see `choose` and `require_run`."""
    chosen, run = choose(connection, robot, run_id, time.time())
    return Subject(chosen.id, chosen.name, require_run(chosen, run).id)
