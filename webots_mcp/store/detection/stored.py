"""Events that were stored when they happened: runs, commands, logs, pictures, what was noticed."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Final, NamedTuple

from webots_mcp.naming import Value
from webots_mcp.store.detection.event import LEVELS, Event
from webots_mcp.store.detection.kind import (
    Alike,
    EventKind,
    NotSearchableError,
    but_for_numbers,
    told_together,
)
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.changes import MOST_VALUES, Point, change_points, value_ended_s
from webots_mcp.store.reading.gaps import frame_around, rhythm_in
from webots_mcp.store.reading.ranges import Segment, just_after
from webots_mcp.store.signals.registry import Signal

MOST_OF_A_KIND: Final = 2000  # newest rows of a table that are looked at, per run
AROUND_S: Final = 10.0  # before and after: what changes all the time there, measures
MOST_NAMED: Final = 3  # values that are named where a signal has many changes
MOST_CHANGES: Final = 500  # of one signal that become events; more become one

_IN_SEGMENT: Final = (
    "WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ? AND wall_time_s >= ? "
    "AND wall_time_s < ? "
)
_NEWEST: Final = "ORDER BY sim_time_s DESC, id DESC LIMIT ?"
_LOGS: Final = f"SELECT sim_time_s, wall_time_s, level, source, message FROM log {_IN_SEGMENT}"
_NOTICED: Final = (  # changes of signals are read from states, of all signals, without a limit
    f"SELECT sim_time_s, wall_time_s, kind, name, data FROM event {_IN_SEGMENT} "
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
    "claimed_sim_time_s, finished_wall_time_s, finished_sim_time_s, result, error FROM command "
    "WHERE robot_id = (SELECT robot_id FROM run WHERE id = :run) "
    "AND coalesce(claimed_wall_time_s, created_wall_time_s) >= :start_wall "
    "AND coalesce(claimed_wall_time_s, created_wall_time_s) < :end_wall "
    "ORDER BY id DESC LIMIT :limit"
)
_RUN_WALLS: Final = (
    "SELECT started_wall_time_s, coalesce((SELECT min(n.started_wall_time_s) FROM run n "
    "WHERE n.robot_id = r.robot_id AND n.id > r.id), 9e99) FROM run r WHERE id = ?"
)
_SIM_AT_WALL: Final = (
    "SELECT sim_time_s FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ? "
    "AND wall_time_s <= ? ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)


def run_events(search: Search) -> Iterator[Event]:
    """Begin and end of the run, where the segment holds them."""
    segment = search.segment
    start_s, start_wall_s, start, end_s, end_wall_s, end = search.connection.execute(
        _RUN, (segment.run_id,)
    ).fetchone()
    if segment.holds_from_s <= start_s and segment.wall_start_s <= start_wall_s:
        details = {"what": "began", "reason": start}
        yield Event("run", segment.run_id, start_s, start_s, start_wall_s, None, details)
    if end_wall_s is not None and end_s < segment.holds_to_s and end_wall_s < segment.wall_end_s:
        details = {"what": "ended", "reason": end}
        yield Event("run", segment.run_id, end_s, end_s, end_wall_s, None, details)


def _recorded(search: Search) -> Segment:
    """The part of the segment that has rows."""
    if search.recorded is None:
        raise NotSearchableError(f"no row in run {search.segment.run_id} there")
    return search.recorded


def gap_events(search: Search) -> Iterator[Event]:
    """Where rows are missing: gaps that the segment touches, also all around it."""
    segment = _recorded(search)
    around = frame_around(search.connection, segment, search.deadline)
    _note_unread(search, "gap", around.cut_at_s)
    rhythm = rhythm_in(around)
    details = {"usual_interval_s": rhythm.interval_s}
    for gap in rhythm.gaps:
        if gap.end_s > segment.start_s and gap.start_s < segment.end_s:
            wall_s = search.wall_time_at(gap.start_s)
            yield Event("gap", segment.run_id, gap.start_s, gap.end_s, wall_s, None, details)


def change_events(search: Search) -> Iterator[Event]:
    """Changes of text, flags and modes, each as long as the new value lasted."""
    segment, newest_s = _recorded(search), search.ended_s
    states = [each for each in search.signals if not each.is_number or each.is_choice]
    if not states:
        raise NotSearchableError(
            "no text, flag or mode was published, or none with these names; for another number "
            "ask with where='changed(NAME)'"
        )
    around = Segment(segment.run_id, segment.start_s - AROUND_S, segment.end_s + AROUND_S)
    found = change_points(search.connection, around, states, search.deadline, since=False)
    _note_unread(search, "change", found.unread_from_s)
    for each in found.unread:
        search.not_searched("change", str(each))
    for signal in states:
        name, points = signal.name, found.points[signal.name]
        points_left = _without_measurements(points)
        last_s, cut_at_s = _last_ends_s(search, signal, points_left)
        if cut_at_s is not None:
            last_s = max(cut_at_s, points_left[-1].sim_time_s)
            why = (
                f"the one at {points_left[-1].sim_time_s:.3f} s may last longer: time limit reached"
            )
            search.not_searched("change", why)
        ends_s = [*(point.sim_time_s for point in points_left[2:]), last_s]
        changes = [
            _Change(before, point, newest_s if end_s is None else end_s, end_s is None)
            for (before, point), end_s in zip(pairwise(points_left), ends_s, strict=False)
            if segment.start_s <= point.sim_time_s < segment.end_s
        ]
        if len(points_left) < len(points):
            why = f"not between numbers of {name}, a measurement: webots_query_history shows them"
            search.not_searched("change", why)
        yield from _reported(search, name, changes)


def _note_unread(search: Search, kind: str, from_s: float | None) -> None:
    if from_s is not None and from_s < search.segment.end_s:
        from_s = max(from_s, search.segment.start_s)
        why = f"not after {from_s:.3f} s: time limit reached, ask start_s={from_s:.3f}"
        search.not_searched(kind, why)


class _Change(NamedTuple):
    """From one value to another, which lasted until `end_s`, or goes on."""

    before: Point
    point: Point
    end_s: float
    ongoing: bool


def _reported(search: Search, name: str, changes: Sequence[_Change]) -> Iterator[Event]:
    """Each change; of what flickers all as one."""
    if len(changes) > MOST_CHANGES:
        starts_s = [each.point.sim_time_s for each in changes]
        lengths_s = [each.end_s - each.point.sim_time_s for each in changes]
        to = _to(list(zip((each.point.value for each in changes), lengths_s, strict=True)))
        together = to | told_together("changes", starts_s, lengths_s)
        one = changes[-1]._replace(point=changes[0].point)
        yield replace(_change(search, name, one, together), count=len(changes))
        return
    for each in changes:
        details = {"before": each.before.value, "after": each.point.value}
        yield _change(search, name, each, details)


def _change(search: Search, name: str, change: _Change, details: dict[str, Any]) -> Event:
    run_id, start_s = search.segment.run_id, change.point.sim_time_s
    wall_s = search.wall_time_at(start_s)
    place = (run_id, start_s, change.end_s, wall_s)
    return Event("change", *place, name, details, ongoing=change.ongoing)


def _last_ends_s(
    search: Search, signal: Signal, points_left: Sequence[Point]
) -> tuple[float | None, float | None]:
    """As `value_ended_s` of the newest of some values; None where it began elsewhere."""
    begin_s = points_left[-1].sim_time_s if points_left else math.inf
    if not search.segment.start_s <= begin_s < search.segment.end_s:
        return None, None
    after = Segment(search.segment.run_id, begin_s, just_after(search.ended_s))
    return value_ended_s(search.connection, after, signal, search.deadline)


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
    wanted = search.options.log_level
    lower, levels = LEVELS[: LEVELS.index(wanted)], LEVELS[LEVELS.index(wanted) :]
    query = f"{_LOGS} AND level IN ({', '.join('?' * len(levels))}) "
    rows = _newest(search, "log", query, *levels)
    for time_s, wall_s, level, source, message in rows:
        details = {"source": source, "message": message}
        yield Event("log", search.segment.run_id, time_s, time_s, wall_s, level, details)
    if rows:
        return
    for rank, level in reversed([*enumerate(lower, 1)]):
        line = search.connection.execute(
            f"{_LOGS} AND level = ? LIMIT 1", (*_bounds(search.segment), level)
        )
        if line.fetchone():
            what = f"there are lines of level {level}, none of {wanted} or above"
            search.came_near("log", rank / len(LEVELS), what)
            return


def noticed_events(search: Search) -> Iterator[Event]:
    """What the bridge noticed and stored: pause, resume, dropped rows, trouble with storage."""
    for time_s, wall_s, kind, name, data in _newest(search, "noticed", _NOTICED):
        details: dict[str, Any] = {"what": kind}
        if data:
            details["data"] = json.loads(data)
        yield Event("noticed", search.segment.run_id, time_s, time_s, wall_s, name, details)


def image_events(search: Search) -> Iterator[Event]:
    """Camera frames and screenshots."""
    for time_s, wall_s, kind, device, path, image_id in _newest(search, "image", _IMAGES):
        details = {"kind": kind, "path": path, "image_id": image_id}
        yield Event("image", search.segment.run_id, time_s, time_s, wall_s, device, details)


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
    """Commands, from when they were claimed (or created, if never) to when they were finished."""
    connection, segment = search.connection, search.segment
    start_wall_s, end_wall_s = connection.execute(_RUN_WALLS, (segment.run_id,)).fetchone()
    walls = {
        "start_wall": max(start_wall_s, segment.wall_start_s),
        "end_wall": min(end_wall_s, segment.wall_end_s),
    }
    asked = {"run": segment.run_id, "limit": MOST_OF_A_KIND, **walls}
    rows = connection.execute(_COMMANDS, asked).fetchall()
    _note_older(search, "command", len(rows))
    for row in rows:
        event = _command(connection, segment, row)
        if event is not None:
            yield event


def _command(
    connection: sqlite3.Connection, segment: Segment, row: tuple[Any, ...]
) -> Event | None:
    """None if it was outside the segment in simulation time."""
    command_id, action, params, status, created_s, claimed_s, start_s, *finished = row
    finished_wall_s, end_s, result, error = finished
    wall_s = created_s if claimed_s is None else claimed_s
    if start_s is None:
        span = (segment.run_id, segment.holds_from_s, segment.holds_to_s, wall_s)
        at = connection.execute(_SIM_AT_WALL, span).fetchone()
        start_s = at[0] if at else None
    if start_s is None or not segment.holds_from_s <= start_s < segment.holds_to_s:
        return None
    details: dict[str, Any] = {"id": command_id, "status": status, "params": json.loads(params)}
    if finished_wall_s is not None:
        details["took_wall_s"] = finished_wall_s - wall_s
    details |= {"result": json.loads(result)} if result else {}
    details |= {"error": error} if error else {}
    end_s = start_s if end_s is None or end_s < start_s else end_s  # a reset finishes in a new run
    ongoing = status in ("pending", "claimed")
    place = (segment.run_id, start_s, end_s, wall_s)
    return Event("command", *place, action, details, ongoing=ongoing)


def _bounds(segment: Segment) -> tuple[float, ...]:
    walls = (segment.wall_start_s, segment.wall_end_s)
    return (segment.run_id, segment.holds_from_s, segment.holds_to_s, *walls)


def _values(events: Sequence[Event]) -> dict[str, Any]:
    """To which values a signal changed."""
    return _to([(event.details["after"], event.duration_s) for event in events])


def _to(values: Sequence[tuple[Value, float]]) -> dict[str, Any]:
    """The most frequent values first, and for how long each was there in all."""
    lasted_s: dict[str, list[float]] = {}
    for value, duration_s in values:
        name = value if isinstance(value, str) else json.dumps(value)
        lasted_s.setdefault(name, []).append(duration_s)
    often = sorted(lasted_s, key=lambda name: -len(lasted_s[name]))
    to: dict[str, Any] = {
        name: f"{len(lasted_s[name])} times, {sum(lasted_s[name]):.4g} s"
        for name in often[:MOST_NAMED]
    }
    rest = len(often) - MOST_NAMED
    return {"to": to | ({"other values": rest} if rest > 0 else {})}


def _outcome(event: Event) -> Hashable:
    return event.details["status"], but_for_numbers(event.details.get("error"))


def _line(event: Event) -> Hashable:
    return event.details["source"], but_for_numbers(event.details["message"])


def _first_line(events: Sequence[Event]) -> dict[str, Any]:
    return {"message": events[0].details["message"]}


def _what(event: Event) -> Hashable:
    return event.details["what"]


RUN: Final = EventKind("run", "began or ended", run_events, stored=True, counted=False)
GAP: Final = EventKind(
    "gap", "no rows", gap_events, stored=True, alike=Alike(lambda events, unit: "gaps")
)
CHANGE: Final = EventKind(
    "change",
    "of a text or flag",
    change_events,
    stored=True,
    routine=True,
    alike=Alike(lambda events, unit: "changes", adds=_values, most_single=10),
)
COMMAND: Final = EventKind(
    "command",
    "",
    command_events,
    stored=True,
    drawn=5,
    alike=Alike(lambda events, unit: "commands", sort=_outcome),
)
LOG: Final = EventKind(
    "log",
    "",
    log_events,
    stored=True,
    drawn=4,
    alike=Alike(lambda events, unit: "similar lines", sort=_line, adds=_first_line),
)
NOTICED: Final = EventKind(
    "noticed",
    "by the bridge",
    noticed_events,
    stored=True,
    drawn=6,
    alike=Alike(lambda events, unit: f"times {events[0].details['what']}", sort=_what),
)
IMAGE: Final = EventKind(
    "image",
    "",
    image_events,
    stored=True,
    usual=lambda options: False,  # no news, and there may be thousands
    routine=True,
    counted=False,
)
