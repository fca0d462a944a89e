"""Observers: which one looks at a robot's world, and what it has seen there."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.contract import OBSERVER, WORLD_EVENT
from webots_mcp.naming import SOLIDS, WORLD
from webots_mcp.store.robots import Robot, list_robots
from webots_mcp.store.runs import Run
from webots_mcp.store.sessions import Session
from webots_mcp.store.states import state_at

_BESIDE: Final = (
    "SELECT r.id, b.name FROM session s JOIN robot b ON b.id = s.robot_id "
    "JOIN run r ON r.session_id = s.id JOIN session me ON me.id = :session "
    f"WHERE b.kind = '{OBSERVER}' AND s.instance = me.instance "
    "AND r.started_wall_time_s <= :last AND r.last_wall_time_s >= :first "
    "ORDER BY r.id DESC LIMIT 1"
)
_SEEN: Final = (
    "SELECT data FROM event WHERE run_id IN (SELECT id FROM run WHERE session_id = "
    f"(SELECT session_id FROM run WHERE id = ?)) AND kind = '{WORLD_EVENT}' AND run_id <= ? "
    "ORDER BY id DESC LIMIT 1"
)


@dataclass(frozen=True)
class WorldSeen:
    """What an observer has seen of a world.

    Attributes:
        observer: Its name.
        told: What there is: title, robots, solids.
        places: Where each is, by the word that it has in signals; its newest of the run.
    """

    observer: str
    told: dict[str, Any]
    places: dict[str, dict[str, float | None]]


def live_observer(
    connection: sqlite3.Connection, session: Session | None, now_s: float
) -> Robot | None:
    """The observer of a session's simulation; without a session the only one that lives."""
    robots = [robot for robot in list_robots(connection, now_s) if robot.live]
    found = [robot for robot in robots if robot.kind == OBSERVER and robot.session is not None]
    if session is not None:
        here = session.instance
        found = [each for each in found if each.session and each.session.instance == here]
    return found[0] if len(found) == 1 or (found and session is not None) else None


def world_seen(connection: sqlite3.Connection, run: Run) -> WorldSeen | None:
    """What an observer saw while that run lasted, last of all; None where none was there."""
    values = {
        "session": run.session_id,
        "first": run.started_wall_time_s,
        "last": run.last_wall_time_s,
    }
    row = connection.execute(_BESIDE, values).fetchone()
    if row is None:
        return None
    run_id, observer = row
    told = connection.execute(_SEEN, (run_id, run_id)).fetchone()
    if told is None:
        return None
    return WorldSeen(observer, json.loads(told[0]), _places(connection, run_id, run))


def _places(connection: sqlite3.Connection, run_id: int, run: Run) -> dict[str, Any]:
    until_s = run.last_sim_time_s if run.ended_wall_time_s is not None else float("inf")
    state = state_at(connection, run_id, until_s)
    seen = state.value() if state else {}
    return {**seen.get(WORLD, {}), **seen.get(SOLIDS, {})}
