"""A run, as the bridge knows it before and after its row is written."""

from __future__ import annotations

import time


class Run:
    """A stretch of rising simulation time; its id is None until its row is written."""

    __slots__ = ("id", "rows", "start_reason", "started_sim_time_s", "started_wall_time_s")

    def __init__(self, start_reason: str, sim_time_s: float) -> None:
        self.id: int | None = None
        self.rows = 0
        self.start_reason = start_reason
        self.started_sim_time_s = sim_time_s
        self.started_wall_time_s = time.time()
