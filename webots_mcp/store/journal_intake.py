"""Ingest journals: what controllers without a database write into files.

'webots-mcp help journal' describes their format.

A controller in C, or any program, appends lines to a file of its session in the data folder and
never opens the database. Servers and commands ingest the lines meanwhile. They do so exactly once,
because `session.last_adopted_entry` is written in the same transaction, and in order, because the
parts of a journal are read one after the other. Each process remembers how far it has read, so that
it reads nothing twice. Any other reader of the same journal, even one that is killed, only finds
entries that are already stored.

The writer holds the lock of the part that it writes. A part without a lock is complete, and is
deleted once it has been ingested. Bridges do not ingest journals, which would take time from their
robots.

Values that do not fit cost as little as possible. Null is stored instead if a row can be without
the value, and a run whose line cannot be read is created from its first row. What is dropped is
counted in `session.rows_dropped` and in an event. A part of which nothing fits stays where it is.
"""

from __future__ import annotations

import codecs
import json
import math
import os
import re
import sqlite3
import stat
import threading
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, cast

from webots_mcp.contract import (
    CUSTOM_DATA,
    find_log_level,
    host_name,
    instance_of,
    is_extern,
    recorded_name,
)
from webots_mcp.database import processes, session_cleanup, waiting_file
from webots_mcp.database.connection import identify_files
from webots_mcp.database.transactions import in_transaction
from webots_mcp.database.waiting_file import (
    FORMAT,
    STATEMENTS,
    Ingested,
    Kind,
    WaitingEntry,
    journal_parts,
)
from webots_mcp.errors import warn
from webots_mcp.signals import register as signal_register
from webots_mcp.signals.naming import flatten

# Wall time of a question for journals; the rest waits for the next question and is reported.
BUDGET_S: Final = 5.0
# Wall time in each round of the maintainer, so that its lease does not expire.
MAINTAINER_BUDGET_S: Final = 1.0
LONGEST_LINE_BYTES: Final = 4_000_000
# The values of each kind: (n)umbers, (c)ounts, (s)trings, (o)bjects. Capital letters may be null.
# For these and for those with a question mark, null replaces a value that does not fit.
_FIELDS: Final[dict[Kind, tuple[str, ...]]] = {
    "run": ("s uuid?", "S world", "N step_ms", "s reason?", "n wall_time?", "n sim_time?"),
    "state": ("n sim_time", "n wall_time", "o data", "O replaced"),
    "event": ("n sim_time", "n wall_time", "s kind", "S name", "O data"),
    "log": ("n sim_time", "n wall_time", "s level", "S source", "s message", "S logger"),
    "run end": ("s reason?", "n now?", "n sim_time?"),
    "session end": ("s reason?", "n now?", "C dropped", "S error"),
}
_SESSION_FIELDS: Final = (
    "c pid?", "n started_wall_time_s?", "S host", "C parent_pid", "O environment", "S controller",
    "O versions", "C throttle_interval",
)  # fmt: skip
# kinds whose values are an object instead of an array
_NAMED: Final = ("run", "run end", "session end")
_REASONS: Final[dict[str, str]] = {"run": "start", "run end": "finished", "session end": "finished"}
# arguments of statements that only bridges use
_UNGIVEN: Final = dict.fromkeys(("rows", "monotonic", "own", "step_wait", "steps"))
_KNOWN: Final = (
    "SELECT id, robot_id, last_adopted_entry, (SELECT data FROM state WHERE run_id = "
    "(SELECT max(id) FROM run WHERE session_id = session.id) ORDER BY sim_time_s DESC, id DESC "
    "LIMIT 1), (SELECT uuid FROM run WHERE session_id = session.id ORDER BY id DESC LIMIT 1) "
    "FROM session WHERE uuid = ?"
)


@dataclass(frozen=True)
class JournalLimits:
    """Limits within which journals and waiting files are ingested.

    Attributes:
        batch_bytes: Size of the lines that are in memory at once; a single line may be longer.
        depth: Levels of a state. SQLite reads 1,000; Python's recursion ends before.
        program_bytes: Maximum size of a program whose digest is recorded.
        headerless_s: Wall time for which a file without a header is left alone: its writer may be
            about to write it.
        lag_s: A row that is at most that new does not count as a delay.
    """

    batch_bytes: int = 1_000_000
    depth: int = 100
    program_bytes: int = 100_000_000
    headerless_s: float = 60.0
    lag_s: float = 2.0


_LIMITS: Final = JournalLimits()


class _Faults(NamedTuple):
    """The number of lines or values that were dropped, and what was wrong with the first."""

    lines: int = 0
    first: str = ""

    def and_those(self, faults: Iterable[str]) -> _Faults:
        """Return the sum of these faults and later ones."""
        found = [fault for fault in faults if fault]
        return _Faults(self.lines + len(found), self.first or next(iter(found), ""))


_NO_FAULTS: Final = _Faults()


class _JournalPosition(NamedTuple):
    """How far this process has read a part of a journal.

    Attributes:
        file: Its device and inode, and those of the database.
        offset: The byte after the last line.
        number: The number of the last ingested entry.
        fits: Whether any of its lines is an entry.
        faults: Faults of lines, to be counted with the next entry.
    """

    file: tuple[int, ...]
    offset: int
    number: int
    fits: bool = False
    faults: _Faults = _NO_FAULTS


class _Line(NamedTuple):
    """A complete line, its entry if it has one, and what is wrong with it.

    Attributes:
        end: The byte after it.
        state: The state of its entry.
        fault: Why a value or the whole line was dropped.
        lost_run: The readable values of a run that cannot be created yet, by name.
    """

    end: int
    entry: WaitingEntry | None
    state: dict[str, Any] | None = None
    fault: str = ""
    lost_run: dict[str, Any] | None = None


class _JournalState:
    """What the states of a session have shown so far.

    Attributes:
        run: UUID of the newest run.
        lost_runs: The runs whose line could not be read completely, by UUID; "" for one without.
    """

    def __init__(self, newest: str | None, run: str | None) -> None:
        self.run = run
        self.lost_runs: dict[str, dict[str, Any]] = {}
        self.names = signal_register.SignalNames()
        self.changes = signal_register.StateChanges()
        self.changes.compare(json.loads(newest or "{}"))


_lock = threading.Lock()
_places: dict[Path, _JournalPosition] = {}
_states: dict[str, _JournalState] = {}
_kept: dict[Path, str] = {}  # parts of which nothing fits, with the reason


def kept_journals(database: Path) -> dict[str, str]:
    """Return the journals that this process could not read and left unchanged, with reasons."""
    return {
        path.name: why
        for path, why in list(_kept.items())
        if path.parent == database.parent and path.exists()
    }


def has_news(database: Path) -> bool:
    """Return whether a journal next to a database has bytes that this process has not ingested."""
    for path in (path for parts in journal_parts(database).values() for path in parts):
        with suppress(OSError):
            status, place = path.stat(), _places.get(path)
            if place is None or place[:2] != (_identity(status, database), status.st_size):
                return True
    return False


def journals_behind(connection: sqlite3.Connection, database: Path) -> list[str]:
    """Return the journals whose rows are not in the database although there was time."""
    behind: list[str] = []
    kept = kept_journals(database)
    for uuid, parts in journal_parts(database).items():
        (seen_s,) = connection.execute(
            "SELECT last_seen_wall_time_s FROM session WHERE uuid = ?", (uuid,)
        ).fetchone() or (0.0,)
        with suppress(OSError):
            if parts[-1].name not in kept and parts[-1].stat().st_mtime > seen_s + _LIMITS.lag_s:
                behind.append(parts[-1].name)
    return behind


def _identity(status: os.stat_result, database: Path) -> tuple[int, ...]:
    return (status.st_dev, status.st_ino, *identify_files(database)[:2])


def ingest_journals(
    connection: sqlite3.Connection, database: Path, budget_s: float = math.inf
) -> None:
    """Ingest what controllers have written up to now, as far as time allows.

    Args:
        connection: A writer in autocommit mode and in no transaction.
        database: Its file.
        budget_s: Wall time, including the wait for another thread that is ingesting.

    Raises:
        sqlite3.Error: The database is locked; what was ingested stays, the rest waits.
    """
    until_s = time.monotonic() + budget_s
    with _turn(budget_s) as is_ours:
        if not is_ours:
            return
        journals = journal_parts(database)
        for path in _places.keys() - {path for parts in journals.values() for path in parts}:
            if path.parent == database.parent:
                del _places[path]
                _kept.pop(path, None)
        for uuid, parts in journals.items():
            # Parts are ingested in order, and no part before its predecessors: only entries with a
            # number above the last ingested one are accepted.
            all(_ingest_part(connection, database, uuid, path, until_s) for path in parts)
            if time.monotonic() > until_s:
                return


@contextmanager
def _turn(budget_s: float) -> Generator[bool]:
    """Return whether no other thread is ingesting journals, or it finishes within that time."""
    timeout_s = -1 if budget_s == math.inf else min(max(budget_s, 0.0), threading.TIMEOUT_MAX)
    is_ours = _lock.acquire(timeout=timeout_s)
    try:
        yield is_ours
    finally:
        if is_ours:
            _lock.release()


def _ingest_part(
    connection: sqlite3.Connection, database: Path, uuid: str, path: Path, until_s: float
) -> bool:
    """Ingest a part, and delete it if it is complete. Return False if some of it remains."""
    try:
        with path.open("r+b") as file:
            status = os.fstat(file.fileno())
            header = waiting_file.read_header(file)
            if header is None and time.time() - status.st_mtime < _LIMITS.headerless_s:
                return False
            # Checked first: lines written after the last read would otherwise be deleted unread.
            is_complete = waiting_file.lock(file.fileno())
            if header is not None and status.st_nlink:
                identity = _identity(status, database)
                reading = _Reading(connection, uuid, path, file, identity, not is_complete)
                if not reading.ingest(header, until_s):
                    return False
                is_complete = is_complete and path not in _kept
            if is_complete and os.name != "nt":
                path.unlink()
        if is_complete and os.name == "nt":  # systems where an open file cannot be deleted
            path.unlink()
    except FileNotFoundError:  # another process has ingested all of it
        return True
    except Exception as error:  # noqa: BLE001  (raised again where it is not the file's)
        _states.pop(uuid, None)
        waiting_file.report_strange(path, error)
        _kept[path] = str(error)
        return False
    return True


@dataclass
class _Reading:
    """Ingest one part of a journal into the database."""

    connection: sqlite3.Connection
    uuid: str
    path: Path
    file: BinaryIO
    identity: tuple[int, ...]
    is_living: bool
    faults: _Faults = _NO_FAULTS
    begun: tuple[str, ...] = ()  # lost runs that this transaction has created

    def ingest(self, header: dict[str, Any], until_s: float) -> bool:
        """Ingest all complete lines from the last position. Return False when time is up."""
        start = self.file.tell()
        session_id, robot_id, number, *newest = self._enter(header)
        place = _places.get(self.path)
        if place is None or place.file != self.identity or place.number > number:
            offset = _skip(self.file, start, number)
            place = _JournalPosition(self.identity, offset, number, offset > start, self.faults)
            _states[self.uuid] = _JournalState(
                *newest
            )  # another process may have read further meanwhile
        session_state = _states.get(self.uuid) or _states.setdefault(
            self.uuid, _JournalState(*newest)
        )
        while lines := _read_lines(self.file, place.offset):
            self.faults = place.faults
            lost = [each.lost_run for each in lines if each.lost_run is not None]
            session_state.lost_runs |= {run.get("uuid") or "": run for run in lost}
            if entries := self._entries(lines, session_id):
                finish = partial(self._finish, session_id, robot_id, session_state, lines)
                begin = partial(self._begin, session_state)
                taken = waiting_file.ingest(self.connection, session_id, entries, finish, begin)
                done = _until(lines, taken.number)[-1].end
                place = _JournalPosition(self.identity, done, taken.number, True, self.faults)
            else:
                faults = self.faults.and_those(each.fault for each in lines)
                place = place._replace(offset=lines[-1].end, faults=faults)
            _places[self.path] = place
            if time.monotonic() > until_s:
                return False
        _places[self.path] = self._counted(session_id, place)
        return True

    def _entries(self, lines: Sequence[_Line], session_id: int) -> list[WaitingEntry]:
        """Return their entries; the end of a session adds its own count of dropped lines."""
        entries = [each.entry for each in lines if each.entry]
        for entry in entries:
            if entry.kind == "session end" and isinstance(entry.values, dict):
                (dropped,) = self.connection.execute(
                    "SELECT rows_dropped FROM session WHERE id = ?", (session_id,)
                ).fetchone()
                entry.values["dropped"] += dropped
        return entries

    def _counted(self, session_id: int, place: _JournalPosition) -> _JournalPosition:
        """Count what was dropped without a following entry.

        A part of which nothing fits is kept.
        """
        _kept.pop(self.path, None)
        if not place.faults.lines:
            return place
        if not place.fits:
            _kept[self.path] = f"none of its {place.faults.lines} lines fits: {place.faults.first}"
        if self.is_living or not place.fits:
            return place
        lines, first = place.faults

        def act() -> None:
            self._drop(session_id, place.faults)
            if run := self.connection.execute(
                "SELECT uuid, last_sim_time_s, last_wall_time_s FROM run WHERE session_id = ? "
                "ORDER BY id DESC LIMIT 1",
                (session_id,),
            ).fetchone():
                uuid, *times = run
                self._drop_event(
                    WaitingEntry(place.number, "event", uuid, tuple(times)), place.faults
                )

        in_transaction(self.connection, act)
        warn(f"{lines} lines or values of {self.path} were dropped: {first}")
        return place._replace(faults=_NO_FAULTS)

    def _enter(self, header: dict[str, Any]) -> tuple[Any, ...]:
        """Return the ids of session and robot, number of the last entry, newest state, run."""
        connection = self.connection
        # Bridges recover their own rows. Journals have no monotonic clock.
        if connection.execute(
            "SELECT 1 FROM session WHERE uuid = ? AND last_seen_monotonic_s IS NOT NULL",
            (self.uuid,),
        ).fetchone():
            raise ValueError("its session is that of a bridge")
        if (known := connection.execute(_KNOWN, (self.uuid,)).fetchone()) is not None:
            return known
        modified_s = os.fstat(self.file.fileno()).st_mtime
        name, session, unfit = _described(header, self.uuid, modified_s)
        self.faults = _NO_FAULTS.and_those(unfit)

        def act() -> None:
            if connection.execute(_KNOWN, (self.uuid,)).fetchone() is None:
                session_cleanup.reap(connection, time.time())
                wanted = recorded_name(name)
                free = session_cleanup.free_name(
                    connection, wanted, lambda it: it.kind == CUSTOM_DATA
                )
                robot = {"name": free, "kind": "Robot", "devices": "{}"}
                now_s = session["started_wall_time_s"]
                robot_id = waiting_file.enter_robot(connection, robot, now_s)
                waiting_file.enter_session(connection, robot_id, session)

        in_transaction(connection, act)
        return connection.execute(_KNOWN, (self.uuid,)).fetchone()

    def _begin(self, session_state: _JournalState, entry: WaitingEntry) -> dict[str, Any] | None:
        """Return the values of the run of an entry whose own line was lost."""
        lost = session_state.lost_runs.get(entry.run or "", session_state.lost_runs.get(""))
        if lost is None or isinstance(entry.values, dict) or not entry.run:
            return None
        sim_time_s, wall_time_s, *_ = entry.values
        times = {"sim_time": sim_time_s, "wall_time": wall_time_s}
        known = {"uuid": entry.run, "world": None, "step_ms": None, "reason": "start"} | times
        self.begun += (entry.run,)
        return known | {name: value for name, value in lost.items() if value is not None}

    def _note_times(
        self,
        session_id: int,
        runs: Mapping[str, tuple[float, float, int]],
        ends: Mapping[Kind, dict[str, Any]],
    ) -> None:
        """Write when runs last recorded, how many rows they have, and which runs ended."""
        for run, (sim, wall, rows) in runs.items():
            values = {"run": run, "sim": sim, "wall": wall, "rows": rows, "session": session_id}
            # Rows arrived late for a run that was ended because its process had disappeared.
            self.connection.execute(
                "UPDATE run SET last_wall_time_s = max(last_wall_time_s, :wall), last_sim_time_s "
                "= max(last_sim_time_s, :sim), ended_wall_time_s = max(ended_wall_time_s, "
                ":wall), row_count = CASE WHEN ended_wall_time_s IS NULL THEN row_count + :rows "
                "ELSE purged_rows + (SELECT count(*) FROM state WHERE run_id = run.id) END WHERE "
                "uuid = :run",
                values,
            )
            self.connection.execute(
                "UPDATE session SET last_seen_wall_time_s = max(last_seen_wall_time_s, :wall), "
                "ended_wall_time_s = max(ended_wall_time_s, :wall) WHERE id = :session",
                values,
            )
        if begun := ends.get("run"):
            session_cleanup.end_runs(self.connection, session_id, "reset", begun["uuid"])
        if end := ends.get("session end"):
            session_cleanup.end_runs(self.connection, session_id, end["reason"])

    def _finish(
        self,
        session_id: int,
        robot_id: int,
        session_state: _JournalState,
        lines: Sequence[_Line],
        taken: Ingested,
    ) -> None:
        """Write what follows from the entries.

        Names, changes, times, ends of runs, dropped lines.
        """
        written = {entry.number for entry in taken.written}
        faults = list(taken.unfit)
        begun_here, self.begun = self.begun, ()
        runs, ends = dict[str, tuple[float, float, int]](), dict[Kind, dict[str, Any]]()
        last: WaitingEntry | None = None
        for _, entry, state, fault, _ in _until(lines, taken.number):
            if entry is None or entry.number in written:
                faults.append(fault)
            if entry is None:
                continue
            begins = entry.run if entry.run in begun_here else session_state.run
            if isinstance(entry.values, dict):
                begins = entry.values.get("uuid", session_state.run)
            if begins != session_state.run:
                session_state.run = begins
                session_state.changes.forget()
                if entry.run in begun_here:
                    ends["run"] = {"uuid": begins}
            changed = session_state.changes.compare(state) if state is not None else ()
            if entry.number not in written:  # ingested by another process, or refused
                continue
            # A run or an end, after which the other runs are over.
            if isinstance(entry.values, dict):
                ends[entry.kind] = entry.values
                continue
            last, run = entry, entry.run or ""
            sim_time_s, wall_time_s, *_ = entry.values
            _, _, rows = runs.get(run, (0.0, 0.0, 0))
            seen_s = min(wall_time_s, time.time())  # Times in the future count as now.
            runs[run] = sim_time_s, seen_s, rows + (entry.kind == "state")
            if state is not None:
                session_state.names.register(
                    state, entry.values[2], partial(self._enter_names, robot_id)
                )
            for name, before, after in changed:
                data = json.dumps({"from": before, "to": after}, ensure_ascii=False)
                self._event(entry, "change", name[:200], data)
        self._note_times(session_id, runs, ends)
        dropped = self.faults.and_those(faults)
        self.faults = _NO_FAULTS if last else dropped
        if last and dropped.lines:
            self._drop(session_id, dropped)
            self._drop_event(last, dropped)

    def _drop(self, session_id: int, dropped: _Faults) -> None:
        why = f"{self.path.name}: {dropped.first}"
        values = {"count": dropped.lines, "why": why, "session": session_id}
        self.connection.execute(
            "UPDATE session SET rows_dropped = rows_dropped + :count, "
            "last_error = coalesce(last_error, :why) WHERE id = :session",
            values,
        )

    def _drop_event(self, entry: WaitingEntry, dropped: _Faults) -> None:
        data = {"row_count": dropped.lines, "why": f"{self.path.name}: {dropped.first}"}
        self._event(entry, "dropped", None, json.dumps(data))

    def _enter_names(self, robot_id: int, seen: Mapping[str, signal_register.Seen]) -> bool:
        changes = signal_register.find_changes(self.connection, robot_id, seen)
        signal_register.write_changes(self.connection, robot_id, changes)
        return True

    def _event(self, entry: WaitingEntry, kind: str, name: str | None, data: str) -> None:
        (run_id,) = self.connection.execute(
            "SELECT id FROM run WHERE uuid = ?", (entry.run,)
        ).fetchone()
        values = (run_id, *cast("tuple[Any, ...]", entry.values)[:2], kind, name, data)
        self.connection.execute(STATEMENTS["event"], values)


def _described(
    header: Mapping[str, Any], uuid: str, modified_s: float
) -> tuple[str, dict[str, Any], list[str]]:
    """Return the robot's name and the values of the session, from the first line of a journal.

    Args:
        header: The content of that line.
        uuid: The UUID in the name of the file.
        modified_s: Unix time of the file, used if the line does not say when the session began.

    Returns:
        Values that do not fit are null or replaced by what is known otherwise.

    Raises:
        ValueError: The header has no robot, or names another session than the file.
    """
    name, session = _object(header.get("robot")).get("name"), _object(header.get("session"))
    if not (name and _fitted("s", name) and session.get("uuid") == uuid):
        raise ValueError("its first line has no robot.name, or another session.uuid than its name")
    given, unfit = _fit(_SESSION_FIELDS, session)
    texts = {key: _fitted("s", value) for key, value in _object(given["environment"]).items()}
    environment = {key: value for key, value in texts.items() if value is not None}
    host, parent, file = given["host"] or host_name(), given["parent_pid"], given["controller"]
    is_here = host == host_name()
    started_s = modified_s if given["started_wall_time_s"] is None else given["started_wall_time_s"]
    pid = given["pid"] or 0  # no process has this id
    # a process that has ended cannot be asked
    lives = processes.process_alive(pid, None, started_s)
    versions = {
        key: value
        for key, value in _object(given["versions"]).items()
        if _fitted("s", key) is not None and _fitted("s", value) is not None
    }
    return (
        cast("str", name),
        {
            "uuid": uuid,
            "pid": pid,
            "process": processes.process_identity(pid) if is_here and lives else None,
            "host": host,
            "instance": instance_of(environment, parent) if is_here else f"{host} process {parent}",
            "extern": int(is_extern(environment)),
            "controller": file,
            "controller_sha256": _sha256(file, started_s) if is_here and file else None,
            "versions": json.dumps({"journal": str(FORMAT)} | versions),
            "supervisor": 0,
            "actions": "{}",
            "started_wall_time_s": min(started_s, time.time()),
            "last_seen_wall_time_s": min(started_s, time.time()),
            "throttle_interval": given["throttle_interval"],
        },
        [unfit] if unfit else [],
    )


def _object(value: object) -> dict[str, Any]:
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {}


def _sha256(file: str, started_s: float) -> str | None:
    """Return the digest of the program, if the file is still the one that was started."""
    with suppress(OSError, ValueError):
        status = Path(file).stat()
        is_program = stat.S_ISREG(status.st_mode) and status.st_size <= _LIMITS.program_bytes
        if is_program and status.st_mtime <= started_s:
            return sha256(Path(file).read_bytes()).hexdigest()
    return None


# -- lines -----------------------------------------------------------------------------------------


def _until(lines: Sequence[_Line], number: int) -> Sequence[_Line]:
    """Return the lines up to the last entry with this number or a lower one."""
    ends = [i for i, each in enumerate(lines, 1) if each.entry and each.entry.number <= number]
    return lines[: ends[-1]]


def _skip(file: BinaryIO, offset: int, number: int) -> int:
    """Return the byte after the last entry with this number or a lower one, from an offset on."""
    file.seek(offset)
    at = offset
    while number and (line := file.readline(LONGEST_LINE_BYTES)).endswith(b"\n"):
        at += len(line)
        head = line[1 : line.find(b",")].strip()
        if head.isdigit():
            if int(head) > number:
                break
            offset = at
    return offset


def _read_lines(file: BinaryIO, offset: int) -> list[_Line]:
    """Return the next complete lines from an offset on, as many as should be in memory at once."""
    lines: list[_Line] = []
    file.seek(offset)
    until = offset + _LIMITS.batch_bytes
    while len(lines) < waiting_file.ENTRIES_AT_ONCE and offset < until:
        line = file.readline(LONGEST_LINE_BYTES)
        start, size, is_whole = line, len(line), len(line) < LONGEST_LINE_BYTES
        while line and not line.endswith(b"\n"):  # The line is too long: only its end is searched.
            size += len(line := file.readline(LONGEST_LINE_BYTES))
        if not line:
            break  # the rest of the line may still follow
        offset += size
        lines.append(_line(start, offset) if is_whole else _too_long(start, size, offset))
    return lines


def _too_long(start: bytes, size: int, end: int) -> _Line:
    text = start[:1000].decode("utf-8", "replace")
    fault = f"{text[:60]!r}: it has {size} bytes, {LONGEST_LINE_BYTES - 1} are read"
    return _Line(end, None, fault=fault, lost_run=_lost_run(text))


def _line(line: bytes, end: int) -> _Line:
    """Parse a line into an entry, or into the reason why it is none."""
    line = line.removeprefix(codecs.BOM_UTF8)
    text = line.decode("utf-8", "replace")
    if not text.strip():
        return _Line(end, None)
    given: dict[str, Any] | None = None
    try:
        number, kind, run, values = json.loads(text, parse_constant=float)
        if kind not in _FIELDS:
            raise ValueError(f"there is no kind {kind!r}")
        given, unfit = _checked(kind, values)
        if not (type(number) is int and 0 < number < 1 << 63):
            raise ValueError(f"its number is {number!r}")
        # These lines name no run before their values.
        if not (run is None if kind in ("run", "session end") else _fitted("s", run)):
            raise ValueError(f"its run is {run!r}")
        if kind == "run" and None in (given["uuid"], given["wall_time"], given["sim_time"]):
            raise ValueError(unfit)
        state = _state(given, text, line) if kind == "state" else None
        entry = WaitingEntry(number, kind, run, _bound(kind, given))
    except (ValueError, TypeError, ArithmeticError, RecursionError) as error:
        return _Line(end, None, fault=_fault(text, error), lost_run=_lost_run(text, given))
    return _Line(end, entry, state, _fault(text, unfit) if unfit else "")


def _fault(text: str, why: object) -> str:
    return f"{text[:60]!r}: {why}"[:300]


def _lost_run(text: str, given: dict[str, Any] | None = None) -> dict[str, Any] | None:
    """Return what is known of the run that an unreadable line may have begun.

    None for other lines.
    """
    # A damaged line may still show that it held a row, and of which run.
    if re.match(r'\s*\[[^"]*"(?:state|event|log|run end|session end)"', text):
        return None
    if given is not None:
        return given
    uuid = re.search(r'"uuid"\s*:\s*"([^"\\]{1,100})"', text)
    return {"uuid": uuid[1]} if uuid else {}


def _fitted(letter: str, value: object) -> Any:
    """Return a value as the database stores it for a type of `_FIELDS`; None if it does not fit."""
    if letter == "s":
        return value if isinstance(value, str) and _is_text(value) else None
    if letter == "o":
        return cast("dict[str, Any]", value) if isinstance(value, dict) else None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    if not math.isfinite(number):
        return None
    if letter == "n":
        return number
    return int(value) if number == int(number) and 0 <= value < 1 << 63 else None


def _is_text(value: str) -> bool:
    """Return whether a text can be stored; half a surrogate pair cannot."""
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def _checked(kind: Kind, values: Any) -> tuple[dict[str, Any], str]:
    """Return the values of an entry by name, and which of them do not fit and become null.

    Raises:
        ValueError: A required value does not fit, or there are too many.
    """
    fields = _FIELDS[kind]
    if kind not in _NAMED:
        if not isinstance(values, list) or len(cast("list[Any]", values)) > len(fields):
            raise ValueError(f"its values are no array of at most {len(fields)}")
        names = [field[2:] for field in fields]
        values = dict(zip(names, cast("list[Any]", values), strict=False))
    if not isinstance(values, dict):
        raise ValueError("its values are no object")
    given, unfit = _fit(fields, cast("dict[str, Any]", values))
    if kind == "log" and find_log_level(given["level"]) is None:
        raise ValueError(f"there is no level {given['level']!r}")
    if kind in _REASONS and given["reason"] is None:
        given["reason"] = _REASONS[kind]
    return given, unfit


def _fit(fields: Iterable[str], values: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Return values by name as they are stored, and the first that does not fit and becomes null.

    Raises:
        ValueError: A required value does not fit.
    """
    given, unfit = dict[str, Any](), ""
    for field in fields:
        letter, name = field[0], field[2:].removesuffix("?")
        value = values.get(name)
        given[name] = _fitted(letter.lower(), value)
        if given[name] is None and not (letter.isupper() and value is None):
            why = f"{name} is {_shown(value)}"
            if not (letter.isupper() or field.endswith("?")):
                raise ValueError(why)
            unfit = unfit or why
        elif letter == "O" and value is not None and not _is_storable(given[name]):
            given[name], unfit = None, unfit or f"{name} holds what JSON does not"
    return given, unfit


def _shown(value: object) -> str:
    """Return a value of any size in a length that a person can read."""
    if isinstance(value, (dict, list)):
        return "an object" if isinstance(value, dict) else "an array"
    # Python does not convert longer integers to text
    if isinstance(value, int) and not -(10**30) < value < 10**30:
        return "a number of more than 30 digits"
    return repr(value)[:80]


def _is_storable(value: dict[str, Any]) -> bool:
    try:
        _require_shallow(value)
        _text(value).encode()
    except (ValueError, RecursionError):
        return False
    return True


def _require_shallow(value: object) -> None:
    """Refuse objects and arrays that are nested too deeply for readers of states.

    Raises:
        ValueError: There are more than 100 levels.
    """
    level: list[Any] = [value]
    for _ in range(_LIMITS.depth):
        inner: list[Any] = []
        for each in level:
            is_object = isinstance(each, dict)
            items: Iterable[Any] = cast("dict[str, Any]", each).values() if is_object else each
            inner += [item for item in items if isinstance(item, (dict, list))]
        if not (level := inner):
            return
    raise ValueError(f"more than {_LIMITS.depth} objects or arrays in each other")


def _state(given: dict[str, Any], text: str, line: bytes) -> dict[str, Any]:
    """Return the state with objects for dotted names.

    Texts that were not UTF-8 count as replaced.
    """
    state = given["data"] = _nested(given["data"])
    _require_shallow(state)
    if "\ufffd" in text and line.decode("utf-8", "ignore") != text:
        given["replaced"] = (given["replaced"] or {}) | {
            name: "not UTF-8"
            for name, value in flatten(state).items()
            if isinstance(value, str) and "\ufffd" in value
        }
    return state


def _nested(state: dict[str, Any]) -> dict[str, Any]:
    """Turn `{"front.m": 1}` into `{"front": {"m": 1}}`.

    A name stays whole if its parts are taken.
    """
    if not any("." in name for name in state):
        return state
    nested: dict[str, Any] = {}
    for name, value in state.items():
        branches, leaf = _path(name)
        at = nested
        for branch in branches:
            inner: Any = at.setdefault(branch, {})
            if not isinstance(inner, dict):
                nested[name] = value
                break
            at = cast("dict[str, Any]", inner)
        else:
            at[leaf] = value
    return nested


@lru_cache(maxsize=4096)
def _path(name: str) -> tuple[list[str], str]:
    *branches, leaf = name.split(".")
    return (branches, leaf) if leaf and all(branches) else ([], name)


def _bound(kind: Kind, given: dict[str, Any]) -> tuple[Any, ...] | dict[str, Any]:
    """Return the values in the order that the statement of that kind expects."""
    if kind in _NAMED:
        return _UNGIVEN | given | {"dropped": given.get("dropped") or 0}
    if kind == "log":
        given |= {"level": find_log_level(given["level"]), "source": "controller"}
    objects = [name for name in ("data", "replaced") if given.get(name) is not None]
    texts = {name: _text(given[name]) for name in objects}
    for text in texts.values():
        if not text.isascii():
            text.encode()  # half a surrogate pair is no character
    return tuple((given | texts).values())


_text: Final[Callable[[object], str]] = json.JSONEncoder(
    ensure_ascii=False, allow_nan=False, separators=(",", ":")
).encode
