"""Which robots were ever seen, which one is meant, and which are alive."""

from __future__ import annotations

import difflib
import json
import sqlite3
from dataclasses import dataclass
from typing import Final

from webots_mcp.contract import OBSERVER
from webots_mcp.errors import AmbiguousRobotError, NothingRecordedError, UnknownRobotError
from webots_mcp.store.sessions import Session, newest_session

_ALL: Final = (
    "SELECT id, name, kind, devices, first_seen_wall_time_s, last_seen_wall_time_s "
    "FROM robot ORDER BY id"
)
_NAME: Final = "SELECT name FROM robot WHERE id = ?"
_SHOWN_NAMES: Final = 20


@dataclass(frozen=True)
class Robot:
    """A robot name that was ever seen, with its latest session."""

    id: int
    name: str
    kind: str
    devices: dict[str, str]
    first_seen_wall_time_s: float
    last_seen_wall_time_s: float
    session: Session | None
    live: bool


def list_robots(connection: sqlite3.Connection, now_s: float) -> list[Robot]:
    """Every robot ever seen, in the order in which they first appeared."""
    return [_robot(connection, row, now_s) for row in connection.execute(_ALL).fetchall()]


def robot_name(connection: sqlite3.Connection, robot_id: int) -> str:
    """The name of the robot of that id.

    Raises:
        NothingRecordedError: Its row is not there, or cannot be read.
    """
    row = connection.execute(_NAME, (robot_id,)).fetchone()
    if row is None:
        raise NothingRecordedError(f"robot {robot_id} has no row that can be read")
    return row[0]


def resolve_robot(connection: sqlite3.Connection, name: str | None, now_s: float) -> Robot:
    """The robot of that name; without a name the only live one, else the only one ever seen.

    An observer is meant without a name only where there is no other robot.

    Raises:
        NothingRecordedError: No robot was ever seen.
        UnknownRobotError: None has that name; the text offers near ones.
        AmbiguousRobotError: No name was given and several are possible; the text lists them.
    """
    robots = list_robots(connection, now_s)
    if not robots:
        raise NothingRecordedError("no robot has been recorded in this database yet")
    if name is not None:
        return _named(robots, name)
    live = [robot for robot in robots if robot.live]
    candidates = without_observers(live or robots)
    if len(candidates) == 1:
        return candidates[0]
    state = "are live" if live else "were recorded and none is live"
    start = "" if live else "start the simulation, or for what was recorded "
    raise AmbiguousRobotError(
        f"{len(candidates)} robots {state}: {_listed(candidates)}; "
        f"{start}say which one with robot=..."
    )


def without_observers(robots: list[Robot]) -> list[Robot]:
    """Those that do something; the observers where there is nobody else."""
    return [robot for robot in robots if robot.kind != OBSERVER] or robots


def _named(robots: list[Robot], name: str) -> Robot:
    for robot in robots:
        if robot.name == name:
            return robot
    near = difflib.get_close_matches(name, [robot.name for robot in robots], n=3, cutoff=0.5)
    offer = f"did you mean {' or '.join(map(repr, near))}?" if near else "they are"
    raise UnknownRobotError(f"no robot named {name!r} was recorded; {offer} {_listed(robots)}")


def _listed(robots: list[Robot]) -> str:
    shown = [_described(robot) for robot in robots[:_SHOWN_NAMES]]
    more = len(robots) - len(shown)
    return ", ".join(shown) + (f" and {more} more (webots_list_robots)" if more else "")


def _described(robot: Robot) -> str:
    return f"{robot.name!r} ({robot.kind}, {'live' if robot.live else 'not live'})"


def _robot(
    connection: sqlite3.Connection,
    row: tuple[int, str, str, str | None, float, float],
    now_s: float,
) -> Robot:
    robot_id, name, kind, devices, first_seen_s, last_seen_s = row
    session = newest_session(connection, robot_id)
    live = session is not None and session.is_alive(now_s)
    known = json.loads(devices or "{}")
    return Robot(robot_id, name, kind, known, first_seen_s, last_seen_s, session, live)
