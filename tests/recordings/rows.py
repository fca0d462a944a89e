"""Recordings for tests: rows through the real schema, as a bridge would write them."""

from __future__ import annotations

import json
import os
import socket
import sqlite3
import time
from typing import Any

from webots_mcp.contract import new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.location import Database
from webots_mcp.database.schema import create_schema


def insert(connection: sqlite3.Connection, table: str, values: dict[str, Any]) -> int:
    names, marks = ", ".join(values), ", ".join(f":{name}" for name in values)
    cursor = connection.execute(f"INSERT INTO {table} ({names}) VALUES ({marks})", values)
    assert cursor.lastrowid is not None
    return cursor.lastrowid


class RecordedRobot:
    """One robot with a session and a current run; `now` is when it was last seen."""

    def __init__(self, connection: sqlite3.Connection, name: str, now: float, **session: Any):
        self.connection, self.name, self.now = connection, name, now
        supervisor = session.setdefault("supervisor", 1)
        self.id = self._robot_id(name, "Supervisor" if supervisor else "Robot")
        self.session_id = self.begin_session(**session)
        self.run_id = self.begin_run("start")

    def _robot_id(self, name: str, kind: str) -> int:
        known = self.connection.execute("SELECT id FROM robot WHERE name = ?", (name,)).fetchone()
        values = {
            "name": name,
            "kind": kind,
            "devices": json.dumps({"front": "DistanceSensor", "eye": "Camera", "lidar": "Lidar"}),
            "first_seen_wall_time_s": self.now,
            "last_seen_wall_time_s": self.now,
        }
        return known[0] if known else insert(self.connection, "robot", values)

    def begin_session(self, **changes: Any) -> int:
        values: dict[str, Any] = {
            "robot_id": self.id,
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "instance": "webots-1",
            "controller": "/project/controllers/rover/rover.py",
            "controller_sha256": "a" * 64,
            "versions": json.dumps({"python": "3.11.7", "webots_mcp": "0.1.0"}),
            "supervisor": 1,
            "actions": "{}",
            "started_wall_time_s": self.now,
            "last_seen_wall_time_s": self.now,
            "last_poll_wall_time_s": self.now,
            "moved_wall_time_s": self.now,
            "sim_time_s": 0.0,
        }
        self.session_id = insert(self.connection, "session", values | changes)
        return self.session_id

    def begin_run(self, start_reason: str) -> int:
        values = {
            "session_id": self.session_id,
            "robot_id": self.id,
            "world": "/project/worlds/arena.wbt",
            "basic_time_step_ms": 16.0,
            "start_reason": start_reason,
            "started_wall_time_s": self.now,
            "started_sim_time_s": 0.0,
            "last_wall_time_s": self.now,
            "last_sim_time_s": 0.0,
        }
        self.run_id = insert(self.connection, "run", values)
        return self.run_id

    def beat(self, **changes: Any) -> None:
        """Change columns of the session, as a heartbeat does."""
        names = ", ".join(f"{name} = :{name}" for name in changes)
        values = changes | {"id": self.session_id}
        self.connection.execute(f"UPDATE session SET {names} WHERE id = :id", values)

    def end_run(self, reason: str) -> None:
        self.connection.execute(
            "UPDATE run SET end_reason = ?, ended_wall_time_s = ? WHERE id = ?",
            (reason, self.now, self.run_id),
        )

    def state(
        self, sim_time_s: float, data: object, replaced: object = None, at: float | None = None
    ) -> int:
        wall_time_s = self.now if at is None else at
        values = {
            "run_id": self.run_id,
            "sim_time_s": sim_time_s,
            "wall_time_s": wall_time_s,
            "data": json.dumps(data),
            "replaced": json.dumps(replaced) if replaced else None,
        }
        self.connection.execute(
            "UPDATE run SET last_sim_time_s = ?, last_wall_time_s = ?, row_count = row_count + 1 "
            "WHERE id = ?",
            (sim_time_s, wall_time_s, self.run_id),
        )
        return insert(self.connection, "state", values)

    def log(self, sim_time_s: float, message: str, level: str = "info") -> int:
        values = self._stamped(sim_time_s) | {
            "level": level,
            "source": "controller",
            "message": message,
        }
        return insert(self.connection, "log", values)

    def event(self, sim_time_s: float, kind: str, name: str | None, data: object) -> int:
        values = self._stamped(sim_time_s) | {"kind": kind, "name": name, "data": json.dumps(data)}
        return insert(self.connection, "event", values)

    def kept(self, start_s: float, end_s: float, reason: str) -> int:
        """A stretch at full rate."""
        values = {"run_id": self.run_id, "uuid": new_uuid(), "wall_time_s": self.now}
        span = {"start_sim_time_s": start_s, "end_sim_time_s": end_s}
        return insert(self.connection, "kept_stretch", values | span | {"reason": reason})

    def kept_state(self, sim_time_s: float, data: object) -> int:
        """A call of `publish` that only a stretch has."""
        values = self._stamped(sim_time_s) | {"data": json.dumps(data)}
        return insert(self.connection, "kept_state", values)

    def image(self, sim_time_s: float, path: str, **changes: Any) -> int:
        values = self._stamped(sim_time_s) | {
            "kind": "camera",
            "device": "eye",
            "path": path,
            "width": 160,
            "height": 120,
            "size_bytes": 1000,
        }
        return insert(self.connection, "image", values | changes)

    def _stamped(self, sim_time_s: float) -> dict[str, Any]:
        return {"run_id": self.run_id, "sim_time_s": sim_time_s, "wall_time_s": self.now}


class Recorded:
    """A database of the current schema that a test fills by hand."""

    def __init__(self, database: Database) -> None:
        self.database = database
        self.connection = connect(database, "writer", create=True)
        create_schema(self.connection)

    def robot(self, name: str = "rover", now: float | None = None, **session: Any) -> RecordedRobot:
        return RecordedRobot(self.connection, name, time.time() if now is None else now, **session)

    def close(self) -> None:
        self.connection.close()
