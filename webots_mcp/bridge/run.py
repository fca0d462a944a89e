"""A run, as the bridge knows it before and after its row is written."""

from __future__ import annotations

import sqlite3
import time
from typing import Final

from webots_mcp.bridge.identity import Identity
from webots_mcp.bridge.registration import Registration
from webots_mcp.contract import new_uuid

INSERT_STATE: Final = (
    "INSERT INTO state (run_id, sim_time_s, wall_time_s, data, odd) VALUES (?, ?, ?, ?, ?)"
)
INSERT_EVENT: Final = (
    "INSERT INTO event (run_id, sim_time_s, wall_time_s, kind, name, data) "
    "VALUES (?, ?, ?, ?, ?, ?)"
)
_INSERT_RUN: Final = (
    "INSERT INTO run (uuid, session_id, robot_id, world, basic_time_step_ms, start_reason, "
    "started_wall_time_s, started_sim_time_s, last_wall_time_s, last_sim_time_s) "
    "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
)


class Run:
    """A stretch of rising simulation time; its id is None until its row is written."""

    __slots__ = ("id", "rows", "start_reason", "started_sim_time_s", "started_wall_time_s", "uuid")

    def __init__(self, start_reason: str, sim_time_s: float) -> None:
        self.begin_anew(0)
        self.start_reason = start_reason
        self.started_sim_time_s = sim_time_s
        self.started_wall_time_s = time.time()

    def begin_anew(self, rows: int) -> None:
        """It has no row yet, or none in the database that is written to from now on."""
        self.id: int | None = None
        self.uuid = new_uuid()
        self.rows = rows


def insert_run(
    connection: sqlite3.Connection, run: Run, owner: Registration, identity: Identity
) -> None:
    """Write the run's row, from which on its id is known."""
    begun = (run.started_wall_time_s, run.started_sim_time_s)
    where = (identity.world, identity.basic_time_step_ms, run.start_reason)
    values = (run.uuid, owner.session_id, owner.robot_id, *where, *begun, *begun)
    run.id = connection.execute(_INSERT_RUN, values).lastrowid
