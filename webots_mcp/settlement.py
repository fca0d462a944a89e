"""What became of sessions and commands whose process is gone; both sides settle it alike.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import sqlite3
import time
from pathlib import Path
from typing import Final

from webots_mcp.contract import ISSUED_TIME_TO_LIVE_S, host_name
from webots_mcp.entries import waiting_path
from webots_mcp.liveness import process_alive

EXPIRE: Final = (
    "UPDATE command SET status = 'expired', finished_wall_time_s = :now, "
    "error = 'no controller claimed it in time; it will never run' "
    "WHERE status = 'pending' AND expires_wall_time_s <= :now"
)
LOSE: Final = (
    "UPDATE command SET status = 'lost', finished_wall_time_s = :now, error = :why "
    "WHERE id = :id AND status = 'claimed'"
)
END_SESSION: Final = (
    "UPDATE session SET ended_wall_time_s = last_seen_wall_time_s, end_reason = :reason "
    "WHERE id = :id AND ended_wall_time_s IS NULL"
)
# Judged from outside: the rows are counted, because the dead process could not say how many; and
# its last row may be younger than its last heartbeat. Counting takes long, and so comes first: no
# robot waits for it, and what it found stays true, since nobody else writes to these runs.
_LAST_ROW: Final = (
    "coalesce((SELECT {0} FROM state WHERE run_id = run.id ORDER BY sim_time_s DESC LIMIT 1), {1})"
)
_FOUND: Final = (
    f"SELECT id AS run, "
    f"max(last_wall_time_s, {_LAST_ROW.format('wall_time_s', 'last_wall_time_s')}), "
    f"max(last_sim_time_s, {_LAST_ROW.format('sim_time_s', 'last_sim_time_s')}), "
    "purged_rows + (SELECT count(*) FROM state WHERE run_id = run.id) "
    "FROM run WHERE session_id = ? AND ended_wall_time_s IS NULL"
)
END_RUN: Final = (
    "UPDATE run SET ended_wall_time_s = :last_s, last_wall_time_s = :last_s, "
    "last_sim_time_s = :last_sim_s, end_reason = :reason, rows = :rows "
    "WHERE id = :id AND ended_wall_time_s IS NULL"
)
EXTERN: Final = "nobody starts an extern controller again: start it by hand"
_OPEN_SESSIONS: Final = (
    "SELECT id, pid, CAST(process AS BLOB), last_seen_wall_time_s, EXISTS (SELECT 1 FROM command "
    "WHERE session_id = session.id AND action = 'reload' AND issued_wall_time_s IS NOT NULL) "
    "FROM session WHERE ended_wall_time_s IS NULL AND host = ?"
)
_FILE: Final = "SELECT file FROM pragma_database_list WHERE name = 'main'"
_CLAIMED_BY_ENDED: Final = (
    "SELECT c.id, c.issued_wall_time_s, s.extern, s.uuid FROM command c "
    "LEFT JOIN session s ON s.id = c.session_id "
    "WHERE c.status = 'claimed' AND (s.id IS NULL OR s.ended_wall_time_s IS NOT NULL)"
)


def settle(connection: sqlite3.Connection, now_s: float) -> None:
    """Say what became of everything that nobody alive will finish.

    Pending commands past their time become `expired`. Open sessions whose process on this host is
    gone are ended (`reload` if they asked for one, else `crashed`). Commands claimed by an ended
    session become `lost`, and are never run again by themselves; only one that asked Webots for a
    reload gets a minute for the next session to confirm it, where Webots starts one. Where a file
    of the session waits beside the database, the command's result may be in it: who takes that
    in settles the rest.

    The caller opens the transaction, or accepts that each statement is one of its own.
    """
    connection.execute(EXPIRE, {"now": now_s})
    for session_id, reason in gone_sessions(connection):
        end_session(connection, session_id, reason)
    for command_id, issued_s, extern, uuid in connection.execute(_CLAIMED_BY_ENDED).fetchall():
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
    """Whether entries of that session may still wait beside the database."""
    ((file,),) = connection.execute(_FILE).fetchall()
    return bool(file and session_uuid) and waiting_path(Path(file), f"{session_uuid}").exists()


def settle_gone(connection: sqlite3.Connection) -> None:
    """Settle where a session looks open and is not: views and SQL can't judge processes."""
    if gone_sessions(connection):
        settle(connection, time.time())


def gone_sessions(connection: sqlite3.Connection) -> list[tuple[int, str]]:
    """Sessions that look open although their process on this host is gone, and how they ended."""
    sessions = connection.execute(_OPEN_SESSIONS, (host_name(),)).fetchall()
    return [
        (session_id, "reload" if reloading else "crashed")
        for session_id, pid, process, seen_s, reloading in sessions
        if not process_alive(pid, process and process.decode("utf-8", "replace"), seen_s)
    ]


def end_session(connection: sqlite3.Connection, session_id: int, reason: str) -> None:
    """End a session that another process left open, and its runs, as of their last sign of life."""
    for run_id, last_s, last_sim_s, rows in connection.execute(_FOUND, (session_id,)).fetchall():
        times = {"last_s": last_s, "last_sim_s": last_sim_s}
        connection.execute(END_RUN, {"id": run_id, "reason": reason, "rows": rows, **times})
    # Last: whoever is killed before leaves a session that is settled again.
    connection.execute(END_SESSION, {"id": session_id, "reason": reason})
