"""What a controller recorded and the database could not take yet, and where that is."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

from webots_mcp.entries import count_rows, waiting_path
from webots_mcp.store.sessions import Session


def waiting(connection: sqlite3.Connection, session: Session | None) -> dict[str, Any]:
    """`rows_waiting`, and `waiting_in` where there are any: a file beside the database, or memory.

    The session's row tells what it was at the last heartbeat, which waits for the same lock.
    """
    if session is None:
        return {"rows_waiting": 0}
    (file,) = connection.execute("SELECT file FROM pragma_database_list").fetchone()
    (uuid,) = connection.execute("SELECT uuid FROM session WHERE id = ?", (session.id,)).fetchone()
    path = waiting_path(Path(file), uuid)
    if rows := count_rows(path) if file else 0:
        return {"rows_waiting": rows, "waiting_in": path.name}
    if session.rows_waiting:
        return {"rows_waiting": session.rows_waiting, "waiting_in": "the controller's memory"}
    return {"rows_waiting": 0}
