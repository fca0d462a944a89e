"""What a controller writes while it runs: each kind by name, and the file in which it may wait.

A row that meets a lock for longer than a control loop may wait is appended, as one line with one
`write()`, to a file of its session beside the database (`webots.db-waiting-<session uuid>.jsonl`).
It survives a killed process; whoever opens the database next takes it in (`adoption`).

The first line tells who records. Each further one is an `Entry` as a JSON array: its number, its
kind, the UUID of its run and its values. A line that was cut off by a kill in the middle of its
`write()` is no JSON array, and its caller never had an answer.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, NamedTuple, cast

Kind = Literal[
    "run",
    "state",
    "event",
    "log",
    "image",
    "image forgotten",
    "run end",
    "session end",
    "actions",
    "parameter",
    "parameter values",
    "parameter next",
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

# Values in order follow on the run's id, where there is a run; named ones may use the ids of
# `run` and `session` too. Ids are those of the database at hand, so they never wait in a file.
STATEMENTS: Final[dict[Kind, str]] = {
    "run": (
        "INSERT INTO run (uuid, session_id, robot_id, world, basic_time_step_ms, start_reason, "
        "started_wall_time_s, started_sim_time_s, last_wall_time_s, last_sim_time_s) "
        "SELECT :uuid, id, robot_id, :world, :step_ms, :reason, :wall_time, :sim_time, "
        ":wall_time, :sim_time FROM session WHERE id = :session "
        # A conflict, instead of this question, would use up an id.
        "AND NOT EXISTS (SELECT 1 FROM run WHERE uuid = :uuid)"
    ),
    "state": (
        "INSERT INTO state (run_id, sim_time_s, wall_time_s, data, odd) VALUES (?, ?, ?, ?, ?)"
    ),
    "event": (
        "INSERT INTO event (run_id, sim_time_s, wall_time_s, kind, name, data) "
        "VALUES (?, ?, ?, ?, ?, ?)"
    ),
    "log": (
        "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message, logger) "
        "VALUES (?, ?, ?, ?, ?, ?, ?)"
    ),
    "image": (
        "INSERT INTO image (run_id, sim_time_s, wall_time_s, kind, device, path, width, height, "
        "bytes) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
    ),
    "image forgotten": "DELETE FROM image WHERE path = ?",
    # Without a number of rows they are counted: a dead process could not say how many.
    "run end": (
        "UPDATE run SET end_reason = :reason, ended_wall_time_s = :now, last_wall_time_s = :now, "
        "last_sim_time_s = :sim_time, rows = coalesce(:rows, "
        "purged_rows + (SELECT count(*) FROM state WHERE run_id = :run)) WHERE id = :run"
    ),
    "session end": (
        "UPDATE session SET ended_wall_time_s = :now, last_seen_wall_time_s = :now, "
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
    "command issued": (
        "UPDATE command SET issued_wall_time_s = :now "
        "WHERE id = :command AND status = 'claimed' AND session_id = :session"
    ),
    "command finished": (
        "UPDATE command SET status = :status, finished_wall_time_s = :now, "
        "finished_sim_time_s = :sim_time, result = :result, error = :error "
        "WHERE id = :command AND status = 'claimed' AND session_id = :session"
    ),
    # The process that asked for the reload is gone; that this one runs is the proof that it worked.
    "reload confirmed": (
        "UPDATE command SET status = 'done', finished_wall_time_s = :now, "
        "finished_sim_time_s = :sim_time, result = json_object('run_id', :run, 'mode', :mode, "
        "'why', 'a reload keeps the mode') "
        "WHERE robot_id = (SELECT robot_id FROM run WHERE id = :run) AND action = 'reload' "
        "AND status = 'claimed' AND issued_wall_time_s IS NOT NULL"
    ),
    "breakpoint hit": "UPDATE breakpoint SET hits = hits + 1 WHERE id = ?",
    "breakpoint failed": "UPDATE breakpoint SET enabled = 0, error = ? WHERE id = ?",
    # What a controller's code has set ends with its session.
    "breakpoints forgotten": (
        "DELETE FROM breakpoint WHERE robot_id = (SELECT robot_id FROM session "
        "WHERE id = :session) AND created_by = :by AND coalesce(session_id, 0) < :session"
    ),
    "kept stretch": (
        "INSERT INTO kept_stretch (run_id, uuid, start_sim_time_s, end_sim_time_s, wall_time_s, "
        "reason) VALUES (:run, :uuid, :start, :end, :wall_time, :reason) ON CONFLICT (uuid) "
        "DO UPDATE SET end_sim_time_s = excluded.end_sim_time_s, reason = excluded.reason"
    ),
    "kept state": (
        "INSERT INTO kept_state (run_id, call, sim_time_s, wall_time_s, data, odd) "
        "VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT (run_id, call) DO NOTHING"
    ),
}
ENTRIES_AT_ONCE: Final = 100  # read, or written in one transaction
FORMAT: Final = 1  # of the file; whoever knows another one leaves the file alone
MAX_FILE_BYTES: Final = 1_000_000_000
_VERSION: Final = "webots_mcp_waiting"
_NO_NUMBER: Final = 1 << 63  # SQLite's integers end there
_LOCKED_BYTE: Final = 1 << 40  # far beyond the end: Windows refuses to read what is locked


class Entry(NamedTuple):
    """One write of a session.

    Attributes:
        number: Rising within the session; what was taken in once is known by it.
        kind: Which of `STATEMENTS`.
        run: UUID of the run that it belongs to.
        values: Of the statement.
    """

    number: int
    kind: Kind
    run: str | None
    values: Values


def bind(run_id: int | None, session_id: int | None, values: Values) -> Values:
    """The values of a statement, with the ids of its run and session."""
    if isinstance(values, dict):
        return {"run": run_id, "session": session_id, **values}
    return values if run_id is None else (run_id, *values)


def waiting_path(database: Path, session_uuid: str) -> Path:
    """Where the entries of a session wait."""
    return Path(f"{database}-waiting-{session_uuid}.jsonl")


def waiting_paths(database: Path) -> list[Path]:
    """The files in which entries for a database wait, of living sessions too."""
    before, after = f"{database.name}-waiting-", ".jsonl"
    try:
        with os.scandir(database.parent) as files:
            names = [f.name for f in files if f.name.startswith(before) and f.name.endswith(after)]
    except OSError:
        return []
    return [database.with_name(name) for name in sorted(names)]


class WaitingFile:
    """The entries of one session that wait beside its database, written by that session.

    The file is made with the first entry and stays locked while it is open: a file that is not
    locked belongs to a process that is gone. All calls come from one thread at a time.

    Args:
        path: See `waiting_path`.
        describe_session: Who records, as `adoption` enters it into a database that does not know.
    """

    def __init__(self, path: Path, describe_session: Callable[[], dict[str, Any]]) -> None:
        self.path = path
        self._describe_session = describe_session
        self._header = b""
        self._file: FileIO | None = None
        self._is_whole = True  # it ends with a whole line

    def append(self, entries: list[Entry]) -> None:
        """Add entries with one `write()`, all or none of them.

        Raises:
            OSError: They could not be written; what was written of them is no whole line.
        """
        file = former = self._file
        if file is None or os.fstat(file.fileno()).st_nlink == 0:
            file = self._file = self._made()
            if former is not None:  # somebody deleted it
                former.close()
        self._write(file, b"".join(encoded(entry) for entry in entries))

    def read(self, offset: int) -> list[tuple[int, Entry]]:
        """The next entries from that byte on; see `next_entries`."""
        if self._file is None:
            return []
        with open(self._file.fileno(), "rb", closefd=False) as file:
            return next_entries(file, max(offset, len(self._header)))

    def empty(self) -> None:
        """Forget the entries; who records stays."""
        if self._file is not None:
            self._file.truncate(len(self._header))
            self._is_whole = True

    def close(self, *, remove: bool) -> None:
        """Without `remove` it stays for whoever opens the database next."""
        file, self._file = self._file, None
        if file is None:
            return
        if remove:
            file.truncate(len(self._header))  # who finds it before it is gone finds nothing in it
        file.close()
        if remove:
            with contextlib.suppress(OSError):
                self.path.unlink()

    def _made(self) -> FileIO:
        """A new file that says who records, with all that a deleted one still holds."""
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


def next_entries(file: BinaryIO, offset: int) -> list[tuple[int, Entry]]:
    """Some entries from that byte on, each with the byte that follows; none at the end.

    Lines that were cut off are passed over.
    """
    entries: list[tuple[int, Entry]] = []
    file.seek(offset)
    for line in file:
        offset += len(line)
        if (entry := _decoded(line)) is not None:
            entries.append((offset, entry))
            if len(entries) == ENTRIES_AT_ONCE:
                break
    return entries


def count_rows(path: Path) -> int:
    """How many rows wait in a file; 0 where there is none."""
    offset, rows = 0, 0
    with contextlib.suppress(OSError), path.open("rb") as file:
        while entries := next_entries(file, offset):
            offset = entries[-1][0]
            rows += sum(entry.kind != "run" for _, entry in entries)
    return rows


def read_header(file: BinaryIO) -> dict[str, Any] | None:
    """Who recorded; None where the first line was cut off.

    Raises:
        ValueError: Another version wrote the file.
    """
    file.seek(0)
    try:
        header = json.loads(file.readline())
    except (ValueError, RecursionError):
        return None
    if not isinstance(header, dict):
        return None
    header = cast("dict[str, Any]", header)
    if header.get(_VERSION) != FORMAT:
        raise ValueError(f"{file.name} was written by another version of webots-mcp")
    return header


def encoded(value: object) -> bytes:
    """A line; ASCII, so that any text can be written."""
    return json.dumps(value).encode() + b"\n"


def _decoded(line: bytes) -> Entry | None:
    """None for what is no entry: cut off by a kill, or damaged since."""
    try:
        number, kind, run, values = json.loads(line)
        entry = Entry(number, kind, run, values if isinstance(values, dict) else tuple(values))
        known = kind in STATEMENTS
    except (ValueError, TypeError, RecursionError):
        return None
    whole = type(number) is int and 0 < number < _NO_NUMBER
    return entry if known and whole and (run is None or isinstance(run, str)) else None


def lock(fd: int) -> bool:
    """Take the lock of an open file, which ends with this process; False while another has it."""
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(fd, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
