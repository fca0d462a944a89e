"""Collect evidence of what a controller's loop does now: stacks, waiting rows, handlers, pauses.

`robot_status` decides what follows from it and words the result.
"""

from __future__ import annotations

import contextlib
import sqlite3
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import (
    BUILT_IN_ACTIONS,
    HEARTBEAT_INTERVAL_S,
    MODE_EVENT,
    host_name,
)
from webots_mcp.database.pause_states import (
    PAUSE,
    PAUSED,
    SEEN_PAUSED_BY,
    SEEN_RUNNING_BY,
    change_since,
)
from webots_mcp.database.processes import (
    has_lost_simulator,
    is_stopped,
    signal_process,
)
from webots_mcp.database.thread_stacks import (
    LOGGER,
    SIGNAL,
    Stacks,
    needs_signal,
    stacks_at,
    stacks_path,
)
from webots_mcp.database.waiting_file import (
    WaitingEntry,
    count_rows,
    next_entries,
    read_header,
    waiting_path,
)
from webots_mcp.store.robots import robot_name
from webots_mcp.store.run_rows import (
    RunRecord,
    newest_state,
    recent_interval_s,
)
from webots_mcp.store.sessions import SessionRecord, companions


@dataclass(frozen=True)
class _LoopLimits:
    """When the loop of a controller counts as silent or slow.

    Attributes:
        still_moving_s: Maximum age of the last movement at which time still counts as moving.
        slowest_still_moving_s: Maximum of that age, for robots that record seldom.
        pace_intervals: The same limit, in usual intervals between two rows.
        sure_of_hang: Factor by which a silence must exceed the limit of the bridge, and the
            longest silence that ended by itself, before it counts as a hang for certain.
        compared_silences: Number of earlier silences that are compared.
        writing_s: Time that a process gets to write its stacks after a signal.
    """

    still_moving_s: float = 1.0
    slowest_still_moving_s: float = 15.0
    pace_intervals: float = 3.0
    sure_of_hang: float = 2.0
    compared_silences: int = 20
    writing_s: float = 0.1


_LIMITS: Final = _LoopLimits()


def usual_step_s(connection: sqlite3.Connection, session: SessionRecord) -> float:
    """Return how long the loop waited in a step on average, in wall seconds; 0 if unknown."""
    (usual_s,) = connection.execute(
        "SELECT sum(step_wait_wall_s) / nullif(sum(steps), 0) FROM run WHERE session_id = ?",
        (session.id,),
    ).fetchone()
    return usual_s or 0.0


def is_sure_to_hang(connection: sqlite3.Connection, session: SessionRecord, now_s: float) -> bool:
    """Return whether a loop is silent for much longer than its limit and than ever before."""
    stacks = find_stacks(connection, session, now_s)
    if stacks is None:
        return False
    silences = connection.execute(
        "SELECT l.wall_time_s, (SELECT s.wall_time_s FROM state s WHERE s.run_id = l.run_id "
        "AND s.sim_time_s >= l.sim_time_s AND s.wall_time_s > l.wall_time_s "
        "ORDER BY s.sim_time_s, s.id LIMIT 1) FROM log l "
        "WHERE l.run_id IN (SELECT id FROM run WHERE session_id = ?) "
        f"AND l.logger = '{LOGGER}' ORDER BY l.id DESC LIMIT {_LIMITS.compared_silences}",
        (session.id,),
    ).fetchall()
    lasted_s = [
        end_s - noted_s + stacks.limit_s for noted_s, end_s in silences if end_s is not None
    ]
    return session.silent_s(now_s) >= _LIMITS.sure_of_hang * max([stacks.limit_s, *lasted_s])


def moved_wall_time_s(
    connection: sqlite3.Connection, session: SessionRecord, run: RunRecord | None
) -> float | None:
    """Return when simulation time last grew, by the heartbeat or by a row that is newer."""
    row = newest_state(connection, run.id) if run and run.session_id == session.id else None
    if row is None or row.sim_time_s <= (session.sim_time_s or 0.0):
        return session.moved_wall_time_s
    if (
        not session.has_bridge
    ):  # The writer's clock may differ, so a row counts from when it was read.
        return min(row.wall_time_s, session.last_seen_wall_time_s)
    return max(row.wall_time_s, session.moved_wall_time_s or row.wall_time_s)


def is_disconnected(session: SessionRecord) -> bool:
    """Return whether Webots has closed the connection to the controller."""
    return session.host == host_name() and has_lost_simulator(session.pid, session.instance)


def is_unseen(session: SessionRecord, moved_s: float | None) -> bool:
    """Return whether the bridge has seen nothing of the loop yet."""
    return moved_s is None and session.last_poll_wall_time_s is None


def find_stacks(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> Stacks | None:
    """Return where the loop of a session is silent now; None if it is not, or if unknown."""
    path = file_of_session(connection, session, stacks_path)
    stacks = stacks_at(path) if path else None
    return stacks if stacks and stacks.began_after(session.last_seen_wall_time_s) else None


def request_stacks(connection: sqlite3.Connection, session: SessionRecord, now_s: float) -> bool:
    """Ask hanging processes of a simulation, by a signal, to write their stacks.

    A process gets the signal only if its loop is silent for longer than the limit of its bridge
    and the thread of the bridge could not write the stacks, because C code keeps Python's lock.

    Returns:
        Whether a signal was sent.
    """
    asked = False
    for each in (session, *companions(connection, session, now_s)):
        path = file_of_session(connection, each, stacks_path) if each.host == host_name() else None
        if path is None or each.ended_wall_time_s is not None:
            continue
        if not needs_signal(path, each.silent_s(now_s)) or is_stopped(each.pid):
            continue
        if find_backlog(connection, each) is None:  # Else that thread may wait for the database.
            with contextlib.suppress(OSError):
                signal_process(each.pid, each.process, SIGNAL)
                asked = True
    if asked:
        time.sleep(_LIMITS.writing_s)
    return asked


def find_hang(connection: sqlite3.Connection, session: SessionRecord, now_s: float) -> str | None:
    """Describe where in the controller's code the loop hangs; None if it does not."""
    stacks = find_stacks(connection, session, now_s)
    if stacks is None or not stacks.is_hang:
        return None
    silent_s = session.silent_s(now_s)
    hangs = f"silent for {silent_s:.{1 if silent_s < 10 else 0}f} s in {stacks.place}"
    return "; ".join(filter(None, (hangs, handler_at_work(connection, session, now_s))))


def seen_by_observer(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> str | None:
    """Describe the simulation mode that a live observer saw; None without an observer."""
    for each in (session, *companions(connection, session, now_s)):
        found = connection.execute(
            "SELECT json_extract(data, '$.mode') FROM event WHERE run_id IN (SELECT id FROM run "
            f"WHERE session_id = ?) AND kind = '{MODE_EVENT}' ORDER BY id DESC LIMIT 1",
            (each.id,),
        ).fetchone()
        if found is not None and each.heartbeat_is_fresh(now_s):
            text = SEEN_PAUSED_BY if found[0] == "pause" else SEEN_RUNNING_BY
            return text.format(robot_name(connection, each.robot_id))
    return None


def handler_at_work(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> str | None:
    """Return in words which custom action the loop is executing; None if there is none.

    During a custom action only its handler sends heartbeats and steps.
    """
    claimed = connection.execute(
        "SELECT id, action, coalesce(claimed_wall_time_s, created_wall_time_s) FROM command "
        "WHERE robot_id = ? AND session_id = ? "
        "AND status = 'claimed' ORDER BY id DESC",
        (session.robot_id, session.id),
    ).fetchall()
    for command_id, action, since_s in claimed:
        built_in = BUILT_IN_ACTIONS.get(action)
        if built_in is None or built_in.runs_user_code:
            return (
                f"its loop is inside the handler of command {command_id} ({action}) for "
                f"{max(now_s - since_s, 0.0):.1f} s"
            )
    return None


def find_holder(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> SessionRecord | None:
    """Return the session whose bridge holds its loop, which freezes the whole simulation."""
    for candidate in (session, *companions(connection, session, now_s)):
        if candidate.heartbeat_is_fresh(now_s) and _is_holding(connection, candidate):
            return candidate
    return None


def _is_holding(connection: sqlite3.Connection, session: SessionRecord) -> bool:
    since = change_since_heartbeat(connection, session)
    return session.pause_state == PAUSED if since is None else since == PAUSE


def change_since_heartbeat(connection: sqlite3.Connection, session: SessionRecord) -> str | None:
    """Return how the pause changed after the newest heartbeat; None if it did not."""
    beat = (session.sim_time_s or 0.0, session.last_seen_wall_time_s)
    return change_since(connection, session.id, *beat)


def is_recent(connection: sqlite3.Connection, run: RunRecord | None, age_s: float) -> bool:
    """Return whether a movement this long ago means that the loop runs.

    Heartbeats report movements only once in a while, and rows may come seldom.
    """
    if age_s <= _LIMITS.still_moving_s + HEARTBEAT_INTERVAL_S:
        return True
    interval_s = (recent_interval_s(connection, run.id) if run else None) or 0.0
    pace_s = min(_LIMITS.pace_intervals * interval_s, _LIMITS.slowest_still_moving_s)
    return age_s <= pace_s + HEARTBEAT_INTERVAL_S


class FileBacklog(NamedTuple):
    """Rows that wait in a file next to the database, with the times of the first and the newest."""

    file_name: str
    oldest_wall_time_s: float
    newest_wall_time_s: float


def rows_waiting(connection: sqlite3.Connection, session: SessionRecord | None) -> dict[str, Any]:
    """Return `rows_waiting`, and in `waiting_in` the file or the memory in which they wait.

    The row of the session has their number at the last heartbeat, which waits for the same lock.
    """
    if session is None:
        return {"rows_waiting": 0}
    path = file_of_session(connection, session)
    if path is not None and (rows := count_rows(path)):
        return {"rows_waiting": rows, "waiting_in": path.name}
    if session.rows_waiting:
        return {"rows_waiting": session.rows_waiting, "waiting_in": "the controller's memory"}
    return {"rows_waiting": 0}


def find_backlog(connection: sqlite3.Connection, session: SessionRecord) -> FileBacklog | None:
    """Return which rows wait in the file of a session; None if none do."""
    path = file_of_session(connection, session)
    if path is None:
        return None
    with contextlib.suppress(OSError, ValueError), path.open("rb") as file:
        if read_header(file) is not None and (entries := next_entries(file, file.tell())):
            newest_s = path.stat().st_mtime
            return FileBacklog(path.name, min(_oldest_s(entries), newest_s), newest_s)
    return None


def file_of_session(
    connection: sqlite3.Connection,
    session: SessionRecord,
    path_in: Callable[[Path, str], Path] = waiting_path,
) -> Path | None:
    """Return the file of a session; None for a database in memory or a file that is missing."""
    (file,) = connection.execute("SELECT file FROM pragma_database_list").fetchone()
    (uuid,) = connection.execute("SELECT uuid FROM session WHERE id = ?", (session.id,)).fetchone()
    path = path_in(Path(file), uuid) if file else None
    return path if path and path.is_file() else None  # Opening a FIFO would wait for a writer.


def _oldest_s(entries: list[tuple[int, WaitingEntry]]) -> float:
    """Return when the first state, log line or event came; infinite without one."""
    stamped = ("state", "log", "event")
    times = (entry.values for _, entry in entries if entry.kind in stamped)
    return next((float(values[1]) for values in times if isinstance(values, tuple)), float("inf"))
