"""Sessions and runs that began after a moment."""

from __future__ import annotations

import sqlite3
from typing import Final, NamedTuple

_NEWEST: Final = "SELECT coalesce(max(id), 0) FROM session"
_SINCE: Final = (
    "SELECT robot.name, s.pid, s.instance, "
    "(SELECT min(id) FROM run WHERE session_id = s.id "
    "AND EXISTS (SELECT 1 FROM state WHERE run_id = run.id)) AS run_id, "
    "(SELECT world FROM run WHERE session_id = s.id ORDER BY id LIMIT 1) "
    "FROM session s JOIN robot ON robot.id = s.robot_id WHERE s.id > ? "
    "ORDER BY run_id IS NULL, s.id"
)


class Beginning(NamedTuple):
    """A controller that began to record.

    Attributes:
        robot: Its robot.
        pid: Its process.
        instance: The Webots that it belongs to, as its bridge knows it.
        run_id: Its first run with a state; None before there is one.
        world: The world of its first run.
    """

    robot: str
    pid: int
    instance: str
    run_id: int | None
    world: str | None


def newest_session(connection: sqlite3.Connection) -> int:
    """The id of the newest session; 0 where there is none."""
    ((newest,),) = connection.execute(_NEWEST)
    return int(newest)


def beginnings(connection: sqlite3.Connection, after: int) -> list[Beginning]:
    """The sessions after that one; those that have recorded first."""
    return [Beginning(*row) for row in connection.execute(_SINCE, (after,))]
