"""How a session and its run stand, as the database holds it: each heartbeat, and the end."""

from __future__ import annotations

import sqlite3
import time
from typing import Final, NamedTuple

from webots_mcp.bridge.run import Run

_BEAT_SESSION: Final = (
    "UPDATE session SET last_seen_wall_time_s = ?, last_seen_monotonic_s = ?, "
    "last_poll_wall_time_s = ?, moved_wall_time_s = ?, sim_time_s = ?, hold = ?, "
    "rows_waiting = ?, rows_dropped = ?, last_error = ? WHERE id = ?"
)
_BEAT_RUN: Final = "UPDATE run SET last_wall_time_s = ?, last_sim_time_s = ?, rows = ? WHERE id = ?"


class Pulse(NamedTuple):
    """What a heartbeat says of the loop."""

    sim_time_s: float
    last_poll_wall_time_s: float | None
    moved_wall_time_s: float | None
    hold: str | None


class Health(NamedTuple):
    """What a heartbeat says of the recording."""

    rows_waiting: int
    rows_dropped: int
    last_error: str | None


def write_pulse(
    connection: sqlite3.Connection, pulse: Pulse, health: Health, session_id: int, run: Run
) -> None:
    """Write session and run as they are now, inside a transaction of the caller."""
    now = time.time()
    seen = (now, time.monotonic(), pulse.last_poll_wall_time_s, pulse.moved_wall_time_s)
    connection.execute(_BEAT_SESSION, (*seen, pulse.sim_time_s, pulse.hold, *health, session_id))
    connection.execute(_BEAT_RUN, (now, pulse.sim_time_s, run.rows, run.id))
