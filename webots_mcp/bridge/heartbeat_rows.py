"""What a heartbeat writes of a session and its run."""

from __future__ import annotations

import sqlite3
import time
from typing import Final, NamedTuple

from webots_mcp.bridge.run import Run

# A sign of life is proof against a judgement by others that the process was gone; but a session
# that a later one has followed stays ended.
_ALIVE: Final = (
    "CASE WHEN end_reason = 'crashed' AND NOT EXISTS (SELECT 1 FROM session n "
    "WHERE n.robot_id = {0}.robot_id AND n.id > {0}.{1}) THEN NULL ELSE {2} END"
)
_BEAT_SESSION: Final = (
    "UPDATE session SET last_seen_wall_time_s = ?, last_seen_monotonic_s = ?, "
    "last_poll_wall_time_s = ?, moved_wall_time_s = ?, sim_time_s = ?, hold = ?, hold_mode = ?, "
    "rows_waiting = ?, rows_dropped = ?, last_error = ?, "
    f"ended_wall_time_s = {_ALIVE.format('session', 'id', 'ended_wall_time_s')}, "
    f"end_reason = {_ALIVE.format('session', 'id', 'end_reason')} WHERE id = ?"
)
_BEAT_RUN: Final = (
    "UPDATE run SET last_wall_time_s = ?, last_sim_time_s = ?, rows = ?, "
    f"ended_wall_time_s = {_ALIVE.format('run', 'session_id', 'ended_wall_time_s')}, "
    f"end_reason = {_ALIVE.format('run', 'session_id', 'end_reason')} WHERE id = ?"
)


class LoopStatus(NamedTuple):
    """What a heartbeat says of the loop."""

    sim_time_s: float
    last_poll_wall_time_s: float | None
    moved_wall_time_s: float | None
    command: str | None
    mode_before: str | None


class RecordingStatus(NamedTuple):
    """What a heartbeat says of the recording."""

    rows_waiting: int
    rows_dropped: int
    last_error: str | None


def write_heartbeat(
    connection: sqlite3.Connection,
    loop: LoopStatus,
    recording: RecordingStatus,
    session_id: int,
    run: Run,
) -> None:
    """Write session and run as they are now, inside a transaction of the caller."""
    now = time.time()
    seen = (now, time.monotonic(), loop.last_poll_wall_time_s, loop.moved_wall_time_s)
    how = (loop.sim_time_s, loop.command, loop.mode_before)
    connection.execute(_BEAT_SESSION, (*seen, *how, *recording, session_id))
    connection.execute(_BEAT_RUN, (now, loop.sim_time_s, run.rows, run.id))
