"""Finds sessions whose controller has died, and settles what they left open: runs and commands.

A session is dead once its process no longer runs (`processes`); silence alone does not count. Its
runs are ended as of their last sign of life, and its commands become `lost`. The sentence that a
reader gets about a dead controller is in `store.why_ended`.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from webots_mcp.contract import ISSUED_TIME_TO_LIVE_S, host_name
from webots_mcp.database.processes import is_living, process_alive
from webots_mcp.database.queue import CLAIMED_BY_ENDED, EXPIRE, LOSE
from webots_mcp.database.waiting_file import waiting_path

# A dead process cannot report its rows, so they are counted; the last row may be younger than the
# last heartbeat. Counting takes long, so it comes first, while no robot waits for the lock. The
# count stays right, since no other process writes to these runs.
_LAST_ROW: Final = (
    "coalesce((SELECT {0} FROM state WHERE run_id = run.id ORDER BY sim_time_s DESC LIMIT 1), {1})"
)
EXTERN: Final = "Webots does not restart an extern controller: start it by hand"


class OpenSession(NamedTuple):
    """A session that has not ended."""

    session_id: int
    host: str
    pid: int
    process: str | None
    last_seen_wall_time_s: float
    instance: str
    kind: str


def free_name(
    connection: sqlite3.Connection, name: str, makes_way: Callable[[OpenSession], bool]
) -> str:
    """Return the name for a robot's new session; `#2` and so on if a living session has the name.

    Dead sessions of that name are ended as `superseded`. The caller opens the transaction.

    Args:
        connection: A connection in a transaction.
        name: The robot's own name.
        makes_way: Returns whether a living session gives up its name, as an observer's recording
            of `customData` does for a bridge.
    """
    wanted, number = name, 1
    while True:
        statement = (
            "SELECT s.id, s.host, s.pid, s.process, s.last_seen_wall_time_s, s.instance, r.kind "
            "FROM session s JOIN robot r ON r.id = s.robot_id "
            "WHERE r.name = ? AND s.ended_wall_time_s IS NULL"
        )
        sessions = [OpenSession(*row) for row in connection.execute(statement, (wanted,))]
        living = (each for each in sessions if is_living(*each[1:5], time.time()))
        if all(map(makes_way, living)):
            for session in sessions:
                end_session(connection, session.session_id, "superseded")
            return wanted
        number += 1
        wanted = f"{name}#{number}"


def reap(connection: sqlite3.Connection, now_s: float) -> None:
    """Settle everything that no live process will finish.

    - Pending commands past their time become `expired`.
    - Open sessions whose process on this host has ended are ended: as `reload` if they requested
      one, else as `crashed`.
    - Commands claimed by an ended session become `lost` and never run again by themselves. A
      reload gets a minute in which the next session may confirm it, unless the controller is
      extern. If a file of the session waits next to the database, the command's result may be in
      it: the process that ingests the file settles the command.

    The caller opens the transaction, or accepts that each statement is a transaction of its own.
    """
    connection.execute(EXPIRE, {"now": now_s})
    for session_id, reason in find_dead_sessions(connection):
        end_session(connection, session_id, reason)
    for command_id, issued_s, extern, uuid in connection.execute(CLAIMED_BY_ENDED).fetchall():
        if _may_wait(connection, uuid):
            continue
        if issued_s is None:
            why = "its controller ended before it finished; it may have run in part"
        elif extern:
            why = f"it was issued to Webots, and its controller's process ended; {EXTERN}"
        elif now_s - issued_s > ISSUED_TIME_TO_LIVE_S:
            why = "it was issued to Webots, but no new controller session confirmed it"
        else:
            continue
        connection.execute(LOSE, {"id": command_id, "now": now_s, "why": why})


def _may_wait(connection: sqlite3.Connection, session_uuid: str | None) -> bool:
    """Return whether rows of that session may still wait in a file next to the database."""
    query = "SELECT file FROM pragma_database_list WHERE name = 'main'"
    ((file,),) = connection.execute(query).fetchall()
    return bool(file and session_uuid) and waiting_path(Path(file), f"{session_uuid}").exists()


def reap_if_dead(connection: sqlite3.Connection) -> None:
    """Settle dead sessions, if there are any: views and SQL cannot check processes."""
    if find_dead_sessions(connection):
        reap(connection, time.time())


def find_dead_sessions(connection: sqlite3.Connection) -> list[tuple[int, str]]:
    """Find sessions that seem open although their process on this host has ended.

    Returns:
        The id of each, and how it ended: `reload` or `crashed`.
    """
    sessions = connection.execute(
        "SELECT id, pid, CAST(process AS BLOB), last_seen_wall_time_s, EXISTS (SELECT 1 "
        "FROM command WHERE session_id = session.id AND action = 'reload' "
        "AND issued_wall_time_s IS NOT NULL) FROM session WHERE ended_wall_time_s IS NULL "
        "AND host = ?",
        (host_name(),),
    ).fetchall()
    return [
        (session_id, "reload" if reloading else "crashed")
        for session_id, pid, process, seen_s, reloading in sessions
        if not process_alive(pid, process and process.decode("utf-8", "replace"), seen_s)
    ]


def end_session(connection: sqlite3.Connection, session_id: int, reason: str) -> None:
    """End a session that another process left open, and its runs, as of their last sign of life."""
    end_runs(connection, session_id, reason)
    # Last: a process that is killed before this leaves a session that will be settled again.
    connection.execute(
        "UPDATE session SET ended_wall_time_s = last_seen_wall_time_s, end_reason = :reason "
        "WHERE id = :id AND ended_wall_time_s IS NULL",
        {"id": session_id, "reason": reason},
    )


def end_runs(
    connection: sqlite3.Connection, session_id: int, reason: str, going_on: str = "none"
) -> None:
    """End the open runs of a session as of their last sign of life, except the run of a UUID."""
    values = (session_id, going_on)
    for run_id, last_s, last_sim_s, rows in connection.execute(
        f"SELECT id AS run, "
        f"max(last_wall_time_s, {_LAST_ROW.format('wall_time_s', 'last_wall_time_s')}), "
        f"max(last_sim_time_s, {_LAST_ROW.format('sim_time_s', 'last_sim_time_s')}), "
        "purged_rows + (SELECT count(*) FROM state WHERE run_id = run.id) "
        "FROM run WHERE session_id = ? AND ended_wall_time_s IS NULL AND coalesce(uuid, '') <> ?",
        values,
    ).fetchall():
        times = {"last_s": last_s, "last_sim_s": last_sim_s}
        connection.execute(
            "UPDATE run SET ended_wall_time_s = :last_s, last_wall_time_s = :last_s, "
            "last_sim_time_s = :last_sim_s, end_reason = :reason, row_count = :rows "
            "WHERE id = :id AND ended_wall_time_s IS NULL",
            {"id": run_id, "reason": reason, "rows": rows, **times},
        )
