"""Takes into the database what controllers write without it: the journals of docs/journal.md.

A controller in C, or any program, appends lines to a file of its session in the data folder, and
never opens the database. Servers and commands take the lines in while it does: exactly once, as
`session.last_adopted_entry` is written in the same transaction, and in order, as the parts of a
journal are read one after the other. How far this process has read is remembered, so that nothing
is read twice; whatever else reads the same journal meanwhile, or is killed at any place, only finds
entries that are in already.

The writer holds the lock of the part that it writes. A part without one is complete: it is deleted
once it is taken in. Bridges leave journals alone, which would cost their robots time.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
import stat
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, cast

from webots_mcp import liveness, signal_register, waiting_file
from webots_mcp.connection import identify_files, in_transaction
from webots_mcp.contract import (
    CUSTOM_DATA,
    find_log_level,
    host_name,
    instance_of,
    is_extern,
    recorded_name,
)
from webots_mcp.errors import warn
from webots_mcp.naming import flatten
from webots_mcp.waiting_file import FORMAT, STATEMENTS, Entry, Kind, Taken, journal_parts

BUDGET_S: Final = 5.0  # of a question; what is left waits for the next one, and is said
LONGEST_LINE_BYTES: Final = 4_000_000
_LARGEST_PROGRAM_BYTES: Final = 100_000_000
_HEADERLESS_S: Final = 60.0  # its writer has not come to the header yet, or never will
_LAG_S: Final = 2.0  # a row that came since the question began is no delay

# The values of each kind: (n)umbers, (s)trings, (o)bjects; a capital letter: or null.
_FIELDS: Final[dict[Kind, tuple[str, ...]]] = {
    "run": ("s uuid", "S world", "N step_ms", "s reason", "n wall_time", "n sim_time"),
    "state": ("n sim_time", "n wall_time", "o data", "O replaced"),
    "event": ("n sim_time", "n wall_time", "s kind", "S name", "O data"),
    "log": ("n sim_time", "n wall_time", "s level", "S source", "s message", "S logger"),
    "run end": ("s reason", "n now", "n sim_time"),
    "session end": ("s reason", "n now", "N dropped", "S error"),
}
_NAMED: Final = ("run", "run end", "session end")  # whose values are an object, not an array
_OF_SESSION: Final = ("run", "session end")  # which name no run before their values
_TYPES: Final[dict[str, tuple[type, ...]]] = {"n": (int, float), "s": (str,), "o": (dict,)}
# Of statements, which bridges alone know.
_UNGIVEN: Final = dict.fromkeys(("rows", "monotonic", "own", "step_wait", "steps"))

_KNOWN: Final = (
    "SELECT id, robot_id, last_adopted_entry, (SELECT data FROM state WHERE run_id = "
    "(SELECT max(id) FROM run WHERE session_id = session.id) ORDER BY sim_time_s DESC, id DESC "
    "LIMIT 1), (SELECT uuid FROM run WHERE session_id = session.id ORDER BY id DESC LIMIT 1) "
    "FROM session WHERE uuid = ?"
)
_OF_BRIDGE: Final = (  # which takes in its own rows; journals know no monotonic clock
    "SELECT 1 FROM session WHERE uuid = ? AND last_seen_monotonic_s IS NOT NULL"
)
_SEEN_SESSION: Final = (
    "UPDATE session SET last_seen_wall_time_s = max(last_seen_wall_time_s, :wall), "
    "ended_wall_time_s = max(ended_wall_time_s, :wall) WHERE id = :session"
)
# Rows of a run that has ended came late: it was ended as its process was found gone.
_SEEN_RUN: Final = (
    "UPDATE run SET last_wall_time_s = max(last_wall_time_s, :wall), "
    "last_sim_time_s = max(last_sim_time_s, :sim), "
    "ended_wall_time_s = max(ended_wall_time_s, :wall), "
    "row_count = CASE WHEN ended_wall_time_s IS NULL THEN row_count + :rows ELSE "
    "purged_rows + (SELECT count(*) FROM state WHERE run_id = run.id) END WHERE uuid = :run"
)
_RUN_ID: Final = "SELECT id FROM run WHERE uuid = ?"
_HAS_RUN: Final = "SELECT 1 FROM run WHERE uuid = ?"
_COUNT_DROPPED: Final = (
    "UPDATE session SET rows_dropped = rows_dropped + ?, last_error = ? WHERE id = ?"
)
_SEEN_S: Final = "SELECT last_seen_wall_time_s FROM session WHERE uuid = ?"


class _Place(NamedTuple):
    """How far this process has read a part of a journal.

    Attributes:
        file: Its device and inode, and those of the database.
        offset: The byte after the last line.
        number: Of the last entry that is in.
        faults: Of lines that are to be counted with the next entry.
    """

    file: tuple[int, ...]
    offset: int
    number: int
    faults: tuple[str, ...] = ()


class _Line(NamedTuple):
    """A complete line: the byte after it, its entry, the state in it, and what does not fit."""

    end: int
    entry: Entry | None
    state: dict[str, Any] | None = None
    fault: str = ""


class _Looks:
    """What is looked for in the states of a session."""

    def __init__(self, newest: str | None, run: str | None) -> None:
        self.run = run
        self.names = signal_register.SignalNames()
        self.changes = signal_register.StateChanges()
        self.changes.look(json.loads(newest or "{}"))


_lock = threading.Lock()
_places: dict[Path, _Place] = {}
_looks: dict[str, _Looks] = {}
_left: dict[Path, str] = {}  # complete parts of which nothing could be taken in, and why


def journals_left(database: Path) -> dict[Path, str]:
    """The complete journals of which this process could take in nothing, and why; they stay."""
    return {path: why for path, why in _left.items() if path.parent == database.parent}


def has_news(database: Path) -> bool:
    """Whether a journal next to a database has bytes that this process has not taken in."""
    for path in (path for parts in journal_parts(database).values() for path in parts):
        with suppress(OSError):
            status, place = path.stat(), _places.get(path)
            if place is None or place[:2] != (_identity(status, database), status.st_size):
                return True
    return False


def journals_behind(connection: sqlite3.Connection, database: Path) -> list[str]:
    """The journals of which rows are not in the database, although there was time."""
    behind: list[str] = []
    for uuid, parts in journal_parts(database).items():
        (seen_s,) = connection.execute(_SEEN_S, (uuid,)).fetchone() or (0.0,)
        with suppress(OSError):
            if parts[-1].stat().st_mtime > seen_s + _LAG_S:
                behind.append(parts[-1].name)
    return behind


def _identity(status: os.stat_result, database: Path) -> tuple[int, ...]:
    return (status.st_dev, status.st_ino, *identify_files(database)[:2])


def take_in_journals(
    connection: sqlite3.Connection, database: Path, budget_s: float = math.inf
) -> None:
    """Take in what controllers have written up to now, as far as there is time.

    Args:
        connection: A writer in autocommit mode and in no transaction.
        database: Its file.
        budget_s: Of wall time.

    Raises:
        sqlite3.Error: The database is locked; what is in is in, the rest waits.
    """
    until_s = time.monotonic() + budget_s
    with _lock:
        journals = journal_parts(database)
        for path in _places.keys() - {path for parts in journals.values() for path in parts}:
            if path.parent == database.parent:
                del _places[path]
        for path in _left.keys() - {path for parts in journals.values() for path in parts}:
            if path.parent == database.parent:
                del _left[path]
        for uuid, parts in journals.items():
            # In order, and no part before those ahead of it are in: of its entries only those that
            # are newer than the last one that is in are taken.
            all(_take_in_part(connection, database, uuid, path, until_s) for path in parts)
            if time.monotonic() > until_s:
                return


def _take_in_part(
    connection: sqlite3.Connection, database: Path, uuid: str, path: Path, until_s: float
) -> bool:
    """Take in a part, and delete it if it is complete; False where some of it is left."""
    try:
        with path.open("r+b") as file:
            status = os.fstat(file.fileno())
            header = waiting_file.read_header(file)
            if header is None and time.time() - status.st_mtime < _HEADERLESS_S:
                return False
            # First of all: what is written after the last look would be deleted unread.
            is_complete = waiting_file.lock(file.fileno())
            if header is not None and status.st_nlink:
                identity = _identity(status, database)
                reading = _Reading(connection, uuid, path, file, identity, not is_complete)
                if not reading.take_in(header, until_s):
                    return False
                if is_complete and not reading.settle_faults():
                    return True
            if is_complete and os.name != "nt":
                path.unlink()
        if is_complete and os.name == "nt":  # where an open file cannot be deleted
            path.unlink()
    except FileNotFoundError:  # another process has taken in all of it
        return True
    except Exception as error:  # noqa: BLE001  (raised again where it is not the file's)
        _looks.pop(uuid, None)
        waiting_file.report_strange(path, error)
        _left[path] = str(error) or repr(error)
        return False
    return True


@dataclass
class _Reading:
    """Reads one part of a journal into the database."""

    connection: sqlite3.Connection
    uuid: str
    path: Path
    file: BinaryIO
    identity: tuple[int, ...]
    is_living: bool
    faults: tuple[str, ...] = ()

    def take_in(self, header: dict[str, Any], until_s: float) -> bool:
        """Take in all complete lines from where it was left; False where time is up."""
        start = self.file.tell()
        session_id, robot_id, number, *newest = self._enter(header)
        place = _places.get(self.path)
        if place is None or place.file != self.identity or place.number > number:
            place = _Place(self.identity, _skip(self.file, start, number), number)
            _looks[self.uuid] = _Looks(*newest)  # another process may have read on meanwhile
        looks = _looks.get(self.uuid) or _looks.setdefault(self.uuid, _Looks(*newest))
        while lines := _read_lines(self.file, place.offset):
            self.faults = place.faults
            if entries := [each.entry for each in lines if each.entry]:
                self._make_missing_runs(session_id, place.number, entries)
                finish = partial(self._finish, session_id, robot_id, looks, lines)
                taken = waiting_file.take_in(self.connection, session_id, entries, finish)
                done = _until(lines, taken.number)[-1].end
                place = _Place(self.identity, done, taken.number, self.faults)
            else:
                faults = (*self.faults, *(each.fault for each in lines if each.fault))
                place = place._replace(offset=lines[-1].end, faults=faults)
            _places[self.path] = place
            if time.monotonic() > until_s:
                return False
        _places[self.path] = place
        self.faults = place.faults
        return True

    def settle_faults(self) -> bool:
        """Count what no later entry has counted; False where nothing of the session fits."""
        if not self.faults:
            return True
        session_id, _, number, *_ = self.connection.execute(_KNOWN, (self.uuid,)).fetchone()
        why = f"{len(self.faults)} lines of {self.path.name} do not fit: {self.faults[0]}"
        if not number:
            if self.path not in _left:
                warn(f"{why}; as nothing of it could be taken in, the file stays")
            _left[self.path] = why
            return False
        warn(why)
        self.connection.execute(_COUNT_DROPPED, (len(self.faults), why, session_id))
        return True

    def _make_missing_runs(self, session_id: int, number: int, entries: Sequence[Entry]) -> None:
        """Make the runs whose own line did not fit, from the first row that is of them."""
        told: set[object] = set()
        for entry in entries:
            if isinstance(entry.values, dict):
                told.add(entry.values.get("uuid"))
            elif entry.number > number and entry.run not in told:
                told.add(entry.run)
                if self.connection.execute(_HAS_RUN, (entry.run,)).fetchone() is None:
                    in_transaction(self.connection, partial(self._make_run, session_id, entry))

    def _make_run(self, session_id: int, entry: Entry) -> None:
        sim_time_s, wall_time_s, *_ = cast("tuple[Any, ...]", entry.values)
        known = {"uuid": entry.run, "world": None, "step_ms": None, "reason": "start"}
        times = {"wall_time": wall_time_s, "sim_time": sim_time_s, "session": session_id}
        self.connection.execute(STATEMENTS["run"], known | times)
        liveness.end_runs(self.connection, session_id, "reset", cast("str", entry.run))

    def _enter(self, header: dict[str, Any]) -> tuple[Any, ...]:
        """The ids of session and robot, the number of the last entry, newest state and run."""
        connection = self.connection
        if connection.execute(_OF_BRIDGE, (self.uuid,)).fetchone():
            raise ValueError("its session is that of a bridge")
        if (known := connection.execute(_KNOWN, (self.uuid,)).fetchone()) is not None:
            return known
        name, session = _described(header, self.uuid)

        def act() -> None:
            if connection.execute(_KNOWN, (self.uuid,)).fetchone() is None:
                liveness.reap(connection, time.time())
                wanted = recorded_name(name)
                free = liveness.free_name(connection, wanted, lambda it: it.kind == CUSTOM_DATA)
                robot = {"name": free, "kind": "Robot", "devices": "{}"}
                now_s = session["started_wall_time_s"]
                robot_id = waiting_file.enter_robot(connection, robot, now_s)
                waiting_file.enter_session(connection, robot_id, session)

        in_transaction(connection, act)
        return connection.execute(_KNOWN, (self.uuid,)).fetchone()

    def _finish(
        self,
        session_id: int,
        robot_id: int,
        looks: _Looks,
        lines: Sequence[_Line],
        taken: Taken,
    ) -> None:
        """Write what follows: names, changes, times, ends of runs, what was dropped."""
        written = {entry.number for entry in taken.written}
        faults = [*self.faults, *taken.unfit]
        runs, ends = dict[str, tuple[float, float, int]](), dict[Kind, dict[str, Any]]()
        last: Entry | None = None
        for _, entry, state, fault in _until(lines, taken.number):
            if entry is None or entry.number in written:
                faults += [fault] * bool(fault)
            if entry is None:
                continue
            if entry.run not in (None, looks.run):  # the line of its run did not fit
                looks.run = entry.run
                looks.changes.forget()
            if isinstance(entry.values, dict) and entry.values.get("uuid", looks.run) != looks.run:
                looks.run = entry.values["uuid"]
                looks.changes.forget()
            changed = looks.changes.look(state) if state is not None else ()
            if entry.number not in written:  # taken in by another process, or refused
                continue
            if isinstance(entry.values, dict):  # a run or an end, after which others are over
                ends[entry.kind] = entry.values
                continue
            last, run = entry, entry.run or ""
            sim_time_s, wall_time_s, *_ = entry.values
            _, _, rows = runs.get(run, (0.0, 0.0, 0))
            seen_s = min(wall_time_s, time.time())  # what is dated later than now was seen now
            runs[run] = sim_time_s, seen_s, rows + (entry.kind == "state")
            if state is not None:
                looks.names.look(state, entry.values[2], partial(self._enter_names, robot_id))
            for name, before, after in changed:
                data = json.dumps({"from": before, "to": after}, ensure_ascii=False)
                self._event(entry, "change", name[:200], data)
        for run, (sim, wall, rows) in runs.items():
            values = {"run": run, "sim": sim, "wall": wall, "rows": rows, "session": session_id}
            self.connection.execute(_SEEN_RUN, values)
            self.connection.execute(_SEEN_SESSION, values)
        if begun := ends.get("run"):
            liveness.end_runs(self.connection, session_id, "reset", begun["uuid"])
        if end := ends.get("session end"):
            liveness.end_runs(self.connection, session_id, end["reason"])
        self.faults = () if last else tuple(faults)
        if faults and last:
            data = {"row_count": len(faults), "why": f"{self.path.name}: {faults[0]}"}
            self._event(last, "dropped", None, json.dumps(data))

    def _enter_names(self, robot_id: int, seen: Mapping[str, signal_register.Seen]) -> bool:
        changes = signal_register.find_changes(self.connection, robot_id, seen)
        signal_register.write_changes(self.connection, robot_id, changes)
        return True

    def _event(self, entry: Entry, kind: str, name: str | None, data: str) -> None:
        (run_id,) = self.connection.execute(_RUN_ID, (entry.run,)).fetchone()
        values = (run_id, *cast("tuple[Any, ...]", entry.values)[:2], kind, name, data)
        self.connection.execute(STATEMENTS["event"], values)


def _described(header: Mapping[str, Any], uuid: str) -> tuple[str, dict[str, Any]]:
    """The robot's name and the values of the session, from the first line of a journal.

    Raises:
        ValueError: It lacks what a session needs.
    """
    name, session = _object(header.get("robot")).get("name"), _object(header.get("session"))
    pid, started_s = session.get("pid"), session.get("started_wall_time_s")
    if not (name and _is("s", name) and session.get("uuid") == uuid):
        raise ValueError("its first line has no robot.name, or another session.uuid than its name")
    if not (_is("n", pid) and _is("n", started_s)):
        raise ValueError("its first line has no session.pid or no session.started_wall_time_s")
    texts = {key: value for key, value in session.items() if _is("s", value)}
    given = _object(session.get("environment"))
    environment = {key: value for key, value in given.items() if _is("s", value)}
    host, parent = texts.get("host", host_name()), cast("int", session.get("parent_pid"))
    is_here, file = host == host_name(), texts.get("controller")
    pid, started_s = cast("int", pid), cast("float", started_s)
    lives = liveness.process_alive(pid, None, started_s)  # of one that is gone none can tell it
    return cast("str", name), {
        "uuid": uuid,
        "pid": pid,
        "process": liveness.process_identity(pid) if is_here and lives else None,
        "host": host,
        "instance": instance_of(environment, parent) if is_here else f"{host} process {parent}",
        "extern": int(is_extern(environment)),
        "controller": file,
        "controller_sha256": _sha256(file, started_s) if is_here and file else None,
        "versions": json.dumps({"journal": str(FORMAT)} | _object(session.get("versions"))),
        "supervisor": 0,
        "actions": "{}",
        "started_wall_time_s": min(started_s, time.time()),
        "last_seen_wall_time_s": min(started_s, time.time()),
        "throttle_interval": session.get("throttle_interval"),
    }


def _object(value: object) -> dict[str, Any]:
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {}


def _sha256(file: str, started_s: float) -> str | None:
    """Of the program, if it is still the one that was started."""
    with suppress(OSError, ValueError):
        status = Path(file).stat()
        is_program = stat.S_ISREG(status.st_mode) and status.st_size <= _LARGEST_PROGRAM_BYTES
        if is_program and status.st_mtime <= started_s:
            return sha256(Path(file).read_bytes()).hexdigest()
    return None


# -- lines -----------------------------------------------------------------------------------------


def _until(lines: Sequence[_Line], number: int) -> Sequence[_Line]:
    """The lines up to the last entry of no higher number."""
    ends = [i for i, each in enumerate(lines, 1) if each.entry and each.entry.number <= number]
    return lines[: ends[-1]]


def _skip(file: BinaryIO, offset: int, number: int) -> int:
    """The byte after the last entry of no higher number, from that byte on."""
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
    """The next complete lines from that byte on; one that is too long comes in pieces."""
    lines: list[_Line] = []
    file.seek(offset)
    while len(lines) < waiting_file.ENTRIES_AT_ONCE:
        line = file.readline(LONGEST_LINE_BYTES)
        if not line.endswith(b"\n") and len(line) < LONGEST_LINE_BYTES:
            break  # the rest of it may come
        offset += len(line)
        lines.append(_line(line, offset))
    return lines


def _line(line: bytes, end: int) -> _Line:
    """What a line says: an entry, or why it is none."""
    text = line.decode("utf-8", "replace").lstrip("\ufeff")  # as some editors begin a file
    if not text.strip():
        return _Line(end, None)
    try:
        number, kind, run, values = json.loads(text)
        if not (type(number) is int and 0 < number < 1 << 63):
            raise ValueError("its number is none")
        if kind not in _FIELDS:
            raise ValueError(f"there is no kind {kind!r}")
        if not (run is None if kind in _OF_SESSION else _is("s", run)):
            raise ValueError(f"its run is {run!r}")
        given, faults = _checked(kind, values)
        if "\\ud" in text.lower():  # half a character is none
            json.dumps(given, ensure_ascii=False).encode()
        state = _state(given, text, line) if kind == "state" else None
        entry = Entry(number, kind, run, _bound(kind, given))
    except (ValueError, TypeError, ArithmeticError, RecursionError) as error:
        return _Line(end, None, fault=f"{text[:60]!r}: {error}"[:300])
    fault = f"{text[:60]!r}: {'; '.join(faults)}"[:300] if faults else ""
    return _Line(end, entry, state, fault)


def _is(letter: str, value: object) -> bool:
    """Whether a value is of a type of `_FIELDS`, and if it is a number, one that SQLite holds."""
    if isinstance(value, bool) or not isinstance(value, _TYPES[letter]):
        return False
    if isinstance(value, int):
        return -(1 << 63) <= value < 1 << 63
    return letter != "n" or math.isfinite(cast("float", value))


def _fits_where_null_would(letter: str, value: object) -> bool:
    """Whether it can be stored, by its characters and the numbers in it too."""
    if not _is(letter, value):
        return False
    try:
        _text(value).encode()
    except (ValueError, RecursionError):  # half a character, a NaN
        return False
    return True


def _checked(kind: Kind, values: Any) -> tuple[dict[str, Any], list[str]]:
    """The values of an entry by their names, and which do not fit and are null instead.

    Those that may be null may be left out.

    Raises:
        ValueError: One that may not be null is missing, or of another type, or there are too many.
    """
    fields = [(field[0], field[2:]) for field in _FIELDS[kind]]
    if kind not in _NAMED:
        if not isinstance(values, list) or len(cast("list[Any]", values)) > len(fields):
            raise ValueError(f"its values are no array of at most {len(fields)}")
        values = dict(zip((name for _, name in fields), cast("list[Any]", values), strict=False))
    given = {name: _object(values).get(name) for _, name in fields}
    faults: list[str] = []
    for letter, name in fields:
        value = given[name]
        if letter.isupper():
            if value is not None and not _fits_where_null_would(letter.lower(), value):
                faults.append(f"{name} is {str(value)[:60]!r}")
                given[name] = None
        elif not _is(letter, value):
            if (kind, name) != ("run", "reason"):
                raise ValueError(f"{name} is {value!r}")
            faults.append(f"{name} is {value!r}, taken as 'start'")
            given[name] = "start"
    if kind == "log" and find_log_level(given["level"]) is None:
        raise ValueError(f"there is no level {given['level']!r}")
    return given, faults


def _state(given: dict[str, Any], text: str, line: bytes) -> dict[str, Any]:
    """The state, with objects for dotted names; texts that were no UTF-8 are named as replaced."""
    state = given["data"] = _nested(given["data"])
    if "\ufffd" in text and line.decode("utf-8", "ignore") != text:
        given["replaced"] = (given["replaced"] or {}) | {
            name: "not UTF-8"
            for name, value in flatten(state).items()
            if isinstance(value, str) and "\ufffd" in value
        }
    return state


def _nested(state: dict[str, Any]) -> dict[str, Any]:
    """`{"front.m": 1}` as `{"front": {"m": 1}}`; a name stays whole where its parts are taken."""
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
    """The values as the statement of that kind takes them."""
    if kind in _NAMED:
        return _UNGIVEN | given | {"dropped": given.get("dropped") or 0}
    if kind == "log":
        given |= {"level": find_log_level(given["level"]), "source": "controller"}
    objects = [name for name in ("data", "replaced") if given.get(name) is not None]
    return tuple((given | {name: _text(given[name]) for name in objects}).values())


_text: Final[Callable[[object], str]] = json.JSONEncoder(
    ensure_ascii=False, allow_nan=False, separators=(",", ":")
).encode
