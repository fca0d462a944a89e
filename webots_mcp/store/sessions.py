"""Read sessions: the controller processes of robots, and whether they still live.

The row of a session is the heartbeat of its bridge.
"""

from __future__ import annotations

import json
import sqlite3
import time
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.contract import (
    HEARTBEAT_LATE_S,
    host_name,
)
from webots_mcp.database.pause_states import (
    PAUSED,
)
from webots_mcp.database.processes import (
    is_living,
    process_alive,
)
from webots_mcp.store.run_rows import (
    columns_of,
)


@dataclass(frozen=True)
class SessionRecord:
    """One controller process; the row is its bridge's heartbeat. Columns as in `store.models`."""

    id: int
    robot_id: int
    pid: int
    process: str | None
    host: str
    instance: str
    extern: bool
    controller: str | None
    controller_sha256: str | None
    git_commit: str | None
    versions: dict[str, Any]
    supervisor: bool
    actions: dict[str, Any]
    started_wall_time_s: float
    last_seen_wall_time_s: float
    last_seen_monotonic_s: float | None
    last_poll_wall_time_s: float | None
    moved_wall_time_s: float | None
    sim_time_s: float | None
    pause_state: str | None
    rows_waiting: int
    rows_dropped: int
    last_error: str | None
    ended_wall_time_s: float | None
    end_reason: str | None

    @property
    def has_bridge(self) -> bool:
        """Return whether it takes commands. Sessions of journals and customData do not."""
        return not self.versions or "webots_mcp" in self.versions

    def is_alive(self, now_s: float) -> bool:
        """Return whether it has not ended and its process still runs."""
        process = (self.host, self.pid, self.process, self.last_seen_wall_time_s)
        return self.ended_wall_time_s is None and is_living(*process, now_s)

    def silent_s(self, now_s: float) -> float:
        """Return the time since its newest heartbeat, in seconds.

        For a process of this machine, a clock is used that cannot be set.
        """
        beat_s = self.last_seen_monotonic_s
        if beat_s is None or self.process is None or not self._is_of_this_boot():
            return now_s - self.last_seen_wall_time_s
        return time.monotonic() - beat_s

    def age_s(self, wall_time_s: float, now_s: float) -> float:
        """Return how long ago the bridge stamped a time, possibly with another clock."""
        return self.silent_s(now_s) + self.last_seen_wall_time_s - wall_time_s

    def heartbeat_is_fresh(self, now_s: float) -> bool:
        """Return whether its newest heartbeat is recent."""
        return self.silent_s(now_s) <= HEARTBEAT_LATE_S

    def _is_of_this_boot(self) -> bool:
        """Return whether its process runs on this machine since its last boot."""
        process = (self.pid, self.process, self.last_seen_wall_time_s)
        return self.host == host_name() and process_alive(*process)


_COLUMNS: Final = columns_of(SessionRecord)


def newest_session(connection: sqlite3.Connection, robot_id: int) -> SessionRecord | None:
    """Return the latest session of a robot, alive or not."""
    query = f"SELECT {_COLUMNS} FROM session WHERE robot_id = ? ORDER BY id DESC LIMIT 1"
    return _session(connection.execute(query, (robot_id,)).fetchone())


def fetch_session(connection: sqlite3.Connection, session_id: int) -> SessionRecord | None:
    """Return the session with an id."""
    query = f"SELECT {_COLUMNS} FROM session WHERE id = ?"
    return _session(connection.execute(query, (session_id,)).fetchone())


def companions(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> list[SessionRecord]:
    """Return the other living sessions in the same simulation."""
    values = {"instance": session.instance, "id": session.id}
    query = (
        f"SELECT {_COLUMNS} FROM session WHERE instance = :instance "
        "AND id <> :id AND ended_wall_time_s IS NULL ORDER BY id"
    )
    rows = connection.execute(query, values).fetchall()
    return [found for row in rows if (found := _session(row)) and found.is_alive(now_s)]


def left_holding(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> SessionRecord | None:
    """Return the newest session of the simulation if it ended while it held its loop."""
    values = {"instance": session.instance, "started": session.started_wall_time_s}
    query = (
        f"SELECT {_COLUMNS} FROM session WHERE instance = :instance AND pause_state = '{PAUSED}' "
        "AND last_seen_wall_time_s >= :started AND id = (SELECT max(id) FROM session n "
        "WHERE n.robot_id = session.robot_id) ORDER BY id DESC LIMIT 1"
    )
    found = _session(connection.execute(query, values).fetchone())
    return found if found is not None and not found.is_alive(now_s) else None


def _session(row: tuple[Any, ...] | None) -> SessionRecord | None:
    if row is None:
        return None
    values = dict(zip(_COLUMNS.split(", "), row, strict=True))
    values["versions"] = json.loads(values["versions"] or "{}")
    values["actions"] = json.loads(values["actions"] or "{}")
    values["supervisor"] = bool(values["supervisor"])
    values["extern"] = bool(values["extern"])
    return SessionRecord(**values)
