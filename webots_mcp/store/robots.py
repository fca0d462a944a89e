"""Find robots that were ever recorded.

Their rows, the one a name means, and what an observer saw.
"""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.contract import (
    OBSERVER,
    WORLD_EVENT,
    recorded_name,
)
from webots_mcp.errors import AmbiguousRobotError, NothingRecordedError, UnknownRobotError
from webots_mcp.signals.naming import SOLIDS, WORLD
from webots_mcp.store.run_rows import (
    RunRecord,
    state_at,
)
from webots_mcp.store.sessions import SessionRecord, newest_session

_SHOWN_NAMES: Final = 20


@dataclass(frozen=True)
class RobotRecord:
    """The name of a robot that was ever recorded, with its latest session."""

    id: int
    name: str
    kind: str
    devices: dict[str, str]
    first_seen_wall_time_s: float
    last_seen_wall_time_s: float
    session: SessionRecord | None
    live: bool


@dataclass(frozen=True)
class WorldSeen:
    """What an observer has seen of a world.

    Attributes:
        observer: Its name.
        content: Its content: title, robots, solids.
        places: The newest position of each in the run, by its name in signals.
    """

    observer: str
    content: dict[str, Any]
    places: dict[str, dict[str, float | None]]


def list_robots(connection: sqlite3.Connection, now_s: float) -> list[RobotRecord]:
    """Return every recorded robot, in the order of first appearance."""
    return [
        _robot(connection, row, now_s)
        for row in connection.execute(
            "SELECT id, name, kind, devices, first_seen_wall_time_s, last_seen_wall_time_s "
            "FROM robot ORDER BY id"
        ).fetchall()
    ]


def robot_name(connection: sqlite3.Connection, robot_id: int) -> str:
    """Return the name of the robot with an id.

    Raises:
        NothingRecordedError: Its row is missing or cannot be read.
    """
    row = connection.execute("SELECT name FROM robot WHERE id = ?", (robot_id,)).fetchone()
    if row is None:
        raise NothingRecordedError(f"robot {robot_id} has no row that can be read")
    return row[0]


def nothing_recorded(connection: sqlite3.Connection) -> str:
    """Return that no robot was ever recorded, with what Webots' console says about it."""
    text = "No robot has been recorded in this database yet"
    trouble = console_trouble(connection)
    return f"{text}. {trouble}" if trouble else text


def console_trouble(connection: sqlite3.Connection) -> str | None:
    """Return the newest warnings of Webots' console that belong to no run, or None.

    A controller that fails before its bridge exists leaves nothing else. Lines from before the
    newest session are left out, because a controller has recorded since.
    """
    # Lines of the newest Webots, unless a controller has started recording since. Lines of
    # controllers come first: a traceback ends with the reason, and Webots itself only says that it
    # exited.
    said = [
        repr(message)
        for (message,) in connection.execute(
            "WITH trouble AS (SELECT id, instance, source, message FROM console_line "
            "WHERE level IN ('warning', 'error', 'critical') "
            "AND wall_time_s > (SELECT coalesce(max(started_wall_time_s), 0) FROM session)) "
            "SELECT substr(message, 1, 200) FROM trouble WHERE id IN (SELECT max(id) FROM trouble "
            "WHERE instance = (SELECT instance FROM trouble ORDER BY id DESC LIMIT 1) "
            "GROUP BY source) ORDER BY source = 'console' DESC, id"
        ).fetchall()
    ]
    if not said:
        return None
    return (
        f"Webots' console says {' and '.join(said)}: a controller may have failed before it "
        "recorded anything. webots_get_logs shows the console"
    )


def resolve_robot(connection: sqlite3.Connection, name: str | None, now_s: float) -> RobotRecord:
    """Return the robot of that name; by default the only live one, else the only recorded one.

    Without a name, an observer is meant only if there is no other robot.

    Raises:
        NothingRecordedError: No robot was ever recorded.
        UnknownRobotError: No robot has that name; the text offers similar names.
        AmbiguousRobotError: No name was given and several robots are possible; the text lists them.
    """
    robots = list_robots(connection, now_s)
    if not robots:
        raise NothingRecordedError(nothing_recorded(connection))
    if name is not None:
        return _named(robots, name)
    live = [robot for robot in robots if robot.live]
    candidates = without_observers(live or robots)
    if len(candidates) == 1:
        return candidates[0]
    state = "are live" if live else "were recorded and none is live"
    start = "" if live else "Start the simulation, or to read what was recorded "
    name_one = "Name" if live else "name"
    raise AmbiguousRobotError(
        f"{len(candidates)} robots {state}: {_listed(candidates)}. "
        f"{start}{name_one} one of them, for example robot={candidates[0].name!r}."
    )


def without_observers(robots: list[RobotRecord]) -> list[RobotRecord]:
    """Return the robots that act, or the observers if there are no others."""
    return [robot for robot in robots if robot.kind != OBSERVER] or robots


def _named(robots: list[RobotRecord], name: str) -> RobotRecord:
    for robot in robots:
        if robot.name in (name, recorded_name(name)):
            return robot
    from difflib import get_close_matches

    near = get_close_matches(name, [robot.name for robot in robots], n=3, cutoff=0.5)
    offer = f"Did you mean {' or '.join(map(repr, near))}? " if near else ""
    raise UnknownRobotError(
        f"No robot named {name!r} was recorded. {offer}Recorded robots: {_listed(robots)}."
    )


def _listed(robots: list[RobotRecord]) -> str:
    shown = [_described(robot) for robot in robots[:_SHOWN_NAMES]]
    more = len(robots) - len(shown)
    return ", ".join(shown) + (f" and {more} more (webots_list_robots)" if more else "")


def _described(robot: RobotRecord) -> str:
    return f"{robot.name!r} ({robot.kind}, {'live' if robot.live else 'not live'})"


def _robot(
    connection: sqlite3.Connection,
    row: tuple[int, str, str, str | None, float, float],
    now_s: float,
) -> RobotRecord:
    robot_id, name, kind, devices, first_seen_s, last_seen_s = row
    session = newest_session(connection, robot_id)
    live = session is not None and session.is_alive(now_s)
    known = json.loads(devices or "{}")
    return RobotRecord(robot_id, name, kind, known, first_seen_s, last_seen_s, session, live)


def live_observer(
    connection: sqlite3.Connection, session: SessionRecord | None, now_s: float
) -> RobotRecord | None:
    """Return the observer of a session's simulation; without a session the only live one."""
    robots = [robot for robot in list_robots(connection, now_s) if robot.live]
    found = [robot for robot in robots if robot.kind == OBSERVER and robot.session is not None]
    if session is not None:
        here = session.instance
        found = [each for each in found if each.session and each.session.instance == here]
    return found[0] if len(found) == 1 or (found and session is not None) else None


def world_seen(connection: sqlite3.Connection, run: RunRecord) -> WorldSeen | None:
    """Return what an observer saw last during a run; None without an observer."""
    values = {
        "session": run.session_id,
        "first": run.started_wall_time_s,
        "last": run.last_wall_time_s,
    }
    row = connection.execute(
        "SELECT r.id, b.name FROM session s JOIN robot b ON b.id = s.robot_id "
        "JOIN run r ON r.session_id = s.id JOIN session me ON me.id = :session "
        f"WHERE b.kind = '{OBSERVER}' AND s.instance = me.instance "
        "AND r.started_wall_time_s <= :last AND r.last_wall_time_s >= :first "
        "ORDER BY r.id DESC LIMIT 1",
        values,
    ).fetchone()
    if row is None:
        return None
    run_id, observer = row
    found = connection.execute(
        "SELECT data FROM event WHERE run_id IN (SELECT id FROM run WHERE session_id = "
        f"(SELECT session_id FROM run WHERE id = ?)) AND kind = '{WORLD_EVENT}' AND run_id <= ? "
        "ORDER BY id DESC LIMIT 1",
        (run_id, run_id),
    ).fetchone()
    if found is None:
        return None
    return WorldSeen(observer, json.loads(found[0]), _places(connection, run_id, run))


def _places(connection: sqlite3.Connection, run_id: int, run: RunRecord) -> dict[str, Any]:
    until_s = run.last_sim_time_s if run.ended_wall_time_s is not None else float("inf")
    state = state_at(connection, run_id, until_s)
    seen = state.value() if state else {}
    return {**seen.get(WORLD, {}), **seen.get(SOLIDS, {})}
