"""A run, as the bridge knows it before and after its row is written."""

from __future__ import annotations

import time
from typing import Any

from webots_mcp.bridge.identity import Identity
from webots_mcp.contract import new_uuid


class Run:
    """A stretch of rising simulation time; its id is None until its row is written.

    Attributes:
        rows: The number of its states in the database.
        counted: Whether `rows` is exact: an interrupt may come between a row and its count.
    """

    __slots__ = (
        "counted",
        "id",
        "rows",
        "start_reason",
        "started_sim_time_s",
        "started_wall_time_s",
        "uuid",
    )

    def __init__(self, start_reason: str, sim_time_s: float) -> None:
        self.id: int | None = None
        self.uuid = new_uuid()
        self.rows = 0
        self.counted = True
        self.start_reason = start_reason
        self.started_sim_time_s = sim_time_s
        self.started_wall_time_s = time.time()

    def begin_anew(self) -> None:
        """Continue as a new run, in a new database."""
        self.id = None
        self.uuid = new_uuid()
        self.rows = 0

    def describe(self, identity: Identity) -> dict[str, Any]:
        """The values of its own row."""
        return {
            "uuid": self.uuid,
            "world": identity.world,
            "step_ms": identity.basic_time_step_ms,
            "reason": self.start_reason,
            "wall_time": self.started_wall_time_s,
            "sim_time": self.started_sim_time_s,
        }
