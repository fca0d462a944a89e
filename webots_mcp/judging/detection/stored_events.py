"""Events that were stored when they happened: runs, commands, logs, pictures, and the like."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Final

from webots_mcp.analysis.arrays import np
from webots_mcp.contract import INSPECTION_EVENT, LOG_LEVELS
from webots_mcp.database.stored_breakpoints import VIOLATION
from webots_mcp.judging.detection.event import (
    Alike,
    Event,
    NotSearchableError,
    but_for_numbers,
)
from webots_mcp.judging.detection.search import EventKind, Search
from webots_mcp.store.inspections import reference_to
from webots_mcp.store.reading.frame_summary import (
    MOST_VALUES,
    Point,
    change_points,
)
from webots_mcp.store.reading.segment import Segment, full_rate_segments, read_so_far
from webots_mcp.store.run_rows import count_kept_frames

MOST_OF_A_KIND: Final = 2000  # newest rows of a table that are looked at, per run
AROUND_S: Final = 10.0  # before and after: what changes all the time there, measures
MOST_NAMED: Final = 3  # values that are named where a signal has many changes
HITS: Final = ("breakpoint", VIOLATION)  # what a condition that somebody set has noticed
MOST_CHANGES: Final = 500  # of one signal that become events; more become one

_IN_SEGMENT: Final = (
    "WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ? AND wall_time_s >= ? "
    "AND wall_time_s < ? "
)
_NEWEST: Final = "ORDER BY sim_time_s DESC, id DESC LIMIT ?"
_LOGS: Final = f"SELECT sim_time_s, wall_time_s, level, source, message FROM log {_IN_SEGMENT}"
_NOTICED: Final = (  # changes of signals are read from states, of all signals, without a limit
    f"SELECT sim_time_s, wall_time_s, kind, name, data, id FROM event {_IN_SEGMENT} "
    "AND kind NOT IN ('change', 'start', 'reset', 'reload') "
)
_IMAGES: Final = f"SELECT sim_time_s, wall_time_s, kind, device, path, id FROM image {_IN_SEGMENT}"
_RUN: Final = (
    "SELECT started_sim_time_s, started_wall_time_s, start_reason, last_sim_time_s, "
    "ended_wall_time_s, end_reason FROM run WHERE id = ?"
)
# A command belongs to the run of its robot that went on when it was claimed, else created.
_COMMANDS: Final = (
    "SELECT id, action, params, status, created_wall_time_s, claimed_wall_time_s, "
    "claimed_sim_time_s, finished_wall_time_s, finished_sim_time_s, result, error, "
    "(SELECT client || ' (' || transport || ')' FROM request WHERE id = request_id) FROM command "
    "WHERE robot_id = (SELECT robot_id FROM run WHERE id = ?) "
    "AND coalesce(claimed_wall_time_s, created_wall_time_s) >= ? "
    "AND coalesce(claimed_wall_time_s, created_wall_time_s) < ? ORDER BY id DESC LIMIT ?"
)
_REFUSED: Final = (
    "SELECT sim_time_s, wall_time_s, tool, client || ' (' || transport || ')', rule FROM request "
    f"{_IN_SEGMENT} AND rule IS NOT NULL "
)
_RUN_WALLS: Final = (  # of all runs of its robot: one by one, all later ones of each are read
    "SELECT id, started_wall_time_s FROM run "
    "WHERE robot_id = (SELECT robot_id FROM run WHERE id = ?) ORDER BY id DESC"
)


def run_events(search: Search) -> Iterator[Event]:
    """Begin and end of the run, where the segment holds them."""
    here, run_id = search.segment, search.segment.run_id
    start_s, start_wall_s, start, end_s, end_wall_s, end = search.connection.execute(
        _RUN, (run_id,)
    ).fetchone()
    if here.holds_from_s <= start_s and here.wall_start_s <= start_wall_s:
        details = {"what": "began", "reason": start}
        yield Event("run", run_id, start_s, start_s, start_wall_s, None, details)
    if end_wall_s is not None and end_s < here.holds_to_s and end_wall_s < here.wall_end_s:
        details = {"what": "ended", "reason": end}
        yield Event("run", run_id, end_s, end_s, end_wall_s, None, details)


def recorded_segment(search: Search) -> Segment:
    """Return the part of the segment that has rows."""
    if search.recorded is None:
        raise NotSearchableError(f"no row in run {search.segment.run_id} there")
    return search.recorded


def change_events(search: Search) -> Iterator[Event]:
    """Changes of text, flags and modes, each as long as the new value lasted."""
    states = [each for each in search.signals if not each.is_number or each.is_choice]
    if not states:
        raise NotSearchableError(
            "no text, flag or mode was published, or none with these names; for another number "
            "ask with where='changed(NAME)'"
        )
    here, asked, frame = search.segment, search.asked or search.segment, search.frame
    found = change_points(
        search.connection, here, states, search.deadline, frame=frame, since=False
    )
    note_unread(search, "change", found.unread_from_s)
    search.not_searched("change", *map(str, found.unread))
    goes_on = found.unread_from_s is None and here.end_s > search.ended_s
    last_s = frame.bounds_s[1] if len(frame) else here.start_s
    for signal in states:
        points = _without_measurements(found.points[signal.name])
        if len(points) < len(found.points[signal.name]):
            why = f"not between numbers of {signal.name}, a measurement"
            search.not_searched("change", f"{why}: webots_query_history shows them")
        changes = [
            Event(
                "change", here.run_id, point.sim_time_s,
                max(last_s, point.sim_time_s) if after is None else after.sim_time_s, 0.0,
                signal.name, {"before": before.value, "after": point.value},
                ongoing=after is None and goes_on,
            )
            for before, point, after in zip(points, points[1:], [*points[2:], None], strict=False)
            if asked.start_s <= point.sim_time_s < asked.end_s
        ]  # fmt: skip
        if len(changes) > MOST_CHANGES:
            changes = [CHANGES.as_one(changes)]
        for each in changes:
            yield replace(each, wall_time_s=search.wall_time_at(each.start_s))


def note_unread(search: Search, kind: str, from_s: float | None) -> None:
    """Note that a kind was not searched after the moment at which the time was over."""
    if from_s is not None and from_s < search.segment.end_s:
        from_s = max(from_s, search.segment.start_s)
        why = f"not after {from_s:.3f} s: time limit reached, ask start_s={from_s:.3f}"
        search.not_searched(kind, why)


def _without_measurements(points: Sequence[Point]) -> Sequence[Point]:
    """Without the changes from number to number of what has more numbers than any mode has.

    It is a measurement that is a text now and then, such as "n/a".
    """
    numbers = [_is_number(point.value) for point in points]
    values = {point.value for point, is_number in zip(points, numbers, strict=True) if is_number}
    if len(values) <= MOST_VALUES:
        return points
    kept = [not (was and now) for was, now in pairwise([False, *numbers])]
    return [point for point, keep in zip(points, kept, strict=True) if keep]


def _is_number(value: object) -> bool:
    try:
        return isinstance(value, str) and math.isfinite(float(value))
    except ValueError:
        return False


def log_events(search: Search) -> Iterator[Event]:
    """Log lines of the level and above; where there are only lower ones, this is noted."""
    wanted, run_id = search.options.log_level, search.segment.run_id
    lower, levels = LOG_LEVELS[: LOG_LEVELS.index(wanted)], LOG_LEVELS[LOG_LEVELS.index(wanted) :]
    query = f"{_LOGS} AND level IN ({', '.join('?' * len(levels))}) "
    rows = _newest(search, "log", query, *levels)
    for time_s, wall_s, level, source, message in rows:
        details = {"source": source, "message": message}
        yield Event("log", run_id, time_s, time_s, wall_s, level, details)
    for rank, level in reversed([*enumerate(lower, 1)] if not rows else []):
        asked = (*_bounds(search.segment), level)
        if search.connection.execute(f"{_LOGS} AND level = ? LIMIT 1", asked).fetchone():
            what = f"there are lines of level {level}, none of {wanted} or above"
            search.note_nearest("log", rank / len(LOG_LEVELS), what)
            return


def noticed_events(search: Search) -> Iterator[Event]:
    """What the bridge noticed and stored: pause, resume, dropped rows, trouble with storage."""
    wanted = search.options.kinds
    is_found = not wanted or VIOLATION in wanted  # in values, as an event of its own kind
    for time_s, wall_s, kind, name, data, event_id in _newest(search, "bridge_event", _NOTICED):
        if kind == VIOLATION and is_found:
            continue
        said = json.loads(data) if data else None
        details: dict[str, Any] = {"what": kind} | ({"data": said} if said else {})
        if kind == INSPECTION_EVENT:  # whose variables webots_inspect_controller shows
            details = {"what": kind, **reference_to(event_id, said)}
        elif kind in HITS:  # of which webots_get_clip makes a clip
            details["event_id"] = event_id
        yield Event("bridge_event", search.segment.run_id, time_s, time_s, wall_s, name, details)


def _newest_id(events: Sequence[Event]) -> dict[str, Any]:
    """The id of the newest of several events, by which its variables or a clip are shown."""
    event_id = events[-1].details.get("event_id")
    return {} if event_id is None else {"newest_event_id": event_id}


def image_events(search: Search) -> Iterator[Event]:
    """Camera frames and screenshots."""
    for time_s, wall_s, kind, device, path, image_id in _newest(search, "image", _IMAGES):
        details = {"kind": kind, "path": path, "image_id": image_id}
        yield Event("image", search.segment.run_id, time_s, time_s, wall_s, device, details)


def kept_events(search: Search) -> Iterator[Event]:
    """The stretches that the segment touches; one that is not over reaches up to the newest row."""
    segment = search.segment
    span = (segment.holds_from_s, segment.holds_to_s)
    for each in full_rate_segments(search.connection, segment.run_id, *span):
        end_s = max(each.start_s, min(each.end_s, search.ended_s))
        frames = count_kept_frames(search.connection, segment.run_id, each.start_s, each.end_s)
        details = {"reason": each.reason} | ({"frames": frames} if frames else {})  # of cameras
        # It was stored when it was asked for, which may be long after it began.
        place = (segment.run_id, each.start_s, end_s, search.wall_time_at(each.start_s))
        yield Event("kept_stretch", *place, None, details, ongoing=each.end_s > search.ended_s)


def _newest(search: Search, kind: str, query: str, *values: object) -> list[Any]:
    """The newest rows of a table in the segment; that there are older ones is noted."""
    parameters = (*_bounds(search.segment), *values, MOST_OF_A_KIND)
    rows = search.connection.execute(f"{query}{_NEWEST}", parameters).fetchall()
    _note_older(search, kind, len(rows))
    return rows


def _note_older(search: Search, kind: str, count: int) -> None:
    if count == MOST_OF_A_KIND:
        search.not_searched(kind, f"only the newest {count} are counted: ask for an earlier end_s")


def command_events(search: Search) -> Iterator[Event]:
    """Commands, from when they were claimed (or created, if never) to when they were finished.

    Not those that lie outside the segment in simulation time. Requests that a rule of the project
    refused are among them, by the names of their tools.
    """
    for time_s, wall_s, tool, by, rule in _newest(search, "command", _REFUSED):
        details: dict[str, Any] = {"status": "refused", "by": by, "rule": rule}
        yield Event("command", search.segment.run_id, time_s, time_s, wall_s, tool, details)
    connection, here = search.connection, search.segment
    start_wall_s, end_wall_s = _walls_of(connection, here.run_id)
    walls_s = max(start_wall_s, here.wall_start_s), min(end_wall_s, here.wall_end_s)
    rows = connection.execute(_COMMANDS, (here.run_id, *walls_s, MOST_OF_A_KIND)).fetchall()
    _note_older(search, "command", len(rows))
    for command_id, action, params, status, created_s, claimed_s, start_s, *finished in rows:
        finished_wall_s, end_s, result, error, by = finished
        wall_s = created_s if claimed_s is None else claimed_s
        if start_s is None:
            start_s = _sim_time_at(search, wall_s)
        if start_s is None or not here.holds_from_s <= start_s < here.holds_to_s:
            continue
        details = {"id": command_id, "status": status, "params": json.loads(params)}
        details |= {"by": by} if by else {}
        details |= {} if finished_wall_s is None else {"took_wall_s": finished_wall_s - wall_s}
        details |= {"result": json.loads(result)} if result else {}
        details |= {"error": error} if error else {}
        end_s = max(start_s, end_s or start_s)  # a reset finishes in a new run
        ongoing = status in ("pending", "claimed")
        place = (here.run_id, start_s, end_s, wall_s)
        yield Event("command", *place, action, details, ongoing=ongoing)


def _walls_of(connection: sqlite3.Connection, run_id: int) -> tuple[float, float]:
    """When a run began, and when the first of its robot's later runs did."""
    known: dict[int, tuple[float, float]] = read_so_far(connection).setdefault(_RUN_WALLS, {})
    if run_id not in known:
        next_s = 9e99
        for each, start_s in connection.execute(_RUN_WALLS, (run_id,)):
            known[each] = start_s, next_s
            next_s = min(next_s, start_s)
    return known[run_id]


def _sim_time_at(search: Search, wall_s: float) -> float | None:
    """Of the last row of the segment at or before a wall time; None without any."""
    note_unread(search, "command", search.whole.cut_at_s)
    rows = search.whole.between(search.segment.holds_from_s, search.segment.holds_to_s)
    place = int(np.searchsorted(rows.wall_times, wall_s, "right"))
    return float(rows.times[place - 1]) if place else None


def _bounds(segment: Segment) -> tuple[float, ...]:
    walls = (segment.wall_start_s, segment.wall_end_s)
    return (segment.run_id, segment.holds_from_s, segment.holds_to_s, *walls)


def _to(changes: Sequence[Event]) -> dict[str, Any]:
    """The most frequent values first, and for how long each was there in all."""
    lasted_s: dict[str, list[float]] = {}
    for each in changes:
        value = each.details["after"]
        name = value if isinstance(value, str) else json.dumps(value)
        lasted_s.setdefault(name, []).append(each.duration_s)
    often = sorted(lasted_s.items(), key=lambda each: -len(each[1]))
    to = {name: f"{len(each)} times, {sum(each):.4g} s" for name, each in often[:MOST_NAMED]}
    rest = len(often) - MOST_NAMED
    return {"to": to | ({"other values": rest} if rest > 0 else {})}


CHANGES: Final = Alike(lambda events, unit: "changes", adds=_to, most_single=10)
RUN: Final = EventKind("run", "a run began or ended", run_events, stored=True, counted=False)
CHANGE: Final = EventKind(
    "change",
    "a mode or flag changed",
    change_events,
    stored=True,
    lasts=True,
    around_s=lambda options: AROUND_S,
    routine=True,
    alike=CHANGES,
)
COMMAND: Final = EventKind(
    "command",
    "a command and its outcome",
    command_events,
    stored=True,
    drawn=5,
    alike=Alike(
        lambda events, unit: "commands",
        sort=lambda e: (e.details["status"], but_for_numbers(e.details.get("error"))),
    ),
)
LOG: Final = EventKind(
    "log",
    "a log line",
    log_events,
    stored=True,
    drawn=4,
    alike=Alike(
        lambda events, unit: "similar lines",
        sort=lambda e: (e.details["source"], but_for_numbers(e.details["message"])),
        adds=lambda events: {"message": events[0].details["message"]},
    ),
)
NOTICED: Final = EventKind(
    "bridge_event",
    "hit of a breakpoint or note of the recorder",
    noticed_events,
    stored=True,
    drawn=6,
    alike=Alike(
        lambda events, unit: f"times {events[0].details['what']}",
        sort=lambda e: e.details["what"],
        adds=_newest_id,
    ),
)
KEPT: Final = EventKind(
    "kept_stretch",
    "seconds recorded at full rate",
    kept_events,
    stored=True,
    routine=True,
    counted=False,
    alike=Alike(
        lambda events, unit: "full-rate segments",
        sort=lambda e: but_for_numbers(e.details["reason"]),
    ),
)
IMAGE: Final = EventKind(  # no news, and there may be thousands
    "image",
    "a picture was stored",
    image_events,
    stored=True,
    usual=lambda options: False,
    routine=True,
    counted=False,
)
