"""What a controller recorded and the database could not take yet, and where that is."""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path
from typing import Any, NamedTuple

from webots_mcp.entries import Entry
from webots_mcp.store.sessions import Session
from webots_mcp.waiting_file import count_rows, next_entries, read_header, waiting_path


class FileBacklog(NamedTuple):
    """Rows that wait in a file beside the database: when the first and the newest came."""

    file_name: str
    oldest_wall_time_s: float
    newest_wall_time_s: float


def waiting(connection: sqlite3.Connection, session: Session | None) -> dict[str, Any]:
    """`rows_waiting`, and `waiting_in` where there are any: a file beside the database, or memory.

    The session's row tells what it was at the last heartbeat, which waits for the same lock.
    """
    if session is None:
        return {"rows_waiting": 0}
    path = _path_of(connection, session)
    if path is not None and (rows := count_rows(path)):
        return {"rows_waiting": rows, "waiting_in": path.name}
    if session.rows_waiting:
        return {"rows_waiting": session.rows_waiting, "waiting_in": "the controller's memory"}
    return {"rows_waiting": 0}


def find_backlog(connection: sqlite3.Connection, session: Session) -> FileBacklog | None:
    """What waits in the file of a session; None where nothing does."""
    path = _path_of(connection, session)
    if path is None:
        return None
    with contextlib.suppress(OSError, ValueError), path.open("rb") as file:
        if read_header(file) is not None and (entries := next_entries(file, file.tell())):
            newest_s = path.stat().st_mtime
            return FileBacklog(path.name, min(_oldest_s(entries), newest_s), newest_s)
    return None


def _path_of(connection: sqlite3.Connection, session: Session) -> Path | None:
    """None for a database in memory."""
    (file,) = connection.execute("SELECT file FROM pragma_database_list").fetchone()
    (uuid,) = connection.execute("SELECT uuid FROM session WHERE id = ?", (session.id,)).fetchone()
    return waiting_path(Path(file), uuid) if file else None


def _oldest_s(entries: list[tuple[int, Entry]]) -> float:
    """When the first state, log line or event came; infinite where none of them tells."""
    stamped = ("state", "log", "event")
    times = (entry.values for _, entry in entries if entry.kind in stamped)
    return next((float(values[1]) for values in times if isinstance(values, tuple)), float("inf"))
