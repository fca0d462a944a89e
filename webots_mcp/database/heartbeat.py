"""The heartbeat of a session: what it reports of the loop and the recording, and how it is written.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import sqlite3
import time
from typing import Final, NamedTuple

# A heartbeat proves wrong that another process has ended the session as crashed, unless a later
# session has followed: then it stays ended.
_ALIVE: Final = (
    "CASE WHEN end_reason = 'crashed' AND NOT EXISTS (SELECT 1 FROM session n "
    "WHERE n.robot_id = {0}.robot_id AND n.id > {0}.{1}) THEN NULL ELSE {2} END"
)
NO_TIMES: Final = (None, None, None)  # in place of `LoopTimes`: no round of the loop was seen


class LoopTimes(NamedTuple):
    """The wall time of a run in the controller's own code and in its steps, and their number."""

    own_s: float
    step_wait_s: float
    steps: int


class LoopStatus(NamedTuple):
    """What a heartbeat reports of the loop."""

    sim_time_s: float
    last_poll_wall_time_s: float | None
    moved_wall_time_s: float | None
    command: str | None
    mode_before: str | None
    times: LoopTimes | None = None


class RecordingStatus(NamedTuple):
    """What a heartbeat reports of the recording."""

    rows_waiting: int
    rows_dropped: int
    last_error: str | None


def write_heartbeat(
    connection: sqlite3.Connection,
    loop: LoopStatus,
    recording: RecordingStatus,
    session_id: int,
    run_id: int | None,
    rows: int,
) -> None:
    """Write the status of a session and its run, inside a transaction of the caller.

    Args:
        connection: A connection in a transaction.
        loop: The status of the loop.
        recording: The status of the recording.
        session_id: The session.
        run_id: Its current run; None before its row is written.
        rows: How many states of that run are in the database.
    """
    now = time.time()
    seen = (now, time.monotonic(), loop.last_poll_wall_time_s, loop.moved_wall_time_s)
    how = (loop.sim_time_s, loop.command, loop.mode_before)
    connection.execute(
        "UPDATE session SET last_seen_wall_time_s = ?, last_seen_monotonic_s = ?, "
        "last_poll_wall_time_s = ?, moved_wall_time_s = ?, sim_time_s = ?, pause_state = ?, "
        "mode_before_pause = ?, rows_waiting = ?, rows_dropped = ?, last_error = ?, "
        f"ended_wall_time_s = {_ALIVE.format('session', 'id', 'ended_wall_time_s')}, "
        f"end_reason = {_ALIVE.format('session', 'id', 'end_reason')} WHERE id = ?",
        (*seen, *how, *recording, session_id),
    )
    connection.execute(
        "UPDATE run SET last_wall_time_s = ?, last_sim_time_s = ?, row_count = ?, "
        "own_wall_s = ?, step_wait_wall_s = ?, steps = ?, "
        f"ended_wall_time_s = {_ALIVE.format('run', 'session_id', 'ended_wall_time_s')}, "
        f"end_reason = {_ALIVE.format('run', 'session_id', 'end_reason')} WHERE id = ?",
        (now, loop.sim_time_s, rows, *(loop.times or NO_TIMES), run_id),
    )
