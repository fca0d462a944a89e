"""Taking in what waits beside a database: exactly once, in order, in short transactions.

How far that came stands in `session.adopted_rows`, the number of the last entry, which is written
in the same transaction as the rows. So nothing hangs on what happens to the file afterwards: who
finds it again, after a kill or an interrupt at any place, passes over what is in already.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

from webots_mcp.entries import (
    STATEMENTS,
    Entry,
    bind,
    lock,
    next_entries,
    read_header,
    waiting_paths,
)
from webots_mcp.errors import SessionGoneError, warn
from webots_mcp.transactions import in_transaction

_PIECE_S: Final = 0.001  # how long a transaction may keep other writers out

_SESSION_OF: Final = "SELECT id, adopted_rows FROM session WHERE uuid = ?"
_ADOPTED: Final = "SELECT adopted_rows FROM session WHERE id = ?"
_SET_ADOPTED: Final = "UPDATE session SET adopted_rows = ? WHERE id = ?"
_RUN_OF: Final = "SELECT id FROM run WHERE uuid = ?"
_RECOUNT: Final = (
    "SELECT purged_rows + (SELECT count(*) FROM state WHERE run_id = run.id), id FROM run "
    "WHERE session_id = ? AND ended_wall_time_s IS NOT NULL"
)
_SET_ROWS: Final = "UPDATE run SET rows = ? WHERE id = ?"
_KNOWN_ROBOT: Final = (
    "INSERT INTO robot (name, kind, devices, first_seen_wall_time_s, last_seen_wall_time_s) "
    "VALUES (:name, :kind, :devices, :now, :now) ON CONFLICT (name) DO UPDATE SET "
    "kind = excluded.kind, devices = excluded.devices, last_seen_wall_time_s = :now"
)
SESSION_COLUMNS: Final = (
    "uuid",
    "pid",
    "process",
    "host",
    "instance",
    "extern",
    "controller",
    "controller_sha256",
    "git_commit",
    "versions",
    "supervisor",
    "actions",
    "started_wall_time_s",
    "last_seen_wall_time_s",
    "last_seen_monotonic_s",
    "throttle_interval",
)
_NEW_SESSION: Final = (
    f"INSERT INTO session (robot_id, {', '.join(SESSION_COLUMNS)}) "
    f"VALUES (:robot_id, :{', :'.join(SESSION_COLUMNS)}) ON CONFLICT (uuid) "
    "DO UPDATE SET ended_wall_time_s = NULL, end_reason = NULL"
)

# What refuses a row whatever state the database is in: its own content.
_UNFIT: Final = (sqlite3.IntegrityError, sqlite3.DataError, UnicodeEncodeError, OverflowError)

# What a file that was damaged, or made by others, raises while it is read.
_OF_THE_FILE: Final = (
    OSError, ValueError, TypeError, LookupError, RecursionError, SessionGoneError,
)  # fmt: skip

_strange: set[Path] = set()


def is_unfit(error: Exception) -> bool:
    """Whether the row itself is refused; a session that is gone is the database's fault."""
    text = str(error)
    if isinstance(error, (sqlite3.InterfaceError, sqlite3.ProgrammingError)):
        return "bind" in text  # a value of a type that SQLite does not know
    return isinstance(error, _UNFIT) and "FOREIGN KEY" not in text


class Taken(NamedTuple):
    """What one transaction took in.

    Attributes:
        number: Of the last entry that is in.
        written: The entries of this call; those passed over are not among them.
        unfit: Why the database will never take an entry, for each such.
    """

    number: int
    written: list[Entry]
    unfit: list[str]


def take_in(connection: sqlite3.Connection, session_id: int, piece: Sequence[Entry]) -> Taken:
    """Write the entries of a session in one transaction, as many as there is time for.

    Raises:
        sqlite3.Error: Nothing was written.
        SessionGoneError: Somebody deleted the session.
    """

    def act() -> Taken:
        until_s = time.monotonic() + _PIECE_S
        session = connection.execute(_ADOPTED, (session_id,)).fetchone()
        if session is None:
            raise SessionGoneError(f"the session {session_id} was deleted from the database")
        taken = Taken(session[0], [], [])
        for entry in piece:
            if entry.number > taken.number:
                taken = taken._replace(number=entry.number)
                why = _write(connection, session_id, entry)
                taken.unfit.append(why) if why else taken.written.append(entry)
                if time.monotonic() > until_s:
                    break
        connection.execute(_SET_ADOPTED, (taken.number, session_id))
        return taken

    return in_transaction(connection, act)


def _write(connection: sqlite3.Connection, session_id: int, entry: Entry) -> str | None:
    """Write an entry; or why the database will never take it, which stops no other."""
    run_id = None
    try:
        if entry.run is not None:
            row = connection.execute(_RUN_OF, (entry.run,)).fetchone()
            if row is None:
                return f"its run {entry.run} is not known"
            run_id = row[0]
        connection.execute(STATEMENTS[entry.kind], bind(run_id, session_id, entry.values))
    except Exception as error:
        if not is_unfit(error):
            raise
        return str(error)
    return None


def adopt(connection: sqlite3.Connection, database: Path) -> int:
    """Take in what sessions left behind whose process is gone; that of the living is theirs.

    Args:
        connection: A writer in autocommit mode and in no transaction.
        database: Its file.

    Returns:
        How many rows and other writes that was. A file that cannot be taken in stays, is said
        once, and keeps nobody from recording.

    Raises:
        sqlite3.Error: The database is locked; what is in is in, the rest waits.
    """
    return sum(_adopt_file(connection, path) for path in waiting_paths(database))


def _adopt_file(connection: sqlite3.Connection, path: Path) -> int:
    try:
        with path.open("r+b") as file:
            if not lock(file.fileno()) or os.fstat(file.fileno()).st_nlink == 0:
                return 0
            count = _adopt_open(connection, file)
            if os.name != "nt":
                path.unlink()
        if os.name == "nt":  # where an open file cannot be deleted; who finds it passes it over
            path.unlink()
    except FileNotFoundError:  # another took it in meanwhile
        return 0
    except Exception as error:
        if not (isinstance(error, _OF_THE_FILE) or is_unfit(error)):
            raise
        _warn_once(path, error)
        return 0
    return count


def _warn_once(path: Path, error: Exception) -> None:
    """A file that stays is met again each second."""
    if path not in _strange:
        _strange.add(path)
        speaks = isinstance(error, (OSError, ValueError))
        why = str(error) if speaks else f"it is damaged ({error!r})"
        warn(f"what waits in {path} cannot be taken in: {why}")


def _adopt_open(connection: sqlite3.Connection, file: BinaryIO) -> int:
    header = read_header(file)
    if header is None:
        return 0
    session_id = _session(connection, header)
    offset, count, unfit = file.tell(), 0, list[str]()
    while piece := next_entries(file, offset):
        taken = take_in(connection, session_id, [entry for _, entry in piece])
        offset = max(end for end, entry in piece if entry.number <= taken.number)
        count += sum(entry.kind != "run" for entry in taken.written)
        unfit += taken.unfit
    if count:
        for counted in connection.execute(_RECOUNT, (session_id,)).fetchall():
            connection.execute(_SET_ROWS, counted)
    if unfit:
        warn(f"{len(unfit)} rows that waited in {file.name} were refused: {unfit[0]}")
    return count


def _session(connection: sqlite3.Connection, header: dict[str, Any]) -> int:
    """The session's id; it is entered where the database does not know it."""
    known = connection.execute(_SESSION_OF, (header["session"]["uuid"],)).fetchone()
    if known is not None:
        return int(known[0])

    def act() -> int:
        robot_id = enter_robot(
            connection, header["robot"], header["session"]["started_wall_time_s"]
        )
        return enter_session(connection, robot_id, header["session"])

    return in_transaction(connection, act)


def enter_robot(connection: sqlite3.Connection, robot: dict[str, Any], now_s: float) -> int:
    """The robot's id; its row is made or brought up to date."""
    connection.execute(_KNOWN_ROBOT, {**robot, "now": now_s})
    found = connection.execute("SELECT id FROM robot WHERE name = ?", (robot["name"],)).fetchone()
    return int(found[0])


def enter_session(connection: sqlite3.Connection, robot_id: int, session: dict[str, Any]) -> int:
    """Make a session's row, of columns and their values; one of that UUID is gone on with."""
    values = dict.fromkeys(SESSION_COLUMNS) | session
    connection.execute(_NEW_SESSION, {**values, "robot_id": robot_id})
    return int(connection.execute(_SESSION_OF, (session["uuid"],)).fetchone()[0])
