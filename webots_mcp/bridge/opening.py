"""Opening the database of a controller: creating it, and entering a session."""

from __future__ import annotations

import sqlite3
import time
from pathlib import Path

from webots_mcp.bridge.identity import Identity
from webots_mcp.bridge.registration import Registration, register
from webots_mcp.connection import (
    connect,
    create_schema,
    journal_mode,
    never_wait,
    require_current,
    schema_version,
)
from webots_mcp.contract import DATABASE_NAME, Database, MemoryDatabase
from webots_mcp.waiting_file import adopt


def open_session(
    database: Database, identity: Identity, session_uuid: str, actions: str, *, patient: bool
) -> tuple[sqlite3.Connection, Registration]:
    """Open or create the database, and enter a session of this process.

    Args:
        database: Where to record.
        identity: The robot and the process.
        session_uuid: The session's UUID; a session that the database knows is continued.
        actions: The registered custom actions as JSON text.
        patient: Wait for locks: at the start, not in the loop.

    Returns:
        A connection that never waits for a lock, and the ids to record under.

    Raises:
        DatabaseError, sqlite3.Error, OSError: It cannot be used, at least now.
    """
    connection = connect(database, "loop", create=True, patient=patient)
    try:
        if schema_version(connection) == 0:
            create_schema(connection)
        require_current(connection)
        if patient and isinstance(database, Path):  # in the loop it takes too long
            adopt(connection, database)
        registration = register(connection, identity, session_uuid, actions)
        never_wait(connection)
    except BaseException:
        connection.close()
        raise
    return connection, registration


def why_readers_block(connection: sqlite3.Connection) -> str | None:
    """Why readers block the writer at the database's location; None where they do not."""
    mode = journal_mode(connection)
    if mode in ("wal", "memory"):
        return None
    return (
        f"is on a drive where SQLite cannot share memory (journal mode {mode}: a network drive, or "
        "across Windows and WSL): rows will wait while others read; use a local data folder"
    )


def move_aside(database: Path) -> None:
    """Give a damaged file, its log and its index another name.

    Raises:
        OSError: It cannot be moved.
    """
    stamp = time.strftime("%Y%m%d-%H%M%S")
    for suffix in ("", "-wal", "-shm"):
        damaged = database.with_name(database.name + suffix)
        if damaged.exists():
            damaged.rename(f"{database}.damaged-{stamp}{suffix}")


def is_ours(database: Database, why: str) -> bool:
    """Whether a damaged file may be moved aside: it has our name, or the header of a database.

    The header is judged by SQLite's error text. Closing a file that was read here would drop the
    locks of this process on it, on which a maintainer's or another bridge's connection may depend
    (SQLite, How To Corrupt, 2.2).
    """
    if isinstance(database, MemoryDatabase):
        return False
    return database.name == DATABASE_NAME or "not a database" not in why
