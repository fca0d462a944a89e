"""The sentence that says why a controller has ended: finished, killed, crashed or reloaded.

`robot_status` shows it as the reason of a robot's state. Whether a session is dead follows from its
process, see `database.processes`.
"""

from __future__ import annotations

import sqlite3
from typing import Final

from webots_mcp.contract import CUSTOM_DATA, ENDED_BY, UNSEEN
from webots_mcp.database.session_cleanup import EXTERN
from webots_mcp.database.thread_stacks import LOGGER, stacks_at, stacks_path
from webots_mcp.store.loop_evidence import file_of_session
from webots_mcp.store.sessions import SessionRecord

_ENDED: Final = {
    "finished": "its controller finished",
    "reload": "the world was reloaded and no new controller session has appeared yet",
    "crashed": "its controller process is gone without having finished (killed or crashed)",
    "superseded": "a newer session took its place",
}
_MAX_ERROR_CHARACTERS: Final = 300  # characters of the exception that ended a controller


def why_ended(connection: sqlite3.Connection, session: SessionRecord) -> str | None:
    """Return why the controller of a dead session ended."""
    (kind,) = connection.execute(
        "SELECT kind FROM robot WHERE id = ?", (session.robot_id,)
    ).fetchone() or (None,)
    if kind == CUSTOM_DATA:
        return (
            "it was recorded by the observer from its customData: the observer ended, or the "
            "robot is gone"
        )
    if session.end_reason is None and (ended := _run_ended(connection, session)) == "finished":
        # the event describes the run; the session had no time left to record its own end
        return _ENDED[ended]
    if session.end_reason == "reload" and session.extern:
        return f"the world was reloaded, which ended its controller; {EXTERN}"
    if session.end_reason == "finished" and (unseen := unseen_report(session)):
        return unseen
    if session.end_reason == "finished" and _run_ended(connection, session) == "reset":
        return "a reset ended its last run, then its controller finished before another began"
    if session.end_reason == "crashed" and (error := ended_by(connection, session.id)):
        return f"its controller ended by {error}"
    why = _ENDED.get(session.end_reason or "crashed")
    if session.end_reason in (None, "crashed"):
        hung = connection.execute(
            "SELECT message FROM log WHERE run_id = (SELECT max(id) FROM run "
            f"WHERE session_id = ?) AND logger = '{LOGGER}' AND wall_time_s > ? ORDER BY id DESC "
            "LIMIT 1",
            (session.id, session.last_seen_wall_time_s),
        ).fetchone()
        said = hung[0] if hung else _left_stacks(connection, session)
        why = f"{why}; it was {said.partition(chr(10))[0]}" if said else why
    return why


def ended_by(connection: sqlite3.Connection, session_id: int) -> str | None:
    """Return the exception that ended a controller; None if its bridge could not log it."""
    found = connection.execute(
        "SELECT message FROM log WHERE run_id = (SELECT max(id) FROM run WHERE session_id = ?) "
        "AND level = 'error' AND source = 'controller' AND message GLOB ? "
        "ORDER BY sim_time_s DESC, id DESC LIMIT 1",
        (session_id, f"{ENDED_BY} *"),
    ).fetchone()
    return found[0].removeprefix(f"{ENDED_BY} ")[:_MAX_ERROR_CHARACTERS] if found else None


def unseen_report(session: SessionRecord) -> str | None:
    """Return the report of its bridge that the loop steps without it; None without a report."""
    return UNSEEN if (session.last_error or "").startswith(UNSEEN) else None


def _run_ended(connection: sqlite3.Connection, session: SessionRecord) -> str | None:
    """Return how the last run of a session ended; None where that is not known."""
    found = connection.execute(
        "SELECT end_reason FROM run WHERE session_id = ? ORDER BY id DESC LIMIT 1", (session.id,)
    ).fetchone()
    return found[0] if found else None


def _left_stacks(connection: sqlite3.Connection, session: SessionRecord) -> str | None:
    """Return where a dead process hung, from a file that was not ingested yet."""
    path = file_of_session(connection, session, stacks_path)
    stacks = stacks_at(path) if path else None
    is_current = stacks and stacks.is_hang and stacks.began_after(session.last_seen_wall_time_s)
    return f"{stacks.log_values(None)['message']}" if stacks and is_current else None
