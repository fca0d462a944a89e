"""The file in which writes of a controller wait for the database, and how they are ingested.

If the database is locked for longer than a control loop may wait, a row is appended to a file of
its session next to the database (`webots.db-waiting-<session uuid>.jsonl`), as one line with one
`write()`. It survives a killed process. The next process that opens the database ingests it:
exactly once, in order, in short transactions. The progress is in `session.last_adopted_entry`,
which is written in the same transaction as the rows. So nothing that happens to the file afterwards
matters: a process that finds it again skips the entries that are already in the database.

The first line has the robot and the session. Each further line is a `WaitingEntry` as a JSON array:
its number, its kind, the UUID of its run and its values. A line that a kill cut off in the middle
of its `write()` is not a JSON array, and its caller never received an answer.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import sqlite3
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, NamedTuple, cast

from webots_mcp.database.queue import CONFIRM_RELOAD, FINISH, ISSUE
from webots_mcp.database.thread_stacks import LOGGER, read_stacks, stacks_path
from webots_mcp.database.transactions import in_transaction
from webots_mcp.errors import SessionGoneError, warn

# The kinds of writes of a running controller; `STATEMENTS` has the statement of each.
Kind = Literal[
    "run",
    "state",
    "event",
    "log",
    "stacks",
    "image",
    "image forgotten",
    "run end",
    "session end",
    "actions",
    "parameter",
    "parameter values",
    "parameter next",
    "meaning",
    "device meanings",
    "command issued",
    "command finished",
    "reload confirmed",
    "breakpoint hit",
    "breakpoint failed",
    "breakpoints forgotten",
    "kept stretch",
    "kept state",
]
Values = tuple[Any, ...] | dict[str, Any]

_OF_MEANING: Final = (
    "name, quantity, role, unit, target_of, same_as, side, low, high"  # in this order
)
_OF_ITEMS: Final = ", ".join(f"json_extract(r.value, '$[{item}]')" for item in range(10))
_SAME_MEANING: Final = (
    "ON CONFLICT (robot_id, name, source, set_by) DO UPDATE SET quantity = excluded.quantity, "
    "role = excluded.role, unit = excluded.unit, target_of = excluded.target_of, "
    "same_as = excluded.same_as, side = excluded.side, low = excluded.low, high = excluded.high, "
    "why = excluded.why, set_wall_time_s = excluded.set_wall_time_s"
)

# Values in a tuple come after the run's id, if there is a run; named values may also use `:run` and
# `:session`. These ids differ between databases, so they never wait in a file.
STATEMENTS: Final[dict[Kind, str]] = {
    "run": (
        "INSERT INTO run (uuid, session_id, robot_id, world, basic_time_step_ms, start_reason, "
        "started_wall_time_s, started_sim_time_s, last_wall_time_s, last_sim_time_s) "
        "SELECT :uuid, id, robot_id, :world, :step_ms, :reason, :wall_time, :sim_time, "
        ":wall_time, :sim_time FROM session WHERE id = :session "
        # A conflict, instead of this question, would use up an id.
        "AND NOT EXISTS (SELECT 1 FROM run WHERE uuid = :uuid)"
    ),
    # An id that a deleted state had is given to no other: see `recording.reserved_state_id`.
    "state": (
        "INSERT INTO state (id, run_id, sim_time_s, wall_time_s, data, replaced) VALUES ("
        "max((SELECT coalesce(max(id), 0) FROM state), "
        "(SELECT CAST(reserved_state_id AS INTEGER) FROM recording)) + 1, ?, ?, ?, ?, ?)"
    ),
    "event": (
        "INSERT INTO event (run_id, sim_time_s, wall_time_s, kind, name, data) "
        "VALUES (?, ?, ?, ?, ?, ?)"
    ),
    "log": (
        "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message, logger) "
        "VALUES (?, ?, ?, ?, ?, ?, ?)"
    ),
    # Of stacks that several processes may find, known by their time.
    "stacks": (
        "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message, logger) "
        "SELECT id, coalesce(:sim_time, last_sim_time_s), :wall_time, 'warning', 'bridge', "
        f":message, '{LOGGER}' FROM run WHERE id = :run AND NOT EXISTS (SELECT 1 FROM log "
        f"WHERE run_id = :run AND wall_time_s = :wall_time AND logger = '{LOGGER}')"
    ),
    "image": (
        "INSERT INTO image (run_id, sim_time_s, wall_time_s, kind, device, path, width, height, "
        "size_bytes) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
    ),
    "image forgotten": "DELETE FROM image WHERE path = ?",
    # Without a number of rows they are counted: a dead process could not say how many.
    "run end": (
        "UPDATE run SET end_reason = :reason, "
        "ended_wall_time_s = coalesce(:now, last_wall_time_s), "
        "last_wall_time_s = coalesce(:now, last_wall_time_s), "
        "last_sim_time_s = coalesce(:sim_time, last_sim_time_s), "
        "own_wall_s = :own, step_wait_wall_s = :step_wait, "
        "steps = :steps, row_count = coalesce(:rows, "
        "purged_rows + (SELECT count(*) FROM state WHERE run_id = :run)) WHERE id = :run"
    ),
    "session end": (
        "UPDATE session SET ended_wall_time_s = coalesce(:now, last_seen_wall_time_s), "
        "last_seen_wall_time_s = coalesce(:now, last_seen_wall_time_s), "
        "last_seen_monotonic_s = :monotonic, end_reason = :reason, rows_waiting = 0, "
        "rows_dropped = :dropped, last_error = :error WHERE id = :session"
    ),
    "actions": "UPDATE session SET actions = :actions WHERE id = :session",
    # What a session declared that ended before another began does not count any more.
    "parameter": (
        "INSERT INTO parameter (robot_id, session_id, name, kind, default_value, low, high, "
        "choices, doc, unit, declared_wall_time_s) SELECT robot_id, id, :name, :kind, :default, "
        ":low, :high, :choices, :doc, :unit, :now FROM session WHERE id = :session "
        "ON CONFLICT (robot_id, name) DO UPDATE SET session_id = excluded.session_id, "
        "kind = excluded.kind, default_value = excluded.default_value, low = excluded.low, "
        "high = excluded.high, choices = excluded.choices, doc = excluded.doc, "
        "unit = excluded.unit, declared_wall_time_s = excluded.declared_wall_time_s, "
        "next_value = NULL WHERE excluded.session_id >= parameter.session_id"
    ),
    # Many at once, all or none: each of `rows` is name, value, is it the default, by whom, command.
    "parameter values": (
        "INSERT INTO parameter_value (run_id, name, sim_time_s, wall_time_s, value, is_default, "
        "set_by, command_id) SELECT :run, json_extract(r.value, '$[0]'), :sim_time, :now, "
        "json_extract(r.value, '$[1]'), json_extract(r.value, '$[2]'), "
        "json_extract(r.value, '$[3]'), (SELECT id FROM command "
        "WHERE id = json_extract(r.value, '$[4]') AND session_id = :session) "
        "FROM json_each(:rows) r"
    ),
    "parameter next": (
        "UPDATE parameter SET next_value = r.next_value FROM (SELECT "
        "json_extract(value, '$[0]') AS name, json_extract(value, '$[1]') AS next_value "
        "FROM json_each(:rows)) AS r WHERE parameter.name = r.name AND session_id = :session "
        "AND robot_id = (SELECT robot_id FROM session WHERE id = :session)"
    ),
    "meaning": (
        f"INSERT INTO meaning (robot_id, {_OF_MEANING}, source, set_wall_time_s, set_by) "
        "SELECT robot_id, :name, :quantity, :role, :unit, :target_of, :same_as, :side, :low, "
        f":high, 'declared', :now, 'controller' FROM session WHERE id = :session {_SAME_MEANING}"
    ),
    # Many at once: each of `rows` is an array of name, what the device says, and why.
    "device meanings": (
        f"INSERT INTO meaning (robot_id, {_OF_MEANING}, why, source, set_wall_time_s, set_by) "
        f"SELECT s.robot_id, {_OF_ITEMS}, 'device', :now, 'bridge' "
        f"FROM session s, json_each(:rows) r WHERE s.id = :session {_SAME_MEANING}"
    ),
    "command issued": ISSUE,
    "command finished": FINISH,
    "reload confirmed": CONFIRM_RELOAD,
    "breakpoint hit": "UPDATE breakpoint SET hit_count = hit_count + 1 WHERE id = ?",
    "breakpoint failed": "UPDATE breakpoint SET enabled = 0, error = ? WHERE id = ?",
    # What a controller's code has set ends with its session.
    "breakpoints forgotten": (
        "DELETE FROM breakpoint WHERE robot_id = (SELECT robot_id FROM session "
        "WHERE id = :session) AND created_by = :by AND coalesce(session_id, 0) < :session "
        "AND (expects IS NULL OR session_id IS NULL)"  # what was expected of earlier runs stays
    ),
    "kept stretch": (
        "INSERT INTO kept_stretch (run_id, uuid, start_sim_time_s, end_sim_time_s, wall_time_s, "
        "reason) VALUES (:run, :uuid, :start, :end, :wall_time, :reason) ON CONFLICT (uuid) "
        "DO UPDATE SET end_sim_time_s = excluded.end_sim_time_s, reason = excluded.reason"
    ),
    "kept state": (
        "INSERT INTO kept_state (run_id, call, sim_time_s, wall_time_s, data, replaced) "
        "VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT (run_id, call) DO NOTHING"
    ),
}
ENTRIES_AT_ONCE: Final = 100  # read, or written in one transaction
FORMAT: Final = 1  # of the file; versions that know another one leave the file alone
MAX_FILE_BYTES: Final = 1_000_000_000
_VERSION: Final = "webots_mcp_waiting"
_SESSION_OF: Final = "SELECT id, last_adopted_entry FROM session WHERE uuid = ?"
_RUN_OF: Final = "SELECT id FROM run WHERE uuid = ? AND session_id = ?"
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
# Errors that mean that a row's own content is refused, whatever state the database is in.
_UNFIT: Final = (sqlite3.IntegrityError, sqlite3.DataError, UnicodeEncodeError, OverflowError)
# Errors that reading a damaged file, or one of unknown origin, may raise.
_OF_THE_FILE: Final = (
    OSError, ValueError, TypeError, LookupError, RecursionError, SessionGoneError,
)  # fmt: skip
# At the end of the name of a journal's part: the session's UUID and the number of the part.
_PART: Final = r"-waiting-([0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12})-(\d{4,})\.jsonl$"


class WaitingFileLimits(NamedTuple):
    """Limits of a file of waiting rows.

    Attributes:
        header_bytes: Maximum size of its first line.
        no_number: First number that SQLite's integers cannot hold.
        locked_byte: Offset of the lock, far beyond the end: Windows refuses to read what is locked.
        piece_s: Time for which a transaction may keep other writers out.
    """

    header_bytes: int = 16_000_000
    no_number: int = 1 << 63
    locked_byte: int = 1 << 40
    piece_s: float = 0.001


_FILE: Final = WaitingFileLimits()


class WaitingEntry(NamedTuple):
    """One write of a session.

    Attributes:
        number: It rises within the session and shows which entries are already in the database.
        kind: The key of its statement in `STATEMENTS`.
        run: UUID of the run that it belongs to.
        values: The values of the statement.
    """

    number: int
    kind: Kind
    run: str | None
    values: Values


def bind(run_id: int | None, session_id: int | None, values: Values) -> Values:
    """Return the values of a statement, with the ids of its run and session."""
    if isinstance(values, dict):
        return {"run": run_id, "session": session_id, **values}
    return values if run_id is None else (run_id, *values)


_strange: set[Path] = set()


def waiting_path(database: Path, session_uuid: str) -> Path:
    """Return the file in which the entries of a session wait."""
    return Path(f"{database}-waiting-{session_uuid}.jsonl")


def waiting_paths(database: Path, kind: Callable[[Path, str], Path] = waiting_path) -> list[Path]:
    """Return the files of a kind; by default those in which entries of bridges wait."""
    names = _names(database, kind)
    return [database.with_name(name) for name in sorted(names) if not re.search(_PART, name)]


def left_waiting(database: Path) -> list[Path]:
    """Return the files of bridges that no living process writes."""
    left: list[Path] = []
    for path in waiting_paths(database):
        with contextlib.suppress(OSError), path.open("r+b") as file:
            if lock(file.fileno()):
                left.append(path)
    return left


def journal_parts(database: Path) -> dict[str, list[Path]]:
    """Return the journals of controllers that open no database, by session.

    Their format is described by 'webots-mcp help journal'.

    Returns:
        Of each UUID the parts in order; those that were written last come last. Where a part is
        here, those before it are complete.
    """
    found: dict[str, list[tuple[int, Path]]] = {}
    for name in _names(database, waiting_path):
        if part := re.search(_PART, name):
            found.setdefault(part[1], []).append((int(part[2]), database.with_name(name)))
    return {
        uuid: [path for _, path in sorted(parts)]
        for uuid, parts in sorted(found.items(), key=lambda each: _written_s(max(each[1])[1]))
    }


def _written_s(path: Path) -> float:
    with contextlib.suppress(OSError):
        return path.stat().st_mtime
    return 0.0  # it was taken in meanwhile


def _names(database: Path, kind: Callable[[Path, str], Path]) -> list[str]:
    before, after = kind(database, "*").name.split("*")
    try:
        with os.scandir(database.parent) as files:
            return [f.name for f in files if f.name.startswith(before) and f.name.endswith(after)]
    except OSError:
        return []


class WaitingFile:
    """The entries of one session that wait next to its database, written by that session.

    The file is made with the first entry and stays locked while it is open: a file that is not
    locked belongs to a process that has ended. All calls come from one thread at a time.

    Args:
        path: See `waiting_path`.
        describe_session: The recording process, as `adopt` enters it into a database without it.
    """

    def __init__(self, path: Path, describe_session: Callable[[], dict[str, Any]]) -> None:
        self.path = path
        self._describe_session = describe_session
        self._header = b""
        self._file: FileIO | None = None
        self._is_whole = True  # it ends with a whole line

    def append(self, entries: list[WaitingEntry]) -> None:
        """Add entries with one `write()`, all or none of them.

        Raises:
            OSError: If they could not be written; a part that was written is not a whole line.
        """
        file = former = self._file
        if file is None or os.fstat(file.fileno()).st_nlink == 0:
            file = self._file = self._made()
            if former is not None:  # the file was deleted
                former.close()
        self._write(file, b"".join(encoded(entry) for entry in entries))

    def read(self, offset: int) -> list[tuple[int, WaitingEntry]]:
        """Return the next entries from that byte on; see `next_entries`."""
        if self._file is None:
            return []
        with open(self._file.fileno(), "rb", closefd=False) as file:
            return next_entries(file, max(offset, len(self._header)))

    def empty(self) -> None:
        """Forget the entries; the header with robot and session stays."""
        if self._file is not None:
            self._file.truncate(len(self._header))
            self._is_whole = True

    def close(self, *, remove: bool) -> None:
        """Close the file; without `remove` it is left for the next opener of the database."""
        file, self._file = self._file, None
        if file is None:
            return
        if remove:
            file.truncate(
                len(self._header)
            )  # a process that finds it before its deletion finds nothing in it
        file.close()
        if remove:
            with contextlib.suppress(OSError):
                self.path.unlink()

    def _made(self) -> FileIO:
        """Create a file with robot and session, and with the entries of a deleted one."""
        file = open(self.path, "a+b", buffering=0, opener=_open_privately)  # noqa: SIM115
        try:
            if not lock(file.fileno()) or os.fstat(file.fileno()).st_nlink == 0:
                raise OSError(f"{self.path} is locked by another process")
            file.truncate(0)
            header = self._header or encoded({_VERSION: FORMAT, **self._describe_session()})
            self._is_whole = True
            self._write(file, header + self._content())
        except BaseException:
            file.close()
            raise
        self._header = header
        return file

    def _content(self) -> bytes:
        if self._file is None:
            return b""
        with open(self._file.fileno(), "rb", closefd=False) as file:
            file.seek(len(self._header))
            return file.read()

    def _write(self, file: FileIO, data: bytes) -> None:
        data = data if self._is_whole else b"\n" + data
        size = os.fstat(file.fileno()).st_size
        if size + len(data) > MAX_FILE_BYTES:
            raise OSError(f"{self.path} holds {size} bytes already")
        self._is_whole = False
        if (written := file.write(data)) != len(data):
            file.truncate(size)
            self._is_whole = True
            raise OSError(f"{self.path} took {written} of {len(data)} bytes: the disk is full")
        self._is_whole = True


_open_privately: Final = partial(os.open, mode=0o600)


def next_entries(file: BinaryIO, offset: int) -> list[tuple[int, WaitingEntry]]:
    """Read some entries from that byte on, each with the offset after it; none at the end.

    Lines that were cut off are skipped.
    """
    entries: list[tuple[int, WaitingEntry]] = []
    file.seek(offset)
    for line in file:
        offset += len(line)
        if (entry := _decoded(line)) is not None:
            entries.append((offset, entry))
            if len(entries) == ENTRIES_AT_ONCE:
                break
    return entries


def count_rows(path: Path) -> int:
    """Count the rows that wait in a file; 0 if there is no file."""
    offset, rows = 0, 0
    with contextlib.suppress(OSError), path.open("rb") as file:
        while entries := next_entries(file, offset):
            offset = entries[-1][0]
            rows += sum(entry.kind != "run" for _, entry in entries)
    return rows


def read_header(file: BinaryIO) -> dict[str, Any] | None:
    """Read robot and session of a file; None if its first line was cut off.

    Raises:
        ValueError: If another version wrote the file, or the line is not a JSON object.
    """
    file.seek(0)
    line = file.readline(_FILE.header_bytes)
    if not line.endswith(b"\n") and len(line) < _FILE.header_bytes:
        return None
    try:
        header = cast("dict[str, Any]", json.loads(line.decode("utf-8-sig", "replace")))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the first line of {file.name} is no JSON: {error}") from None
    if not isinstance(header, dict) or header.get(_VERSION) != FORMAT:  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ValueError(f"{file.name} was written by another version of webots-mcp")
    return header


def encoded(value: object) -> bytes:
    """Return a line; ASCII, so that any text can be written."""
    return json.dumps(value).encode() + b"\n"


def _decoded(line: bytes) -> WaitingEntry | None:
    """Decode an entry; None for a line that was cut off by a kill, or damaged since."""
    try:
        number, kind, run, values = json.loads(line)
        entry = WaitingEntry(
            number, kind, run, values if isinstance(values, dict) else tuple(values)
        )
        known = kind in STATEMENTS
    except (ValueError, TypeError, RecursionError):
        return None
    whole = type(number) is int and 0 < number < _FILE.no_number
    return entry if known and whole and (run is None or isinstance(run, str)) else None


def lock(fd: int) -> bool:
    """Take the lock of an open file, which ends with this process; False while another has it."""
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(fd, _FILE.locked_byte, os.SEEK_SET)
            msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def is_unfit(error: Exception) -> bool:
    """Return whether the row itself is refused; a missing session is not the row's fault."""
    text = str(error)
    if isinstance(error, (sqlite3.InterfaceError, sqlite3.ProgrammingError)):
        return "bind" in text  # a value of a type that SQLite does not know
    return isinstance(error, _UNFIT) and "FOREIGN KEY" not in text


class Ingested(NamedTuple):
    """The outcome of one transaction that ingested entries.

    Attributes:
        since: Number of the last entry that was in the database before.
        number: Number of the last entry that is in the database now.
        written: The entries that this call wrote; skipped ones are not among them.
        unfit: The reason for each entry that the database will never accept.
    """

    since: int
    number: int
    written: list[WaitingEntry]
    unfit: list[str]


def ingest(
    connection: sqlite3.Connection,
    session_id: int,
    piece: Sequence[WaitingEntry],
    finish: Callable[[Ingested], object] | None = None,
    begin: Callable[[WaitingEntry], dict[str, Any] | None] | None = None,
) -> Ingested:
    """Write entries of a session in one transaction, as many as fit into a millisecond.

    Args:
        connection: A writer in autocommit mode and in no transaction.
        session_id: The session.
        piece: Its next entries, in order.
        finish: Called at the end of that transaction.
        begin: Returns the values of an entry's run that the database does not have, or None if
            that run is not to be created.

    Raises:
        sqlite3.Error: If the transaction fails; nothing was written.
        SessionGoneError: If the session was deleted.
    """

    def act() -> Ingested:
        until_s = time.monotonic() + _FILE.piece_s
        statement = "SELECT last_adopted_entry FROM session WHERE id = ?"
        session = connection.execute(statement, (session_id,)).fetchone()
        if session is None:
            raise SessionGoneError(f"the session {session_id} was deleted from the database")
        taken = Ingested(session[0], session[0], [], [])
        for entry in piece:
            if entry.number > taken.number:
                taken = taken._replace(number=entry.number)
                why = _write(connection, session_id, entry, begin)
                taken.unfit.append(why) if why else taken.written.append(entry)
                if time.monotonic() > until_s:
                    break
        connection.execute(
            "UPDATE session SET last_adopted_entry = ? WHERE id = ?", (taken.number, session_id)
        )
        if finish is not None:
            finish(taken)
        return taken

    return in_transaction(connection, act)


def _write(
    connection: sqlite3.Connection,
    session_id: int,
    entry: WaitingEntry,
    begin: Callable[[WaitingEntry], dict[str, Any] | None] | None,
) -> str | None:
    """Write an entry; return why the database will never accept it, or None if it was written."""
    run_id = None
    try:
        if entry.run is not None:
            row = connection.execute(_RUN_OF, (entry.run, session_id)).fetchone()
            if row is None and begin is not None and (run := begin(entry)) is not None:
                connection.execute(STATEMENTS["run"], bind(None, session_id, run))
                row = connection.execute(_RUN_OF, (entry.run, session_id)).fetchone()
            if row is None:
                return f"its session has no run {entry.run}"
            run_id = row[0]
        connection.execute(STATEMENTS[entry.kind], bind(run_id, session_id, entry.values))
    except Exception as error:
        if not is_unfit(error):
            raise
        return str(error)
    return None


def adopt(connection: sqlite3.Connection, database: Path, until_s: float = math.inf) -> int:
    """Ingest what sessions of dead processes left behind; files of live sessions stay as they are.

    Args:
        connection: A writer in autocommit mode and in no transaction.
        database: Its file.
        until_s: The monotonic time at which to stop; the rest waits.

    Returns:
        The number of rows and other writes. A file that cannot be ingested is left in place and
        reported once; recording continues without it.

    Raises:
        sqlite3.Error: If the database is locked; what was ingested stays, the rest waits.
    """
    count = sum(_adopt_file(connection, path, until_s) for path in waiting_paths(database))
    found = waiting_paths(database, stacks_path)
    return count + sum(_adopt_stacks(connection, path) for path in found)


def _adopt_stacks(connection: sqlite3.Connection, path: Path) -> int:
    """Log where the loop of a dead process hung, and delete the file."""
    logged = 0
    with contextlib.suppress(OSError):  # another took it in meanwhile, or it cannot be read
        with path.open("r+b") as file:
            if not lock(file.fileno()):
                return 0
            stacks = read_stacks(file)
            run = (
                stacks
                and connection.execute(
                    "SELECT r.id, r.last_wall_time_s FROM run r "
                    "JOIN session s ON s.id = r.session_id WHERE r.uuid = ? "
                    "AND coalesce(s.last_poll_wall_time_s, s.moved_wall_time_s) IS NOT NULL",
                    (stacks.run,),
                ).fetchone()
            )
            if stacks and run and stacks.is_hang and stacks.began_after(run[1]):
                values = bind(run[0], None, stacks.log_values(None))
                logged = connection.execute(STATEMENTS["stacks"], values).rowcount
        path.unlink()
    return logged


def _adopt_file(connection: sqlite3.Connection, path: Path, until_s: float) -> int:
    try:
        with path.open("r+b") as file:
            if not lock(file.fileno()) or os.fstat(file.fileno()).st_nlink == 0:
                return 0
            count, is_whole = _adopt_open(connection, file, until_s)
            if not is_whole:
                return count
            if os.name != "nt":
                path.unlink()
        if os.name == "nt":  # where an open file cannot be deleted; who finds it passes it over
            path.unlink()
    except FileNotFoundError:  # another took it in meanwhile
        return 0
    except Exception as error:  # noqa: BLE001  (raised again where it is not the file's)
        report_strange(path, error)
        return 0
    return count


def report_strange(path: Path, error: Exception) -> None:
    """Warn once of a file that cannot be ingested: it stays, and is found again each second.

    Raises:
        Exception: The error, if it is not the file's fault.
    """
    if not (isinstance(error, _OF_THE_FILE) or is_unfit(error)):
        raise error
    if path not in _strange:
        _strange.add(path)
        speaks = isinstance(error, (OSError, ValueError))
        why = str(error) if speaks else f"it is damaged ({error!r})"
        warn(f"what waits in {path} cannot be taken in: {why}")


def _adopt_open(connection: sqlite3.Connection, file: BinaryIO, until_s: float) -> tuple[int, bool]:
    """Ingest an open file; return how many entries were written, and whether none is left."""
    header = read_header(file)
    if header is None:
        return 0, True
    session_id = _session(connection, header)
    offset, count, unfit = file.tell(), 0, list[str]()
    while piece := next_entries(file, offset):
        taken = ingest(connection, session_id, [entry for _, entry in piece])
        offset = max(end for end, entry in piece if entry.number <= taken.number)
        count += sum(entry.kind != "run" for entry in taken.written)
        unfit += taken.unfit
        if time.monotonic() > until_s:
            return count, False
    # Also where all entries were in: who wrote them may have ended before it came to this.
    statement = (
        "SELECT purged_rows + (SELECT count(*) FROM state WHERE run_id = run.id), id FROM run "
        "WHERE session_id = ? AND ended_wall_time_s IS NOT NULL"
    )
    for counted in connection.execute(statement, (session_id,)).fetchall():
        connection.execute("UPDATE run SET row_count = ? WHERE id = ?", counted)
    if unfit:
        warn(f"{len(unfit)} rows that waited in {file.name} were refused: {unfit[0]}")
    return count, True


def _session(connection: sqlite3.Connection, header: dict[str, Any]) -> int:
    """Return the session's id; enter the session if the database does not have it."""
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
    """Insert or update a robot's row; return its id."""
    statement = (
        "INSERT INTO robot (name, kind, devices, first_seen_wall_time_s, last_seen_wall_time_s) "
        "VALUES (:name, :kind, :devices, :now, :now) ON CONFLICT (name) DO UPDATE SET "
        "kind = excluded.kind, devices = excluded.devices, last_seen_wall_time_s = :now"
    )
    connection.execute(statement, {**robot, "now": now_s})
    found = connection.execute("SELECT id FROM robot WHERE name = ?", (robot["name"],)).fetchone()
    return int(found[0])


def enter_session(connection: sqlite3.Connection, robot_id: int, session: dict[str, Any]) -> int:
    """Insert a session's row, or reopen the one of that UUID; return its id."""
    values = dict.fromkeys(SESSION_COLUMNS) | session
    connection.execute(
        f"INSERT INTO session (robot_id, {', '.join(SESSION_COLUMNS)}) "
        f"VALUES (:robot_id, :{', :'.join(SESSION_COLUMNS)}) ON CONFLICT (uuid) "
        "DO UPDATE SET ended_wall_time_s = NULL, end_reason = NULL",
        {**values, "robot_id": robot_id},
    )
    return int(connection.execute(_SESSION_OF, (session["uuid"],)).fetchone()[0])
